"""Candidates: the model with no effect, one or two, fitted with all nuisances, and their evidence.

Residuals of all groups are whitened and put in one vector. The Jacobian along the nuisances is
taken at the fit without effects, and again where a fit moves far; along an effect's own sizes it
is taken at every step.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from diagnosis.inference.estimation import LEAST_DECREMENT, MapEstimate, fit, posterior_covariance
from diagnosis.inference.problem import (
    FINE,
    HERE,
    MOST_FINE,
    MOST_NEAR,
    NEAR,
    STEP,
    InferenceProblem,
    LocatedEffect,
    noise_inflation_gain,
    with_effects,
)
from holography.arrays import Array
from physics.effects.effect import Parameter
from physics.errors import ImpossibleReedError
from physics.parameters.tree import BenchParameters

# Effects have not quite the form that the catalogue gives them: a share of what they do.
_FORM = 0.12
# Searches end where a step gains less than this share of the cost: hundredths of a nat.
_LEAST_GAIN = 1e-4


@dataclass(frozen=True)
class Candidate:
    """The model with chosen effects, fitted.

    Attributes
    ----------
    effects : tuple of LocatedEffect
    estimate : MapEstimate
        Of nuisances, then of the effects' sizes; residuals and Jacobian in units of `deviation`.
    fit_log_evidence : float
        Log evidence of the fit.
    chi2 : dict of float
        Of each block.
    deviation : (n,) float
        Standard deviation of the whitened residuals: 1, and more where the effects do much, which
        have not quite the form that the catalogue gives them.
    other_locations : float
        What other locations of the effects add to the log evidence.
    """

    effects: tuple[LocatedEffect, ...]
    estimate: MapEstimate
    fit_log_evidence: float
    chi2: dict[str, float]
    deviation: Array
    other_locations: float = 0.0

    @property
    def log_evidence(self) -> float:
        """Log evidence of the fit and of other locations."""
        return self.fit_log_evidence + self.other_locations

    @property
    def names(self) -> tuple[str, ...]:
        """Identifiers of the effects."""
        return tuple(located.effect.id for located in self.effects)

    @property
    def sizes(self) -> Array:
        """Sizes (s,) of all effects, in units of their priors."""
        count = sum(len(located.sizes) for located in self.effects)
        return self.estimate.z[len(self.estimate.z) - count :]

    @property
    def size_estimates(self) -> dict[str, list[tuple[Parameter, float, float]]]:
        """For each effect, its sizes with value and error in units of the prior."""
        errors = np.sqrt(np.diag(self.estimate.covariance))[-len(self.sizes) :]
        found = iter(zip(self.sizes.tolist(), errors.tolist(), strict=True))
        return {
            located.effect.id: [(parameter, *next(found)) for parameter in located.sizes]
            for located in self.effects
        }

    @property
    def whitened_residual(self) -> Array:
        """Whitened residuals (n,)."""
        left: Array = self.estimate.residuals * self.deviation
        return left

    @property
    def free_jacobian(self) -> Array:
        """Jacobian (n, q) of the estimate along all parameters that are not held at 0."""
        positive = [size.positive for located in self.effects for size in located.sizes]
        held = np.zeros(len(self.estimate.z), dtype=bool)
        held[len(held) - len(positive) :] = np.array(positive, dtype=bool) & (self.sizes <= 0)
        free: Array = self.estimate.jacobian[:, ~held]
        return free

    def parameters(self, problem: InferenceProblem) -> BenchParameters:
        """Return the fitted model."""
        count = len(problem.nuisances)
        return self.changed(problem.parameters(self.estimate.z[:count]), self.sizes)

    def changed(self, parameters: BenchParameters, sizes: Array) -> BenchParameters:
        """Return a model with the candidate's effects at other sizes (s,)."""
        return with_effects(parameters, self.effects, sizes)


def d_prime(null: Candidate, candidate: Candidate) -> float:
    """Return at how many standard deviations a candidate is detected, against no effect.

    The form of an effect adds to its uncertainty, which is corrected for.
    """
    form = 2 * float(np.sum(np.log(candidate.deviation)) - np.sum(np.log(null.deviation)))
    gain = null.estimate.cost - candidate.estimate.cost - form
    return float(np.sqrt(max(gain, 0.0)))


def fit_model(
    problem: InferenceProblem,
    effects: Sequence[LocatedEffect],
    starts: Sequence[Array],
    *,
    exact: bool = False,
) -> Candidate:
    """Fit the model with effects.

    Parameters
    ----------
    problem : InferenceProblem
    effects : sequence of LocatedEffect
        Empty for the model without effects.
    starts : sequence of (p + s,) float
        Nuisances, then sizes of all effects.
    exact : bool
        Whether the Jacobian along the nuisances is taken where the fit ends.

    Raises
    ------
    ImpossibleReedError
        If no start is a possible reed.
    """
    p, positive = len(problem.nuisances), _positive(problem, effects)

    def residuals(z: Array) -> Array:
        return problem.residuals(with_effects(problem.parameters(z[:p]), effects, z[p:]))

    def jacobian(z: Array) -> Array:
        return np.column_stack([problem.jacobian(z[:p]), *_by_size(residuals, z, p, positive)])

    def by_effects(z: Array) -> Array:
        moved: Array = residuals(z) - problem.residuals(problem.parameters(z[:p]))
        return moved

    if not exact:
        found = fit(residuals, positive, starts, jacobian, _LEAST_GAIN)
        return _loosened(problem, effects, by_effects(found.z), found)
    near = _Slopes(problem, effects, NEAR, MOST_NEAR * len(starts))
    here = _Slopes(problem, effects, HERE, MOST_FINE, fine=True)

    def close(z: Array) -> Array:
        return np.column_stack([near.at(z), *_by_size(residuals, z, p, positive)])

    def closer(z: Array) -> Array:
        return np.column_stack([here.at(z), *_by_size(residuals, z, p, positive, fine=True)])

    ends = _ends(residuals, positive, starts, jacobian)
    found = fit(residuals, positive, ends, close, _LEAST_GAIN)
    agreeing = found.consistent_starts
    if found.decrement > LEAST_DECREMENT:
        # A Jacobian taken a little way off can show a step that is not there.
        found = fit(residuals, positive, [found.z], closer, _LEAST_GAIN)
    # Searches that end at no possible reed agree with none of the others.
    found = replace(found, consistent_starts=agreeing, starts=len(starts))
    return _loosened(problem, effects, by_effects(found.z), found)


class _Slopes:
    """Jacobians along the nuisances, given effects, taken again where a fit has moved far.

    Their number is limited: fits that keep moving explain nothing, and Jacobians take most of the
    time.
    """

    def __init__(
        self,
        problem: InferenceProblem,
        effects: Sequence[LocatedEffect],
        far: float,
        most: int,
        *,
        fine: bool = False,
    ) -> None:
        self._comparison, self._effects, self._fine = problem, effects, fine
        self._far, self._most = far, most
        self._kept: list[tuple[Array, Array]] = []

    def at(self, z: Array) -> Array:
        """Derivatives (n, p) near z (p + s,)."""
        apart = [float(np.abs(z - at).max()) for at, _ in self._kept]
        if apart and (min(apart) <= self._far or len(apart) == self._most):
            return self._kept[int(np.argmin(apart))][1]
        p = len(self._comparison.nuisances)
        changed = partial(with_effects, effects=self._effects, sizes=z[p:])
        slope = self._comparison.jacobian_of_changed(z[:p], changed, fine=self._fine)
        self._kept.append((z.copy(), slope))
        return slope


def _ends(
    residuals: Callable[[Array], Array],
    positive: Sequence[bool],
    starts: Sequence[Array],
    jacobian: Callable[[Array], Array],
) -> list[Array]:
    """Return where searches from each start end, except those of no possible reed."""
    ends = []
    for start in starts:
        with contextlib.suppress(ImpossibleReedError):
            ends.append(fit(residuals, positive, [start], jacobian, _LEAST_GAIN).z)
    return ends


def fit_linearised(
    problem: InferenceProblem, effects: Sequence[LocatedEffect], about: Array, sizes: Array
) -> Candidate:
    """Fit the model with effects, linearised in the nuisances.

    Parameters
    ----------
    problem : InferenceProblem
    effects : sequence of LocatedEffect
    about : (p,) float
        Nuisances at which the model is linearised.
    sizes : (s,) float
        To begin with.

    Raises
    ------
    ImpossibleReedError
        If the start is no possible reed.
    """
    p, positive = len(problem.nuisances), _positive(problem, effects)
    slope, base = problem.jacobian(about, NEAR), problem.parameters(about)

    def residuals(z: Array) -> Array:
        bent = problem.residuals(with_effects(base, effects, z[p:]))
        straight: Array = bent + slope @ (z[:p] - about)
        return straight

    def jacobian(z: Array) -> Array:
        return np.column_stack([slope, *_by_size(residuals, z, p, positive)])

    def by_effects(z: Array) -> Array:
        moved: Array = residuals(z) - nothing - slope @ (z[:p] - about)
        return moved

    nothing = problem.residuals(base)
    start = np.concatenate([about, sizes])
    found = fit(residuals, positive, [start], jacobian, _LEAST_GAIN)
    return _loosened(problem, effects, by_effects(found.z), found)


def prepare_jacobian(problem: InferenceProblem, about: Array) -> None:
    """Compute the Jacobian at nuisances (p,) that linearised fits there share."""
    problem.jacobian(about, NEAR)


def linearised_cost(
    problem: InferenceProblem, effects: Sequence[LocatedEffect], about: Array, sizes: Array
) -> float:
    """Return the least cost of effects of given sizes (s,) in the linearised model.

    Infinite if no such reed is possible. Parameters as those of `fit_linearised`.
    """
    slope = problem.jacobian(about, NEAR)
    try:
        left = problem.residuals(with_effects(problem.parameters(about), effects, sizes))
    except ImpossibleReedError:
        return float("inf")
    move = -posterior_covariance(slope) @ (slope.T @ left + about)
    left, nuisances = left + slope @ move, about + move
    return float(left @ left + nuisances @ nuisances + sizes @ sizes)


def with_nonlinear_cost(problem: InferenceProblem, candidate: Candidate) -> Candidate:
    """Return a candidate with the cost of the nonlinear model at its parameters.

    Its residuals stay those of the linearised model, whose optimum it is.

    Raises
    ------
    ImpossibleReedError
        If its parameters are of no possible reed.
    """
    estimate = candidate.estimate
    residuals = problem.residuals(candidate.parameters(problem)) / candidate.deviation
    more = float(residuals @ residuals - estimate.residuals @ estimate.residuals)
    noise = noise_inflation_gain(problem, residuals) - noise_inflation_gain(
        problem, estimate.residuals
    )
    return replace(
        candidate,
        estimate=replace(estimate, cost=estimate.cost + more),
        fit_log_evidence=candidate.fit_log_evidence - 0.5 * more + noise,
    )


def _loosened(
    problem: InferenceProblem,
    effects: Sequence[LocatedEffect],
    by_effects: Array,
    found: MapEstimate,
) -> Candidate:
    """Return a candidate whose effects may deviate from their catalogue form.

    `by_effects` (n,) is how much its effects move the residuals.
    """
    deviation = np.ones(len(found.residuals))
    if effects:
        # Little moves: along the slopes that are known anyway.
        deviation = np.hypot(1.0, _FORM * by_effects)
        narrow, z = found.jacobian / deviation[:, None], found.z.copy()
        left = found.residuals / deviation
        again = fit(
            lambda at: left + narrow @ (at - z),
            _positive(problem, effects),
            [z],
            lambda _at: narrow,
            _LEAST_GAIN,
        )
        found = replace(
            again,
            consistent_starts=found.consistent_starts,
            starts=found.starts,
            decrement=found.decrement,
        )
    chi2 = _chi2(problem, found.residuals * deviation)
    fitted = found.log_evidence - float(np.sum(np.log(deviation)))
    fitted += noise_inflation_gain(problem, found.residuals)
    return Candidate(tuple(effects), found, fitted, chi2, deviation)


def _chi2(problem: InferenceProblem, left: Array) -> dict[str, float]:
    """Of each block, of what is left (n,)."""
    return {name: float(np.sum(left[piece] ** 2)) for name, piece in problem.slices.items()}


def _positive(problem: InferenceProblem, effects: Sequence[LocatedEffect]) -> list[bool]:
    sizes = [size.positive for located in effects for size in located.sizes]
    return [False] * len(problem.nuisances) + sizes


def _by_size(
    residuals: Callable[[Array], Array],
    z: Array,
    p: int,
    positive: Sequence[bool],
    *,
    fine: bool = False,
) -> list[Array]:
    """Derivatives (n,) along each size, which come after p nuisances.

    Fine ones are good where what an effect moves bends within a step, and cost twice as much.
    """
    if len(z) == p:
        return []
    here = residuals(z)
    columns: list[Array] = []
    for k in range(p, len(z)):
        step = STEP if positive[k] or z[k] <= 0 else -STEP
        step *= FINE if fine else 1
        moved, back = z.copy(), z.copy()
        moved[k] += step
        # Nothing is on the other side of a bound.
        back[k] -= step if fine and (z[k] > step or not positive[k]) else 0.0
        other = here if back[k] == z[k] else residuals(back)
        columns.append((residuals(moved) - other) / (moved[k] - back[k]))
    return columns
