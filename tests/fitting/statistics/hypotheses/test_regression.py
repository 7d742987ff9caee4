"""Hypotheses H10 and H11: resonances straight from factors."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime, least_squares
from scipy.stats import special_ortho_group

from fitting.errors import FitInputError
from fitting.statistics.factors import orthonormal
from fitting.statistics.hypotheses import regression
from fitting.statistics.hypotheses.regression import (
    drying_design,
    regress_on_factors,
    regress_with_drying,
)

C10, C20, C30, C22 = 1.0, -2.2, 0.8, 0.6


@pytest.fixture(scope="module")
def factors():
    return orthonormal(np.random.default_rng(8).standard_normal((55, 4)))


@pytest.fixture(scope="module")
def dried(factors, noisy):
    """Resonances that H11 describes exactly, as many missing as in Table 1, by its formula."""
    g1, g2, g3, g4 = factors.T
    one = np.ones(55)
    a = np.stack([one, g1, g2, g3])
    b = np.stack([one, C10 + g1, C20 + C22 * (g2 + g4), C30 + g3])
    hat = 30 * np.random.default_rng(9).standard_normal((11, 4))
    hat[:, 0] += 3000
    cents = np.stack([(hat @ a).T, (hat @ b).T], axis=1)
    return np.where(np.isnan(noisy.observed_cents), np.nan, cents), hat


def test_h10_is_a_regression_of_each_mode_in_each_series(noisy, factors):
    found = regress_on_factors(noisy.observed_cents, factors)
    assert found.free_weights == 110
    assert found.weights.shape == (2, 11, 5)
    design = np.column_stack([np.ones(55), factors])
    np.testing.assert_array_equal(np.isnan(found.residual_cents), np.isnan(noisy.observed_cents))
    for series in range(2):
        for mode in range(11):
            left = found.residual_cents[:, series, mode]
            # Normal equations: the residuals have nothing in common with what explains them.
            assert np.nan_to_num(left) @ design == pytest.approx(np.zeros(5), abs=1e-8)
            computed = design @ found.weights[series, mode]
            seen = ~np.isnan(left)
            np.testing.assert_allclose(
                (noisy.observed_cents[:, series, mode] - computed)[seen], left[seen]
            )


def test_h10_needs_no_orientation_of_the_factors(noisy, factors):
    turn = special_ortho_group.rvs(4, random_state=1)
    one, other = (regress_on_factors(noisy.observed_cents, f) for f in (factors, factors @ turn))
    np.testing.assert_allclose(one.residual_cents, other.residual_cents, atol=1e-8)


def test_h11_comes_back_from_factors_as_they_are(dried, factors):
    cents, hat = dried
    found = regress_with_drying(cents, factors)
    assert found.rmsd_cents < 1e-8
    assert (len(found.coefficients), found.free_weights) == (4, 44)
    # Turning g1 and g3 into each other is left free; nothing else.
    c = found.coefficients
    assert (c["c20"], c["c22"]) == pytest.approx((C20, C22))
    assert np.hypot(c["c10"], c["c30"]) == pytest.approx(np.hypot(C10, C30))
    np.testing.assert_allclose(found.rotation[[1, 3]], np.eye(4)[[1, 3]], atol=1e-7)
    assert found.rotation[np.ix_([0, 2], [0, 2])].trace() > 1.9
    np.testing.assert_allclose(found.weights[0, :, 0], hat[:, 0], atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_h11_finds_drying_in_factors_turned_any_way(dried, factors, seed):
    cents, _ = dried
    turn = special_ortho_group.rvs(4, random_state=seed)
    found = regress_with_drying(cents, factors @ turn)
    assert found.rmsd_cents < 1e-6
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(4), atol=1e-12)
    sign = np.sign(found.rotation[3] @ turn[3])
    np.testing.assert_allclose(found.rotation[[1, 3]], sign * turn[[1, 3]], atol=1e-6)
    assert found.coefficients["c22"] == pytest.approx(C22)


@pytest.mark.parametrize("seed", range(3))
def test_h11_of_noisy_reeds_does_not_depend_on_the_orientation(noisy, factors, seed):
    turn = special_ortho_group.rvs(4, random_state=seed)
    e = noisy.components
    one, other = (regress_with_drying(noisy.observed_cents, f) for f in (e, e @ turn))
    np.testing.assert_allclose(one.residual_cents, other.residual_cents, atol=1e-4)
    np.testing.assert_allclose(other.rotation @ other.rotation.T, np.eye(4), atol=1e-12)
    design = np.column_stack([np.ones(55), e @ turn])
    computed = np.einsum("smk,nk->nsm", other.weights, design)
    np.testing.assert_allclose(noisy.observed_cents - computed, other.residual_cents, atol=1e-8)


def test_h11_is_a_special_case_of_h10(noisy):
    e = noisy.components
    h10 = regress_on_factors(noisy.observed_cents, e)
    h11 = regress_with_drying(noisy.observed_cents, e)
    assert h10.rmsd_cents < h11.rmsd_cents < 1.1 * h10.rmsd_cents
    # Drawn from H4, whose drying is in e4 and lowers e2 by two standard deviations.
    assert h11.rotation[3, 3] > 0.97
    assert -3 < h11.coefficients["c20"] < -1.5
    assert h11.coefficients["c10"] > 0


@pytest.mark.parametrize("signs", [(1, 1, 1, 1), (1, -1, 1, -1), (-1, 1, 1, -1), (1, -1, -1, 1)])
def test_h11_keeps_the_sign_of_the_second_factor(noisy, signs):
    found = regress_with_drying(noisy.observed_cents, noisy.components * signs)
    assert found.rotation[1, 1] > 0.9
    assert abs(found.rotation[3, 3]) > 0.9
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_h11_takes_few_steps(noisy, monkeypatch):
    """Slopes without the projection lead to the same minimum, in hundreds of steps."""
    searches = []

    def spy(*arguments, **settings):
        searches.append(least_squares(*arguments, **settings))
        return searches[-1]

    monkeypatch.setattr(regression, "least_squares", spy)
    regress_with_drying(noisy.observed_cents, noisy.components)
    assert searches[0].success
    assert searches[0].nfev < 20


def test_h11_stands_at_a_minimum(noisy):
    """Coefficients and angles moved one by one, the weights fitted again each time."""
    e, modes = noisy.components, noisy.observed_cents.reshape(110, 11).T
    found = regress_with_drying(noisy.observed_cents, e)

    def squares(at):
        design, _ = drying_design(at, e, found.rotation)
        sums = [
            np.linalg.lstsq(design[~np.isnan(mode)], mode[~np.isnan(mode)], rcond=None)[1]
            for mode in modes
        ]
        return np.sum(sums)

    at = np.array([*found.coefficients.values(), *np.zeros(5)])
    best = squares(at)
    assert best == pytest.approx(np.nansum(found.residual_cents**2))
    for step in 1e-2 * np.eye(9):
        assert min(squares(at + step), squares(at - step)) > best


def test_slopes_of_the_design_are_those_of_differences(factors):
    rng = np.random.default_rng(3)
    base = special_ortho_group.rvs(4, random_state=5)
    at = rng.standard_normal(9)
    jacobian = drying_design(at, factors[:5], base)[1]
    numeric = approx_fprime(at, lambda x: drying_design(x, factors[:5], base)[0].ravel(), 1e-7)
    np.testing.assert_allclose(jacobian.reshape(9, -1), numeric.T, atol=1e-5)


def test_what_cannot_be_regressed_is_refused(noisy, factors):
    observed = noisy.observed_cents
    with pytest.raises(FitInputError, match="do not belong together"):
        regress_on_factors(observed, factors[:54])
    with pytest.raises(FitInputError, match="H11 needs 4 factors"):
        regress_with_drying(observed, factors[:, :3])
    few = observed.copy()
    few[4:, 1, 2] = np.nan
    with pytest.raises(FitInputError, match="identified on 4 reeds only"):
        regress_on_factors(few, factors)
