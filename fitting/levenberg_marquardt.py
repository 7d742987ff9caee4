"""Levenberg-Marquardt minimisation of many small problems at once, each with its own damping."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array, IndexArray


@dataclass(frozen=True)
class NormalEquations:
    """Quadratic approximations of s problems with u unknowns each.

    Attributes
    ----------
    cost_terms : (c, s) float
        Terms whose sum is the cost of each problem.
    negative_gradient : (s, u) float
        Of half the cost.
    matrix : (s, u, u) float
        Gauss-Newton approximation of half the Hessian.
    curvature : (s,) float
        Sum of the diagonal elements that set the scale of the damping.
    """

    cost_terms: Array
    negative_gradient: Array
    matrix: Array
    curvature: Array

    def some(self, chosen: NDArray[np.bool_]) -> "NormalEquations":
        """Return the equations of the chosen problems (s,)."""
        return NormalEquations(
            self.cost_terms[:, chosen],
            self.negative_gradient[chosen],
            self.matrix[chosen],
            self.curvature[chosen],
        )

    def replace(self, chosen: NDArray[np.bool_], other: "NormalEquations") -> None:
        """Overwrite the equations of the chosen problems (s,)."""
        self.negative_gradient[chosen] = other.negative_gradient[chosen]
        self.matrix[chosen] = other.matrix[chosen]
        self.curvature[chosen] = other.curvature[chosen]


@dataclass(frozen=True)
class Damping:
    """How the damping of each problem is chosen.

    The damping, times the mean curvature of the damped unknowns, is added to the diagonal of the
    normal matrix.

    Attributes
    ----------
    first : float
        Damping of the first step.
    after_gain, after_loss : float
        Factors on the damping after a step that decreased the cost, and after one that did not.
    constant : float
        Added to the diagonal in every step, in units of the normal matrix. It keeps the matrix
        regular.
    largest : float
        Upper limit of the damping.
    """

    first: float
    after_gain: float
    after_loss: float
    constant: float
    largest: float = np.inf


def minimise_all(
    equations: Callable[[Array, IndexArray], NormalEquations],
    cost_terms: Callable[[Array, IndexArray], Array],
    start: Array,
    iterations: int,
    damping: Damping,
    damped: int | None = None,
    least_gain: float = 0.0,
) -> tuple[Array, Array]:
    """Take Levenberg-Marquardt steps in all problems; a step that increases the cost is undone.

    Parameters
    ----------
    equations : callable
        Returns the normal equations at unknowns (p, u) of problems (p,). They are overwritten.
    cost_terms : callable
        Returns only the terms (c, p) of the cost at unknowns (p, u) of problems (p,).
    start : (s, u) float
    iterations : int
        Number of steps, at least 1.
    damping : Damping
    damped : int, optional
        Number of leading unknowns that are damped; all by default.
    least_gain : float
        Steps of a problem end early when one that was damped no more than the first step is
        expected to lower the cost by less than this.

    Returns
    -------
    x : (s, u) float
    cost_terms : (c, s) float
        Terms of the cost at x.

    Notes
    -----
    J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3.
    """
    x, left = start.copy(), np.arange(len(start))
    here, amount = equations(x, left), np.full(len(x), damping.first)
    terms = here.cost_terms.copy()
    diagonal = np.arange(x.shape[1])[:damped]
    for remaining in reversed(range(iterations)):
        step = _steps(here, amount * here.curvature / len(diagonal) + damping.constant, diagonal)
        little = np.sum(step * here.negative_gradient, axis=1) < least_gain
        going = ~(little & (amount <= damping.first))
        if not np.all(going):
            left, step, amount, here = left[going], step[going], amount[going], here.some(going)
        if not left.size:
            break
        trial = x[left] + step
        # The last step needs no equations: they take most of the time.
        there = equations(trial, left) if remaining else None
        tried = there.cost_terms if there else cost_terms(trial, left)
        better = tried.sum(axis=0) < terms[:, left].sum(axis=0)
        x[left[better]], terms[:, left[better]] = trial[better], tried[:, better]
        if there:
            here.replace(better, there)
        more = np.minimum(damping.after_loss * amount, damping.largest)
        amount = np.where(better, damping.after_gain * amount, more)
    return x, terms


def _steps(here: NormalEquations, added: Array, diagonal: IndexArray) -> Array:
    """Return the step (s, u) of every problem, with numbers (s,) added to some of the diagonal."""
    matrix = here.matrix.copy()
    matrix[:, diagonal, diagonal] += added[:, None]
    steps: Array = np.linalg.solve(matrix, here.negative_gradient[..., None])[..., 0]
    return steps
