"""Minimise the cost of the joint model by Levenberg-Marquardt steps, each followed by L-BFGS steps.

Drive and participations have a nearly free common factor, and so have participations and mixing of
weak modes: the cost is a long valley. In the coordinates of the parameters it is curved, and steps
stay short. Steps therefore multiply: the inverse of the drive moves in proportion to the
participations, and the product of mixing and participation in proportion to the mixing. Then the
valley is straight. Along it the cost bends 10⁷ times less than across it, which takes numbers of
double precision.

Most of the time is spent on the normal equations; gradients are cheap. The factored equations are
therefore used for some further steps, as the initial Hessian of L-BFGS (J. Nocedal, S. J. Wright,
Numerical Optimization, 2nd ed., algorithm 7.4).
"""

import contextlib
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from fitting.errors import FitError
from fitting.modal.expected.prior import Prior
from fitting.modal.model import GROWTH, Model, State
from fitting.modal.noise import Data
from fitting.modal.normal_equations import (
    Equations,
    Evaluation,
    equations,
    evaluate,
    negative_gradient,
)
from holography.arrays import Array

# Damping, relative to the diagonal (D. W. Marquardt 1963, SIAM Journal 11:431): first, least and
# largest. It falls to a fifth after a step that gains more than a quarter of what the equations
# predict, and is doubled after a smaller gain. Chosen: they decide how long a search takes, and not
# where it ends.
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-10, 1e8
_LESS, _MORE, _FAR_MORE, _GOOD = 5.0, 2.0, 8.0, 0.25
# Added to the diagonal of a matrix of unit diagonal: more than its rounding.
_ROUNDING = 1e-11
# Least decrease of the cost in a step: a parameter that is off by its standard error costs 1.
_LEAST_PROGRESS, _LEAST_GAIN = 1.0, 1.0
# Steps that follow a Levenberg-Marquardt step, and how many of them L-BFGS remembers.
_FOLLOWING, _REMEMBERED = 12, 12
# Line search: least fraction of the decrease that the gradient predicts, factor that cuts the
# step, and shortest step.
_SUFFICIENT, _CUT, _SHORTEST = 1e-4, 3.0, 1e-2
# Largest change of the inverse of a drive, towards zero: a factor of e.
_MOST_LOUDER = 1 - np.exp(-1)
# ... and limits of the factor by which a step multiplies a participation, for its mixing. Chosen:
# where a participation changes sign, a product says nothing.
_GROWTH = 0.5, 2.0
_INSEPARABLE = (
    "the holograms cannot separate the modes of this reed; look at the contact sheet that acquire "
    "report writes, or count fringes: --method picture"
)


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
        scaled, self._root, self._solved = without_drive(here, damping)
        diagonal = np.diag(here.matrix)
        # Parameters of very different sizes are scaled to a unit diagonal.
        self._unit = 1 / np.sqrt(diagonal)
        scaled *= self._unit[:, None]
        scaled *= self._unit
        scaled[np.diag_indices_from(scaled)] += damping + _ROUNDING
        self._factor = linalg.cho_factor(scaled, lower=True, overwrite_a=True, check_finite=False)
        self._here = here

    def step(self, force: Array) -> Array:
        """Return the step (q + 2k,) for a negative gradient."""
        count, coupling = len(self._unit), self._here.coupling
        (solve,) = linalg.get_blas_funcs(("trsm",), (self._root,))
        pulled = solve(1.0, self._root, force[count:, None], lower=1)[:, 0]
        reduced = self._unit * (force[:count] - pulled @ self._solved)
        move = self._unit * linalg.cho_solve(self._factor, reduced, check_finite=False)
        left = force[count:] - coupling.T @ move
        drive = linalg.cho_solve((self._root, True), left, check_finite=False)
        return np.concatenate([move, drive])

    def expected(self, move: Array, force: Array) -> float:
        """Return the decrease of the cost that a step brings if it is as the equations say."""
        here, own, drive = self._here, *np.split(move, [len(self._unit)])
        bend = own @ (here.matrix @ own + 2 * here.coupling @ drive)
        return float(2 * force @ move - bend - drive @ here.drive_matrix @ drive)


def without_drive(here: Equations, damping: float) -> tuple[Array, Array, Array]:
    """Eliminate the drive from the normal equations.

    Returns
    -------
    matrix : (q, q) float
        Lower triangle of the Schur complement of the drive's block.
    root : (2k, 2k) float
        Lower Cholesky factor of the drive's damped block.
    solved : (2k, q) float
        Inverse of `root` times the coupling.
    """
    diagonal = np.diag(here.drive_matrix)
    damped = here.drive_matrix + np.diag(damping * diagonal + 1e-9)
    root = linalg.cholesky(damped, lower=True, check_finite=False)
    # Elements of distant holograms are tiny. Their products would be subnormal numbers, for which
    # processors take ten times as long.
    root[np.abs(root) < np.sqrt(np.finfo(float).tiny)] = 0
    # BLAS itself: scipy's solve_triangular is five times as slow.
    (solve,) = linalg.get_blas_funcs(("trsm",), (root,))
    solved = solve(1.0, root, here.coupling.T, lower=1)
    (rank,) = linalg.get_blas_funcs(("syrk",), (solved,))
    # It takes half of the time of the whole product, which is symmetric.
    return rank(-1.0, solved, beta=1.0, c=here.matrix.T, trans=1, lower=1), root, solved


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
    # A scatter that another ripple left would be near another minimum.
    state = replace(state, scatter=np.zeros(len(state.log_drive)))
    at, damping = evaluate(model, data, prior, state), _FIRST_DAMPING
    force = negative_gradient(model, data, prior, at)
    for _ in range(iterations):
        here, before = equations(model, data, prior, at), at.cost
        while True:
            # More damping makes the matrix positive definite.
            with contextlib.suppress(np.linalg.LinAlgError):
                newton = _Newton(here, damping)
                move = newton.step(force)
                expected = newton.expected(move, force)
                tried = evaluate(model, data, prior, _moved(model, data, prior, at, move))
                if tried.cost < before:
                    break
            damping *= _FAR_MORE
            if damping > _MOST_DAMPING:
                return at.state
        good = before - tried.cost > _GOOD * expected
        damping = max(damping / _LESS, _LEAST_DAMPING) if good else _MORE * damping
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
        tried = evaluate(model, data, prior, _moved(model, data, prior, at, move))
        while not tried.cost < at.cost - 2 * _SUFFICIENT * length * slope:
            length /= _CUT
            if slope <= 0 or length < _SHORTEST:
                return at, force
            tried = evaluate(model, data, prior, _moved(model, data, prior, at, length * move))
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


def _moved(model: Model, data: Data, prior: Prior, at: Evaluation, move: Array) -> State:
    """Take a step (q + 2k,), in coordinates in which the valley is straight."""
    state, modes, powers = at.state, len(model.active), model.powers.shape[1]
    count, among = len(state.log_drive), int(np.count_nonzero(prior.free))
    step = np.zeros_like(state.x)
    step[prior.free] = move[:among]
    # A logarithm changes by at most 1 in a step: the linearisation does not hold farther.
    step[:modes, 2 * powers :] = np.clip(step[:modes, 2 * powers :], -1, 1)
    # So does an exponent: losses would overflow.
    shared = move[among : -2 * count].copy()
    shared[GROWTH] = np.clip(shared[GROWTH], -1, 1)
    step[modes:, :modes] /= _growth(model, data, at, step)
    drive = np.clip(move[-2 * count :].reshape(2, -1), -1, 1)
    inverse = 1 - np.minimum(drive[0], _MOST_LOUDER) - 1j * drive[1]
    return replace(
        state,
        x=state.x + step,
        log_drive=state.log_drive - np.log(inverse),
        shared=state.shared + shared,
    )


def _growth(model: Model, data: Data, at: Evaluation, step: Array) -> Array:
    """Return the factor (a,) by which a step (v, p) multiplies each participation.

    It is the one that fits best where the mode is seen.
    """
    now, active, powers = at.terms, model.active, model.powers.shape[1]
    of_active = step[: len(active)]
    change = model.powers @ (of_active[:, :powers] + 1j * of_active[:, powers : 2 * powers]).T
    before = now.participation[:, active]
    moved = np.exp(at.state.log_drive.real)[:, None] / np.abs(now.alone[:, active])
    seen = data.seen[:, None] * moved**2
    along = np.sum(seen * (before.conj() * change).real, axis=0)
    return np.asarray(np.clip(1 + along / np.sum(seen * np.abs(before) ** 2, axis=0), *_GROWTH))


def inverse(matrix: Array) -> Array:
    """Invert a positive definite matrix of parameters of very different sizes.

    Its lower triangle is read.

    Raises
    ------
    FitError
        If the matrix is not positive definite because of rounding.
    """
    unit, root = _scaled_root(matrix)
    lower, _ = linalg.lapack.dpotri(root, lower=1, overwrite_c=1)
    inverse: Array = np.tril(lower) + np.tril(lower, -1).T
    inverse *= unit[:, None]
    inverse *= unit
    return inverse


def log_determinant(matrix: Array) -> float:
    """Return the logarithm of the determinant of a matrix as for `inverse`."""
    unit, root = _scaled_root(matrix)
    return 2 * float(np.sum(np.log(np.diag(root) / unit)))


def _scaled_root(matrix: Array) -> tuple[Array, Array]:
    """Return the scale (q,) of each parameter, and the lower factor of the scaled matrix."""
    diagonal = np.diag(matrix)
    if not np.all(diagonal > 0):
        raise FitError(_INSEPARABLE)
    unit = 1 / np.sqrt(diagonal)
    scaled = unit[:, None] * matrix * unit
    scaled[np.diag_indices_from(scaled)] += _ROUNDING
    try:
        return unit, linalg.cholesky(scaled, lower=True, overwrite_a=True)
    except np.linalg.LinAlgError:
        raise FitError(_INSEPARABLE) from None
