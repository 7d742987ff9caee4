"""Diagnose a campaign: where measurement and model differ, why, and what to measure next."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from diagnosis.experiment_design import (
    RankedExperiment,
    Unseen,
    rank_experiments,
    unseen_effects,
)
from diagnosis.explained_fraction import (
    ExplainedFraction,
    GapInUnits,
    KnownGap,
    explained_fraction,
    gaps_in_units,
)
from diagnosis.floor_certificate import Floor, certified, floor_certificate
from diagnosis.gap_map import GapMap, gap_map
from diagnosis.inference.candidate_search import confirmed
from diagnosis.inference.candidates import Candidate, without_effects
from diagnosis.inference.discrepancy import group_discrepancies
from diagnosis.inference.model_selection import (
    ModelSelection,
    likeliest_unknown,
    probability_range,
    refit_candidate,
    select_model,
    tried_alone,
)
from diagnosis.inference.nuisances import (
    NUISANCES,
    USUAL_COMPLIANCE_M_PA,
    of_further_resonances,
)
from diagnosis.inference.null_starts import starts_without_effects
from diagnosis.inference.predictive_checks import PredictiveCheck, predictive_checks
from diagnosis.inference.probabilities import NONE, UNKNOWN
from diagnosis.inference.problem import InferenceProblem
from diagnosis.inference.similarity import Detectability, confusable_classes, detectability_of
from diagnosis.known_bench import KnownEffects, only_once
from diagnosis.observe import observable_groups
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.sweeps import names_in_order
from physics.alterations import YieldingClamp
from physics.effects.catalogue import CATALOGUE
from physics.effects.effect import Effect, Stage
from physics.mechanics import ReedSolver
from physics.parameters.tree import BenchParameters, with_alteration
from physics.sized_effect import SizedEffect

Kind = Literal["none", "effect", "pair", "unknown", "not converged"]

# Of the sets of hypotheses. Chosen: nine of ten.
COVERAGE: Final = 0.9
# A number belongs to a gap if it is off, or moved by the effect, by this many deviations. Chosen:
# chance takes one number in 370 so far off; half of an error hardly moves one.
_OFF, _MOVED = 3.0, 0.5
# Most candidates whose explained fraction is computed. Chosen: a page has no room for more.
_MOST_CLOSED = 8
# Most candidates that are refitted one after the other because they have become the likeliest.
_MOST_CONFIRMED = 8
# A fit without effects that has not converged does not matter beyond this many nats.
_BEYOND_DOUBT = 20.0


@dataclass(frozen=True)
class Diagnosis:
    """The answer of a diagnosis.

    Attributes
    ----------
    kind : {'none', 'effect', 'pair', 'unknown', 'not converged'}
    effects : tuple of str
        Identifiers of the effects that are named.
    probability : dict of float
        Of 'none', 'unknown', effects, and pairs joined by '+'.
    probability_of_what_shows : dict of float
        The same, where what would not show in these runs counts as no effect.
    classes : tuple of tuple of str
        Groups of effects that this campaign cannot separate.
    likely : tuple of tuple of str
        The fewest classes that together have 90 % of the probability.
    shown : tuple of tuple of str
        The same by `probability_of_what_shows`.
    likeliest_range : (float, float)
        Probability of the first of these for others, to whom no effect, one, two or something
        unknown is three times as likely beforehand, or a third.
    gap : GapMap
    selection : ModelSelection
    detectability : tuple of Detectability
        How well this campaign can detect each effect.
    unseen : tuple of Unseen
        Effects that it cannot detect at any size, and what would.
    unknown_with, unknown_in : str
        Where something unknown is likeliest: in addition to which effect, pair or none, and in
        which group of observables.
    checks : tuple of PredictiveCheck
        Predictive checks of what is named.
    floor : tuple of Floor
        How far the errors of each group can be trusted, given what is named.
    explained_with : tuple of str
        The effects named, or else the one that explains most by itself.
    explained, explained_other_sweep : ExplainedFraction or None
        Fraction that these explain, on numbers left out, and in the sweep that was left out.
    explained_by : dict of ExplainedFraction
        The same on all numbers, for each candidate that is better than none.
    gaps_in_units : tuple of GapInUnits
        The same gap in familiar units.
    known : KnownGap or None
        What the known effects of the bench explain; None if it has none.
    condition : str
        Name of that sweep.
    next_experiments : tuple of RankedExperiment
        Experiments that separate the two likeliest candidates, the best first.
    compared : (str, str)
        The two likeliest candidates.
    missing, refused : tuple of str
    """

    kind: Kind
    effects: tuple[str, ...]
    probability: dict[str, float]
    probability_of_what_shows: dict[str, float]
    classes: tuple[tuple[str, ...], ...]
    likely: tuple[tuple[str, ...], ...]
    shown: tuple[tuple[str, ...], ...]
    likeliest_range: tuple[float, float]
    gap: GapMap
    selection: ModelSelection
    detectability: tuple[Detectability, ...]
    unseen: tuple[Unseen, ...]
    unknown_with: str
    unknown_in: str
    checks: tuple[PredictiveCheck, ...]
    floor: tuple[Floor, ...]
    explained_with: tuple[str, ...]
    explained: ExplainedFraction | None
    explained_other_sweep: ExplainedFraction | None
    explained_by: dict[str, ExplainedFraction]
    gaps_in_units: tuple[GapInUnits, ...]
    known: KnownGap | None
    condition: str
    next_experiments: tuple[RankedExperiment, ...]
    compared: tuple[str, str]
    missing: tuple[str, ...]
    refused: tuple[str, ...]


def diagnose(
    readings: Readings,
    reed_solver: ReedSolver,
    base: BenchParameters | None = None,
    known: KnownEffects | None = None,
    progress: Callable[[float], None] | None = None,
) -> Diagnosis:
    """Diagnose a campaign.

    Parameters
    ----------
    readings : Readings
    reed_solver : ReedSolver
        Of the kind of reed.
    base : BenchParameters, optional
        Model with what is known of the bench, but for effects; by default the nominal one.
    known : KnownEffects, optional
        Effects that the bench is known to have; by default none.
    progress : callable, optional
        Called with the fraction that is done.
    """
    known = known or KnownEffects()
    problem = inference_problem(readings, reed_solver, base or BenchParameters(), known.effects)
    summary = CampaignSummary(
        condition_of(readings),
        readings.missing,
        readings.refused,
        known.foreseen,
        readings.moments_h,
    )
    return diagnose_problem(problem, summary, progress, only_once(known.effects))


@dataclass(frozen=True)
class CampaignSummary:
    """What is known of a campaign besides its observables.

    Attributes
    ----------
    condition : str
        Sweep that is left out completely; empty if there is none.
    missing, refused : tuple of str
    foreseen : bool
        Whether known effects were known before the campaign was measured.
    moments_h : tuple of float
        See `Readings.moments_h`.
    """

    condition: str = ""
    missing: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    foreseen: bool = False
    moments_h: tuple[float, ...] = ()


def diagnose_problem(
    problem: InferenceProblem,
    summary: CampaignSummary,
    progress: Callable[[float], None] | None = None,
    without: Sequence[str] = (),
) -> Diagnosis:
    """Diagnose an inference problem; other parameters as those of `diagnose`."""
    # Matrices are small: threads of linear algebra would wait for each other more than compute.
    with threadpool_limits(limits=1, user_api="blas"):
        return _judged(problem, summary, progress, without)


def _judged(
    problem: InferenceProblem,
    summary: CampaignSummary,
    progress: Callable[[float], None] | None,
    without: Sequence[str],
) -> Diagnosis:
    effects, (problem, null, inflated) = _effects(without, summary.moments_h), _certified(problem)
    found = select_model(problem, effects, progress, null)
    alone = tried_alone(effects)
    reach = detectability_of(alone, found.signatures)
    classes = confusable_classes(reach)
    for _ in range(_MOST_CONFIRMED):
        # A single search is no proof of an optimum.
        likeliest = _likeliest(found.probability_of_what_shows, classes)
        found = refit_candidate(problem, found, likeliest)
    probability = found.probability
    kind, named = _named(found, classes)
    shown = _likely(found.probability_of_what_shows, classes)
    first, second = _two_likeliest(found)
    groups, condition = _groups(problem), summary.condition
    left_out = _only(problem, condition)
    chosen = found.candidate("+".join(named)) or _best_alone(found)
    acts = _touched(problem, found.null, chosen)
    elsewhere = _where(left_out, acts)
    named_or_none = chosen if named else found.null
    unknown_with = likeliest_unknown(found)
    return Diagnosis(
        kind=kind,
        effects=named,
        probability=probability,
        probability_of_what_shows=found.probability_of_what_shows,
        classes=classes,
        likely=_likely(probability, classes),
        shown=shown,
        likeliest_range=probability_range(found, shown[0]),
        gap=gap_map(problem),
        selection=found,
        detectability=reach,
        unseen=tuple(unseen_effects(problem, found.null, alone, reach)),
        unknown_with=unknown_with,
        unknown_in=_likeliest_group(problem, found.candidate(unknown_with) or found.null),
        checks=predictive_checks(problem, named_or_none, left_out),
        floor=floor_certificate(problem, named_or_none, inflated),
        explained_with=chosen.names,
        explained=explained_fraction(problem, found.null, chosen, _where(groups, acts)),
        explained_other_sweep=explained_fraction(problem, found.null, chosen, elsewhere)
        if condition
        else None,
        explained_by={
            name: explained_fraction(problem, found.null, candidate, groups)
            for name, candidate in _better(found).items()
        },
        gaps_in_units=tuple(gaps_in_units(problem, found.null, chosen)),
        known=known_gap(problem, found.null, summary.foreseen) if problem.known else None,
        condition=condition,
        next_experiments=tuple(rank_experiments(problem, first, second) if second else ()),
        compared=(_name(first), _name(second)) if second else ("", ""),
        missing=summary.missing,
        refused=summary.refused,
    )


def _effects(without: Sequence[str], moments_h: Sequence[float]) -> list[Effect]:
    """Return the effects that are tried: those of nature, but for some, at the given times."""
    physical = [e for e in CATALOGUE if e.stage is not Stage.NUMERICS and e.id not in without]
    return [effect.at_moments(moments_h) for effect in physical]


def _certified(
    problem: InferenceProblem,
) -> tuple[InferenceProblem, Candidate, dict[str, float]]:
    """Return the problem with errors as large as replicates scatter, its fit, and the factors."""
    null = without_effects(problem, starts_without_effects(problem))
    other, inflated = certified(problem, null)
    if inflated:
        null = without_effects(other, [null.nuisances, np.zeros(len(null.nuisances))])
    if not null.estimate.converged:
        # Of starts far apart, one alone may have found the best optimum.
        null = confirmed(other, null)
    return other, null, inflated


def _likeliest_group(problem: InferenceProblem, candidate: Candidate) -> str:
    """Return the group in which something unknown is likeliest, given a candidate."""
    factors = group_discrepancies(problem, candidate)
    return max(factors, key=lambda name: factors[name])


def known_gap(problem: InferenceProblem, null: Candidate, foreseen: bool) -> KnownGap:
    """Return how much of the gap the known effects explain, of a problem that has some.

    Parameters
    ----------
    problem : InferenceProblem
    null : Candidate
        Its fit without further effects.
    foreseen : bool
        See `KnownGap`.
    """
    bare = problem.without_known()
    count = len(bare.nuisances)
    without = without_effects(bare, [np.zeros(count), null.estimate.z[:count]])
    moved = null.whitened_residual - bare.residuals(bare.parameters(null.estimate.z[:count]))
    acts = (np.abs(without.whitened_residual) > _OFF) | (np.abs(moved) > _MOVED)
    return KnownGap(
        problem.known,
        foreseen,
        explained_fraction(problem, without, null, _where(_groups(problem), acts)),
        tuple(gaps_in_units(problem, without, null)),
    )


def inference_problem(
    readings: Readings,
    reed_solver: ReedSolver,
    base: BenchParameters,
    known: Sequence[SizedEffect] = (),
) -> InferenceProblem:
    """Return the inference problem of a campaign, with all nuisances.

    No clamp is rigid: the nominal one yields as an ordinary clamp does.
    """
    clamped = with_alteration(base, YieldingClamp(), USUAL_COMPLIANCE_M_PA)
    nuisances = (*NUISANCES, *of_further_resonances(base.drive))
    solver = reed_solver.in_order(names_in_order(readings.sweeps))
    return InferenceProblem(observable_groups(readings, solver), clamped, nuisances, known)


def _likeliest(probability: Mapping[str, float], classes: Sequence[tuple[str, ...]]) -> str:
    """Return the likeliest hypothesis of the likeliest class."""
    mass = _mass(probability, classes)
    group = max(mass, key=lambda group: mass[group])
    return max(group, key=lambda name: probability.get(name, 0.0))


def _named(
    found: ModelSelection, classes: Sequence[tuple[str, ...]]
) -> tuple[Kind, tuple[str, ...]]:
    """Return the verdict and the effects that are named."""
    best = _likeliest(found.probability_of_what_shows, classes)
    beyond = found.log_probability[best] - found.log_probability[NONE]
    if not found.null.estimate.converged and beyond < _BEYOND_DOUBT:
        return "not converged", ()
    if best == NONE:
        return "none", ()
    if best == UNKNOWN:
        return "unknown", ()
    names = tuple(best.split("+"))
    candidate = found.candidate(best)
    if candidate is not None and (
        not candidate.estimate.converged or candidate.estimate.starts < 2
    ):
        return "not converged", ()
    return ("effect" if len(names) == 1 else "pair"), names


def _better(found: ModelSelection) -> dict[str, Candidate]:
    """Return the likeliest candidates that are better than none."""
    candidates = {**found.single, **found.pairs}
    better = [
        name for name in candidates if candidates[name].log_evidence > found.null.log_evidence
    ]
    ranked = sorted(better, key=lambda name: -candidates[name].log_evidence)
    return {name: candidates[name] for name in ranked[:_MOST_CLOSED]}


def _best_alone(found: ModelSelection) -> Candidate:
    """Effect that explains most by itself; none if none was fitted."""
    return max(
        found.single.values(), key=lambda candidate: candidate.log_evidence, default=found.null
    )


def _two_likeliest(found: ModelSelection) -> tuple[Candidate, Candidate | None]:
    """Likeliest two of no effect, each by itself, and pairs; None if no effect was fitted."""
    candidates = {NONE: found.null, **found.single, **found.pairs}
    ranked = sorted(candidates, key=lambda name: -found.log_probability[name])
    return candidates[ranked[0]], candidates[ranked[1]] if len(ranked) > 1 else None


def _name(candidate: Candidate) -> str:
    return "+".join(candidate.names) or NONE


def _mass(
    probability: Mapping[str, float], classes: Sequence[tuple[str, ...]]
) -> dict[tuple[str, ...], float]:
    """Probability of every class; a class of pairs has all that are of the same two classes."""
    of = {name: group for group in classes for name in group}
    members: dict[tuple[tuple[str, ...], ...], list[str]] = {}
    for name in probability:
        parts = tuple(sorted(of.get(part, (part,)) for part in name.split("+")))
        members.setdefault(parts, []).append(name)
    return {
        kinds[0] if len(kinds) == 1 else tuple(sorted(names)): sum(probability[n] for n in names)
        for kinds, names in members.items()
    }


def _likely(
    probability: Mapping[str, float], classes: Sequence[tuple[str, ...]]
) -> tuple[tuple[str, ...], ...]:
    """Fewest classes that cover the probability."""
    mass = _mass(probability, classes)
    covered, chosen = 0.0, []
    for group in sorted(mass, key=lambda group: -mass[group]):
        chosen.append(group)
        covered += mass[group]
        if covered >= COVERAGE:
            break
    return tuple(chosen)


def _touched(problem: InferenceProblem, null: Candidate, candidate: Candidate) -> NDArray[np.bool_]:
    """Return which numbers differ without effects, or are moved by the effects of a candidate."""
    z = candidate.estimate.z[: len(problem.nuisances)]
    moved = candidate.whitened_residual - problem.residuals(problem.parameters(z))
    off = np.abs(null.whitened_residual) > _OFF
    touched: NDArray[np.bool_] = off | (np.abs(moved) > _MOVED)
    return touched


def _where(groups: Sequence[str], chosen: NDArray[np.bool_]) -> list[str]:
    """Groups of chosen numbers; empty elsewhere."""
    return [name if here else "" for name, here in zip(groups, chosen.tolist(), strict=True)]


def _groups(problem: InferenceProblem) -> list[str]:
    """Return for each number the label of those that are left out with it."""
    names = []
    for block in problem.groups:
        for place in block.coordinates:
            label = place.mode or place.band or place.time or place.quantity
            names.append(f"{block.name} {label}")
    return names


def condition_of(readings: Readings) -> str:
    """Sweep that is left out whole: of another clamping if there is one, else of another level."""
    sweeps = readings.sweeps
    if len(sweeps) < 2:
        return ""
    other = [s.name for s in sweeps if s.clamping != sweeps[0].clamping]
    if other:
        return other[-1]
    return min(sweeps, key=lambda sweep: sweep.loudness).name


def _of_sweep(time: str, sweep: str) -> bool:
    """Whether a time is a sweep, or a numbered piece of it."""
    return time == sweep or re.fullmatch(rf"{re.escape(sweep)} \d+", time) is not None


def _only(problem: InferenceProblem, condition: str) -> list[str]:
    """Group that holds one sweep's numbers; empty elsewhere.

    Means of all sweeps have some of it, and stay.
    """
    return [
        condition if _of_sweep(place.time, condition) or place.level == condition else ""
        for block in problem.groups
        for place in block.coordinates
    ]
