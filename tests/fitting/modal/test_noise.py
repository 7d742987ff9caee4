"""Noise and discrepancy of displacements: what neighbouring holograms share, and what not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from fitting.modal.noise import Noise, parts, sharing_holograms
from tests.numbers import complex_normal

COORDINATES, DISCREPANCY = 5, 0.05


def a_noise(rng, count, power):
    """Noise of directions that differ from hologram to hologram, some of them next to unknown."""
    directions = np.linalg.qr(rng.standard_normal((count, 2 * COORDINATES, 2 * COORDINATES)))[0]
    variance = np.exp(rng.uniform(np.log(1e-6), np.log(1e-2), (count, 2 * COORDINATES)))
    variance[:, 0] = 1e4
    return Noise(directions, variance, power, np.ones(count))


def drawn(rng, noise, correlation, size=DISCREPANCY):
    """Residuals of noise and a discrepancy that is a first-order autoregression; drive, too."""
    count = len(noise.power)
    normal = np.sqrt(2) * complex_normal(rng, count, COORDINATES)
    one = np.sqrt(1 - correlation**2)
    walk = lfilter([one], [1, -correlation], normal, axis=0)
    phase = rng.uniform(0, 2 * np.pi, count)
    discrepancy = size * (np.sqrt(noise.power) * np.exp(1j * phase))[:, None] * walk
    along = (noise.directions @ parts(discrepancy)[..., None])[..., 0]
    along += np.sqrt(noise.variance) * rng.standard_normal(along.shape)
    return along / noise.deviation(DISCREPANCY), 1j * phase


def summed(correlation):
    """Sum of an autoregression's correlations up to ten steps either way."""
    return 1 + 2 * np.sum(correlation ** np.arange(1, 11))


@pytest.mark.parametrize("correlation", [0.3, 0.6, 0.8])
def test_the_number_of_holograms_is_the_sum_of_their_correlations(correlation):
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        noise = a_noise(rng, 3000, np.exp(rng.uniform(-4, 0, 3000)))
        residual, log_drive = drawn(rng, noise, correlation)
        found.append(sharing_holograms(noise, residual, log_drive, DISCREPANCY))
    assert np.mean(found) == pytest.approx(summed(correlation), rel=0.05)


def test_holograms_of_noise_share_nothing():
    rng = np.random.default_rng(2)
    noise = a_noise(rng, 3000, np.ones(3000))
    residual, log_drive = drawn(rng, noise, 0.0, size=0.0)
    assert sharing_holograms(noise, residual, log_drive, DISCREPANCY) == pytest.approx(1, abs=0.1)


def test_noise_of_faint_holograms_does_not_hide_what_loud_ones_share():
    """Three of four holograms, in blocks, are so faint that all their residual is noise."""
    rng = np.random.default_rng(3)
    power = np.repeat(np.tile([1.0, 1e-8, 1e-8, 1e-8], 30), 50)
    noise = a_noise(rng, len(power), power)
    residual, log_drive = drawn(rng, noise, 0.6)
    found = sharing_holograms(noise, residual, log_drive, DISCREPANCY)
    assert found == pytest.approx(summed(0.6), rel=0.15)


def test_the_loudest_holograms_do_not_speak_for_all():
    rng = np.random.default_rng(4)
    power = np.repeat([1e4, 1.0], 3000)
    noise = a_noise(rng, len(power), power)
    # Noise that is small everywhere: each hologram counts as much as any other.
    noise = replace(noise, variance=np.full_like(noise.variance, 1e-9))
    together, drive = drawn(rng, noise, 0.8)
    apart, _ = drawn(rng, noise, 0.0)
    phase = np.exp(drive.imag * 1j)
    residual = np.where(np.arange(6000)[:, None] < 3000, together, apart)
    found = sharing_holograms(noise, residual, np.log(phase), DISCREPANCY)
    assert found == pytest.approx(0.5 * (summed(0.8) + 1), rel=0.15)


def test_outliers_share_no_more_than_others():
    """Every tenth hologram has residuals of its own that are ten times as large."""
    rng = np.random.default_rng(5)
    noise = a_noise(rng, 3000, np.ones(3000))
    residual, log_drive = drawn(rng, noise, 0.6)
    inflation = np.where(np.arange(3000) % 10 == 0, 100.0, 1.0)
    residual += np.sqrt(inflation - 1)[:, None] * rng.standard_normal(residual.shape)
    residual /= np.sqrt(inflation)[:, None]
    found = sharing_holograms(replace(noise, inflation=inflation), residual, log_drive, DISCREPANCY)
    assert found == pytest.approx(summed(0.6), rel=0.1)


def test_phases_of_holograms_change_nothing():
    rng = np.random.default_rng(6)
    noise = a_noise(rng, 300, np.ones(300))
    residual, log_drive = drawn(rng, noise, 0.6)
    turn = np.exp(1j * rng.uniform(0, 2 * np.pi, 300))
    complex_directions = (
        noise.directions[..., :COORDINATES] + 1j * noise.directions[..., COORDINATES:]
    )
    turned = complex_directions * turn[:, None, None]
    other = replace(noise, directions=np.concatenate([turned.real, turned.imag], axis=2))
    before = sharing_holograms(noise, residual, log_drive, DISCREPANCY)
    after = sharing_holograms(other, residual, log_drive + 1j * np.angle(turn), DISCREPANCY)
    assert after == pytest.approx(before, rel=1e-9)
    assert sharing_holograms(other, residual, log_drive, DISCREPANCY) < 0.7 * before


@pytest.mark.parametrize(("distance", "expected"), [(10, 2.0), (11, 1.0)])
def test_correlations_count_up_to_ten_steps(distance, expected):
    """A discrepancy that each hologram has half in common with one at a distance."""
    rng = np.random.default_rng(9)
    noise = a_noise(rng, 6000, np.ones(6000))
    own = complex_normal(rng, 6000 + distance, COORDINATES)
    discrepancy = DISCREPANCY * (own[distance:] + own[:-distance])
    along = (noise.directions @ parts(discrepancy)[..., None])[..., 0]
    residual = along / noise.deviation(DISCREPANCY)
    found = sharing_holograms(noise, residual, np.zeros(6000, complex), DISCREPANCY)
    assert found == pytest.approx(expected, abs=0.1)


def test_few_holograms_share_a_number_that_is_bounded():
    """Residuals that are equal, and larger than a discrepancy could make them."""
    noise = a_noise(np.random.default_rng(7), 3, np.ones(3))
    directions = np.broadcast_to(np.eye(2 * COORDINATES), noise.directions.shape)
    noise, equal = replace(noise, directions=directions), np.ones((3, 2 * COORDINATES))
    assert sharing_holograms(noise, 9 * equal, np.zeros(3, complex), DISCREPANCY) == 5
    assert sharing_holograms(noise, 9 * equal, np.zeros(3, complex), 0.0) == 1
    opposite = 9 * equal * np.array([1, -1, 0])[:, None]
    assert sharing_holograms(noise, opposite, np.zeros(3, complex), DISCREPANCY) == 1


def test_sharing_increases_the_variance_of_the_discrepancy_only():
    rng = np.random.default_rng(8)
    noise = replace(a_noise(rng, 4, np.array([1.0, 1e-3, 2.0, 0.0])), inflation=np.full(4, 3.0))
    found = noise.deviation(0.1, 7.0) ** 2 - noise.deviation(0.1) ** 2
    expected = np.broadcast_to(3 * 6 * 0.1**2 * noise.power[:, None], found.shape)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-11)
