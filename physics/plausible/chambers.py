"""Forces on modes by pressures that a chamber may have: how far they are from the model's.

The pressure on a reed is not measured. Its shape depends on how the reed lies on the rails of the
window, where it was put on the table, how the far end of the chamber reflects, and how much sound
gets to the bark side. Some modes are moved by the difference of large pressures that nearly cancel:
their forces are known to a factor of ten only. The forces in many such chambers say how well.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from holography.arrays import Array, ComplexArray
from physics.air import pressure_on_reed
from physics.mechanics import ReedMode, ReedSolver
from physics.parameters.chamber import Chamber
from physics.reed.elements.fem import Symmetry

# Number of chambers, and the seed they are drawn with: errors of a standard deviation are 5 %.
_CHAMBERS, _SEED = 200, 20260917
# Standard deviations of where a reed lies across the table, put there by hand, and of dimensions
# of the window that are measured with a ruler.
_PLACED_M, _RULER_M = 0.3e-3, 0.5e-3
# Least fraction of that, and of what differs from left to right in a chamber. Chosen: 0.01 mm for
# the reed, as under a magnifying glass, and as symmetric a chamber.
_EVEN = 0.03
# Largest part of a wave that travels: (1 - R) / (1 + R) for an end that reflects R of
# the pressure. Chosen: R of a third; an open slit of 1 mm at the end of a duct 10 mm high reflects
# (10 - 1) / (10 + 1), four fifths.
_MOST_TRAVELLING = 0.5
# Standard deviation of each part of the pressure on the bark side, of that at the tip. Chosen:
# sound that passes through gaps and around the mouthpiece is weaker by 17 dB.
_BEHIND = 0.1
# Factor by which the distance over which the pressure falls at a wall may be larger or smaller.
# Chosen: the gap between reed and walls is not measured.
_EDGE = 2.0
# Share of smooth products over the window and over frequency, and their degrees along and across.
# Chosen: a chamber with corners, and walls that give.
_DISTORTED, _DEGREES = 0.1, ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
_MIDDLE_HZ, _LOWEST_HZ = 4.5e3, 1e3
# Least share of a force without cancellation: rounding, not pressure, is below it.
_LEAST = 1e-4


@dataclass(frozen=True)
class LogForces:
    """Log forces on m modes by many chambers, over that by the pressure of the model.

    Attributes
    ----------
    mean : (m,) float
    columns : (m, m) float
        Independent standard deviations: their products are the covariance.
    """

    mean: Array
    columns: Array


@dataclass(frozen=True)
class _Points:
    """Load points of the left half of a reed, and how modes move there.

    Attributes
    ----------
    x_m, y_m : (n,) float
    left, right : (m, n) float
        Deflection times area of the left point and of its mirror image, halved.
    """

    x_m: Array
    y_m: Array
    left: Array
    right: Array


def log_forces(
    reed_solver: ReedSolver, chamber: Chamber, modes: Sequence[ReedMode], usual: Array
) -> LogForces:
    """Return how log forces on modes are distributed over the chambers that a bench may have.

    Parameters
    ----------
    reed_solver : ReedSolver
    chamber : Chamber
        As it is known: filling and dimensions.
    modes : sequence of ReedMode
        The m modes.
    usual : (m,) float
        Force on each by the pressure of the model.
    """
    points, rng = _points(reed_solver, modes), np.random.default_rng(_SEED)
    hz = np.array([mode.hz for mode in modes])
    logs = np.array([_drawn(points, chamber, hz, rng) for _ in range(_CHAMBERS)])
    logs = logs - np.log(usual)
    values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(logs.T)))
    return LogForces(logs.mean(axis=0), vectors * np.sqrt(np.maximum(values, 0.0)))


def _points(reed_solver: ReedSolver, modes: Sequence[ReedMode]) -> _Points:
    reed, start = reed_solver.reed, 0
    x, y = reed.load_points_m.T
    left, right = np.zeros((2, len(modes), len(x)))
    for symmetry, half in reed.loose.items():
        size = half.mass.shape[0]
        for row, mode in enumerate(modes):
            moved = 0.5 * half.load_z @ mode.coordinates[start : start + size]
            left[row] += moved
            right[row] += moved if symmetry is Symmetry.SYMMETRIC else -moved
        start += size
    return _Points(x, y, left, right)


def _drawn(points: _Points, chamber: Chamber, hz: Array, rng: np.random.Generator) -> Array:
    """Return log forces (m,) by the pressure in one chamber."""
    drawn = replace(
        chamber,
        length_m=chamber.length_m + _RULER_M * rng.standard_normal(),
        half_width_m=chamber.half_width_m + _RULER_M * rng.standard_normal(),
        edge_m=chamber.edge_m * _EDGE ** rng.uniform(-1, 1),
        # From a reed that closes the rails to one that is warped.
        rail_leak=rng.uniform(),
        # A wave that travels the other way has the conjugate pressure: its forces are as large.
        travelling=rng.uniform(0, _MOST_TRAVELLING),
    )
    uneven = _EVEN ** rng.uniform()
    offset_m = uneven * _PLACED_M * rng.standard_normal()
    behind = _BEHIND * (rng.standard_normal() + 1j * rng.standard_normal())
    shape = _DISTORTED * rng.standard_normal((2, len(_DEGREES)))
    shape *= [uneven if b % 2 else 1.0 for _, b in _DEGREES]
    forces = []
    for f, left, right in zip(hz, points.left, points.right, strict=True):
        pitch = float(np.clip(np.log(f / _MIDDLE_HZ) / np.log(_MIDDLE_HZ / _LOWEST_HZ), -1, 1))
        weights = shape[0] + np.sqrt(3) * pitch * shape[1]
        acting = [
            _pressure(drawn, float(f), points.x_m, side * points.y_m + offset_m, weights) - behind
            for side in (1, -1)
        ]
        pushed = acting[0] @ left + acting[1] @ right
        largest = np.abs(acting[0]) @ np.abs(left) + np.abs(acting[1]) @ np.abs(right)
        forces.append(max(abs(pushed), _LEAST * largest))
    return np.log(forces)


def _pressure(chamber: Chamber, hz: float, x_m: Array, y_m: Array, weights: Array) -> ComplexArray:
    """Return the pressure (n,) over that at the tip, with smooth products of such weights."""
    along = _legendre(2 * x_m / chamber.length_m - 1)
    across = _legendre(y_m / chamber.half_width_m)
    factor = 1 + sum(
        weight * along[:, a] * across[:, b]
        for weight, (a, b) in zip(weights, _DEGREES, strict=True)
    )
    return np.asarray(factor * pressure_on_reed(chamber, hz, x_m, y_m))


def _legendre(at: Array) -> Array:
    """Return Legendre polynomials (n, 3) of mean square 1 over −1 … 1."""
    degree = max(max(pair) for pair in _DEGREES)
    table: Array = np.polynomial.legendre.legvander(np.clip(at, -1, 1), degree)
    return table * np.sqrt(2 * np.arange(degree + 1) + 1)
