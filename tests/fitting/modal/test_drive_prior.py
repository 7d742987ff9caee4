"""Tests of what is known of a drive before a fit."""

import numpy as np
import pytest
from scipy import integrate, stats

from fitting.modal.drive_prior import LEAST_GAIN, QUIET, drive_covariance, drive_prior, found_gain

DOF = 4.0
HZ = np.geomspace(1400, 20000, 184)


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
        prior = drive_prior(np.array([magnitude]), np.array([[variance]]), gain, DOF)
        found = 0.5 * (prior.log_volume - prior.cost)
        off.append(found - log_density(magnitude, variance, gain))
    # A constant is left out. Laplace's method is off by less than a quarter of a neper.
    assert np.ptp(off) < 0.25


def test_the_scatter_of_holograms_is_found_around_a_smooth_drive():
    rng = np.random.default_rng(1)
    covariance = drive_covariance(HZ, QUIET)
    smooth = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(HZ))) @ rng.standard_normal(len(HZ))
    for gain in (0.005, 0.02):
        magnitude = smooth + gain * rng.standard_normal(len(HZ))
        assert found_gain(magnitude, covariance, 0.1, DOF) == pytest.approx(gain, rel=0.3)
    assert found_gain(smooth, covariance, 0.1, DOF) == LEAST_GAIN
