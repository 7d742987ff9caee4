"""Minimise the cost of the joint model: Newton's steps, each followed along a curved valley.

What holograms are driven by and what modes take part with have a common factor that may be almost
anything, and does not enter both alike: the cost has a long valley that is curved. A step of
Newton's, damped as Levenberg and Marquardt do, stays near its bottom and gets on slowly. Its
equations, which are what costs time, serve a dozen further steps: gradients are cheap, and what
they tell of the curvature is added by the limited memory of Broyden, Fletcher, Goldfarb and Shanno.
"""

import contextlib
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.modal.model import (
    Model,
    Prior,
    State,
)
from fitting.modal.normal_equations import (
    Data,
    Equations,
    Place,
    downhill,
    equations,
    place,
)

Array = NDArray[np.floating[Any]]

_LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e8
# What rounding may take off the smallest eigenvalues of a matrix of units in single precision.
_ROUGH = 3e-6
# Shares of the cost that a step of Newton's with all that follow it, and one of those, must gain.
_LEAST_PROGRESS, _LEAST_GAIN = 1e-3, 3e-5
# Steps after one of Newton's, and how many of them are remembered.
_FOLLOWING, _REMEMBERED = 12, 12
# A step must gain this share of what the slope promises, or it is cut.
_SUFFICIENT, _CUT, _SHORTEST = 1e-4, 3.0, 1e-2


@dataclass(frozen=True)
class _Step:
    """A step along all coordinates (q + 2k,), and what it changed the gradient by."""

    move: Array
    change: Array

    @property
    def product(self) -> float:
        """Positive where the cost bends upwards."""
        return float(self.move @ self.change)


class _Newton:
    """Damped equations, factored: solves for steps against any gradient.

    Raises
    ------
    numpy.linalg.LinAlgError
        If rounding has left a matrix that is none of a minimum.
    """

    def __init__(self, here: Equations, damping: float) -> None:
        matrix, self._root, self._solved = without_drive(here, damping, np.float32)
        diagonal = np.diag(here.matrix)
        # Parameters of very different sizes: each in units of what alone would be told of it.
        self._unit = 1 / np.sqrt(diagonal)
        damped = matrix + np.diag(damping * diagonal)
        scaled = self._unit[:, None] * damped * self._unit + _ROUGH * np.eye(len(diagonal))
        self._factor = linalg.cho_factor(scaled.astype(np.float32))
        self._coupling = here.coupling

    def step(self, force: Array) -> Array:
        """Step (q + 2k,) for a negative gradient."""
        count = len(self._unit)
        (solve,) = linalg.get_blas_funcs(("trsm",), (self._root,))
        pulled = solve(1.0, self._root, force[count:, None].astype(np.float32), lower=1)[:, 0]
        beside_drive = self._unit * (force[:count] - pulled @ self._solved)
        move = self._unit * linalg.cho_solve(self._factor, beside_drive.astype(np.float32))
        left = force[count:] - self._coupling.T @ move
        drive = linalg.cho_solve((self._root, True), left.astype(np.float32))
        return np.concatenate([move, drive])


def without_drive(
    here: Equations, damping: float, precision: type[np.floating[Any]]
) -> tuple[Array, Array, Array]:
    """Eliminate the drive, as precisely as is asked.

    Returns
    -------
    matrix : (q, q) float
    root : (2k, 2k) float
        (Lower) root of the drive's damped matrix.
    solved : (2k, q) float
        Its inverse times the coupling.
    """
    diagonal = np.diag(here.drive_matrix)
    damped = here.drive_matrix + np.diag(damping * diagonal + 1e-9)
    root = linalg.cholesky(damped.astype(precision), lower=True, check_finite=False)
    # The drives of holograms far apart hardly bend together. Products of numbers so small would be
    # subnormal, for which processors take ten times as long.
    root[np.abs(root) < np.sqrt(np.finfo(precision).tiny)] = 0
    # BLAS itself: scipy's solve_triangular is five times as slow.
    (solve,) = linalg.get_blas_funcs(("trsm",), (root,))
    solved = solve(1.0, root, here.coupling.T.astype(precision), lower=1)
    return here.matrix - solved.T @ solved, root, solved


def improve(model: Model, data: Data, prior: Prior, state: State, iterations: int) -> State:
    """Minimise the cost until nothing is gained, or for so many of Newton's steps.

    Parameters
    ----------
    model : Model
    data : Data
    prior : Prior
    state : State
        Where to begin.
    iterations : int
    """
    at, damping, quick = place(model, data, prior, state), 1e-3, data.single()
    force = downhill(model, data, prior, at)
    for _ in range(iterations):
        here, before = equations(model, quick, prior, at.state), at.cost
        while True:
            # Damping makes a matrix one of a minimum.
            with contextlib.suppress(np.linalg.LinAlgError):
                newton = _Newton(here, damping)
                moved = _moved(model, prior, at.state, newton.step(force))
                tried = place(model, data, prior, moved)
                if tried.cost < at.cost:
                    break
            damping = max(8 * damping, 1e-6)
            if damping > _MOST_DAMPING:
                return at.state
        damping = max(damping / 5, _LEAST_DAMPING)
        at, force = _followed(model, data, prior, newton, tried)
        if before - at.cost < _LEAST_PROGRESS * at.cost:
            break
    return at.state


def _followed(
    model: Model, data: Data, prior: Prior, newton: _Newton, at: Place
) -> tuple[Place, Array]:
    """Go on along the valley with the equations of a place nearby; also the last gradient."""
    force = downhill(model, data, prior, at)
    steps: deque[_Step] = deque(maxlen=_REMEMBERED)
    for _ in range(_FOLLOWING):
        move = _direction(newton, steps, force)
        slope, share = float(force @ move), 1.0
        tried = place(model, data, prior, _moved(model, prior, at.state, move))
        while not tried.cost < at.cost - 2 * _SUFFICIENT * share * slope:
            share /= _CUT
            if slope <= 0 or share < _SHORTEST:
                return at, force
            tried = place(model, data, prior, _moved(model, prior, at.state, share * move))
        gain, at, before = at.cost - tried.cost, tried, force
        force = downhill(model, data, prior, at)
        step = _Step(share * move, before - force)
        if step.product > 0:
            steps.append(step)
        if gain < _LEAST_GAIN * at.cost:
            break
    return at, force


def _direction(newton: _Newton, steps: deque[_Step], force: Array) -> Array:
    """Step by Newton's equations, as corrected by what earlier steps have told (two loops)."""
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
    # A step of a logarithm by more than 1 is no small one.
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
        together=state.together + move[among : -2 * count],
    )
