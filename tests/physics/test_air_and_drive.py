"""From volts to pressure on the reed: tweeter, cavity, chamber."""

import numpy as np
import pytest
import scipy.fft
from hypothesis import given, settings
from hypothesis import strategies as st

from physics.air import pressure_on_reed, pressure_shape
from physics.drive import resonance_gain, tweeter_pressure_pa
from physics.parameters.chamber import Chamber, Filling
from physics.parameters.drive import AcousticResonance, Tweeter

FREQUENCIES = st.floats(1.0, 1e5)


def gains(system, frequencies_hz):
    return np.array([system(hz) for hz in frequencies_hz])


def cavity(hz):
    return complex(resonance_gain(AcousticResonance(), hz))


def tweeter(hz):
    return tweeter_pressure_pa(Tweeter(), hz, 1.0)


def impulse_response(system, rate_hz=400e3, count=2**15):
    """Of a gain for the time factor exp(+iωt); the second half of the samples lies before 0.

    Smoothed over some 3 µs, which keeps the band limit of the samples from ringing.
    """
    frequencies = scipy.fft.rfftfreq(count, 1 / rate_hz)
    return scipy.fft.irfft(gains(system, frequencies) * np.exp(-((frequencies / 60e3) ** 2)), count)


def test_the_cavity_is_loudest_at_the_papers_line():
    frequencies = np.arange(1400.0, 20e3, 2.0)
    loudness = np.abs(gains(cavity, frequencies))
    peak = frequencies[np.argmax(loudness)]
    assert peak == pytest.approx(4308.6, rel=0.01)
    assert loudness.max() > 2 * np.median(loudness)


def test_the_cavity_line_is_a_resonance_of_its_quality():
    """Relative to the direct path: ``strength·Q`` and a quarter turn late at the line."""
    line = AcousticResonance(frequency_hz=3e3, quality=40.0, strength=0.2)
    assert resonance_gain(line, 3e3) - 1 == pytest.approx(-1j * 0.2 * 40, rel=1e-9)
    half_power = [3e3 * (1 + side / 80) for side in (-1, 1)]
    for hz in half_power:
        assert abs(resonance_gain(line, hz) - 1) == pytest.approx(8 / np.sqrt(2), rel=0.02)


def test_a_line_of_a_quarter_turn_adds_pressure_in_phase():
    line = AcousticResonance(frequency_hz=3e3, quality=40.0, strength=0.2, phase_rad=np.pi / 2)
    assert resonance_gain(line, 3e3) == pytest.approx(1 + 0.2 * 40, rel=1e-9)


def test_far_from_the_line_pressure_passes():
    assert cavity(1.0) == pytest.approx(1 + AcousticResonance().strength, rel=1e-3)
    assert cavity(1e6) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("system", [cavity, tweeter])
@settings(deadline=None)
@given(hz=FREQUENCIES)
def test_gains_belong_to_real_signals(system, hz):
    assert system(-hz) == pytest.approx(np.conj(system(hz)))


@pytest.mark.parametrize("system", [cavity, tweeter])
def test_nothing_sounds_before_it_is_driven(system):
    response = impulse_response(system)
    before = response[len(response) // 2 : -10]
    assert np.sum(before**2) < 1e-6 * np.sum(response**2)
    assert np.abs(before).max() < 1e-3 * np.abs(response).max()


def test_the_cavity_rings_down_with_its_quality():
    line = AcousticResonance()
    response = impulse_response(lambda hz: resonance_gain(line, hz) - 1)
    envelope_s = line.quality / (np.pi * line.frequency_hz)
    time_s = np.arange(len(response)) / 400e3
    windows = [np.sqrt(np.mean(response[np.abs(time_s - t) < 0.5e-3] ** 2)) for t in (2e-3, 6e-3)]
    assert windows[0] / windows[1] == pytest.approx(np.exp(4e-3 / envelope_s), rel=0.05)


def test_the_tweeter_is_a_band_pass():
    middle = abs(tweeter(4e3))
    assert middle == pytest.approx(Tweeter().sensitivity_pa_v, rel=0.15)
    assert tweeter(0.0) == 0
    assert abs(tweeter(20.0) / tweeter(10.0)) == pytest.approx(4, rel=0.01)
    assert abs(tweeter(4e6) / tweeter(2e6)) == pytest.approx(0.5, rel=0.01)


def test_the_tweeter_at_its_resonance():
    """``|p| = sensitivity · Q`` and a quarter turn ahead, but for the voice coil."""
    at_resonance = tweeter_pressure_pa(Tweeter(corner_hz=1e9), 1100.0, 1.0)
    assert at_resonance == pytest.approx(1j * 0.7 * 0.7, rel=1e-4)


@settings(deadline=None)
@given(FREQUENCIES, st.floats(0, 20))
def test_the_tweeter_is_linear(hz, volts):
    assert tweeter_pressure_pa(Tweeter(), hz, volts) == pytest.approx(volts * tweeter(hz))


@settings(deadline=None)
@given(FREQUENCIES)
def test_an_unplugged_tweeter_is_silent(hz):
    assert tweeter_pressure_pa(Tweeter(connected=False), hz, 16.0) == 0


GRID_X, GRID_Y = np.meshgrid(np.linspace(0, 38e-3, 77), np.linspace(-6e-3, 6e-3, 61), indexing="ij")


@pytest.mark.parametrize("hz", [100.0, 4e3, 15e3])
def test_an_open_chamber_presses_both_sides_equally(hz):
    shape = pressure_shape(Chamber(), hz, GRID_X, GRID_Y)
    np.testing.assert_allclose(shape, shape[:, ::-1], atol=1e-12)


@pytest.mark.parametrize("hz", [100.0, 4e3, 15e3])
def test_clay_on_the_right_leaves_the_left(hz):
    open_shape = pressure_shape(Chamber(), hz, GRID_X, GRID_Y)
    filled = pressure_shape(Chamber(Filling.ASYMMETRIC), hz, GRID_X, GRID_Y)
    # Clay on either side in turn makes up the open chamber.
    np.testing.assert_allclose(filled + filled[:, ::-1], open_shape, atol=1e-12)
    left, right = GRID_Y > 2e-3, GRID_Y < -2e-3
    np.testing.assert_allclose(filled[left], open_shape[left], atol=2e-3)
    assert np.abs(filled[right]).max() < 2e-3


def test_pressure_is_one_at_the_tip_and_nothing_outside_the_window():
    chamber = Chamber()
    assert pressure_shape(chamber, 9e3, np.array(0.0), np.array(0.0)) == pytest.approx(1)
    beyond = np.array([chamber.length_m + 2e-3, 5e-3]), np.array([0.0, chamber.half_width_m + 2e-3])
    np.testing.assert_allclose(pressure_shape(chamber, 100.0, *beyond), 0, atol=2e-3)


def test_a_standing_wave_is_in_the_chamber_closed_at_the_tip():
    """Nodes at odd quarters of the wavelength; no gradient at the tip."""
    chamber = Chamber(sound_speed_m_s=343.0)
    hz = 8e3
    quarter = 343.0 / hz / 4
    x = np.array([quarter, 2 * quarter])
    node, antinode = pressure_shape(chamber, hz, x, np.zeros(2))
    assert node == pytest.approx(0, abs=1e-9)
    assert antinode == pytest.approx(-1, abs=1e-6)
    at_tip = pressure_shape(chamber, hz, np.array([0.0, 1e-6]), np.zeros(2))
    assert at_tip[1] - at_tip[0] == pytest.approx(0, abs=1e-7)


def test_a_wave_that_travels_lags_behind_along_the_reed():
    """All travelling: constant size, and a phase that falls by kx."""
    x, hz = np.linspace(0, 30e-3, 7), 5e3
    wavenumber = 2 * np.pi * hz / 343.0
    centre = np.zeros(7)
    gone = pressure_on_reed(Chamber(travelling=1.0), hz, x, centre)
    np.testing.assert_allclose(gone[:6], np.exp(-1j * wavenumber * x[:6]), atol=1e-3)
    some = pressure_on_reed(Chamber(travelling=0.2), hz, x, centre)
    expected = np.cos(wavenumber * x) - 0.2j * np.sin(wavenumber * x)
    np.testing.assert_allclose(some[:6], expected[:6], atol=1e-3)
    still = pressure_on_reed(Chamber(), hz, GRID_X, GRID_Y)
    np.testing.assert_array_equal(still, pressure_shape(Chamber(), hz, GRID_X, GRID_Y))


def test_pressure_past_the_rails_acts_on_the_covered_edges_only():
    hz, closed = 2e3, Chamber()
    leaking = Chamber(rail_leak=0.1)
    tight, leaky = (pressure_shape(each, hz, GRID_X, GRID_Y) for each in (closed, leaking))
    middle = np.abs(GRID_Y) < closed.half_width_m - 2e-3
    np.testing.assert_allclose(leaky[middle], tight[middle], atol=1e-3)
    x, y = np.full(2, 5e-3), np.array([closed.half_width_m + 3e-3, -closed.half_width_m - 3e-3])
    inside = pressure_shape(closed, hz, x, np.zeros(2))
    np.testing.assert_allclose(pressure_shape(leaking, hz, x, y), 0.1 * inside, rtol=1e-2)
