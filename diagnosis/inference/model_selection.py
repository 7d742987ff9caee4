"""Model selection: each known effect, likely pairs, and something unknown.

The probability of each is its evidence times a prior that is the same for all effects.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from diagnosis.inference.candidate_search import (
    SEED,
    confusable_pairs,
    fit_pairs,
    refine_best,
    refit_from_elsewhere,
    refit_without_effects,
    search_alone,
)
from diagnosis.inference.candidates import Candidate, without_effects
from diagnosis.inference.discrepancy import group_discrepancies, log_bayes_any_unknown
from diagnosis.inference.effect_scan import Start
from diagnosis.inference.estimation import SAME_COST, marginalised_signature
from diagnosis.inference.null_starts import starts_without_effects
from diagnosis.inference.predictive_checks import Refutation, refutations
from diagnosis.inference.probabilities import (
    NONE,
    PRIOR,
    Evidence,
    log_odds_of_all,
    log_odds_with_unknown,
    log_probabilities,
    other_priors,
    unseen_share,
)
from diagnosis.inference.problem import InferenceProblem
from fitting.parallel.processes import map_processes
from holography.arrays import Array
from physics.effects.effect import Effect

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
    undetectable : tuple of str
        Effects without a signature here.
    count : int
        Number of effects that were tried.
    refuted : dict of tuple of Refutation
        Candidates that a group of observables refutes, by name. Their evidence is at most that of
        no effect.
    """

    null: Candidate
    single: dict[str, Candidate]
    pairs: dict[str, Candidate]
    signatures: dict[str, tuple[Array, Array]]
    group_log_bayes: dict[str, float]
    unknown_log_bayes: float
    unknown_log_bayes_with: dict[str, float]
    undetectable: tuple[str, ...]
    count: int
    refuted: dict[str, tuple[Refutation, ...]]

    @cached_property
    def log_probability(self) -> dict[str, float]:
        """Log probability of `NONE`, `UNKNOWN`, effects, and pairs joined by '+'."""
        return log_probabilities(self.evidence)

    @property
    def probability(self) -> dict[str, float]:
        """Probability of each hypothesis."""
        return {name: float(np.exp(log)) for name, log in self.log_probability.items()}

    @cached_property
    def probability_of_what_shows(self) -> dict[str, float]:
        """Probability of each hypothesis, where what would not show here counts as none."""
        logs = log_probabilities(self.evidence, only_what_shows=True)
        return {name: float(np.exp(log)) for name, log in logs.items()}

    @property
    def evidence(self) -> Evidence:
        """What the campaign says of every hypothesis."""
        return Evidence(
            self.null, {**self.single, **self.pairs}, self.unknown_log_bayes,
            self.unknown_log_bayes_with, self.undetectable, self.count,
        )  # fmt: skip

    def candidate(self, name: str) -> Candidate | None:
        """Return the candidate of a name; None for `NONE`, `UNKNOWN` and what was not fitted."""
        return self.single.get(name) or self.pairs.get(name)


def tried_alone(effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects without those that are only there after another one of them."""
    names = {effect.id for effect in effects}
    return [effect for effect in effects if effect.after not in names]


def select_model(
    problem: InferenceProblem,
    effects: Sequence[Effect],
    progress: Callable[[float], None] | None = None,
    null: Candidate | None = None,
) -> ModelSelection:
    """Fit all candidates, and weigh them by evidence and prior.

    Parameters
    ----------
    problem : InferenceProblem
    effects : sequence of Effect
        Those that are only there after another one of these are tried in pairs with that.
    progress : callable, optional
        Called with the fraction that is done.
    null : Candidate, optional
        The fit without effects, if it is known.
    """
    report, everything = progress or (lambda _share: None), effects
    effects = tried_alone(everything)
    count = len(effects)
    null = null or without_effects(problem, starts_without_effects(problem))
    report(0.2)
    alone = each_alone(problem, null, effects)
    report(0.5)
    refine_best(problem, null, alone, log_odds_of_all(alone, null, count))
    better = refit_without_effects(problem, null, alone.values())
    moved = better.log_evidence > null.log_evidence + SAME_COST
    null = better
    if moved:
        before = alone
        alone = each_alone(problem, null, effects)
        # Of both searches for an effect, the better one counts.
        alone |= {n: o for n, o in before.items() if _log_evidence(alone.get(n)) < o.log_evidence}
    refuted = refute(problem, null, alone)
    report(0.7)
    signatures = signatures_of(null, alone)
    confusable = confusable_pairs({name: left for name, (_, left) in signatures.items()})
    pairs = fit_pairs(problem, null, alone, everything, confusable)
    refine_best(problem, null, pairs, log_odds_of_all({**alone, **pairs}, null, count))
    refuted |= refute(problem, null, pairs)
    report(0.9)
    odds = log_odds_of_all(alone, null, count)
    likely = sorted(alone, key=lambda name: -odds[name])[:_LOOKED_BESIDE]
    unknown_with = {name: log_bayes_any_unknown(problem, alone[name]) for name in likely}
    unknown = log_bayes_any_unknown(problem, null)
    unseen = tuple(effect.id for effect in effects if effect.id not in alone)
    report(1.0)
    factors = group_discrepancies(problem, null)
    return ModelSelection(
        null, alone, pairs, signatures, factors, unknown, unknown_with, unseen, count, refuted
    )


def refute(
    problem: InferenceProblem, null: Candidate, candidates: dict[str, Candidate]
) -> dict[str, tuple[Refutation, ...]]:
    """Find candidates that a group of observables refutes, and take their evidence from them.

    Parameters
    ----------
    problem : InferenceProblem
    null : Candidate
    candidates : dict of Candidate
        Those that are refuted are replaced.
    """
    better = [name for name, one in candidates.items() if one.log_evidence > null.log_evidence]
    each = map_processes(lambda name: refutations(problem, candidates[name]), better)
    found = {name: against for name, against in zip(better, each, strict=True) if against}
    for name in found:
        candidates[name] = replace(candidates[name], log_evidence=null.log_evidence)
    return found


def each_alone(
    problem: InferenceProblem, null: Candidate, effects: Sequence[Effect]
) -> dict[str, Candidate]:
    """Return the candidates with one effect, by identifier."""
    residuals = null.estimate.residuals
    start = Start(
        null.parameters(problem), residuals, null.model, null.weighed, np.zeros(0), null.weighed
    )
    each = map_processes(partial(search_alone, problem, start, null), effects)
    return {
        effect.id: found for effect, found in zip(effects, each, strict=True) if found is not None
    }


def _log_evidence(candidate: Candidate | None) -> float:
    return -np.inf if candidate is None else candidate.log_evidence


def signatures_of(
    null: Candidate, alone: Mapping[str, Candidate]
) -> dict[str, tuple[Array, Array]]:
    """Return what effects (n, s) change, whitened, and what nuisances leave of it.

    Parameters
    ----------
    null : Candidate
        Without effects.
    alone : mapping of Candidate
        With one effect, by identifier.
    """
    J, p = null.estimate.jacobian, len(null.estimate.z)
    found: dict[str, tuple[Array, Array]] = {}
    for name, candidate in alone.items():
        table = candidate.estimate.jacobian[:, p:] * candidate.deviation[:, None]
        found[name] = table, marginalised_signature(J, table)
    return found


def refit_candidate(problem: InferenceProblem, found: ModelSelection, name: str) -> ModelSelection:
    """Refit one candidate from two starts, and return the updated selection."""
    candidate = found.candidate(name)
    if candidate is None or candidate.estimate.starts > 1:
        return found
    again = refit_from_elsewhere(problem, candidate, np.random.default_rng(SEED))
    alone, pairs, unknown_with = (
        dict(found.single),
        dict(found.pairs),
        dict(found.unknown_log_bayes_with),
    )
    only = {name: again}
    refuted = found.refuted | refute(problem, found.null, only)
    (alone if name in alone else pairs).update(only)
    if name in unknown_with:
        unknown_with[name] = log_bayes_any_unknown(problem, again)
    return replace(
        found, single=alone, pairs=pairs, unknown_log_bayes_with=unknown_with, refuted=refuted
    )


def probability_range(found: ModelSelection, names: Collection[str]) -> tuple[float, float]:
    """Return the least and largest probability that one of these shows, by the priors of others."""
    totals = []
    for prior in other_priors():
        logs = log_probabilities(found.evidence, prior, only_what_shows=True)
        totals.append(sum(float(np.exp(logs[name])) for name in names if name in logs))
    return min(totals), max(totals)


def likeliest_unknown(found: ModelSelection) -> str:
    """Return the effect, pair or `NONE` in addition to which something unknown is likeliest."""
    logs = log_odds_with_unknown(found.evidence)
    shows = float(np.log1p(-unseen_share(found.evidence)))
    logs[NONE] = float(np.log(PRIOR["unknown"])) + shows + found.unknown_log_bayes
    return max(logs, key=lambda name: logs[name])
