"""Model selection: each known effect, likely pairs, and something unknown.

The probability of each is its evidence times a prior that is the same for all effects.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from diagnosis.inference.candidate_search import (
    SEED,
    confusable_pairs,
    fit_pairs,
    refine_best,
    refit_without_effects,
    search_effect,
    search_starts,
    undetectable_alternatives,
)
from diagnosis.inference.candidates import (
    Candidate,
    fit_model,
    prepare_jacobian,
)
from diagnosis.inference.discrepancy import group_discrepancies, log_bayes_any_unknown
from diagnosis.inference.estimation import marginalised_signature
from diagnosis.inference.importance_sampling import Sampled, checked
from diagnosis.inference.probabilities import (
    NONE,
    PRIOR,
    log_odds,
    log_odds_with_unknown,
    log_probabilities,
    rank_candidates,
)
from diagnosis.inference.problem import InferenceProblem
from fitting.parallel.processes import map_processes
from holography.arrays import Array
from physics.effects.effect import Effect
from physics.errors import ImpossibleReedError

# Candidates whose log evidence is within this many nats are checked by importance sampling.
_CLOSE = 5.0
# Most searches from other starts: some end in a worse optimum or do not come to rest.
_MOST_AGAIN = 4
# Something unknown is tried in addition to this many of the likeliest effects.
_LOOKED_BESIDE = 3


@dataclass(frozen=True)
class ModelSelection:
    """All candidates and the probability of each.

    Attributes
    ----------
    null : Candidate
    single : dict of Candidate
        Candidates with one effect, by identifier.
    pairs : dict of Candidate
        Candidates with two effects, by identifiers joined by '+'.
    signatures : dict of ((n, s) float, (n, s) float)
        Whitened and marginalised signature of each effect, at its median location.
    group_log_bayes : dict of float
        Log Bayes factor of something unknown in each group, against no effect.
    unknown_log_bayes : float
        The same in any group, or in a few.
    unknown_log_bayes_with : dict of float
        Log Bayes factor of something unknown in addition to each of the likeliest candidates.
    sampled : dict of Sampled
        Importance samples of candidates with similar evidence.
    undetectable : dict of (str, float)
        Alternatives that need not be seen and were not fitted: effects without a signature here,
        and pairs of the likeliest effect with another one. For each the effect that it is
        paired with, and the gain of log evidence.
    log_probability : dict of float
        Log probability of `NONE`, `UNKNOWN`, effects, and pairs joined by '+'.
    """

    null: Candidate
    single: dict[str, Candidate]
    pairs: dict[str, Candidate]
    signatures: dict[str, tuple[Array, Array]]
    group_log_bayes: dict[str, float]
    unknown_log_bayes: float
    unknown_log_bayes_with: dict[str, float]
    sampled: dict[str, Sampled]
    undetectable: dict[str, tuple[str, float]]
    log_probability: dict[str, float]

    @property
    def probability(self) -> dict[str, float]:
        """Probability of each hypothesis."""
        return {name: float(np.exp(log)) for name, log in self.log_probability.items()}

    def candidate(self, name: str) -> Candidate | None:
        """Return the candidate of a name; None for `NONE`, `UNKNOWN` and what was not fitted."""
        return self.single.get(name) or self.pairs.get(name)


def select_model(
    problem: InferenceProblem,
    effects: Sequence[Effect],
    progress: Callable[[float], None] | None = None,
) -> ModelSelection:
    """Fit all candidates, and weigh them by evidence and prior.

    Parameters
    ----------
    problem : InferenceProblem
    effects : sequence of Effect
    progress : callable, optional
        Called with the fraction that is done.
    """
    report = progress or (lambda _share: None)
    rng = np.random.default_rng(SEED)
    nothing = np.zeros(len(problem.nuisances))
    null = fit_model(problem, (), [nothing, 0.5 * rng.standard_normal(len(nothing))], exact=True)
    report(0.2)
    begun = search_starts(problem, null)
    for start in begun:
        prepare_jacobian(problem, start.at)
    alone: dict[str, Candidate] = {}
    signatures: dict[str, tuple[Array, Array]] = {}
    each = map_processes(partial(search_effect, problem, begun), effects)
    for number, (effect, (table, found)) in enumerate(zip(effects, each, strict=True)):
        if table is not None:
            signatures[effect.id] = table, marginalised_signature(begun[0].base.jacobian, table)
        if found is not None:
            alone[effect.id] = found
        report(0.2 + 0.4 * (number + 1) / len(effects))
    refine_best(problem, alone, null, len(effects))
    null = refit_without_effects(problem, null, alone.values())
    report(0.7)
    alike = confusable_pairs(signatures)
    pairs = fit_pairs(problem, null, alone, effects, alike)
    refine_best(problem, pairs, null, len(effects))
    report(0.85)
    candidates = {**alone, **pairs}
    sampled = _settle(problem, null, candidates, len(effects), rng)
    alone, pairs = ({n: r for n, r in candidates.items() if n in part} for part in (alone, pairs))
    report(0.95)
    likely = rank_candidates(alone, null, len(effects))[:_LOOKED_BESIDE]
    beside = {name: log_bayes_any_unknown(problem, candidates[name]) for name in likely}
    unknown = log_bayes_any_unknown(problem, null)
    unseen = undetectable_alternatives(problem, null, alone, pairs, effects, alike)
    probabilities = log_probabilities(null, candidates, unknown, beside, unseen, len(effects))
    report(1.0)
    told = {name: float(f[0]) for name, f in group_discrepancies(problem, null).items()}
    return ModelSelection(
        null, alone, pairs, signatures, told, unknown, beside, sampled, unseen, probabilities
    )


def refit_candidate(
    problem: InferenceProblem, found: ModelSelection, name: str, effects: int
) -> ModelSelection:
    """Refit one candidate from two starts, and return the updated selection."""
    candidate = found.candidate(name)
    if candidate is None or candidate.estimate.starts > 1:
        return found
    again = refit_from_elsewhere(problem, candidate, np.random.default_rng(SEED))
    alone, pairs, beside = dict(found.single), dict(found.pairs), dict(found.unknown_log_bayes_with)
    (alone if name in alone else pairs)[name] = again
    if name in beside:
        beside[name] = log_bayes_any_unknown(problem, again)
    candidates = {**alone, **pairs}
    odds = log_probabilities(
        found.null, candidates, found.unknown_log_bayes, beside, found.undetectable, effects
    )
    return replace(
        found, single=alone, pairs=pairs, unknown_log_bayes_with=beside, log_probability=odds
    )


def likeliest_unknown(found: ModelSelection, effects: int) -> str:
    """Return the effect, pair or `NONE` in addition to which something unknown is likeliest."""
    logs = log_odds_with_unknown(
        {**found.single, **found.pairs}, found.null, found.unknown_log_bayes_with, effects
    )
    logs[NONE] = float(np.log(PRIOR["unknown"])) + found.unknown_log_bayes
    return max(logs, key=lambda name: logs[name])


def _settle(
    problem: InferenceProblem,
    null: Candidate,
    candidates: dict[str, Candidate],
    effects: int,
    rng: np.random.Generator,
) -> dict[str, Sampled]:
    """Refit the best candidate from other starts, and sample the best two if they are close.

    Replaces them among the candidates.
    """
    best = rank_candidates(candidates, null, effects)[:2]
    for name in best[:1]:
        candidates[name] = refit_from_elsewhere(problem, candidates[name], rng)
    odds = {NONE: float(np.log(PRIOR["none"]))}
    odds |= {name: log_odds(candidates[name], null, effects) for name in best}
    first, second = sorted(odds, key=lambda name: -odds[name])[:2] if best else (NONE, NONE)
    found: dict[str, Sampled] = {}
    if odds[first] - odds[second] < _CLOSE:
        close = [name for name in (first, second) if name != NONE]
        each = map_processes(lambda name: checked(problem, candidates[name]), close)
        for name, (candidate, sampled) in zip(close, each, strict=True):
            candidates[name], found[name] = candidate, sampled
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
        elsewhere = z + 0.3 * rng.standard_normal(len(z))
        elsewhere[p:] = 0.8 * z[p:]
        try:
            again = fit_model(problem, candidate.effects, [z, elsewhere], exact=True)
        except ImpossibleReedError:
            return replace(
                candidate, estimate=replace(candidate.estimate, consistent_starts=0, starts=2)
            )
        if again.estimate.converged:
            break
    return replace(again, other_locations=candidate.other_locations)
