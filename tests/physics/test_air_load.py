"""Air that moves along: against a strip, a disc, waves, a piston in a wall, and its own laws."""

import numpy as np
import pytest

from physics.mechanics import Mechanics, ReedSolver
from physics.reed.elements.fem import Symmetry
from physics.reed.radiation import AIR_DENSITY_KG_M3, air_load, moved_along
from physics.reed.reduced.elastic import elastic_modes, viscoelastic_modes

# What another program found with ρ/k per area and side, cents (no sound, another mesh and cane):
# the air of a plate in a wide wall.
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
# Distance of the edge of a plate from its last nodes, over their distance.
EDGE = 0.824


@pytest.fixture(scope="module")
def modes(standard_reed):
    return elastic_modes(standard_reed, 13.5e9, 1.0e9, air_fraction=0.0)


@pytest.fixture
def added_mass(standard_reed, monkeypatch):
    """Return a function that gives the air's mass on a drawn deflection (m), both sides, in kg."""

    def give(deflection, frequency_hz=1.0, wall=False):
        def shapes(reed, x_m, y_m, *, loose):
            drawn = deflection(x_m, y_m)[:, None]
            return {Symmetry.SYMMETRIC: drawn, Symmetry.ANTISYMMETRIC: 0 * drawn}

        monkeypatch.setattr("physics.reed.radiation.surface_shapes", shapes)
        monkeypatch.setattr("physics.reed.radiation._HZ", frequency_hz * np.array([1.0, 1.01]))
        air = air_load(standard_reed)
        # Of half the reed, as all modal masses are.
        ((mass, _), _) = air.at(frequency_hz)
        return 2 * float(mass[0, 0] + wall * air.wall_kg[0][0, 0])

    return give


@pytest.fixture(scope="module")
def shift_cents(standard_reed):
    """Return a function that gives the shift of a mode by slow air, free or in a wall."""
    places = list(standard_reed.loose)

    def give(mode, wall=0.0):
        own, number = np.s_[: len(mode.coordinates)], places.index(mode.symmetry)
        air = standard_reed.air
        mass = air.at(1e3)[number][0] + wall * air.wall_kg[number]
        moved = mode.coordinates @ mass[own, own] @ mode.coordinates
        return -600 * np.log2(1 + moved)

    return give


def strip(half_width_m, lines, length):
    """Nodes of a strip, and their distance."""
    along, across = np.meshgrid(np.arange(length), np.arange(lines), indexing="ij")
    spacing_m = 2 * half_width_m / (lines - 1 + 2 * EDGE)
    return np.stack([along.ravel(), across.ravel()], axis=1), spacing_m


# --- Analytic answers --------------------------------------------------------------------------


def test_a_strip_moves_a_cylinder_of_its_width():
    """Lamb, Hydrodynamics, section 71: π ρ a² per length of a strip of half width a."""
    nodes, spacing_m = strip(6e-3, 11, 120)
    # Waves along the strip as long as it is: nothing at its ends, and little curvature.
    wave = np.sin(np.pi * (nodes[:, 0] + 0.5) / 120)
    mass = moved_along(nodes, spacing_m, wave[:, None], 0.0)[0, 0].real
    expected = np.pi * 6e-3**2 * spacing_m * np.sum(wave[nodes[:, 1] == 0] ** 2)
    assert mass == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("lines", "within"), [(13, 0.05), (33, 0.015)])
def test_a_free_disc_moves_eight_thirds_of_its_cube(lines, within):
    """Lamb, Hydrodynamics, section 102: (8/3) ρ a³ on both sides of a disc in free air."""
    steps = np.arange(lines) - (lines - 1) // 2
    nodes = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    radius = (lines - 1) / 2 + EDGE
    nodes = nodes[np.hypot(*nodes.T) <= radius - (EDGE - 0.5)]
    mass = moved_along(nodes, 1e-3, np.ones((len(nodes), 1)), 0.0)[0, 0].real
    assert mass == pytest.approx(8 / 3 * (radius * 1e-3) ** 3, rel=within)


def test_a_free_disc_radiates_as_a_dipole():
    """A force (8/3) ρ a³ ω² w radiates k³/6π of its square over ρ: 16/27π of (ka)³ of its mass."""
    steps = np.arange(-12, 13)
    nodes = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    nodes = nodes[np.hypot(*nodes.T) <= 12 + EDGE - (EDGE - 0.5)]
    k, radius_m = 20.0, (12 + EDGE) * 1e-3
    mass = moved_along(nodes, 1e-3, np.ones((len(nodes), 1)), k)[0, 0]
    still = moved_along(nodes, 1e-3, np.ones((len(nodes), 1)), 0.0)[0, 0].real
    assert -mass.imag == pytest.approx(k**3 * still**2 / (12 * np.pi), rel=0.1)
    assert k * radius_m < 0.3


@pytest.mark.parametrize("sign", [1, -1])
def test_half_a_plate_carries_half_the_air(sign):
    whole, spacing_m = strip(5e-3, 8, 10)
    whole[:, 1] -= 4
    half = whole[whole[:, 1] >= 0]

    def odd_or_even(nodes):
        y = nodes[:, 1] + 0.5
        return ((1 + 0.1 * nodes[:, 0]) * (y if sign < 0 else 1 + y**2))[:, None]

    of_whole = moved_along(whole, spacing_m, odd_or_even(whole), 50.0)
    of_half = moved_along(half, spacing_m, odd_or_even(half), 50.0, sign)
    np.testing.assert_allclose(2 * of_half, of_whole, rtol=1e-9)


def test_a_wave_shorter_than_sound_carries_density_over_wavenumber(added_mass):
    k, width_m, centre_m = 2 * np.pi / 6e-3, 2.2e-3, 25e-3

    def deflection(x, y):
        bell = np.exp(-((x - centre_m) ** 2 + y**2) / (2 * width_m**2))
        return bell * np.cos(k * (x - centre_m))

    square_m2 = 0.5 * np.pi * width_m**2
    # The bell spreads the wavenumbers by 1/(√2 width); of 1/|k| that leaves this mean.
    spread = 1 / (2 * width_m**2 * k**2)
    expected = 2 * AIR_DENSITY_KG_M3 / k * square_m2 * (1 + 0.5 * spread)
    # With six nodes to a wave an eighth too much moves along; F4 below 20 kHz has ten.
    assert added_mass(deflection) == pytest.approx(expected, rel=0.13)


@pytest.mark.parametrize("radius_m", [4e-3, 5e-3])
def test_a_piston_in_a_wall_moves_eight_thirds_of_its_cube(added_mass, radius_m):
    """Rayleigh: (8/3) ρ a³ on each side, for waves much longer than the piston."""

    def deflection(x, y):
        return ((x - 25e-3) ** 2 + y**2 < radius_m**2).astype(float)

    expected = 2 * 8 / 3 * AIR_DENSITY_KG_M3 * radius_m**3
    # A disc drawn on a grid of 0.5 mm has a ragged edge.
    assert added_mass(deflection, wall=True) == pytest.approx(expected, rel=0.05)


def test_waves_longer_than_sound_radiate_and_add_no_mass(added_mass):
    def deflection(x, y):
        return np.exp(-((x - 25e-3) ** 2 + y**2) / (2 * 2e-3**2))

    # At 60 kHz sound is as short as the bell is wide.
    slow, fast = (added_mass(deflection, frequency_hz=hz) for hz in (1.0, 60e3))
    assert slow > 0
    assert abs(fast) < 0.2 * slow


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


def test_shifts_in_a_wall_are_those_that_others_found(shift_cents, modes):
    """Roughly: theirs are of another mesh and cane, and of air in which sound is not heard."""
    for name, others in OTHERS_CENTS.items():
        assert shift_cents(modes[name], wall=1.0) == pytest.approx(others, rel=0.4)


def test_a_wall_adds_to_every_mode_and_doubles_the_air_of_f1(shift_cents, modes):
    for name in OTHERS_CENTS:
        ratio = shift_cents(modes[name], wall=1.0) / shift_cents(modes[name])
        assert 1 < ratio < 2.1
    free = shift_cents(modes["F1"])
    assert shift_cents(modes["F1"], wall=1.0) == pytest.approx(2 * free, rel=0.1)


def test_named_modes_in_air_are_those_of_the_vibrations(standard_reed):
    """Named by number or by shape, and found by Newton's method: three programs, one reed."""
    cane = Mechanics().cane
    found = ReedSolver(standard_reed).modes(Mechanics())
    by_number = viscoelastic_modes(standard_reed, cane)
    for name in OTHERS_CENTS:
        assert by_number[name].frequency_hz == pytest.approx(found[name].hz, rel=1e-6)


def test_mass_and_resistance_are_symmetric_and_take_energy_away(standard_reed):
    air = standard_reed.air
    for mass, resistance in [part for hz in (1e3, 6e3, 25e3) for part in air.at(hz)]:
        np.testing.assert_allclose(mass, mass.T, atol=1e-12 * np.abs(mass).max())
        np.testing.assert_allclose(resistance, resistance.T, atol=1e-12 * np.abs(resistance).max())
        # Sound that is sent out never brings energy back; the grid leaves a thousandth.
        values = np.linalg.eigvalsh(resistance)
        assert values.min() > -1e-3 * values.max()
