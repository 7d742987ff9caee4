"""Candidates: the model with no effect, one or two, fitted with all nuisances, and their evidence.

Residuals of all groups are whitened and put in one vector. A fit in full follows nuisances and
sizes until a further step would gain nothing; a fit along a line takes the sizes from a scan, and
nuisances as linear.
"""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from diagnosis.inference.effect_scan import (
    LEAST,
    LOG_DENSITY,
    Elsewhere,
    Scan,
    Start,
    scan_again,
)
from diagnosis.inference.estimation import (
    LEAST_DECREMENT,
    SAME_COST,
    MapEstimate,
    absorbed_part,
    fit,
    posterior_covariance,
)
from diagnosis.inference.gross_errors import with_gross_errors
from diagnosis.inference.linear_model import (
    FORMS,
    LinearModel,
    Scales,
    Weighed,
    weigh,
    weighed_at,
)
from diagnosis.inference.problem import (
    FORM,
    STEP,
    InferenceProblem,
    LocatedEffect,
    with_effects,
)
from fitting.parallel.processes import map_processes
from holography.arrays import Array
from physics.effects.effect import Parameter
from physics.errors import ImpossibleReedError
from physics.parameters.tree import BenchParameters

# Searches end where a step gains less than this share of the cost: hundredths of a nat.
_LEAST_GAIN = 1e-4
# Slopes are computed again until nothing moves by more than this, in prior standard deviations, and
# the next step would gain nothing; at most this often. Chosen: within a third, slopes change the
# cost by less than a tenth of a nat, and most searches need five turns.
_AT_REST, _MOST_TURNS = 0.35, 12
# Least share by which the form of an effect deviates, for the error of its sizes. Chosen: what one
# unit of an effect does is as unsure as laws of one or two numbers are, even where all numbers
# agree.
_LEAST_FORM_OF_SIZES = 0.1
# Log share of other places in the evidence from which on the best one counts for nothing.
_ALL_ELSEWHERE = -1e-6
# Information, in units of the noise, of a size that changes nothing. Chosen: against division by 0.
_NOTHING = 1e-12


@dataclass(frozen=True)
class Candidate:
    """The model with chosen effects, fitted.

    Attributes
    ----------
    effects : tuple of LocatedEffect
    estimate : MapEstimate
        Of nuisances, then of the effects' sizes, with noise and nuisances of usual size; residuals
        and Jacobian in units of `deviation`.
    log_evidence : float
        With the likeliest scales of noise and nuisances: all strengths that would show and all
        locations together. Without effects, what would not show is not in it.
    chi2 : dict of float
        Of each group.
    deviation : (n,) float
        Standard deviation of the whitened residuals: 1, and more where the effects do much, which
        have not quite the form that the catalogue gives them.
    model : LinearModel
        Around the fit.
    weighed : Weighed
        The same with the likeliest scales.
    elsewhere : Elsewhere
        Other locations and directions of the last effect.
    of_others : float
        What the prior of the other effects adds to it.
    log_hidden : float
        Log evidence with the strengths of the last effect that would not show.
    slopes : (n, s) float
        What one unit of each size changes, in units of the noise.
    """

    effects: tuple[LocatedEffect, ...]
    estimate: MapEstimate
    log_evidence: float
    chi2: dict[str, float]
    deviation: Array
    model: LinearModel
    weighed: Weighed
    elsewhere: Elsewhere = Elsewhere()
    of_others: float = 0.0
    log_hidden: float = -np.inf
    slopes: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def of_places(self) -> float:
        """What the prior of direction and location of the last effect adds to the log evidence."""
        if not self.effects:
            return 0.0
        others = min(self.elsewhere.log_evidence - self.log_evidence, _ALL_ELSEWHERE)
        return min(-float(np.log1p(-np.exp(others))) - math.log(self.elsewhere.count), 0.0)

    @property
    def names(self) -> tuple[str, ...]:
        """Identifiers of the effects."""
        return tuple(located.effect.id for located in self.effects)

    @property
    def sizes(self) -> Array:
        """Sizes (s,) of all effects, in units of their scales."""
        count = sum(len(located.sizes) for located in self.effects)
        return self.estimate.z[len(self.estimate.z) - count :]

    @property
    def nuisances(self) -> Array:
        """Nuisances (p,), in units of their priors."""
        return self.estimate.z[: len(self.estimate.z) - len(self.sizes)]

    @property
    def size_estimates(self) -> dict[str, list[tuple[Parameter, float, float]]]:
        """For each effect, its sizes with value and error in units of their scales.

        Errors are as large as the likeliest scales of noise, nuisances and form make them.
        """
        errors = self._errors
        found = iter(zip(self.sizes.tolist(), errors.tolist(), strict=True))
        return {
            located.effect.id: [(parameter, *next(found)) for parameter in located.sizes]
            for located in self.effects
        }

    @cached_property
    def _errors(self) -> Array:
        """Standard errors (s,) of the sizes, in units of their scales."""
        errors = np.sqrt(np.diag(self.estimate.covariance))[-len(self.sizes) :]
        found = self.weighed.scales
        families = found.families.copy()
        families[FORMS] = np.maximum(families[FORMS], np.log(_LEAST_FORM_OF_SIZES / FORM))
        usual, own = (
            np.maximum(np.einsum("ns,nm,ms->s", self.slopes, precision, self.slopes), _NOTHING)
            for precision in (
                weighed_at(self.model, self.model.usual).precision,
                weighed_at(self.model, Scales(found.noise, families)).precision,
            )
        )
        strengths = [bool(size.most) for located in self.effects for size in located.sizes]
        # Strengths are no surer than all numbers together make them, in whatever form.
        least = np.where(strengths, 1 / np.sqrt(own), 0.0)
        return np.asarray(np.maximum(errors * np.sqrt(usual / own), least))

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
        return with_effects(problem.parameters(self.nuisances), self.effects, self.sizes)


def d_prime(null: Candidate, candidate: Candidate) -> float:
    """Return at how many standard deviations a candidate is detected, against no effect.

    The form of an effect adds to its uncertainty, which is corrected for.
    """
    form = 2 * float(np.sum(np.log(candidate.deviation)) - np.sum(np.log(null.deviation)))
    gain = null.estimate.cost - candidate.estimate.cost - form
    return float(np.sqrt(max(gain, 0.0)))


def without_effects(problem: InferenceProblem, starts: Sequence[Array]) -> Candidate:
    """Fit the model without effects in full.

    Parameters
    ----------
    problem : InferenceProblem
    starts : sequence of (p,) float
        Nuisances.

    Raises
    ------
    ImpossibleReedError
        If no start is a possible reed.
    """
    found = fit_fully(problem, (), starts)
    start = Start.without(problem, found)
    return _candidate(problem, (), found, start.weighed.log_evidence, start.model, start.weighed)


def along_line(problem: InferenceProblem, start: Start, scan: Scan, before: Candidate) -> Candidate:
    """Return the candidate that a scan has found, with nuisances as linear.

    Parameters
    ----------
    problem : InferenceProblem
    start : Start
        Of the scan.
    scan : Scan
    before : Candidate
        To which the scanned effect was added: the model without effects, or with another one.
    """
    J = np.hstack([before.estimate.jacobian * before.deviation[:, None], scan.columns])
    z = np.concatenate([before.estimate.z, scan.sizes])
    residuals, p = start.residuals + scan.shift, len(before.estimate.z)
    own = J[:, :p]
    move = -posterior_covariance(own) @ (own.T @ residuals + z[:p])
    z[:p] += move
    residuals = residuals + own @ move
    of_others = before.of_places + log_prior(before.effects, before.sizes)
    found = MapEstimate(
        z=z,
        covariance=posterior_covariance(J),
        residuals=residuals,
        jacobian=J,
        cost=float(residuals @ residuals + z @ z),
        log_evidence=scan.log_evidence,
        decrement=0.0,
        consistent_starts=1,
        starts=1,
    )
    return _with_scan(problem, (*before.effects, scan.located), found, scan, of_others)


def refitted(problem: InferenceProblem, candidate: Candidate, starts: Sequence[Array]) -> Candidate:
    """Fit a candidate in full, and scan its last effect again there.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
        With effects.
    starts : sequence of (p + s,) float

    Raises
    ------
    ImpossibleReedError
        If no start is a possible reed.
    """
    found = fit_fully(problem, candidate.effects, starts)
    start = _beyond(problem, candidate, found)
    last = candidate.effects[-1]
    elsewhere, hidden = candidate.elsewhere, candidate.log_hidden - candidate.of_others
    scan = scan_again(problem, start, last, elsewhere, hidden) if start else None
    if scan is None:
        return replace(candidate, estimate=found)
    before, strong = candidate.effects[:-1], len(found.z) - len(last.sizes)
    of_others = candidate.of_others + log_prior(before, found.z[len(problem.nuisances) : strong])
    of_others -= log_prior(before, candidate.sizes[: -len(last.sizes)])
    return _with_scan(problem, candidate.effects, found, scan, of_others)


def log_prior(effects: Sequence[LocatedEffect], sizes: Array) -> float:
    """Return the log prior of sizes (s,), over that of standard deviations of 1 around them.

    Strengths are equally likely on a scale of logarithms, second parameters are around 0.
    """
    log, at = 0.0, 0
    for located in effects:
        own = sizes[at : at + len(located.sizes)]
        strong, at = np.array([bool(size.most) for size in located.sizes]), at + len(own)
        # A size of 2 is the largest.
        strength = max(float(np.linalg.norm(own[strong])), 2 * LEAST)
        log += 0.5 * math.log(2 * math.pi) - math.log(strength) + LOG_DENSITY
        log -= 0.5 * float(own[~strong] @ own[~strong])
    return log


def _with_scan(
    problem: InferenceProblem,
    effects: tuple[LocatedEffect, ...],
    found: MapEstimate,
    scan: Scan,
    of_others: float,
) -> Candidate:
    log_evidence = scan.log_evidence + of_others
    candidate = _candidate(problem, effects, found, log_evidence, scan.model, scan.weighed)
    return replace(
        candidate,
        elsewhere=scan.elsewhere,
        of_others=of_others,
        log_hidden=scan.log_hidden + of_others,
    )


def _candidate(
    problem: InferenceProblem,
    effects: tuple[LocatedEffect, ...],
    found: MapEstimate,
    log_evidence: float,
    model: LinearModel,
    weighed: Weighed,
) -> Candidate:
    """Return a candidate whose effects may deviate from their catalogue form."""
    deviation = np.ones(len(found.residuals))
    if effects:
        count = sum(len(located.sizes) for located in effects)
        p = len(found.z) - count
        moved = found.jacobian[:, p:] @ found.z[p:]
        seen = moved - absorbed_part(found.jacobian[:, :p], moved)
        deviation = np.hypot(1.0, weighed.scales.form * FORM * seen)
        left, slopes = found.residuals / deviation, found.jacobian / deviation[:, None]
        found = replace(
            found,
            residuals=left,
            jacobian=slopes,
            covariance=posterior_covariance(slopes),
            cost=float(left @ left + found.z @ found.z),
        )
    slopes = found.jacobian[:, len(problem.nuisances) :] * deviation[:, None]
    chi2 = {
        name: float(np.sum((found.residuals * deviation)[piece] ** 2))
        for name, piece in problem.slices.items()
    }
    return Candidate(
        effects, found, log_evidence, chi2, deviation, model, weighed,
        slopes=problem.to_noise(slopes),
    )  # fmt: skip


def fit_fully(
    problem: InferenceProblem, effects: Sequence[LocatedEffect], starts: Sequence[Array]
) -> MapEstimate:
    """Fit nuisances and sizes until a further step would gain nothing.

    Parameters
    ----------
    problem : InferenceProblem
    effects : sequence of LocatedEffect
        Empty for the model without effects.
    starts : sequence of (p + s,) float
        Nuisances, then sizes of all effects.

    Raises
    ------
    ImpossibleReedError
        If no start is a possible reed.
    """
    each = map_processes(partial(_followed, problem, effects), starts)
    ends = [end for end in each if end is not None]
    if not ends:
        raise ImpossibleReedError("no start of a fit is a possible reed")
    best = min(ends, key=lambda end: end.cost)
    agreeing = sum(end.cost < best.cost + SAME_COST for end in ends)
    # Searches that end at no possible reed agree with none of the others.
    return replace(best, consistent_starts=agreeing, starts=len(starts))


def _followed(
    problem: InferenceProblem, effects: Sequence[LocatedEffect], z: Array
) -> MapEstimate | None:
    """Follow one search; None if it begins at no possible reed.

    Slopes are taken again where it has come to rest with them.
    """
    p, positive = len(problem.nuisances), _positive(effects, len(problem.nuisances))

    def model(z: Array) -> BenchParameters:
        return with_effects(problem.parameters(z[:p]), effects, z[p:])

    found = None
    with contextlib.suppress(ImpossibleReedError):
        for _ in range(_MOST_TURNS):
            near = model(z)
            residuals = partial(_residuals, problem, model, near)
            slopes = partial(_held, _slopes(problem, effects, residuals, z))
            found = fit(residuals, positive, [z], slopes, _LEAST_GAIN)
            still = np.abs(found.z - z).max() < _AT_REST
            if still and found.decrement < LEAST_DECREMENT:
                break
            z = found.z
    return found


def _residuals(
    problem: InferenceProblem,
    model: Callable[[Array], BenchParameters],
    near: BenchParameters,
    z: Array,
) -> Array:
    return problem.residuals(model(z), near)


def _held(slopes: Array, _z: Array) -> Array:
    return slopes


def _slopes(
    problem: InferenceProblem,
    effects: Sequence[LocatedEffect],
    residuals: Callable[[Array], Array],
    z: Array,
) -> Array:
    """Derivatives (n, p + s) at nuisances and sizes z (p + s,)."""
    p = len(problem.nuisances)

    def change(parameters: BenchParameters) -> BenchParameters:
        return with_effects(parameters, effects, z[p:])

    columns = [problem.jacobian_of_changed(z[:p], change)]
    for k in range(p, len(z)):
        moved = z.copy()
        # Towards no effect, where there is one: a bound may be on the other side.
        step = -STEP if z[k] > STEP else STEP
        moved[k] += step
        columns.append((residuals(moved) - residuals(z))[:, None] / step)
    return np.hstack(columns)


def start_with(problem: InferenceProblem, candidate: Candidate) -> Start:
    """Return the start at which effects are added to those of a candidate.

    Its own sizes are linear, with the standard deviations of their scales.
    """
    p = len(candidate.nuisances)
    parameters = candidate.parameters(problem)
    residuals = problem.residuals(parameters)
    slopes = candidate.estimate.jacobian * candidate.deviation[:, None]
    model = problem.linear_model(residuals, slopes[:, :p], candidate.nuisances)
    model = _with_sizes(problem, model, slopes, candidate.sizes)
    weighed = weigh(model, candidate.weighed.scales)
    model, weighed = with_gross_errors(problem, model, weighed)
    return Start(parameters, residuals, model, weighed, np.zeros(0), weighed)


def _beyond(problem: InferenceProblem, candidate: Candidate, found: MapEstimate) -> Start | None:
    """Return the start at which the last effect of a full fit is scanned again; None if it is 0."""
    p, last = len(problem.nuisances), len(candidate.effects[-1].sizes)
    z, sizes, slopes = found.z[:p], found.z[p:], found.jacobian
    others, strong = len(sizes) - last, [bool(s.most) for s in candidate.effects[-1].sizes]
    if not np.any(sizes[others:][strong]):
        return None
    before = with_effects(problem.parameters(z), candidate.effects[:-1], sizes[:others])
    model = problem.linear_model(found.residuals, slopes[:, :p], z)
    model = _with_sizes(problem, model, slopes[:, : p + others], sizes[:others])
    seen = _seen(problem, slopes[:, :p], slopes[:, p + others :] @ sizes[others:])
    formed = problem.with_form(model, seen)
    formed, weighed = with_gross_errors(problem, formed, weigh(formed, candidate.weighed.scales))
    model = model.with_errors_of(formed)
    bare = weighed_at(model, weighed.scales)
    return Start(before, found.residuals, model, weighed, sizes[others:], bare)


def _with_sizes(
    problem: InferenceProblem,
    model: LinearModel,
    slopes: Array,
    sizes: Array,
) -> LinearModel:
    """Return a model with sizes of effects as known columns, and with their form.

    `slopes` are along the nuisances, then along the sizes. Whatever the sizes are costs nothing
    here: `Candidate.of_others` is what their prior adds.
    """
    p = slopes.shape[1] - len(sizes)
    own = slopes[:, p:]
    seen = _seen(problem, slopes[:, :p], own @ sizes)
    return problem.with_form(model.with_columns(problem.to_noise(own)), seen)


def _seen(problem: InferenceProblem, slopes: Array, moved: Array) -> Array:
    """Return what is moved (n,) beyond nuisances of such slopes, in units of the noise."""
    return problem.to_noise(moved - absorbed_part(slopes, moved))


def _positive(effects: Sequence[LocatedEffect], nuisances: int) -> list[bool]:
    sizes = [size.positive for located in effects for size in located.sizes]
    return [False] * nuisances + sizes
