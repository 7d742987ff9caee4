"""Levenberg-Marquardt minimisation of many small problems at once, each with its own damping."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array


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
    equations: Callable[[Array], NormalEquations],
    cost_terms: Callable[[Array], Array],
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
        Returns the normal equations at unknowns (s, u). The arrays are overwritten.
    cost_terms : callable
        Returns only the terms (c, s) of the cost at unknowns (s, u), for the last step.
    start : (s, u) float
    iterations : int
        Number of steps, at least 1.
    damping : Damping
    damped : int, optional
        Number of leading unknowns that are damped; all by default.
    least_gain : float
        Steps end early when in every problem one that was damped no more than the first step was
        expected to lower the cost by less than this.

    Returns
    -------
    x : (s, u) float
    cost_terms : (c, s) float
        Terms of the cost at x.

    Notes
    -----
    J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3. The factors on the
    damping are constants that the caller chooses, not functions of the gain ratio.
    """
    x, here, ended = start.copy(), equations(start), np.zeros(len(start), bool)
    terms, amount = here.cost_terms.copy(), np.full(len(x), damping.first)
    diagonal = np.arange(x.shape[1] if damped is None else damped)
    for remaining in reversed(range(iterations)):
        matrix, mean = here.matrix.copy(), here.curvature / len(diagonal)
        matrix[:, diagonal, diagonal] += (amount * mean + damping.constant)[:, None]
        step = np.linalg.solve(matrix, here.negative_gradient[..., None])[..., 0]
        little = np.sum(step * here.negative_gradient, axis=1) < least_gain
        ended |= little & (amount <= damping.first)
        if np.all(ended):
            break
        trial = x + step
        # The last step needs no equations: they take most of the time.
        there = equations(trial) if remaining else None
        trial_terms = there.cost_terms if there else cost_terms(trial)
        better = trial_terms.sum(axis=0) < terms.sum(axis=0)
        x[better], terms[:, better] = trial[better], trial_terms[:, better]
        if there:
            here.replace(better, there)
        increased = np.minimum(damping.after_loss * amount, damping.largest)
        amount = np.where(better, damping.after_gain * amount, increased)
    return x, terms
