"""Search for candidates: each effect alone, pairs, and the model without effects."""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np

from diagnosis.inference.candidates import (
    Candidate,
    along_line,
    refitted,
    start_with,
    without_effects,
)
from diagnosis.inference.effect_scan import Start, scan_effect
from diagnosis.inference.estimation import SAME_COST
from diagnosis.inference.problem import InferenceProblem
from diagnosis.inference.similarity import CONFUSABLE, cosine
from fitting.parallel.processes import map_processes
from holography.arrays import Array
from physics.effects.effect import Effect
from physics.errors import ImpossibleReedError

SEED = 20_080_402
# The likeliest candidates, at most this many and within this many nats of the best, are fitted in
# full, if they gain at least 1.5 nats: what gains less cannot become likely.
_MOST_REFINED, _FAR_BEHIND, _WORTH = 5, 8.0, 1.5
# The model without effects is refitted from the nuisances of this many candidates.
_MOST_POLISHED = 4
# Other effects are looked for in addition to the best one, and to this many more, if they gain at
# least this many nats.
_MOST_PAIRED, _LEAST_GAIN = 4, 3.0
# Most searches from other starts: some end in a worse optimum or do not come to rest.
_MOST_AGAIN = 4
# Chosen: a search that confirms an optimum starts this far from it, in prior standard deviations.
_NEAR = 0.3


def search_alone(
    problem: InferenceProblem, start: Start, null: Candidate, effect: Effect
) -> Candidate | None:
    """Return the fit of one effect; None if it changes nothing."""
    scan = scan_effect(problem, start, effect)
    return None if scan is None else along_line(problem, start, scan, null)


def refine_best(
    problem: InferenceProblem,
    null: Candidate,
    candidates: dict[str, Candidate],
    odds: Mapping[str, float],
) -> None:
    """Fit the likeliest candidates in full.

    Parameters
    ----------
    problem : InferenceProblem
    null : Candidate
    candidates : dict of Candidate
        Those that are refined are replaced.
    odds : mapping of float
        Log odds of each, and of no effect.
    """
    least = max(odds.values()) - _FAR_BEHIND
    ranked = sorted(candidates, key=lambda name: -odds[name])[:_MOST_REFINED]
    worth = null.log_evidence + _WORTH
    near = [n for n in ranked if odds[n] > least and candidates[n].log_evidence > worth]
    each = map_processes(lambda name: _refined(problem, candidates[name]), near)
    candidates.update(zip(near, each, strict=True))


def _refined(problem: InferenceProblem, candidate: Candidate) -> Candidate:
    """Fit a candidate in full; return it unchanged if that fails."""
    with contextlib.suppress(ImpossibleReedError):
        return refitted(problem, candidate, [candidate.estimate.z])
    return candidate


def refit_without_effects(
    problem: InferenceProblem, null: Candidate, candidates: Iterable[Candidate]
) -> Candidate:
    """Refit the model without effects from the nuisances of candidates that are better."""
    worth = null.log_evidence + _WORTH
    best = [candidate for candidate in candidates if candidate.log_evidence > worth]
    best = sorted(best, key=lambda candidate: -candidate.log_evidence)[:_MOST_POLISHED]
    each = map_processes(lambda one: _without(problem, one.nuisances), best)
    ends = [end for end in each if end is not None]
    if not ends:
        return null
    again = min(ends, key=lambda end: end.estimate.cost)
    gain = null.estimate.cost - again.estimate.cost
    if gain > SAME_COST:
        # The searches that agreed had found a worse optimum.
        return confirmed(problem, again)
    kept = again if gain > 0 else null
    least = kept.estimate.cost + SAME_COST
    agreeing = null.estimate.consistent_starts + sum(end.estimate.cost < least for end in ends)
    tried = null.estimate.starts + len(ends)
    return replace(kept, estimate=replace(kept.estimate, consistent_starts=agreeing, starts=tried))


def confirmed(problem: InferenceProblem, again: Candidate) -> Candidate:
    """Fit the model without effects from its optimum and near it, until two searches agree.

    A search from near the optimum may end in a worse one, or in a better one that nothing confirms.
    """
    rng = np.random.default_rng(SEED)
    for _ in range(_MOST_AGAIN):
        z = again.estimate.z
        again = without_effects(problem, [z, z + _NEAR * rng.standard_normal(len(z))])
        if again.estimate.converged:
            break
    return again


def _without(problem: InferenceProblem, start: Array) -> Candidate | None:
    """Fit the model without effects from one start; None if no such bench is possible."""
    with contextlib.suppress(ImpossibleReedError):
        return without_effects(problem, [start])
    return None


def confusable_pairs(signatures: Mapping[str, Array]) -> set[frozenset[str]]:
    """Return pairs of effects that are confusable, and therefore not fitted together."""
    return {
        frozenset((one, other))
        for one, other in combinations(signatures, 2)
        if cosine(signatures[one], signatures[other]) >= CONFUSABLE
    }


def fit_pairs(
    problem: InferenceProblem,
    null: Candidate,
    alone: Mapping[str, Candidate],
    effects: Sequence[Effect],
    confusable: set[frozenset[str]],
) -> dict[str, Candidate]:
    """Fit every effect in addition to the best one, and to others that gain by themselves.

    Confusable effects are not paired. Effects that are only there after another one are tried in
    addition to that.
    """
    ranked = sorted(alone.values(), key=lambda candidate: -candidate.log_evidence)
    best = [r for r in ranked if r.log_evidence > null.log_evidence + _LEAST_GAIN]
    found: dict[str, Candidate] = {}
    for number, first in enumerate(best[: 1 + _MOST_PAIRED]):
        others = effects if number == 0 else [r.effects[0].effect for r in best[number + 1 :]]
        apart = [
            effect
            for effect in others
            if effect.id in alone and effect.id != first.names[0]
            and frozenset((effect.id, first.names[0])) not in confusable
        ]  # fmt: skip
        apart += [effect for effect in effects if effect.after == first.names[0]]
        start = start_with(problem, first)
        each = map_processes(partial(search_alone, problem, start, first), apart)
        found |= {"+".join(pair.names): pair for pair in each if pair is not None}
    return found


def refit_from_elsewhere(
    problem: InferenceProblem, candidate: Candidate, rng: np.random.Generator
) -> Candidate:
    """Fit a candidate from its optimum and from other starts, to confirm the optimum.

    A search may end in a worse optimum or not come to rest; then the next one is tried.
    """
    p, again = len(problem.nuisances), candidate
    for _ in range(_MOST_AGAIN):
        z = again.estimate.z
        elsewhere = z + _NEAR * rng.standard_normal(len(z))
        elsewhere[p:] = 0.8 * z[p:]
        try:
            again = refitted(problem, again, [z, elsewhere])
        except ImpossibleReedError:
            return replace(
                candidate, estimate=replace(candidate.estimate, consistent_starts=0, starts=2)
            )
        if again.estimate.converged:
            break
    return again
