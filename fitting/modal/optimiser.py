"""Minimise the cost of the joint model by Levenberg-Marquardt steps, each followed by L-BFGS steps.

Drive and participations have a nearly free common factor, which makes the cost a long, curved
valley. A Levenberg-Marquardt step stays near its bottom and proceeds slowly. Most of the time is
spent on the normal equations; gradients are cheap. The factored equations are therefore used for up
to 12 further steps, as the initial Hessian of L-BFGS (J. Nocedal, S. J. Wright, Numerical
Optimization, 2nd ed., algorithm 7.4).
"""

import contextlib
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import linalg

from fitting.errors import FitError
from fitting.modal.model import (
    Model,
    Prior,
    State,
)
from fitting.modal.normal_equations import (
    Data,
    Equations,
    Evaluation,
    equations,
    evaluate,
    negative_gradient,
)
from holography.arrays import Array

_LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e8
# Added to the diagonal of a matrix of unit diagonal: more than its rounding in double and in single
# precision.
_ROUNDING, _ROUGH = 1e-11, 3e-6
# Least decrease of the cost in a Levenberg-Marquardt step with all that follow it, and in one of
# those: a parameter that is off by its standard error costs 1. With three times as much, searches
# from two starts ended at different places of the same valley.
_LEAST_PROGRESS, _LEAST_GAIN = 0.1, 0.01
# Steps that follow a Levenberg-Marquardt step, and how many of them L-BFGS remembers.
_FOLLOWING, _REMEMBERED = 12, 12
# Line search: least fraction of the decrease that the gradient predicts, factor that cuts the
# step, and shortest step.
_SUFFICIENT, _CUT, _SHORTEST = 1e-4, 3.0, 1e-2


@dataclass(frozen=True)
class _Step:
    """A step in all coordinates (q + 2k,), and the change of the gradient."""

    move: Array
    change: Array

    @property
    def product(self) -> float:
        """Scalar product of step and change; positive where the cost is convex."""
        return float(self.move @ self.change)


class _Newton:
    """Factored damped normal equations, solved for the step of any gradient.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite because of rounding.
    """

    def __init__(self, here: Equations, damping: float) -> None:
        matrix, self._root, self._solved = without_drive(here, damping, np.float32)
        diagonal = np.diag(here.matrix)
        # Parameters of very different sizes are scaled to a unit diagonal.
        self._unit = 1 / np.sqrt(diagonal)
        damped = matrix + np.diag(damping * diagonal)
        scaled = self._unit[:, None] * damped * self._unit + _ROUGH * np.eye(len(diagonal))
        self._factor = linalg.cho_factor(scaled.astype(np.float32))
        self._coupling = here.coupling

    def step(self, force: Array) -> Array:
        """Return the step (q + 2k,) for a negative gradient."""
        count = len(self._unit)
        (solve,) = linalg.get_blas_funcs(("trsm",), (self._root,))
        pulled = solve(1.0, self._root, force[count:, None].astype(np.float32), lower=1)[:, 0]
        reduced = self._unit * (force[:count] - pulled @ self._solved)
        move = self._unit * linalg.cho_solve(self._factor, reduced.astype(np.float32))
        left = force[count:] - self._coupling.T @ move
        drive = linalg.cho_solve((self._root, True), left.astype(np.float32))
        return np.concatenate([move, drive])


def without_drive(
    here: Equations, damping: float, precision: type[np.floating[Any]]
) -> tuple[Array, Array, Array]:
    """Eliminate the drive from the normal equations.

    Returns
    -------
    matrix : (q, q) float
        Schur complement of the drive's block.
    root : (2k, 2k) float
        Lower Cholesky factor of the drive's damped block.
    solved : (2k, q) float
        Inverse of `root` times the coupling.
    """
    diagonal = np.diag(here.drive_matrix)
    damped = here.drive_matrix + np.diag(damping * diagonal + 1e-9)
    root = linalg.cholesky(damped.astype(precision), lower=True, check_finite=False)
    # Elements of distant holograms are tiny. Their products would be subnormal numbers, for which
    # processors take ten times as long.
    root[np.abs(root) < np.sqrt(np.finfo(precision).tiny)] = 0
    # BLAS itself: scipy's solve_triangular is five times as slow.
    (solve,) = linalg.get_blas_funcs(("trsm",), (root,))
    solved = solve(1.0, root, here.coupling.T.astype(precision), lower=1)
    return here.matrix - solved.T @ solved, root, solved


def minimise_cost(model: Model, data: Data, prior: Prior, state: State, iterations: int) -> State:
    """Minimise the cost until it no longer decreases.

    Parameters
    ----------
    model : Model
    data : Data
    prior : Prior
    state : State
        Start.
    iterations : int
        Largest number of Levenberg-Marquardt steps.
    """
    at, damping, quick = evaluate(model, data, prior, state), 1e-3, data.single()
    force = negative_gradient(model, data, prior, at)
    for _ in range(iterations):
        here, before = equations(model, quick, prior, at.state), at.cost
        while True:
            # More damping makes the matrix positive definite.
            with contextlib.suppress(np.linalg.LinAlgError):
                newton = _Newton(here, damping)
                moved = _moved(model, prior, at.state, newton.step(force))
                tried = evaluate(model, data, prior, moved)
                if tried.cost < at.cost:
                    break
            damping = max(8 * damping, 1e-6)
            if damping > _MOST_DAMPING:
                return at.state
        damping = max(damping / 5, _LEAST_DAMPING)
        at, force = _followed(model, data, prior, newton, tried)
        if before - at.cost < _LEAST_PROGRESS:
            break
    return at.state


def _followed(
    model: Model, data: Data, prior: Prior, newton: _Newton, at: Evaluation
) -> tuple[Evaluation, Array]:
    """Take L-BFGS steps with equations of a nearby state; return the last state and gradient."""
    force = negative_gradient(model, data, prior, at)
    steps: deque[_Step] = deque(maxlen=_REMEMBERED)
    for _ in range(_FOLLOWING):
        move = _direction(newton, steps, force)
        slope, length = float(force @ move), 1.0
        tried = evaluate(model, data, prior, _moved(model, prior, at.state, move))
        while not tried.cost < at.cost - 2 * _SUFFICIENT * length * slope:
            length /= _CUT
            if slope <= 0 or length < _SHORTEST:
                return at, force
            tried = evaluate(model, data, prior, _moved(model, prior, at.state, length * move))
        gain, at, before = at.cost - tried.cost, tried, force
        force = negative_gradient(model, data, prior, at)
        step = _Step(length * move, before - force)
        if step.product > 0:
            steps.append(step)
        if gain < _LEAST_GAIN:
            break
    return at, force


def _direction(newton: _Newton, steps: deque[_Step], force: Array) -> Array:
    """Return the L-BFGS direction (two-loop recursion)."""
    rest, weights = force.copy(), []
    for step in reversed(steps):
        weight = float(step.move @ rest) / step.product
        weights.append(weight)
        rest -= weight * step.change
    move = newton.step(rest)
    for step, weight in zip(steps, reversed(weights), strict=True):
        move += (weight - float(step.change @ move) / step.product) * step.move
    return move


def _moved(model: Model, prior: Prior, state: State, move: Array) -> State:
    count, among = len(state.log_drive), int(np.count_nonzero(prior.free))
    # A logarithm changes by at most 1 in a step: the linearisation does not hold farther.
    drive = np.clip(move[-2 * count :].reshape(2, -1), -1, 1)
    x = state.x.copy()
    x[prior.free] += move[:among]
    logs = slice(len(model.active)), slice(2 * model.powers.shape[1], None)
    before = state.x[logs]
    x[logs] = np.clip(x[logs], before - 1, before + 1)
    return replace(
        state,
        x=x,
        log_drive=state.log_drive + drive[0] + 1j * drive[1],
        common_mode_shift=state.common_mode_shift + move[among : -2 * count],
    )


def inverse(matrix: Array) -> Array:
    """Invert a positive definite matrix of parameters of very different sizes.

    Raises
    ------
    FitError
        If the matrix is not positive definite because of rounding.
    """
    unit = 1 / np.sqrt(np.diag(matrix))
    scaled = unit[:, None] * matrix * unit + _ROUNDING * np.eye(len(unit))
    try:
        root = linalg.cholesky(scaled, lower=True)
    except (np.linalg.LinAlgError, ValueError):
        raise FitError(
            "the holograms cannot separate the modes of this reed; look at the contact sheet "
            "that acquire report writes, or count fringes: --method picture"
        ) from None
    (solve,) = linalg.get_blas_funcs(("trsm",), (root,))
    half = solve(1.0, root, np.diag(unit), lower=1)
    inverse: Array = half.T @ half
    return inverse
