"""Random and unwanted differences of reeds: statistics, and against other finite elements."""

from dataclasses import replace

import numpy as np
import pytest

from physics.alterations import MovedClamp, RandomLayer
from physics.conditions import ConditionChange
from physics.mechanics import CaneShift, Mechanics, ReedSolver, cane_law
from physics.motion import AlteredMotion, PlainMotion
from physics.reed.cane.viscoelastic import ViscoelasticCane, Zener
from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import ThicknessMap, half_width_m
from physics.reed.modes import reed_modes
from physics.reed.random_surface import random_surface
from tests.numbers import cents

# Moduli that no frequency changes.
ELASTIC = ViscoelasticCane(Zener(14000.0, 0.0, 0.0), Zener(1100.0, 0.0, 0.0))
REED = Mechanics(cane=ELASTIC)
UNCHANGED = ConditionChange(*[np.zeros(())] * 4)


@pytest.fixture(scope="module")
def reed_solver(coarse_reed):
    return ReedSolver(coarse_reed)


def hz_of(reed_solver, reed):
    return np.array([mode.hz for mode in reed_solver.modes(reed).values()])


def fem_hz(geometry, coarse_level, reed_solver):
    modes = reed_modes(geometry, reed_solver.reed.cane, coarse_level, 20e3)
    return np.array([mode.frequency_hz for mode in modes])


# --- Random thickness ----------------------------------------------------------------------------


def test_a_random_surface_has_the_variance_and_the_correlation_that_it_says():
    """At its correlation lengths the correlation is 1/e, at half of them exp(-1/4)."""
    x = np.array([15.0, 23.0, 19.0, 15.0, 15.0, 23.0]) * 1e-3
    y = np.array([0.0, 0.0, 0.0, 4.0, 2.0, 4.0]) * 1e-3
    drawn = np.array([random_surface(seed, 8e-3, 4e-3)(x, y) for seed in range(3000)])
    assert np.abs(drawn.mean(axis=0)).max() < 5 / np.sqrt(3000)
    assert np.mean(drawn**2, axis=0) == pytest.approx(np.ones(6), abs=5 * np.sqrt(2 / 3000))
    found = np.mean(drawn[:, :1] * drawn, axis=0)
    expected = np.exp([0.0, -1.0, -0.25, -1.0, -0.25, -2.0])
    # A mean of products of unit Gaussian numbers has a variance below 2 / n.
    assert found == pytest.approx(expected, abs=4 * np.sqrt(2 / 3000))
    assert np.mean(drawn[:, 0] ** 4) == pytest.approx(3.0, abs=5 * np.sqrt(96 / 3000))


def test_a_seed_is_a_surface():
    x, y = np.linspace(0, 30e-3, 5), np.linspace(-5e-3, 5e-3, 5)
    first, again, other = (random_surface(seed, 8e-3, 4e-3)(x, y) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 0.1


def test_a_random_map_shifts_modes_as_new_elements_do(reed_solver, geometry, coarse_level):
    """Finite elements of a reed that has the map in its drawing know nothing of first order."""
    rms_m, seed = 5e-6, 11
    x, y = np.linspace(0, 36e-3, 37), np.linspace(-7e-3, 7e-3, 29)
    heights = random_surface(seed, 8e-3, 4e-3)(*np.meshgrid(x, y, indexing="ij"))
    rows = tuple(map(tuple, (rms_m * heights).tolist()))
    measured = ThicknessMap(tuple(x.tolist()), tuple(y.tolist()), rows)
    drawn, mapped = (
        fem_hz(each, coarse_level, reed_solver)
        for each in (geometry, replace(geometry, thickness_map=measured))
    )
    count = min(len(drawn), len(mapped), 14)
    expected = cents(mapped[:count], drawn[:count])
    altered = replace(REED, alterations=((RandomLayer(seed), rms_m),))
    found = cents(hz_of(reed_solver, altered)[:count], hz_of(reed_solver, REED)[:count])
    assert np.abs(expected).max() > 5.0
    assert found == pytest.approx(expected, abs=3.0)


def test_a_random_map_has_its_rms_on_the_vamp(coarse_reed):
    """Weighted by area; the scatter from map to map is that of some 15 independent patches."""
    x, y = coarse_reed.bark_m.T
    inside = (x < 35e-3) & (np.abs(y) < half_width_m(coarse_reed.geometry.outline, x))
    area = coarse_reed.area_m2 * inside
    squares = [
        np.sum(area * random_surface(seed, 8e-3, 4e-3)(x, y) ** 2) / area.sum()
        for seed in range(200)
    ]
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1)
    assert 0.1 < np.std(np.sqrt(squares)) < 0.3


# --- Clamp ---------------------------------------------------------------------------------------


def test_an_edge_that_is_shifted_shifts_modes_as_new_elements_do(
    reed_solver, geometry, coarse_level
):
    back_m = 0.2e-3
    clamp = geometry.clamp
    moved = replace(clamp, x_m=(clamp.x_m[0] + back_m, clamp.x_m[1]))
    drawn, meshed = (
        fem_hz(each, coarse_level, reed_solver)[:10]
        for each in (geometry, replace(geometry, clamp=moved))
    )
    altered = replace(REED, alterations=((MovedClamp(), back_m),))
    found = cents(hz_of(reed_solver, altered)[:10], hz_of(reed_solver, REED)[:10])
    expected = cents(meshed, drawn)
    assert expected[0] < -5.0
    assert found == pytest.approx(expected, abs=2.0)


def test_a_tilted_edge_couples_symmetric_and_antisymmetric_motion(reed_solver):
    def antisymmetric(tilt_m):
        reed = replace(REED, alterations=((MovedClamp(tilted=True), tilt_m),))
        moved = AlteredMotion(reed_solver).coordinates(
            reed, UNCHANGED, 3000.0, 0.0, lambda _hz, x, _y: np.ones(len(x), dtype=complex)
        )
        return moved[Symmetry.ANTISYMMETRIC]

    one, twice, other_way = antisymmetric(1e-5), antisymmetric(2e-5), antisymmetric(-1e-5)
    assert np.abs(one).max() > 0
    assert twice == pytest.approx(2 * one, rel=2e-2, abs=1e-3 * np.abs(one).max())
    assert other_way == pytest.approx(-one, rel=2e-2, abs=1e-3 * np.abs(one).max())


# --- Cane and damping ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["nu_LT", "nu_LR", "nu_TR"])
def test_poisson_ratios_grow_by_their_factor_and_nothing_else_does(name, coarse_reed):
    drawn, shifted = (
        cane_law(coarse_reed.cane, ELASTIC, CaneShift(**{name: log})).at(3000.0)
        for log in (0.0, 0.2)
    )
    assert getattr(shifted, name) == pytest.approx(getattr(drawn, name) * np.exp(0.2))
    assert replace(shifted, **{name: getattr(drawn, name)}) == drawn


def test_shear_that_loses_more_damps_torsion_more_than_bending(reed_solver):
    even, uneven = (reed_solver.modes(replace(REED, shear_loss_log=log)) for log in (0.0, 0.5))
    grown = {name: uneven[name].loss_factor / even[name].loss_factor for name in even}
    assert all(1.0 < factor < np.exp(0.5) for factor in grown.values())
    # Energy in shear: 5 % of F1, over half of T1 (reed-model study, Table 3 of the paper).
    assert grown["F1"] < 1.1 < 1.25 < grown["T1"]


@pytest.mark.parametrize("mode", ["F1", "T1", "X1"])
def test_peaks_are_as_low_as_modes_say_that_shear_makes_them(mode, reed_solver):
    """Far from others, the peak is inversely proportional to the loss factor of the mode."""
    vacuum = replace(REED, air_share=0.0)
    hz = reed_solver.modes(vacuum)[mode].hz

    def peak(log):
        reed = replace(vacuum, loss_factor=1e-3, shear_loss_log=log)
        moved = PlainMotion(reed_solver.reed).coordinates(
            reed, UNCHANGED, hz, 0.0, lambda _hz, _x, y: (1 + 100 * y).astype(complex)
        )
        return max(np.abs(own).max() for own in moved.values())

    even, uneven = (
        reed_solver.modes(replace(vacuum, shear_loss_log=log))[mode].loss_factor
        for log in (0.0, 0.6)
    )
    assert peak(0.0) / peak(0.6) == pytest.approx(uneven / even, rel=0.03)


def test_both_ways_to_move_a_reed_know_of_the_losses_of_shear(reed_solver):
    reed = replace(REED, shear_loss_log=0.6)
    hz, pressure = 3580.0, lambda _hz, _x, y: (1 + 100 * y).astype(complex)
    plain = PlainMotion(reed_solver.reed).coordinates(reed, UNCHANGED, hz, 0.0, pressure)
    altered = AlteredMotion(reed_solver).coordinates(reed, UNCHANGED, hz, 0.0, pressure)
    for key, own in plain.items():
        least = 1e-6 * np.abs(own).max()
        assert altered[key][: len(own)] == pytest.approx(own, rel=1e-6, abs=least)


def test_a_condition_changes_the_moduli_that_it_names(reed_solver):
    """The same motion as of a reed whose constants are these from the start."""
    still = replace(REED, air_share=0.0)
    logs = {"E_L": 0.02, "G_LT": -0.03, "others": 0.05}
    change = ConditionChange(**{n: np.asarray(v) for n, v in logs.items()}, loss=np.zeros(()))
    shift = CaneShift(E_L=0.02, G_LT=-0.03, **dict.fromkeys(("E_T", "E_R", "G_LR", "G_TR"), 0.05))
    other = replace(still, shift=shift)

    def moved(reed, change):
        return PlainMotion(reed_solver.reed).coordinates(
            reed, change, 5000.0, 0.0, lambda _hz, _x, y: (1 + 100 * y).astype(complex)
        )

    changed, expected = moved(still, change), moved(other, UNCHANGED)
    for key, own in expected.items():
        # Motions are some picometres: the least absolute difference must not count.
        assert changed[key] == pytest.approx(own, rel=1e-9, abs=1e-9 * np.abs(own).max())
