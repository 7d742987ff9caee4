"""Tests of what is known of a drive before a fit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, optimize, stats

from fitting.modal.drive.prior import (
    HELD_LEVEL,
    LEAST_GAIN,
    DrivePrior,
    KnownMagnitude,
    _size_equations,
    _Splitting,
    drive_prior,
    found_gain,
    found_ripple,
    quiet_ripple,
    strong_ripple,
)

DOF = 4.0
HZ = np.geomspace(1400, 20000, 184)
NONE = np.zeros(len(HZ))


def log_density(magnitude, variance, gain):
    """Log density of one magnitude, by integration over its scatter."""

    def both(scatter):
        smooth = stats.norm.pdf(magnitude - scatter, 0, np.sqrt(variance))
        return smooth * stats.t.pdf(scatter / gain, DOF) / gain

    edges = [0, magnitude]
    return np.log(integrate.quad(both, -4, 4, points=edges, limit=2000)[0])


def test_cost_and_volume_are_the_density_whatever_covariance_gain_and_magnitude():
    off = []
    for magnitude, variance, gain in [
        (0.0, 0.01, 0.003), (0.05, 0.01, 0.003), (0.5, 0.01, 0.003), (0.5, 0.0625, 0.003),
        (0.5, 0.01, 0.1), (0.0, 0.01, 0.1),
    ]:  # fmt: skip
        prior = drive_prior(np.array([magnitude]), np.array([[variance]]), np.zeros(1), gain, DOF)
        found = 0.5 * (prior.log_volume - prior.cost)
        off.append(found - log_density(magnitude, variance, gain))
    # A constant is left out. Laplace's method is off by less than a quarter of a neper.
    assert np.ptp(off) < 0.25


@pytest.mark.parametrize("gain", [LEAST_GAIN, 0.02, 0.1])
@pytest.mark.parametrize("outliers", [0, 12])
def test_a_magnitude_is_split_where_it_costs_least(gain, outliers):
    rng = np.random.default_rng(outliers)
    covariance = quiet_ripple(HZ).covariance
    smooth = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(HZ))) @ rng.standard_normal(len(HZ))
    scatter = gain * rng.standard_t(DOF, len(HZ))
    scatter[rng.choice(len(HZ), outliers, replace=False)] += 0.3
    magnitude = smooth + scatter
    prior = drive_prior(magnitude, covariance, NONE, gain, DOF)
    weighted = np.linalg.solve(covariance, magnitude - prior.scatter)
    # Where both forces are equal, nothing is gained by moving a part of one into the other.
    forces = (DOF + 1) * prior.scatter / (DOF * gain**2 + prior.scatter**2)
    assert prior.gradient == pytest.approx(-forces, abs=1e-4 / gain)
    assert weighted == pytest.approx(forces, abs=1e-2 / gain)
    for direction in rng.standard_normal((3, len(HZ))):
        step = 1e-5 * gain * direction
        costs = [
            drive_prior(magnitude + sign * step, covariance, prior.scatter, gain, DOF).cost
            for sign in (1, -1)
        ]
        slope = (costs[0] - costs[1]) / 4
        size = np.linalg.norm(prior.gradient) * np.linalg.norm(step)
        assert slope == pytest.approx(-prior.gradient @ step, abs=1e-3 * size)


def test_a_step_next_to_a_singular_matrix_is_a_step_without_a_warning():
    """Where the cost bends downwards: here 1 + Σ bend is 0 but for rounding."""
    splitting = _Splitting(np.ones(2), np.ones((2, 2)), LEAST_GAIN, DOF)
    step = splitting.step(np.array([-0.5, -0.5 * (1 - 1e-16)]), np.array([1.0, 2.0]))
    assert np.isfinite(step).all()


def test_the_scatter_of_holograms_is_found_around_a_smooth_drive():
    rng = np.random.default_rng(1)
    covariance = quiet_ripple(HZ).covariance
    smooth = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(HZ))) @ rng.standard_normal(len(HZ))
    for gain in (0.005, 0.02):
        magnitude = smooth + gain * rng.standard_normal(len(HZ))
        assert found_gain(magnitude, covariance, NONE, 0.1, DOF) == pytest.approx(gain, rel=0.3)
    assert found_gain(smooth, covariance, NONE, 0.1, DOF) == LEAST_GAIN


NOISE = 0.01
# A pole with a notch, of quality 20 and 6 dB.
POLE_HZ, QUALITY = 5000.0, 20.0
POLE = np.log(np.abs(1 + 0.05 / (1 - (HZ / POLE_HZ) ** 2 + 1j * HZ / POLE_HZ / QUALITY)))


def known(magnitude, noise=NOISE):
    return KnownMagnitude(np.eye(len(HZ)) / noise**2, magnitude / noise**2)


def ripple_of(magnitude):
    start = strong_ripple(quiet_ripple(HZ))
    return found_ripple(start, known(magnitude), LEAST_GAIN, DOF)


def far_from_pole(ripple):
    nodes = np.linspace(np.log(HZ[0]), np.log(HZ[-1]), len(ripple.log_size))
    return np.abs(nodes - np.log(POLE_HZ)) > 0.3


def test_ripple_is_found_where_the_pole_of_a_chamber_is_and_nowhere_else():
    rng = np.random.default_rng(2)
    found = ripple_of(POLE + NOISE * rng.standard_normal(len(HZ))).ripple
    size, far = np.exp(found.log_size), far_from_pole(found)
    # The pole is 0.69 nepers high, and data sheets have 0.1.
    assert size[~far].max() > 0.3
    assert size[far].max() < 0.1


def test_the_found_size_is_that_of_the_drive():
    rng = np.random.default_rng(3)
    ripple = quiet_ripple(HZ)
    for size in (0.05, 0.2, 0.8):
        drawn = replace(ripple, log_size=np.full_like(ripple.log_size, np.log(size)))
        root = np.linalg.cholesky(drawn.finer + 1e-9 * np.eye(len(HZ)))
        found = ripple_of(
            root @ rng.standard_normal(len(HZ)) + NOISE * rng.standard_normal(len(HZ))
        )
        off = found.ripple.log_size - np.log(size)
        pulls = off / np.sqrt(np.diag(found.covariance))
        # 23 nodes: a χ² of 23 with its 0.1 % limits.
        assert 7 < np.sum(pulls**2) < 50


def test_the_sizes_maximise_the_density_of_magnitudes():
    """Compared with the normal density itself, integrated by no formula of the fit."""
    rng = np.random.default_rng(4)
    magnitude = POLE + NOISE * rng.standard_normal(len(HZ))
    scatter = np.full(len(HZ), LEAST_GAIN**2)
    start = strong_ripple(quiet_ripple(HZ))
    # A Student distribution of many degrees of freedom is normal, and its variance known.
    found = found_ripple(start, known(magnitude), LEAST_GAIN, 1e9).ripple

    def density(node, log_size):
        sizes = found.log_size.copy()
        sizes[node] = log_size
        covariance = replace(found, log_size=sizes).covariance
        covariance += np.diag(scatter + NOISE**2)
        off = log_size - np.log(0.1)
        return stats.multivariate_normal(cov=covariance).logpdf(magnitude) - np.logaddexp(off, -off)

    for node in (3, 9, 10, 15):
        best = optimize.minimize_scalar(
            lambda log_size, node=node: -density(node, log_size), bounds=np.log((0.012, 2.3))
        )
        assert best.x == pytest.approx(found.log_size[node], abs=0.05)


def test_the_evidence_of_sizes_is_the_normal_density_and_its_derivatives_are_those_of_the_cost():
    rng = np.random.default_rng(6)
    magnitude = POLE + NOISE * rng.standard_normal(len(HZ))
    variance = LEAST_GAIN**2 * rng.uniform(1, 5, len(HZ))
    ripple = quiet_ripple(HZ, HELD_LEVEL)
    sizes = ripple.log_size + 0.5 * rng.standard_normal(len(ripple.log_size))

    def at(log_size):
        return _size_equations(replace(ripple, log_size=log_size), known(magnitude), variance)

    def density(log_size):
        covariance = replace(ripple, log_size=log_size).covariance + np.diag(variance + NOISE**2)
        prior = np.sum(np.log(np.cosh(log_size - np.log(0.1))))
        return stats.multivariate_normal(cov=covariance).logpdf(magnitude) - prior

    here, moved = at(sizes), sizes + 0.3
    assert at(moved).cost - here.cost == pytest.approx(
        -2 * (density(moved) - density(sizes)), rel=1e-5
    )
    for step in 1e-4 * np.eye(len(sizes)):
        ahead, behind = at(sizes + step), at(sizes - step)
        slope = (ahead.cost - behind.cost) / 2e-4
        assert slope == pytest.approx(step @ here.gradient / 1e-4, rel=1e-4, abs=1e-3)
        bend = (ahead.gradient - behind.gradient) / 2e-4
        np.testing.assert_allclose(bend, here.hessian @ step / 1e-4, rtol=1e-4, atol=1e-3)


def test_a_prior_that_a_fit_had_is_taken_out():
    rng = np.random.default_rng(5)
    ripple = strong_ripple(quiet_ripple(HZ))
    magnitude = POLE + NOISE * rng.standard_normal(len(HZ))
    held = ripple.covariance + np.diag(np.full(len(HZ), LEAST_GAIN**2))
    curvature = np.linalg.inv(held)
    covariance = np.linalg.inv(curvature + np.eye(len(HZ)) / NOISE**2)
    prior = DrivePrior(0.0, -curvature @ magnitude, NONE, held, 0.0)
    alone = KnownMagnitude.of(covariance @ magnitude / NOISE**2, covariance, prior)
    np.testing.assert_allclose(alone.precision, np.eye(len(HZ)) / NOISE**2, atol=1e-3 / NOISE**2)
    np.testing.assert_allclose(alone.pull, magnitude / NOISE**2, atol=1e-5 / NOISE**2)
