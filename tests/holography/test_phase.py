"""The turn of synthetic light from frame to frame, which is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holography.fresnel import FresnelTransform
from holography.phase import TURN_OF_FRAMES, steady_turn
from holography.region import Region

SHAPE = (20, 30)


def speckle(rng, shape=SHAPE, power=1.0):
    """Circular Gaussian field of a mean power."""
    parts = rng.standard_normal((2, *shape))
    return np.sqrt(power / 2) * (parts[0] + 1j * parts[1])


def turning(image, advance_rad, background=0.0):
    """Images of four frames, the first of which shows the image as it is."""
    return [background + image * np.exp(-1j * m * advance_rad) for m in range(4)]


def noisy(frames, rng):
    """The same with noise of mean power 1."""
    return [frame + speckle(rng, frame.shape) for frame in frames]


def combined(frames):
    """I0 − I2, I1 − I3 and (I0 + I2) − (I1 + I3)."""
    first, second, third, fourth = frames
    return first - third, second - fourth, first + third - second - fourth


@given(st.floats(-1.4, 1.4), st.integers(0, 100))
def test_the_turn_of_synthetic_fields_is_exact(error_rad, seed):
    rng = np.random.default_rng(seed)
    frames = turning(speckle(rng), np.pi / 2 + error_rad, speckle(rng, power=10))
    turn = steady_turn(*combined(frames), 1e-12)
    assert turn.error_rad == pytest.approx(error_rad, abs=1e-5)
    assert turn.unexplained == pytest.approx(0, abs=1e-9)


def test_light_that_turns_backwards_is_half_a_turn_off():
    """As with exchanged modulators."""
    turn = steady_turn(*combined(turning(speckle(np.random.default_rng(1)), -np.pi / 2)), 1e-12)
    assert abs(turn.error_rad) == pytest.approx(np.pi, abs=1e-5)


@pytest.mark.parametrize("error_hz", [0.3, -0.3])
def test_a_difference_that_is_too_high_turns_the_light_too_fast(error_hz):
    """Frames of light at n·f against a local oscillator at n·f + f_CCD/4 and a little more."""
    rate_hz, sideband_hz = 12.4, 2000.1
    transform, region = FresnelTransform((64, 80), 6.7e-6, 650e-9, 1.0), Region(42, 20, 12, 40)
    image = speckle(np.random.default_rng(1), (12, 40)).astype(np.complex64)
    light = transform.to_sensor(region.paste(image, (64, 80)))
    difference_hz = sideband_hz + rate_hz / 4 + error_hz
    times_s = np.arange(4) / rate_hz
    beat = np.exp(2j * np.pi * (sideband_hz - difference_hz) * times_s)
    frames = 2 * (light * beat[:, None, None]).real
    parts = [region.crop(transform.to_object(part)) for part in combined(frames)]
    turn = steady_turn(*parts, 1e-12)
    # The twin image, out of focus, turns the other way; of its light a little is in the region.
    assert turn.error_rad * rate_hz / (2 * np.pi) == pytest.approx(error_hz, abs=0.01)


@pytest.mark.parametrize("signal", [0.5, 4.0, 100.0])
@pytest.mark.parametrize("error_rad", [0.0, 0.3])
def test_the_standard_error_is_the_scatter_of_the_noise(signal, error_rad):
    rng, draws = np.random.default_rng(2), 1000
    frames = turning(speckle(rng, power=signal), np.pi / 2 + error_rad, speckle(rng, power=9))
    found = [steady_turn(*combined(noisy(frames, rng)), 1.0) for _ in range(draws)]
    errors = np.array([turn.error_rad for turn in found])
    stated = np.mean([turn.standard_error_rad for turn in found])
    # The scatter of 1000 draws is known to 2.2 %.
    assert errors.std() == pytest.approx(stated, rel=0.08)
    assert errors.mean() == pytest.approx(error_rad, abs=4 * stated / np.sqrt(draws))
    unexplained = np.array([turn.unexplained for turn in found])
    stated = np.mean([turn.unexplained_error for turn in found])
    assert unexplained.std() == pytest.approx(stated, rel=0.1)


def test_four_frames_tell_the_turn_three_times_better_than_two_differences():
    """Variances; see decision 0020."""
    rng, draws = np.random.default_rng(6), 2000
    frames = turning(speckle(rng, power=100.0), np.pi / 2)
    by_four, by_two = [], []
    for _ in range(draws):
        even, odd, unused = combined(noisy(frames, rng))
        by_four.append(steady_turn(even, odd, unused, 1.0).error_rad)
        by_two.append(-np.angle(np.vdot(even, odd)) - np.pi / 2)
    # The ratio of two variances of 2000 draws each is known to 4.5 %.
    assert np.var(by_two) / np.var(by_four) == pytest.approx(3, rel=0.15)


def test_brighter_pixels_weigh_more():
    """Half of the pixels hold noise only, and do not blur the turn of the others."""
    rng = np.random.default_rng(3)
    image = speckle(rng, power=1e4)
    image[::2] = 0
    turn = steady_turn(*combined(noisy(turning(image, np.pi / 2 + 0.1), rng)), 1.0)
    assert turn.error_rad == pytest.approx(0.1, abs=5e-4)


def test_without_light_the_error_is_infinite():
    dark = [np.zeros(SHAPE)] * 4
    rng = np.random.default_rng(4)
    for frames, noise in ((dark, 0.0), (dark, 1.0), (noisy(dark, rng), 1.5)):
        turn = steady_turn(*combined(frames), noise)
        assert np.isnan(turn.error_rad)
        assert turn.standard_error_rad == np.inf


def test_of_noise_alone_little_is_claimed():
    """A standard error below a fifth of a radian would be light of five deviations."""
    rng, dark = np.random.default_rng(5), [np.zeros(SHAPE)] * 4
    stated = [steady_turn(*combined(noisy(dark, rng)), 1.0).standard_error_rad for _ in range(1000)]
    assert min(stated) > 0.1


@pytest.mark.parametrize("number", range(4))
def test_a_small_phase_of_one_frame_turns_the_fit_by_its_weight(number):
    rng = np.random.default_rng(number)
    frames = turning(speckle(rng), np.pi / 2)
    frames[number] = frames[number] * np.exp(-1e-4j)
    turn = steady_turn(*combined(frames), 1e-12)
    assert turn.error_rad == pytest.approx(1e-4 * TURN_OF_FRAMES[number], abs=2e-7)
