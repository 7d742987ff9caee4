"""Air that moves along: against a sound-free wave, a piston in a wall, and laws of its own."""

import numpy as np
import pytest

from physics.reed.elements.fem import Symmetry
from physics.reed.radiation import AIR_DENSITY_KG_M3, air_load
from physics.reed.reduced.elastic import elastic_modes

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


@pytest.fixture(scope="module")
def air(standard_reed):
    return air_load(standard_reed)


@pytest.fixture
def added_mass(standard_reed, monkeypatch):
    """Return a function that gives the modal mass of a drawn deflection (m), both sides, in kg."""

    def give(deflection, frequency_hz=1.0):
        def shapes(reed, x_m, y_m, *, loose):
            drawn = deflection(x_m, y_m)[:, None]
            return {Symmetry.SYMMETRIC: drawn, Symmetry.ANTISYMMETRIC: 0 * drawn}

        monkeypatch.setattr("physics.reed.radiation.surface_shapes", shapes)
        monkeypatch.setattr("physics.reed.radiation._HZ", (frequency_hz, 1.01 * frequency_hz))
        # Of half the reed, as all modal masses are.
        ((mass, _), _) = air_load(standard_reed).at(frequency_hz)
        return 2 * float(mass[0, 0])

    return give


@pytest.fixture(scope="module")
def shift_cents(standard_reed, air):
    """Return a function that gives the shift of a mode at a frequency, in air of a share."""
    places = list(standard_reed.loose)

    def give(mode, share=1.0, hz=None):
        own = np.s_[: len(mode.coordinates)]
        mass, _ = air.at(hz or mode.frequency_hz)[places.index(mode.symmetry)]
        moved = mode.coordinates @ mass[own, own] @ mode.coordinates
        return -600 * np.log2(1 + share * moved)

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


def test_air_lowers_every_mode(shift_cents, modes):
    assert all(shift_cents(modes[name]) < -5 for name in OTHERS_CENTS)


@pytest.mark.parametrize("letter", ["F", "T", "X"])
def test_low_modes_are_lowered_most(shift_cents, modes, letter):
    shifts = [shift_cents(modes[n]) for n in OTHERS_CENTS if n[0] == letter]
    assert shifts == sorted(shifts)


def test_shifts_are_those_that_others_found(shift_cents, modes):
    """Roughly: theirs are of another mesh and cane, and of air in which sound is not heard."""
    for name, others in OTHERS_CENTS.items():
        assert shift_cents(modes[name], hz=1e3) == pytest.approx(others, rel=0.4)


def test_mass_and_resistance_are_symmetric_and_take_energy_away(air):
    for mass, resistance in [part for hz in (1e3, 5e3, 25e3) for part in air.at(hz)]:
        np.testing.assert_allclose(mass, mass.T, atol=1e-12 * np.abs(mass).max())
        np.testing.assert_allclose(resistance, resistance.T, atol=1e-12 * np.abs(resistance).max())
        # Sound that is sent out never brings energy back; the grid leaves a millionth.
        values = np.linalg.eigvalsh(resistance)
        assert values.min() > -1e-6 * values.max()
