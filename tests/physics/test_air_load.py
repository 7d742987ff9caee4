"""Air that moves along: against a sound-free wave, a piston in a wall, and laws of its own."""

from dataclasses import replace

import numpy as np
import pytest

from physics.effects import air_load
from physics.effects.air_load import AIR_DENSITY_KG_M3, air_load_cents
from physics.reed.fem import Symmetry
from physics.reed.response import Mode, elastic_modes

# What another program found with ρ/k per area and side, cents (no sound, another mesh and cane).
OTHERS_CENTS = {
    "F1": -60,
    "T1": -54,
    "F2": -48,
    "T2": -37,
    "X1": -27,
    "T3": -28,
    "F3": -22,
    "X2": -20,
    "X3": -17,
    "F4": -15,
}


@pytest.fixture(scope="module")
def modes(standard_reed):
    return elastic_modes(standard_reed, 13.5e9, 1.0e9)


@pytest.fixture
def added_mass(standard_reed, monkeypatch):
    """Return a function that gives the modal mass of a drawn deflection (m), both sides, in kg."""

    def give(deflection, frequency_hz=1.0, share=1.0):
        def shapes(reed, x_m, y_m):
            return {Symmetry.SYMMETRIC: deflection(x_m, y_m)[:, None]}

        monkeypatch.setattr(air_load, "surface_shapes", shapes)
        mode = Mode("drawn", frequency_hz, Symmetry.SYMMETRIC, np.ones(1), 1.0)
        return 2 * (2 ** (-air_load_cents(standard_reed, mode, share) / 600) - 1)

    return give


# --- Analytic answers --------------------------------------------------------------------------


@pytest.mark.parametrize("wavelength_m", [4e-3, 6e-3])
def test_a_wave_shorter_than_sound_carries_density_over_wavenumber(added_mass, wavelength_m):
    k, width_m, centre_m = 2 * np.pi / wavelength_m, 2.2e-3, 25e-3

    def deflection(x, y):
        bell = np.exp(-((x - centre_m) ** 2 + y**2) / (2 * width_m**2))
        return bell * np.cos(k * (x - centre_m))

    square_m2 = 0.5 * np.pi * width_m**2
    # The bell spreads the wavenumbers by 1/(√2 width); of 1/|k| that leaves this mean.
    spread = 1 / (2 * width_m**2 * k**2)
    expected = 2 * AIR_DENSITY_KG_M3 / k * square_m2 * (1 + 0.5 * spread)
    assert added_mass(deflection) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("radius_m", [4e-3, 5e-3])
def test_a_piston_in_a_wall_moves_eight_thirds_of_its_cube(added_mass, radius_m):
    """Rayleigh: (8/3) ρ a³ on each side, for waves much longer than the piston."""

    def deflection(x, y):
        return ((x - 25e-3) ** 2 + y**2 < radius_m**2).astype(float)

    expected = 2 * 8 / 3 * AIR_DENSITY_KG_M3 * radius_m**3
    # A disc drawn on a grid of 0.5 mm has a ragged edge.
    assert added_mass(deflection) == pytest.approx(expected, rel=0.05)


def test_waves_longer_than_sound_radiate_and_add_no_mass(added_mass):
    def deflection(x, y):
        return np.exp(-((x - 25e-3) ** 2 + y**2) / (2 * 2e-3**2))

    # At 100 kHz sound is shorter than the bell: 3.4 mm.
    slow, fast = (added_mass(deflection, frequency_hz=hz) for hz in (1.0, 100e3))
    assert slow > 0
    assert abs(fast) < 0.03 * slow


def test_mass_grows_with_the_square_of_the_deflection(added_mass):
    def deflection(x, y):
        return np.exp(-((x - 20e-3) ** 2 + y**2) / (2 * 2e-3**2))

    once, thrice = added_mass(deflection), added_mass(lambda x, y: 3 * deflection(x, y))
    assert thrice == pytest.approx(9 * once, rel=1e-6)


# --- Modes of the reed -------------------------------------------------------------------------


def test_no_air_is_the_nominal_twin_exactly(standard_reed, modes):
    for name in OTHERS_CENTS:
        assert air_load_cents(standard_reed, modes[name], share=0.0) == 0


def test_air_lowers_every_mode(standard_reed, modes):
    assert all(air_load_cents(standard_reed, modes[name]) < -5 for name in OTHERS_CENTS)


def test_the_shift_is_linear_in_a_thin_air(standard_reed, modes):
    for name in ("F1", "T1", "F3"):
        one, ten = (air_load_cents(standard_reed, modes[name], s) for s in (1e-4, 1e-3))
        assert ten == pytest.approx(10 * one, rel=1e-3)
        whole = air_load_cents(standard_reed, modes[name])
        assert abs(whole) < 1000 * abs(ten)
        assert whole == pytest.approx(1000 * ten, rel=0.05)


@pytest.mark.parametrize("letter", ["F", "T", "X"])
def test_low_modes_are_lowered_most(standard_reed, modes, letter):
    shifts = [air_load_cents(standard_reed, modes[n]) for n in OTHERS_CENTS if n[0] == letter]
    assert shifts == sorted(shifts)


@pytest.mark.parametrize("name", list(OTHERS_CENTS))
def test_the_shift_is_smooth_in_frequency(standard_reed, modes, name):
    """A reed three percent higher or lower moves the same air, to a cent."""
    mode = modes[name]
    pitches = mode.frequency_hz * np.linspace(0.97, 1.03, 13)
    shifts = [air_load_cents(standard_reed, replace(mode, frequency_hz=hz)) for hz in pitches]
    assert np.ptp(shifts) < 1


def test_shifts_are_those_that_others_found(standard_reed, modes):
    """Roughly: theirs are of another mesh and cane."""
    for name, others in OTHERS_CENTS.items():
        slow = replace(modes[name], frequency_hz=1.0)
        assert air_load_cents(standard_reed, slow) == pytest.approx(others, rel=0.4)
