"""Least squares with unknowns of each reed and unknowns that all reeds have in common.

The normal matrix has the form of an arrow: a small block for each reed, and a border for the common
unknowns. The blocks are eliminated one by one, so that the time of a step is proportional to the
number of reeds. Linear equality constraints on the steps (see `ArrowEquations.constraints`) are
added to the border with Lagrange multipliers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg

from holography.arrays import Array

_FIRST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-9
# With more damping than this a step may be short because of the damping, far from the minimum.
_UNDAMPED = 1e-4
_SOFTER, _STIFFER = 0.2, 4.0
# The damping decreases if the cost decreases by this fraction of the expected amount.
_AS_EXPECTED = 0.25
# Relative rounding error of the cost.
_ROUNDING = 1e-14
# Steps remembered by the acceleration.
_MEMORY = 6


@dataclass(frozen=True, eq=False)
class ArrowPoint:
    """Values of all unknowns, or a step of all.

    Attributes
    ----------
    shared : (q,) float
    own : (n, K) float
        A row for each reed.
    """

    shared: Array
    own: Array

    def plus(self, other: "ArrowPoint", factor: float = 1.0) -> "ArrowPoint":
        """Add a multiple of another point or step."""
        return ArrowPoint(self.shared + factor * other.shared, self.own + factor * other.own)

    def dot(self, other: "ArrowPoint") -> float:
        """Return the scalar product."""
        return float(np.vdot(self.shared, other.shared) + np.vdot(self.own, other.own))


@dataclass(frozen=True, eq=False)
class ArrowEquations:
    """Sum of squares to be minimised, to second order in a step.

    Attributes
    ----------
    cost : float
        Sum of squares here.
    own : (n, K, K), cross : (n, K, q), shared : (q, q) float
        Blocks of JᵀJ.
    own_descent : (n, K), shared_descent : (q,) float
        Half the negative gradient.
    constraints : (n, K, c) float
        Steps of the reeds' own unknowns are orthogonal to each of the c columns.
    """

    cost: float
    own: Array
    cross: Array
    shared: Array
    own_descent: Array
    shared_descent: Array
    constraints: Array

    def step(self, damping: float) -> ArrowPoint:
        """Return the damped step (Marquardt's scaling) within the constraints."""
        _, K, q = self.cross.shape
        shared = self.shared * (1 + damping * np.eye(q))
        own = self.own * (1 + damping * np.eye(K))
        border = np.concatenate([self.cross, self.constraints], axis=-1)
        solved = np.linalg.solve(own, np.concatenate([border, self.own_descent[..., None]], -1))
        eliminated = np.tensordot(border, solved, axes=([0, 1], [0, 1]))
        matrix = -eliminated[:, :-1]
        matrix[:q, :q] += shared
        right = np.zeros(len(matrix))
        right[:q] = self.shared_descent
        outer = _solve_symmetric(matrix, right - eliminated[:, -1])
        return ArrowPoint(outer[:q], solved[..., -1] - solved[..., :-1] @ outer)

    def expected_decrease(self, step: ArrowPoint) -> float:
        """Return the decrease of the cost that the gradient predicts for a damped step."""
        return ArrowPoint(self.shared_descent, self.own_descent).dot(step)

    def times(self, step: ArrowPoint) -> ArrowPoint:
        """Return JᵀJ times a step."""
        return ArrowPoint(
            self.shared @ step.shared + np.tensordot(step.own, self.cross, axes=2),
            np.einsum("nkl,nl->nk", self.own, step.own) + self.cross @ step.shared,
        )

    def information_on_shared(self) -> Array:
        """Return JᵀJ of the common unknowns (q, q) with the reeds' own unknowns eliminated.

        The inverse, times the noise's variance, is the covariance of the shared unknowns.
        """
        q = len(self.shared)
        border = np.concatenate([self.cross, self.constraints], axis=-1)
        spent = np.tensordot(border, np.linalg.solve(self.own, border), axes=([0, 1], [0, 1]))
        kept = np.linalg.solve(spent[q:, q:], spent[q:, :q])
        information: Array = self.shared - spent[:q, :q] + spent[:q, q:] @ kept
        return information


def _solve_symmetric(matrix: Array, right: Array) -> Array:
    """Solve a symmetric indefinite system whose rows may be of very different size."""
    size = np.sqrt(np.abs(np.diag(matrix)))
    size[size == 0] = 1
    scaled = scipy.linalg.solve(matrix / np.outer(size, size), right / size, assume_a="sym")
    return np.asarray(scaled / size)


class ArrowProblem(Protocol):
    """Problem that `minimise` solves."""

    def cost(self, at: ArrowPoint) -> float:
        """Return the sum of squares; infinite where the model is not defined."""

    def normal_equations(self, at: ArrowPoint) -> ArrowEquations:
        """Return the normal equations at a point that satisfies the constraints."""

    def onto_constraints(self, near: ArrowPoint) -> ArrowPoint:
        """Return the point near `near` that satisfies the constraints."""


@dataclass(frozen=True, eq=False)
class Minimum:
    """Result of a minimisation.

    Attributes
    ----------
    point : ArrowPoint
    cost : float
    iterations : int
    converged : bool
        Whether a minimum was reached. False if the iterations were used up, or if the model is not
        defined beyond the result.
    """

    point: ArrowPoint
    cost: float
    iterations: int
    converged: bool


def minimise(
    problem: ArrowProblem, start: ArrowPoint, *, tolerance: float, most_iterations: int
) -> Minimum:
    """Minimise by Levenberg-Marquardt steps with Anderson acceleration.

    Gauss-Newton steps converge slowly along curved valleys of weakly determined directions.
    Anderson acceleration extrapolates from the last few steps (Anderson, J. ACM 12, 1965). If that
    does not decrease the cost, the plain step is taken; if that does not either, a more damped one.
    The cost never increases.

    Parameters
    ----------
    problem : ArrowProblem
    start : ArrowPoint
    tolerance : float
        Expected decrease of the cost at which the minimisation ends.
    most_iterations : int
    """
    at, damping = problem.onto_constraints(start), _FIRST_DAMPING
    here = problem.normal_equations(at)
    past: list[tuple[ArrowPoint, ArrowPoint]] = []
    for iteration in range(1, most_iterations + 1):
        step = here.step(damping)
        promised = here.expected_decrease(step)
        plain = at.plus(step)
        for candidate in [_accelerated(here, at, step, past), plain] if past else [plain]:
            target = problem.onto_constraints(candidate)
            decrease = here.cost - problem.cost(target)
            if decrease > 0:
                break
        little = promised < max(tolerance, _ROUNDING * here.cost)
        if little and (damping < _UNDAMPED or decrease <= 0):
            best, cost = (target, here.cost - decrease) if decrease > 0 else (at, here.cost)
            # Where the model ends there is no minimum.
            return Minimum(best, cost, iteration, converged=decrease > -np.inf)
        if decrease > 0:
            past = [(at, step), *past][:_MEMORY]
            at, here = target, problem.normal_equations(target)
            if decrease > _AS_EXPECTED * promised:
                damping = max(damping * _SOFTER, _LEAST_DAMPING)
        else:
            damping = max(damping, _FIRST_DAMPING) * _STIFFER
    return Minimum(at, here.cost, most_iterations, converged=False)


def _accelerated(
    here: ArrowEquations,
    at: ArrowPoint,
    step: ArrowPoint,
    past: Sequence[tuple[ArrowPoint, ArrowPoint]],
) -> ArrowPoint:
    """Return the point at which the next step would be shortest, extrapolated from past steps."""
    moves = [(at.plus(before, -1), step.plus(then, -1)) for before, then in past]
    # The length of a step is that of its effect on the residuals.
    changed = [here.times(change) for _, change in moves]
    products = np.array([[a.dot(change) for _, change in moves] for a in changed])
    with_step = np.array([a.dot(step) for a in changed])
    fractions = np.linalg.lstsq(products, with_step, rcond=1e-10)[0]
    point = at.plus(step)
    for fraction, (move, change) in zip(fractions, moves, strict=True):
        point = point.plus(move, -fraction).plus(change, -fraction)
    return point
