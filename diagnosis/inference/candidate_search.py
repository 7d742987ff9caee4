"""Search for candidates: each effect at its best location, and likely pairs."""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import logsumexp

from diagnosis.inference.candidates import (
    Candidate,
    fit_linearised,
    fit_model,
    linearised_cost,
    prepare_jacobian,
    with_nonlinear_cost,
)
from diagnosis.inference.estimation import SAME_COST
from diagnosis.inference.probabilities import NONE, PRIOR, log_odds, rank_candidates
from diagnosis.inference.problem import InferenceProblem, LocatedEffect
from diagnosis.inference.screening import (
    Baseline,
    ScreenedEffect,
    count_locations,
    most_typical,
    screen_at,
    screen_effect,
)
from diagnosis.inference.similarity import CONFUSABLE, cosine
from fitting.parallel.processes import map_processes
from holography.arrays import Array
from physics.effects.effect import Effect
from physics.errors import ImpossibleReedError

SEED = 20_080_402
# The likeliest candidates, at most this many and within this many nats of the best, are refitted
# with the nonlinear model.
_MOST_REFINED, _FAR_BEHIND = 5, 8.0
# The model without effects is refitted from the nuisances of this many candidates.
_MOST_POLISHED = 4
# Pairs: all of the best effects, and the best with those that explain most of its residuals, if
# they gain at least this many nats.
_MOST_PAIRED, _MOST_BESIDE, _LEAST_GAIN = 5, 4, 3.0
# Large sizes that are tried, in prior standard deviations.
_FAR_SIZES = 2.0, 4.0, 6.0
# The model without effects is far off from this mean square residual, or this size of a nuisance
# in prior standard deviations.
_FAR_OFF, _FAR_BENT = 2.0, 4.0
# Effects that gain more than this many nats at their best location are refitted at this many.
_MUCH, _MOST_PLACES = 20.0, 6


@dataclass(frozen=True)
class SearchStart:
    """Nuisances (p,) from which effects are searched for, and whether large sizes are tried."""

    at: Array
    base: Baseline
    far: bool = True


def search_starts(problem: InferenceProblem, null: Candidate) -> list[SearchStart]:
    """Return the nuisances from which effects are searched for.

    Fit biases can hide an effect, so that the search also starts without them. If the model without
    effects is far off, its nuisances may be too, so that the search also starts from none.
    """
    at = null.estimate.z
    found = [SearchStart(at, Baseline.at(problem, at))]
    if problem.is_fit_bias.any():
        kept = np.where(problem.is_fit_bias, 0.0, at)
        found.append(SearchStart(kept, Baseline.at(problem, kept), far=False))
    bent = np.abs(at).max(initial=0.0) > _FAR_BENT
    if bent or null.estimate.chi2 > _FAR_OFF * len(null.whitened_residual):
        nothing = np.zeros(len(at))
        found.append(SearchStart(nothing, Baseline.at(problem, nothing)))
    return found


def refine_best(
    problem: InferenceProblem, candidates: dict[str, Candidate], null: Candidate, effects: int
) -> None:
    """Refit the likeliest candidates with the nonlinear model."""
    ranked = rank_candidates(candidates, null, effects)[:_MOST_REFINED]
    if not ranked:
        return
    odds = {name: log_odds(candidates[name], null, effects) for name in ranked}
    least = max(*odds.values(), float(np.log(PRIOR["none"]))) - _FAR_BEHIND
    near = [name for name in ranked if odds[name] > least]
    for name, found in zip(
        near, map_processes(lambda name: _refit(problem, candidates[name]), near), strict=True
    ):
        candidates[name] = found


def _refit(problem: InferenceProblem, candidate: Candidate) -> Candidate:
    """Refit a candidate with the nonlinear model; return it unchanged if that fails."""
    with contextlib.suppress(ImpossibleReedError):
        found = fit_model(problem, candidate.effects, [candidate.estimate.z])
        return replace(found, other_locations=candidate.other_locations)
    return candidate


def refit_without_effects(
    problem: InferenceProblem, null: Candidate, candidates: Iterable[Candidate]
) -> Candidate:
    """Refit the model without effects from the nuisances of its best candidates."""
    best = sorted(candidates, key=lambda candidate: -candidate.log_evidence)[:_MOST_POLISHED]
    starts = [candidate.estimate.z[: len(problem.nuisances)] for candidate in best]
    each = map_processes(lambda start: _without(problem, start), starts)
    ends = [end for end in each if end is not None]
    if not ends:
        return null
    again = min(ends, key=lambda end: end.estimate.cost)
    gain = null.estimate.cost - again.estimate.cost
    if gain > SAME_COST:
        # The searches that agreed had found a worse optimum.
        rng = np.random.default_rng(SEED)
        near = again.estimate.z + 0.3 * rng.standard_normal(len(again.estimate.z))
        return fit_model(problem, (), [again.estimate.z, near], exact=True)
    kept = again if gain > 0 else null
    least = kept.estimate.cost + SAME_COST
    agreeing = null.estimate.consistent_starts + sum(end.estimate.cost < least for end in ends)
    tried = null.estimate.starts + len(ends)
    return replace(kept, estimate=replace(kept.estimate, consistent_starts=agreeing, starts=tried))


def _without(problem: InferenceProblem, start: Array) -> Candidate | None:
    """Fit the model without effects from one start; None if no such bench is possible."""
    with contextlib.suppress(ImpossibleReedError):
        return fit_model(problem, (), [start], exact=True)
    return None


def search_effect(
    problem: InferenceProblem, begun: Sequence[SearchStart], effect: Effect
) -> tuple[Array | None, Candidate | None]:
    """Return the median signature (n, s) of an effect and its fit; None without a signature."""
    places = [screen_effect(problem, start.base, effect) for start in begun]
    table = most_typical(places[0]).signature if places[0] else None
    return table, _alone(problem, begun, places)


def _alone(
    problem: InferenceProblem,
    begun: Sequence[SearchStart],
    places: Sequence[Sequence[ScreenedEffect]],
) -> Candidate | None:
    """Fit one effect at its best location; None without a signature, or of no possible reed.

    Parameters
    ----------
    problem : InferenceProblem
    begun : sequence of SearchStart
    places : sequence of sequence of ScreenedEffect
        The screened effect for each start.
    """
    fitted = [_at_its_best(problem, start, own) for start, own in zip(begun, places, strict=True)]
    found = [candidate for candidate in fitted if candidate is not None]
    if any(other.estimate.cost < found[0].estimate.cost for other in found[1:]):
        # Far from an optimum the linearised model may promise too much.
        found = [
            exact
            for candidate in found
            if (exact := _with_nonlinear_cost(problem, candidate)) is not None
        ]
    return min(found, key=lambda candidate: candidate.estimate.cost, default=None)


def _with_nonlinear_cost(problem: InferenceProblem, candidate: Candidate) -> Candidate | None:
    try:
        return with_nonlinear_cost(problem, candidate)
    except ImpossibleReedError:
        return None


def _at_its_best(
    problem: InferenceProblem, start: SearchStart, places: Sequence[ScreenedEffect]
) -> Candidate | None:
    """Fit one effect at its best location from one start."""
    if not places:
        return None
    ranked = sorted(places, key=lambda place: -place.gain)
    tried = [(ranked[0], ranked[0].sizes)]
    if ranked[0].gain > _MUCH:
        # The best location of a large effect need not be that of the score test.
        for place in ranked[:_MOST_PLACES]:
            tried += [(place, place.sizes), (place, _first(place, np.sign(place.sizes[0])))]
    if start.far:
        tried += [(ranked[0], sizes) for sizes in _far_out(problem, start.at, ranked[0])]
    found = [
        (candidate, place)
        for place, sizes in tried
        if (candidate := fit_linearised_or_none(problem, (place.located,), start.at, sizes))
        is not None
    ]
    if not found:
        return None
    candidate, best = min(found, key=lambda pair: pair[0].estimate.cost)
    # Other locations are worse by what the score test says; here the fit is exact.
    count = count_locations(best.located.effect)
    others = float(logsumexp([place.gain - ranked[0].gain for place in places]) - np.log(count))
    return replace(candidate, other_locations=others)


def _far_out(problem: InferenceProblem, about: Array, place: ScreenedEffect) -> list[Array]:
    """Return large sizes (s,) that are better than none, even if small ones are not."""
    signs = (1.0,) if place.located.sizes[0].positive else (1.0, -1.0)
    sizes = [_first(place, sign * size) for sign in signs for size in _FAR_SIZES]
    effects = (place.located,)
    nothing = linearised_cost(problem, (), about, np.zeros(0))
    costs = [linearised_cost(problem, effects, about, tried) for tried in sizes]
    best = int(np.argmin(costs))
    return [sizes[best]] if costs[best] < nothing else []


def _first(place: ScreenedEffect, size: float) -> Array:
    """Return sizes (s,) with the first given and the others at their prior centre."""
    sizes: Array = np.zeros(len(place.sizes))
    sizes[0] = size
    return sizes


def confusable_pairs(signatures: Mapping[str, tuple[Array, Array]]) -> set[frozenset[str]]:
    """Return pairs of effects that are confusable, and therefore not fitted together."""
    return {
        frozenset((one, other))
        for one, other in combinations(signatures, 2)
        if cosine(signatures[one][1], signatures[other][1]) >= CONFUSABLE
    }


def fit_pairs(
    problem: InferenceProblem,
    null: Candidate,
    alone: Mapping[str, Candidate],
    effects: Sequence[Effect],
    alike: set[frozenset[str]],
) -> dict[str, Candidate]:
    """Fit pairs: of the best effects, and of the best with those that explain its residuals.

    Confusable effects are not paired.
    """
    ranked = sorted(alone.values(), key=lambda candidate: -candidate.log_evidence)
    best = [r for r in ranked if r.log_evidence > null.log_evidence + _LEAST_GAIN][:_MOST_PAIRED]
    chosen = {tuple(sorted((a.names[0], b.names[0]))): (a, b) for a, b in combinations(best, 2)}
    for first in best[:1]:
        for other in _beside(problem, first, alone, effects):
            chosen.setdefault(tuple(sorted((first.names[0], other.names[0]))), (first, other))
    apart = [both for names, both in chosen.items() if frozenset(names) not in alike]
    for both in apart:
        prepare_jacobian(problem, _about(problem, both))
    found = map_processes(lambda both: _pair(problem, *both), apart)
    return {"+".join(candidate.names): candidate for candidate in found if candidate is not None}


def undetectable_alternatives(
    problem: InferenceProblem,
    null: Candidate,
    alone: Mapping[str, Candidate],
    pairs: Mapping[str, Candidate],
    effects: Sequence[Effect],
    alike: set[frozenset[str]],
) -> dict[str, tuple[str, float]]:
    """Return effects that may be present, alone or with the likeliest, without being seen."""
    found = {effect.id: (NONE, 0.0) for effect in effects if effect.id not in alone}
    best = max(alone.values(), key=lambda candidate: candidate.log_evidence, default=null)
    if best.log_evidence < null.log_evidence + _LEAST_GAIN:
        return found
    first, base = best.names[0], Baseline.of(problem, best)
    for effect in effects:
        name = "+".join((first, effect.id))
        fitted = {name, "+".join((effect.id, first))} & set(pairs)
        if effect.id == first or fitted or frozenset((first, effect.id)) in alike:
            continue
        other = alone.get(effect.id)
        more = screen_at(problem, base, other.effects[0]) if other else None
        # An effect that would be seen is among the fitted pairs, or gains nothing there.
        found[name] = first, min(more.gain, 0.0) if more else 0.0
    return found


def _beside(
    problem: InferenceProblem,
    first: Candidate,
    alone: Mapping[str, Candidate],
    effects: Sequence[Effect],
) -> list[Candidate]:
    """Return effects that explain most of the residuals of the first."""
    gains, base = {}, Baseline.of(problem, first)
    for effect in effects:
        other = alone.get(effect.id)
        if other is None or effect.id == first.names[0]:
            continue
        found = screen_at(problem, base, other.effects[0])
        if found is not None and found.gain > _LEAST_GAIN:
            gains[effect.id] = found.gain
    ranked = sorted(gains, key=lambda name: -gains[name])
    return [alone[name] for name in ranked[:_MOST_BESIDE]]


def _about(problem: InferenceProblem, both: tuple[Candidate, Candidate]) -> Array:
    """Return the nuisances (p,) from which a pair is fitted: those of the better effect."""
    better = min(both, key=lambda candidate: candidate.estimate.cost)
    return better.estimate.z[: len(problem.nuisances)]


def _pair(problem: InferenceProblem, one: Candidate, other: Candidate) -> Candidate | None:
    first, second = sorted((one, other), key=lambda candidate: candidate.estimate.cost)
    about = _about(problem, (first, second))
    sizes = np.concatenate([first.sizes, second.sizes])
    pair = fit_linearised_or_none(problem, (*first.effects, *second.effects), about, sizes)
    if pair is None:
        return None
    # Both stay at their locations; other locations count as for each alone.
    return replace(pair, other_locations=one.other_locations + other.other_locations)


def fit_linearised_or_none(
    problem: InferenceProblem, effects: Sequence[LocatedEffect], about: Array, sizes: Array
) -> Candidate | None:
    """Fit the linearised model; None if no such reed is possible."""
    try:
        return fit_linearised(problem, effects, about, sizes)
    except ImpossibleReedError:
        return None
