"""Fits and evidence compared with integrals that can be done by hand."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from diagnosis.inference.estimation import (
    absorbed_part,
    fit,
    marginalised_signature,
    posterior_covariance,
    random_starts,
    residual_covariance,
)
from physics.errors import ImpossibleReedError


def linear(seed: int, n: int = 12, p: int = 3):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((n, p)), rng.standard_normal(n)


def test_evidence_of_a_linear_model_is_exact() -> None:
    J, y = linear(1)
    found = fit(lambda z: J @ z - y, [False] * 3, [np.zeros(3)])
    exact = multivariate_normal(np.zeros(12), np.eye(12) + J @ J.T).logpdf(y)
    assert found.log_evidence - 6 * np.log(2 * np.pi) == pytest.approx(exact, abs=1e-5)
    posterior = np.linalg.solve(np.eye(3) + J.T @ J, J.T @ y)
    np.testing.assert_allclose(found.z, posterior, atol=1e-4)


def test_evidence_with_a_bound_is_that_of_half_a_gaussian() -> None:
    # One number y of a size that cannot be negative: ∫₀^∞ N(y; z, 1) 2 N(z; 0, 1) dz.
    for y in (-3.0, 0.2, 4.0):
        found = fit(lambda z, y=y: z - y, [True], [np.array([0.5])])
        exact = norm(0, np.sqrt(2)).logpdf(y) + np.log(2 * norm.cdf(y / np.sqrt(2)))
        assert found.log_evidence - 0.5 * np.log(2 * np.pi) == pytest.approx(exact, abs=1e-3)
        assert found.z[0] == pytest.approx(max(y / 2, 0.0), abs=1e-3)


def test_a_fit_is_certified_only_where_two_searches_agree() -> None:
    # A valley near 0 and a deeper one near 3, with a ridge between them.
    def residuals(z):
        return np.array([12 * np.sin(np.pi * z[0] / 3), 3 * (z[0] - 3)])

    alone = fit(residuals, [False], [np.array([3.1]), np.array([-0.1])])
    assert alone.z[0] == pytest.approx(3.0, abs=0.1)
    assert not alone.converged
    together = fit(residuals, [False], [np.array([3.1]), np.array([2.9])])
    assert together.converged


def test_impossible_starts_are_left_out_and_none_is_an_error() -> None:
    def residuals(z):
        if z[0] < 0:
            raise ImpossibleReedError("no such reed")
        return z - 1.0

    found = fit(residuals, [False], [np.array([-1.0]), np.array([0.5])])
    assert found.z[0] == pytest.approx(0.5)
    with pytest.raises(ImpossibleReedError, match="no such reed"):
        fit(residuals, [False], [np.array([-1.0])])


def test_starts_obey_bounds_and_begin_where_asked() -> None:
    first = np.array([2.0, -1.0])
    starts = random_starts(50, [True, False], np.random.default_rng(0), first)
    assert len(starts) == 50
    np.testing.assert_array_equal(starts[0], first)
    assert min(start[0] for start in starts[1:]) >= 0
    assert min(start[1] for start in starts[1:]) < 0


def test_what_parameters_take_up_and_leave_is_that_of_the_joint_gaussian() -> None:
    S, y = linear(4, n=9, p=3)
    # Residuals are noise and what parameters of unit priors move: covariance I + S Sᵀ.
    whole = np.eye(9) + S @ S.T
    np.testing.assert_allclose(
        posterior_covariance(S), np.eye(3) - S.T @ np.linalg.solve(whole, S), atol=1e-12
    )
    left = np.linalg.solve(whole, y)
    np.testing.assert_allclose(y - absorbed_part(S, y), left, atol=1e-12)
    some = slice(2, 6)
    np.testing.assert_allclose(
        residual_covariance(S, some), np.linalg.inv(whole)[some, some], atol=1e-12
    )


def test_what_stands_out_costs_its_square() -> None:
    S, _ = linear(5, n=9, p=3)
    moved = np.random.default_rng(6).standard_normal((9, 2))
    out = marginalised_signature(S, moved)
    for k in range(2):
        # The least cost of residuals that move so, over all sizes of the parameters.
        found = fit(lambda z, k=k: moved[:, k] - S @ z, [False] * 3, [np.zeros(3)])
        assert out[:, k] @ out[:, k] == pytest.approx(found.cost, rel=1e-6)
    assert out[:, 0] @ out[:, 1] == pytest.approx(
        moved[:, 0] @ np.linalg.solve(np.eye(9) + S @ S.T, moved[:, 1])
    )


def test_a_defect_of_the_model_is_not_taken_for_an_impossible_reed() -> None:
    def residuals(z):
        return np.ones(3) + np.ones(2) if z[0] > 0.2 else z - 1.0

    with pytest.raises(ValueError, match="broadcast"):
        fit(residuals, [False], [np.array([0.0])])
