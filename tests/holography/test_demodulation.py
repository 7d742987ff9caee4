"""Demodulation of frames whose complex beat, steps and powers are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import fft
from scipy.special import jv

from holography.demodulation import (
    NOMINAL_STEPS_RAD,
    PhaseSteps,
    carrier_leak,
    closure,
    four_phase,
    measure_phase_steps,
    sideband_gain,
    unequal_steps,
)
from tests.numbers import relative_error

SHAPE = (256, 320)


def phase_steps(degrees=(0, 90, 180, 270), powers=(1, 1, 1, 1), visibilities=(1, 1, 1, 1)):
    powers, visibilities = np.array(powers, float), np.array(visibilities, float)
    return PhaseSteps(
        np.deg2rad(degrees), powers / powers.mean(), visibilities / visibilities.mean()
    )


def off_axis_speckle(rng):
    """Circular complex speckle of unit mean intensity around a carrier, grain of a few pixels."""
    ky, kx = fft.fftfreq(SHAPE[0])[:, None], fft.fftfreq(SHAPE[1])
    noise = rng.standard_normal(SHAPE) + 1j * rng.standard_normal(SHAPE)
    field = fft.ifft2(fft.fft2(noise) * ((ky - 0.12) ** 2 + (kx - 0.1) ** 2 < 0.08**2))
    return field / np.sqrt(np.mean(np.abs(field) ** 2))


def local_oscillator():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 400 + 3600 * np.exp(-((y - 100) ** 2 + (x - 150) ** 2) / 150**2)


def stepped_frames(background, beat, steps):
    """The model that `PhaseSteps` documents, in float64."""
    return np.stack(
        [
            power * (background + visibility * 2 * np.real(beat * np.exp(-1j * theta)))
            for power, visibility, theta in zip(
                steps.powers, steps.visibilities, steps.steps_rad, strict=True
            )
        ]
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_four_phase_is_the_formula_and_does_not_wrap(dtype):
    rng = np.random.default_rng(0)
    full_scale = np.iinfo(dtype).max if np.dtype(dtype).kind == "u" else 1000
    frames = rng.integers(0, full_scale, (4, 300, 7), endpoint=True).astype(dtype)
    i0, i1, i2, i3 = frames.astype(np.float64)
    hologram = four_phase(frames)
    assert hologram.dtype == np.complex64
    np.testing.assert_array_equal(hologram, (i0 - i2) + 1j * (i1 - i3))


def test_four_phase_is_four_times_the_beat():
    rng = np.random.default_rng(1)
    beat = off_axis_speckle(rng)
    frames = stepped_frames(5.0, beat, phase_steps()).astype(np.float32)
    assert relative_error(four_phase(frames), 4 * beat) < 1e-6


def test_four_phase_writes_where_asked():
    frames = np.random.default_rng(2).random((4, 5, 6)).astype(np.float32)
    out = np.full((5, 6), np.nan, dtype=np.complex64)
    assert four_phase(frames, out) is out
    np.testing.assert_array_equal(out, four_phase(frames))


@pytest.mark.parametrize(
    "frames", [np.zeros((3, 4, 4)), np.zeros((4, 4)), np.zeros((4, 2, 2), "c8")]
)
def test_anything_but_four_real_images_is_refused(frames):
    for function in (four_phase, measure_phase_steps, closure):
        with pytest.raises(ValueError, match="give four real images"):
            function(frames)


@pytest.mark.parametrize("out", [np.zeros((5, 5), "c8"), np.zeros((5, 6), "c16")])
def test_an_out_that_does_not_fit_is_refused(out):
    with pytest.raises(ValueError, match="out is"):
        four_phase(np.zeros((4, 5, 6), np.uint16), out)


def test_unequal_steps_in_quadrature_is_four_phase():
    frames = np.random.default_rng(3).integers(0, 65536, (4, 40, 50), dtype=np.uint16)
    np.testing.assert_allclose(
        unequal_steps(frames, phase_steps()), four_phase(frames), rtol=1e-5, atol=0.1
    )


UNEQUAL = [
    phase_steps((0, 54, 150, 229), (53, 64, 72, 71)),
    phase_steps((0, 49, 106, 174), (53, 64, 72, 71)),
    phase_steps((0, 120, 185, 300), (1, 1.2, 0.9, 1), (1, 0.9, 1.1, 1)),
    phase_steps((0, 90, 180, 270), (1, 0.7, 0.9, 1.1)),
]


@pytest.mark.parametrize("steps", UNEQUAL)
def test_unequal_steps_recovers_the_beat_where_four_phase_does_not(steps):
    rng = np.random.default_rng(4)
    beat = 40 * off_axis_speckle(rng)
    frames = stepped_frames(local_oscillator(), beat, steps).astype(np.float32)
    assert relative_error(unequal_steps(frames, steps), 4 * beat) < 1e-4
    assert relative_error(four_phase(frames), 4 * beat) > 0.2
    assert closure(frames, steps) < 1e-4
    assert closure(frames) > 0.2


@pytest.mark.parametrize("modulation", [0.15, 0.05])
@pytest.mark.parametrize("steps", [phase_steps(), *UNEQUAL])
def test_steps_powers_and_visibilities_are_measured_blind(steps, modulation):
    """LO of uneven profile, speckled object, photon noise; nothing but frames is given."""
    rng = np.random.default_rng(5)
    profile = 4 * local_oscillator()
    beat = modulation * np.sqrt(profile * profile.mean()) * off_axis_speckle(rng)
    background = profile + np.abs(beat) ** 2 / profile
    frames = rng.poisson(stepped_frames(background, beat, steps)).astype(np.uint16)
    measured = measure_phase_steps(frames)
    assert measured.steps_rad[0] == 0
    np.testing.assert_allclose(measured.steps_rad, steps.steps_rad, atol=np.deg2rad(1.0))
    assert np.max(np.abs(measured.steps_rad - steps.steps_rad)) < 3 * measured.error_rad
    np.testing.assert_allclose(measured.powers, steps.powers, rtol=2e-3)
    np.testing.assert_allclose(measured.visibilities, steps.visibilities, rtol=0.01)
    photon_noise = 2 * np.sqrt(profile.mean()) / np.sqrt(np.mean(np.abs(4 * beat) ** 2))
    assert closure(frames, measured) < 1.1 * photon_noise
    assert measured.closure == closure(frames)


@pytest.mark.parametrize("degrees", [(0, 70, 150, 235), (0, 40, 80, 120), (0, 120, 240, 360)])
def test_measured_steps_have_the_sign_of_nominal_quadrature(degrees):
    rng = np.random.default_rng(6)
    beat = off_axis_speckle(rng)
    forward = phase_steps(degrees)
    frames = stepped_frames(10.0, beat, forward).astype(np.float32)
    hologram = unequal_steps(frames, measure_phase_steps(frames))
    assert relative_error(hologram, 4 * beat) < 0.02
    # The same frames are those of the conjugate beat stepped backwards: nothing can tell.
    backwards = PhaseSteps(-forward.steps_rad, forward.powers, forward.visibilities)
    np.testing.assert_allclose(
        stepped_frames(10.0, beat.conj(), backwards), stepped_frames(10.0, beat, forward)
    )


def test_a_fit_that_ends_in_the_mirror_image_is_turned_forward():
    """A series that was found to end there, from starting points that all step forward."""
    rng = np.random.default_rng(15)
    beat = off_axis_speckle(rng)
    visibilities = 1 + rng.uniform(-0.2, 0.2, 4)
    steps = phase_steps((0, 144, 276, 316), visibilities=visibilities)
    frames = stepped_frames(10.0, beat, steps) + rng.normal(0, 0.5, (4, *SHAPE))
    measured = measure_phase_steps(frames.astype(np.float32))
    np.testing.assert_allclose(measured.steps_rad, steps.steps_rad, atol=np.deg2rad(1.0))


def test_closure_is_the_documented_ratio():
    frames = np.random.default_rng(7).random((4, 30, 40)).astype(np.float32)
    i0, i1, i2, i3 = frames
    hologram = (i0 - i2) + 1j * (i1 - i3)
    expected = np.sqrt(np.mean((i0 + i2 - i1 - i3) ** 2) / np.mean(np.abs(hologram) ** 2))
    assert closure(frames) == pytest.approx(expected, rel=1e-5)


def test_closure_of_noise_over_fringes():
    rng = np.random.default_rng(8)
    beat = 50 * off_axis_speckle(rng)
    frames = stepped_frames(1000.0, beat, phase_steps()) + rng.normal(0, 10, (4, *SHAPE))
    total = np.hypot(4 * 50, np.sqrt(4) * 10)
    assert closure(frames.astype(np.float32)) == pytest.approx(2 * 10 / total, rel=0.02)


def test_frames_without_stepped_fringes_are_refused():
    rng = np.random.default_rng(9)
    one = rng.poisson(1000, (1, 128, 128)).astype(np.uint16)
    with pytest.raises(ValueError, match="no stepped fringes"):
        measure_phase_steps(np.repeat(one, 4, axis=0))
    with pytest.raises(ValueError, match="no stepped fringes"):
        measure_phase_steps(rng.poisson(1000, (4, 128, 128)).astype(np.uint16))
    with pytest.raises(ValueError, match="every frame needs light"):
        measure_phase_steps(np.zeros((4, 8, 8), np.uint16))
    with pytest.raises(ValueError, match="all frames are equal"):
        closure(np.full((4, 8, 8), 7, np.uint16))


@pytest.mark.parametrize("degrees", [(0, 0, 0, 0), (0, 180, 0, 180), (0, 90, 90, 0)])
def test_fringes_that_were_not_stepped_are_refused(degrees):
    rng = np.random.default_rng(10)
    frames = stepped_frames(100.0, 5 * off_axis_speckle(rng), phase_steps(degrees))
    with pytest.raises(ValueError, match="no stepped fringes"):
        measure_phase_steps(rng.poisson(frames).astype(np.uint16))


@pytest.mark.parametrize("degrees", [(0, 180, 0, 180), (0, 180, 4, 184)])
def test_steps_with_fewer_than_three_phases_are_refused(degrees):
    with pytest.raises(ValueError, match="do not separate fringes"):
        unequal_steps(np.ones((4, 8, 8), np.uint16), phase_steps(degrees))


# --- what a frame integral lets through -----------------------------------------------------


@given(
    st.floats(-20_000, 20_000),
    st.floats(1, 100),
    st.floats(0.01, 1.0),
    st.complex_numbers(min_magnitude=0.1, max_magnitude=10),
)
def test_gain_describes_the_demodulation_of_integrated_frames(offset_hz, rate_hz, duty, beat):
    """Against the antiderivative of the beat over each exposure."""
    exposure_s = duty / rate_hz
    starts_s = np.arange(4) / rate_hz
    if abs(offset_hz * exposure_s) < 1e-6:
        mean = np.exp(2j * np.pi * offset_hz * (starts_s + exposure_s / 2))
    else:
        turns = [np.exp(2j * np.pi * offset_hz * t) for t in (starts_s, starts_s + exposure_s)]
        mean = (turns[1] - turns[0]) / (2j * np.pi * offset_hz * exposure_s)
    i0, i1, i2, i3 = 2 * np.real(beat * mean)
    hologram = (i0 - i2) + 1j * (i1 - i3)
    gain, twin_gain = (sideband_gain(sign * offset_hz, rate_hz, exposure_s) for sign in (1, -1))
    np.testing.assert_allclose(gain * beat + twin_gain * beat.conjugate(), hologram, atol=1e-3)


def test_gain_at_the_three_frequencies_that_matter():
    rate_hz = 12.5
    gain = sideband_gain([-rate_hz / 4, rate_hz / 4, 0.0], rate_hz, 1 / rate_hz)
    assert abs(gain) == pytest.approx([4 * np.sinc(0.25), 0, 0], abs=1e-12)
    assert np.angle(gain[0]) == pytest.approx(-np.pi / 4)
    assert sideband_gain(-rate_hz / 4, rate_hz, 1e-9) == pytest.approx(4)


def test_detuned_gain_turns_with_the_middle_of_the_four_frames_and_vanishes_at_a_quarter():
    detuning_hz = np.array([-0.1, 0.0, 0.1, 12.5 / 4])
    gain = sideband_gain(-12.5 / 4 + detuning_hz, 12.5, 0.08)
    assert np.angle(gain[1:3] / gain[:2]) == pytest.approx(2 * np.pi * 0.1 * 0.16, rel=1e-9)
    assert abs(gain[3]) == pytest.approx(0, abs=1e-12)


def test_carrier_leak_against_frames_of_a_vibrating_point():
    """Carrier alone, over all phases: rms of |H| over the selected sideband's |H|."""
    rate_hz, exposure_s, drive_hz = 12.5, 0.03, 2143.7
    difference_hz = drive_hz + rate_hz / 4
    time_s = (np.arange(4)[:, None] / rate_hz) + exposure_s * (np.arange(20_000) + 0.5) / 20_000
    power = []
    for phase in 2 * np.pi * np.arange(8) / 8:
        frames = np.mean(2 * np.cos(phase - 2 * np.pi * difference_hz * time_s), axis=1)
        power.append((frames[0] - frames[2]) ** 2 + (frames[1] - frames[3]) ** 2)
    selected = 4 * np.sinc(exposure_s * rate_hz / 4)
    leak = carrier_leak(drive_hz, rate_hz, exposure_s)
    assert leak == pytest.approx(np.sqrt(np.mean(power)) / selected, rel=1e-3)


def test_carrier_leak_has_its_nulls_at_odd_quarters_of_the_frame_rate():
    rate_hz = 12.5
    drive_hz = rate_hz * (171 + np.array([0, 0.25, 0.5, 0.75]))
    leak = carrier_leak(drive_hz, rate_hz, 1 / rate_hz)
    assert leak[[1, 3]] == pytest.approx([0, 0], abs=1e-10)
    # At φ = 0.02 this is the known 15 %.
    assert leak[[0, 2]] * jv(0, 0.02) / jv(1, 0.02) == pytest.approx([0.15, 0.15], abs=0.006)
    off_axis = carrier_leak(drive_hz, rate_hz, 1 / rate_hz, off_axis=True)
    assert off_axis[0] == pytest.approx(leak[0])
    assert off_axis[1:] == pytest.approx([0, 0, 0], abs=1e-10)


def test_carrier_leak_falls_with_the_order_and_is_one_for_the_carrier_itself():
    drive_hz = np.array([[1000.0, 2000.0]])
    leaks = [carrier_leak(drive_hz, 12.5, 0.08, order) for order in (1, 2, 8)]
    assert leaks[0].shape == drive_hz.shape
    assert np.all(leaks[0] > leaks[1])
    assert np.all(leaks[1] > leaks[2])
    assert carrier_leak(drive_hz, 12.5, 0.08, 0) == pytest.approx(np.ones((1, 2)))


@pytest.mark.parametrize(("rate_hz", "exposure_s"), [(0, 0.01), (12.5, 0), (12.5, 0.081)])
def test_impossible_timing_is_refused(rate_hz, exposure_s):
    with pytest.raises(ValueError, match="at most one frame"):
        sideband_gain(1.0, rate_hz, exposure_s)
    with pytest.raises(ValueError, match="at most one frame"):
        carrier_leak(1000.0, rate_hz, exposure_s)


def test_nominal_steps_are_quadrature():
    assert np.exp(1j * np.array(NOMINAL_STEPS_RAD)) == pytest.approx([1, 1j, -1, -1j])
