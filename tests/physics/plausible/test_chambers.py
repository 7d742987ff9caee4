"""How far forces by the pressures of many chambers are from those of the model."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from diagnosis.observables.drive import _pushes
from diagnosis.observables.shapes import elastic_reed
from physics.air import pressure_on_reed, pressure_shape
from physics.mechanics import Mechanics, ReedSolver
from physics.parameters.chamber import Chamber, Filling
from physics.parameters.tree import BenchParameters
from physics.plausible.chambers import _points, _pressure, log_forces
from physics.reed.elements.mesh import MeshLevel
from physics.reed.reduced.response import pressure_forces
from physics.reed.reduced.stored import reduced_reed

NAMES = ("F1", "T1", "F2", "T2", "X1", "T3", "F3")
BENDING = [NAMES.index(name) for name in ("F1", "F2", "F3")]
TORSION = [NAMES.index(name) for name in ("T1", "X1", "T3")]
OPEN, HALF = Chamber(), Chamber(filling=Filling.ASYMMETRIC)


@pytest.fixture(scope="module")
def solver():
    return ReedSolver(reduced_reed(level=MeshLevel(orders=(2, 2, 2))))


@pytest.fixture(scope="module")
def modes(solver):
    every = solver.modes(Mechanics())
    return [every[name] for name in NAMES]


def elastic(solver):
    return solver.modes(elastic_reed(BenchParameters()))


def spread(found) -> np.ndarray:
    return np.sqrt(np.sum(found.columns**2, axis=1))


def fields(solver, modes, chamber):
    pushes = _pushes(solver, chamber, modes, elastic(solver))
    usual = np.maximum(np.abs(pushes.closed), 0.15 * pushes.without_signs)
    return log_forces(solver, chamber, modes, usual)


@pytest.mark.parametrize("chamber", [OPEN, HALF])
def test_no_force_exceeds_that_without_cancellation(solver, modes, chamber) -> None:
    pushes = _pushes(solver, chamber, modes, elastic(solver))
    assert np.all(np.abs(pushes.closed) <= pushes.without_signs * (1 + 1e-9))
    # The first mode bends the whole reed to one side.
    assert abs(pushes.closed[0]) == pytest.approx(pushes.without_signs[0], rel=0.1)


@pytest.mark.parametrize("chamber", [OPEN, replace(HALF, leak=0.2, rail_leak=0.3, travelling=0.4)])
def test_points_of_both_halves_give_the_force_of_the_reduced_reed(solver, modes, chamber) -> None:
    points = _points(solver, modes)
    for mode, left, right in zip(modes, points.left, points.right, strict=True):
        sides = [
            pressure_on_reed(chamber, mode.hz, points.x_m, side * points.y_m) for side in (1, -1)
        ]
        force = pressure_forces(
            solver.reed, mode.hz, partial(pressure_on_reed, chamber), loose=True
        )
        known = np.concatenate(list(force.values())) @ mode.coordinates
        scale = np.abs(sides[0]) @ np.abs(left) + np.abs(sides[1]) @ np.abs(right)
        assert sides[0] @ left + sides[1] @ right == pytest.approx(known, abs=1e-6 * scale)


def test_a_chamber_without_distortion_has_its_own_pressure(solver) -> None:
    x, y = solver.reed.load_points_m.T
    plain = _pressure(HALF, 5e3, x, y, np.zeros(5))
    assert plain == pytest.approx(pressure_shape(HALF, 5e3, x, y).astype(complex))


def test_of_modes_that_an_open_chamber_does_not_push_little_is_known(solver, modes) -> None:
    """What differs from left to right pushes all of them, by an amount that is not known."""
    found = fields(solver, modes, OPEN)
    own = spread(found)
    assert own[TORSION].min() > 2 * own[BENDING].max()
    covariance = found.columns @ found.columns.T
    together = covariance[np.ix_(TORSION, TORSION)] / np.multiply.outer(own[TORSION], own[TORSION])
    assert together.min() > 0.5


def test_with_clay_all_modes_are_known_within_a_factor(solver, modes) -> None:
    assert spread(fields(solver, modes, HALF)).max() < 1.0


def test_forces_are_the_same_each_time(solver, modes) -> None:
    one, other = fields(solver, modes, HALF), fields(solver, modes, HALF)
    assert np.array_equal(one.mean, other.mean)
    assert np.array_equal(one.columns, other.columns)
