"""Prior of many numbers: a centre and a precision for each, and pairs that are tied."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array


@dataclass(frozen=True)
class Ties:
    """Pairs of parameters of which a weighted sum is expected to be 0.

    No parameter is in two pairs.

    Attributes
    ----------
    at : (2, 2, t) int
        Rows and places in them (first axis) of both parameters (second axis).
    weights : (2, t) float
    precision : float
        Of each sum.
    """

    at: NDArray[np.intp]
    weights: Array
    precision: float

    def sums(self, x: Array) -> Array:
        """Return the sums (t,) for parameters (v, p)."""
        found: Array = np.sum(self.weights * x[tuple(self.at)], axis=0)
        return found

    def pull(self, x: Array) -> Array:
        """Return half the slopes (v, p) of their cost."""
        found = np.zeros_like(x)
        found[tuple(self.at)] = self.precision * self.weights * self.sums(x)
        return found

    def add_to(self, matrix: Array, positions: NDArray[np.intp]) -> None:
        """Add their precisions to a matrix; `positions` (v, p) of the parameters in it."""
        first, second = positions[tuple(self.at)]
        one, other = self.weights
        matrix[first, first] += self.precision * one**2
        matrix[second, second] += self.precision * other**2
        matrix[first, second] += self.precision * one * other
        matrix[second, first] += self.precision * one * other

    def variances(self, precision: Array) -> Array:
        """Return the variances (2, t) of parameters that have a precision (v, p) of their own."""
        own, tied = precision[tuple(self.at)], self.precision * self.weights**2
        whole = own + tied
        found: Array = whole[::-1] / (whole[0] * whole[1] - tied[0] * tied[1])
        return found

    def log_volume(self, precision: Array) -> float:
        """Return what they add to that of parameters with a precision (v, p) of their own."""
        weight = np.sum(self.weights**2 / precision[tuple(self.at)], axis=0)
        return float(np.sum(np.log1p(self.precision * weight)))


def no_ties() -> Ties:
    """Return no pairs."""
    return Ties(np.zeros((2, 2, 0), int), np.zeros((2, 0)), 0.0)


@dataclass(frozen=True)
class Prior:
    """What is expected of every parameter.

    Attributes
    ----------
    centre, precision : (v, p) float
        Infinite precision fixes a parameter.
    ties : Ties
        Of free parameters whose centre is 0.
    """

    centre: Array
    precision: Array
    ties: Ties = field(default_factory=no_ties)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Mask (v, p) of the parameters that are not fixed."""
        return np.isfinite(self.precision)

    @property
    def positions(self) -> NDArray[np.intp]:
        """Positions (v, p) of the parameters among the free ones; -1 where one is fixed."""
        number = np.full(self.free.shape, -1)
        number[self.free] = np.arange(np.count_nonzero(self.free))
        return number

    @property
    def spread(self) -> Array:
        """Standard deviations (v, p); 0 for fixed parameters."""
        found: Array = self.precision**-0.5
        found[tuple(self.ties.at)] = np.sqrt(self.ties.variances(self.precision))
        return found

    @property
    def log_volume(self) -> float:
        """Twice the log of the density's factor, but for a constant."""
        own = float(np.sum(np.log(self.precision[self.free])))
        return own + self.ties.log_volume(self.precision)

    def cost(self, x: Array) -> float:
        """Return twice the negative log of the prior density, but for its factor."""
        free = self.free
        own = float(np.sum(self.precision[free] * (x - self.centre)[free] ** 2))
        return own + self.ties.precision * float(np.sum(self.ties.sums(x) ** 2))

    def pull(self, x: Array) -> Array:
        """Return half the slopes (v, p) of the cost; 0 for fixed parameters."""
        found = self.ties.pull(x)
        found[self.free] += self.precision[self.free] * (x - self.centre)[self.free]
        return found

    def add_to(self, matrix: Array) -> None:
        """Add the precisions of the free parameters to a matrix, of which they are the first."""
        own = np.arange(np.count_nonzero(self.free))
        matrix[own, own] += self.precision[self.free]
        self.ties.add_to(matrix, self.positions)

    def share(self, covariance: Array, among: NDArray[np.bool_]) -> float:
        """Return how many parameters the prior determines.

        Parameters
        ----------
        covariance : (q, q) float
            Posterior covariance; the free parameters are its first.
        among : (v, p) bool
            Those to count; both of a tie, or neither.
        """
        chosen = among[self.free]
        free = len(chosen)
        own = self.precision[self.free] * np.diag(covariance)[:free]
        tied = among[tuple(self.ties.at[:, 0])]
        first, second = self.positions[tuple(self.ties.at)][:, tied]
        one, other = self.ties.weights[:, tied]
        shared = one**2 * covariance[first, first] + other**2 * covariance[second, second]
        shared += 2 * one * other * covariance[first, second]
        return float(np.sum(own[chosen]) + self.ties.precision * np.sum(shared))
