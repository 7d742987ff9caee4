"""The phase advance of synthetic fields, whose turn is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holography.fresnel import FresnelTransform
from holography.phase import phase_advance
from holography.region import Region

SHAPE = (20, 30)


def speckle(rng, shape=SHAPE, power=1.0):
    """Circular Gaussian field of a mean power."""
    parts = rng.standard_normal((2, *shape), dtype=np.float32)
    return (np.sqrt(power / 2) * (parts[0] + 1j * parts[1])).astype(np.complex64)


def turned(field, advance_rad):
    """I0 − I2 and I1 − I3 of frames ``2 Re[c exp(-i m δ)]``, but for their common factor."""
    return field, (field * np.exp(-1j * advance_rad)).astype(np.complex64)


@given(st.floats(-np.pi, np.pi), st.integers(0, 100))
def test_the_turn_of_synthetic_fields_is_exact(error_rad, seed):
    even, odd = turned(speckle(np.random.default_rng(seed)), np.pi / 2 + error_rad)
    measured = phase_advance(even, odd, 0.0)
    # Where a turn too far and a turn too little meet, either is right.
    assert np.angle(np.exp(1j * (measured.error_rad - error_rad))) == pytest.approx(0, abs=1e-5)
    assert abs(measured.error_rad) <= np.pi
    assert measured.standard_error_rad == 0


@pytest.mark.parametrize("error_hz", [0.3, -0.3])
def test_a_difference_that_is_too_high_turns_the_light_too_fast(error_hz):
    """Frames of light at n·f against a local oscillator at n·f + f_CCD/4 and a little more."""
    rate_hz, sideband_hz = 12.4, 2000.1
    transform, region = FresnelTransform((64, 80), 6.7e-6, 650e-9, 1.0), Region(42, 20, 12, 40)
    light = transform.to_sensor(region.paste(speckle(np.random.default_rng(1), (12, 40)), (64, 80)))
    difference_hz = sideband_hz + rate_hz / 4 + error_hz
    times_s = np.arange(4) / rate_hz
    beat = np.exp(2j * np.pi * (sideband_hz - difference_hz) * times_s)
    frames = 2 * (light * beat[:, None, None]).real
    halves = [transform.to_object(frames[k] - frames[k + 2]) for k in (0, 1)]
    measured = phase_advance(*(region.crop(half) for half in halves), 0.0)
    # The twin image, out of focus, turns the other way; of its light a little is in the region.
    assert measured.error_rad * rate_hz / (2 * np.pi) == pytest.approx(error_hz, abs=0.01)


@pytest.mark.parametrize("signal", [0.5, 4.0, 100.0])
@pytest.mark.parametrize("error_rad", [0.0, 0.4])
def test_the_standard_error_is_the_scatter_of_the_noise(signal, error_rad):
    rng, draws = np.random.default_rng(2), 2000
    even, odd = turned(speckle(rng, power=signal), np.pi / 2 + error_rad)
    # The scatter is that of the light there is, whose mean power is itself drawn.
    signal = float(np.mean(np.abs(even) ** 2))
    found = [phase_advance(even + speckle(rng), odd + speckle(rng), 1.0) for _ in range(draws)]
    errors = np.array([phase.error_rad for phase in found])
    spread = np.sqrt((2 * signal + 1) / (2 * even.size)) / signal
    assert errors.std() == pytest.approx(spread, rel=0.06)
    assert errors.mean() == pytest.approx(error_rad, abs=4 * spread / np.sqrt(draws))
    told = [phase.standard_error_rad for phase in found]
    # Each is computed from a power that scatters by one part in ten at the weakest signal.
    assert np.mean(told) == pytest.approx(spread, rel=0.06)


def test_brighter_pixels_weigh_more():
    """Half of the pixels hold noise only, and do not blur the turn of the others."""
    rng = np.random.default_rng(3)
    even, odd = turned(speckle(rng, power=1e4), np.pi / 2 + 0.1)
    even[::2], odd[::2] = speckle(rng, (10, 30)), speckle(rng, (10, 30))
    assert phase_advance(even, odd, 1.0).error_rad == pytest.approx(0.1, abs=5e-4)


def test_without_light_the_error_is_infinite():
    rng, dark = np.random.default_rng(4), np.zeros(SHAPE, np.complex64)
    for even, odd, noise in (
        (dark, dark, 0.0),
        (dark, dark, 1.0),
        (speckle(rng), speckle(rng), 1.5),
        # Light of which a half is missing tells nothing either.
        (speckle(rng), dark, 0.0),
    ):
        measured = phase_advance(even, odd, noise)
        assert np.isnan(measured.error_rad)
        assert measured.standard_error_rad == np.inf


def test_of_noise_alone_little_is_claimed():
    """A standard error below a fifth of a radian would be light of five deviations."""
    rng = np.random.default_rng(5)
    told = [phase_advance(speckle(rng), speckle(rng), 1.0).standard_error_rad for _ in range(2000)]
    assert min(told) > 0.2
    assert np.isinf(told).mean() == pytest.approx(0.5, abs=0.05)
