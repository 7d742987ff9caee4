"""Fit parameters with Gaussian noise and proper priors, with evidence and a check of convergence.

Parameters z are in units of their priors: 0 is the prior's centre, ±1 a standard deviation. One
that cannot be negative has half a Gaussian. The cost is the sum of squares of the whitened
residuals ``r(z)`` and of z, minimised by Levenberg–Marquardt. Evidence is Laplace's approximation,
corrected for what a bound cuts off the posterior.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import log_ndtr

from holography.arrays import Array
from physics.errors import ImpossibleReedError

Residuals = Callable[[Array], Array]

# Step of finite differences, in prior standard deviations.
_STEP = 1e-3
_MOST_ITERATIONS = 60
_LEAST_GAIN = 1e-7
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-9, 1e9
# A fit has converged if two starts end within this cost of each other, and a further full step
# would gain no more than this decrement.
SAME_COST, LEAST_DECREMENT = 1.0, 0.1
# Starts lie within this many standard deviations of the prior.
_START_SPREAD = 1.0


@dataclass(frozen=True)
class MapEstimate:
    """Parameters at the greatest posterior density.

    Attributes
    ----------
    z : (p,) float
        In units of the prior.
    covariance : (p, p) float
        Of z, as if no bound were there.
    residuals : (n,) float
        Whitened.
    jacobian : (n, p) float
        Of the residuals.
    cost : float
        Sum of squares of residuals and of z.
    log_evidence : float
        In nats; of whitened data.
    decrement : float
        What the next full step would gain.
    consistent_starts : int
        Starts that ended within 1 of the least cost, this one included.
    starts : int
    """

    z: Array
    covariance: Array
    residuals: Array
    jacobian: Array
    cost: float
    log_evidence: float
    decrement: float
    consistent_starts: int
    starts: int

    @property
    def converged(self) -> bool:
        """Whether two starts agree, and a further step would gain nothing."""
        return self.consistent_starts >= min(2, self.starts) and self.decrement < LEAST_DECREMENT

    @property
    def chi2(self) -> float:
        """Sum of squares of the residuals."""
        return float(self.residuals @ self.residuals)


def fit(
    residuals: Residuals,
    positive: Sequence[bool],
    starts: Sequence[Array],
    jacobian: Callable[[Array], Array] | None = None,
    least_gain: float = _LEAST_GAIN,
) -> MapEstimate:
    """Find the parameters of the greatest posterior density.

    Parameters
    ----------
    residuals : callable
        Whitened residuals (n,) at z (p,). May raise ImpossibleReedError where nothing is possible.
    positive : sequence of bool
        Which of the p parameters cannot be negative.
    starts : sequence of (p,) float
        Where searches begin.
    jacobian : callable, optional
        Derivatives (n, p); by differences if not given.
    least_gain : float, optional
        Searches end where a step gains less than this share of the cost.

    Raises
    ------
    ImpossibleReedError
        If no start is possible.
    """
    bound = np.asarray(positive, dtype=bool)
    slope = jacobian or (lambda z: _differences(residuals, z, bound))
    found: list[tuple[float, Array]] = []
    trouble: ImpossibleReedError | None = None
    for start in starts:
        try:
            found.append(
                _descend(residuals, slope, bound, np.array(start, dtype=float), least_gain)
            )
        except ImpossibleReedError as error:
            trouble = error
    if not found:
        raise trouble or ValueError("a fit needs a start")
    cost, z = min(found, key=lambda end: end[0])
    agreeing = sum(other < cost + SAME_COST for other, _ in found)
    r, J = residuals(z), slope(z)
    precision = J.T @ J + np.eye(len(z))
    gradient = J.T @ r + z
    free = ~(bound & (z <= 0) & (gradient > 0))
    step = np.linalg.solve(precision[np.ix_(free, free)], gradient[free])
    return MapEstimate(
        z=z,
        covariance=posterior_covariance(J),
        residuals=r,
        jacobian=J,
        cost=cost,
        log_evidence=_log_evidence(cost, precision, gradient, z, bound),
        decrement=float(gradient[free] @ step),
        consistent_starts=agreeing,
        starts=len(starts),
    )


def posterior_covariance(slopes: Array) -> Array:
    """Return the posterior covariance (p, p) of parameters with a whitened Jacobian (n, p)."""
    p = slopes.shape[1]
    covariance: Array = linalg.cho_solve(
        linalg.cho_factor(np.eye(p) + slopes.T @ slopes), np.eye(p)
    )
    return covariance


def absorbed_part(slopes: Array, moved: Array) -> Array:
    """Return the part of a shift (n, d) that parameters with Jacobian (n, p) absorb."""
    answer: Array = slopes @ (posterior_covariance(slopes) @ (slopes.T @ moved))
    return answer


def marginalised_signature(slopes: Array, moved: Array) -> Array:
    """Return a signature (n, d) whitened by noise and nuisance covariance.

    Squares of its columns are the increase of the cost if only nuisances, Jacobian (n, p), can
    absorb the signature.
    """
    along, size, _ = np.linalg.svd(slopes, full_matrices=False)
    out: Array = moved - along @ ((1 - 1 / np.hypot(1.0, size))[:, None] * (along.T @ moved))
    return out


def residual_covariance(slopes: Array, some: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Array:
    """Return the covariance (k, k) of some residuals at the optimum, Jacobian (n, p)."""
    own = slopes[some]
    left: Array = np.eye(len(own)) - own @ posterior_covariance(slopes) @ own.T
    return left


def random_starts(
    count: int, positive: Sequence[bool], rng: np.random.Generator, first: Array | None = None
) -> list[Array]:
    """Starts (p,) from the prior, after one that is given or the prior's centre."""
    bound = np.asarray(positive, dtype=bool)
    drawn = _START_SPREAD * rng.standard_normal((max(count - 1, 0), len(bound)))
    drawn[:, bound] = np.abs(drawn[:, bound])
    return [np.zeros(len(bound)) if first is None else first, *drawn]


def _differences(residuals: Residuals, z: Array, bound: NDArray[np.bool_]) -> Array:
    """Derivatives (n, p) by differences, away from a bound."""
    here = residuals(z)
    columns = np.empty((len(here), len(z)))
    for k, bounded in enumerate(bound):
        # Models answer smoothly: one side will do, and costs half.
        step = _STEP if bounded or z[k] <= 0 else -_STEP
        moved = z.copy()
        moved[k] += step
        columns[:, k] = (residuals(moved) - here) / step
    return columns


def _descend(
    residuals: Residuals,
    slope: Callable[[Array], Array],
    bound: NDArray[np.bool_],
    z: Array,
    least_gain: float,
) -> tuple[float, Array]:
    """Least cost near a start, and where."""

    def cost_of(r: Array, z: Array) -> float:
        return float(r @ r + z @ z)

    r, damping = residuals(z), _FIRST_DAMPING
    cost = cost_of(r, z)
    for _ in range(_MOST_ITERATIONS):
        J = slope(z)
        precision, gradient = J.T @ J + np.eye(len(z)), J.T @ r + z
        free = ~(bound & (z <= 0) & (gradient > 0))
        gain = 0.0
        while damping < _MOST_DAMPING and free.any():
            part = precision[np.ix_(free, free)]
            move = np.zeros(len(z))
            move[free] = np.linalg.solve(part + damping * np.diag(np.diag(part)), -gradient[free])
            tried = np.where(bound, np.maximum(z + move, 0.0), z + move)
            try:
                r_tried = residuals(tried)
                reached = cost_of(r_tried, tried)
            except ImpossibleReedError:
                reached = np.inf
            if reached < cost:
                gain, cost, z, r = cost - reached, reached, tried, r_tried
                damping = max(damping / 10, _LEAST_DAMPING)
                break
            damping *= 10
        if gain <= least_gain * max(cost, 1.0):
            break
        damping = min(damping, 1.0)
    return cost, z


def _log_evidence(
    cost: float, precision: Array, gradient: Array, z: Array, bound: NDArray[np.bool_]
) -> float:
    """Log of the integral of likelihood times prior, Laplace's.

    Around the optimum the posterior is a Gaussian, whose middle may lie beyond a bound. Bounded
    parameters are cut one by one, as if they were independent in the posterior; their half Gaussian
    priors are twice as dense.
    """
    middle = z - np.linalg.solve(precision, gradient)
    at_middle = cost - float(gradient @ np.linalg.solve(precision, gradient))
    spread = np.sqrt(np.diag(np.linalg.inv(precision)))
    _, log_det = np.linalg.slogdet(precision)
    cut = float(np.sum(np.log(2) + log_ndtr(middle[bound] / spread[bound])))
    return -0.5 * at_middle - 0.5 * float(log_det) + cut
