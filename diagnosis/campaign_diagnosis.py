"""The answer of a diagnosis: where, which, how far, and what to measure next."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from diagnosis.experiment_design import RankedExperiment, rank_experiments
from diagnosis.explained_fraction import (
    ExplainedFraction,
    GapInUnits,
    explained_fraction,
    gaps_in_units,
)
from diagnosis.gap_map import GapMap, gap_map
from diagnosis.inference.candidates import Candidate
from diagnosis.inference.discrepancy import group_discrepancies
from diagnosis.inference.model_selection import (
    ModelSelection,
    likeliest_unknown,
    refit_candidate,
    select_model,
)
from diagnosis.inference.nuisances import NUISANCES, of_fits
from diagnosis.inference.predictive_checks import PredictiveCheck, predictive_checks
from diagnosis.inference.probabilities import NONE, UNKNOWN
from diagnosis.inference.problem import InferenceProblem
from diagnosis.inference.similarity import Detectability, confusable_classes, detectability_of
from diagnosis.observe import observable_groups
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.sweeps import common_modes
from physics.effects.catalogue import CATALOGUE
from physics.effects.effect import Stage
from physics.mechanics import ReedSolver
from physics.twin import Twin

Array = NDArray[np.floating[Any]]
Kind = Literal["none", "effect", "pair", "unknown", "not converged"]

COVERAGE: Final = 0.9
# A number off by so many deviations, or moved by an effect by so many, is part of a gap.
_OFF, _MOVED = 3.0, 0.5
# Of so many candidates it is told what they close.
_MOST_CLOSED = 8
# Candidates that turn out to be the likeliest are fitted again, so many one after the other.
_MOST_CONFIRMED = 8
# A doubtful fit without effects does not matter to what is likelier by so many nats.
_BEYOND_DOUBT = 20.0


@dataclass(frozen=True)
class Diagnosis:
    """What a campaign says.

    Attributes
    ----------
    kind : {'none', 'effect', 'pair', 'unknown', 'not converged'}
    effects : tuple of str
        Ids of the effects named.
    probability : dict of float
        Of 'none', 'unknown', effects, and pairs joined by '+'.
    classes : tuple of tuple of str
        Effects that this campaign does not tell apart.
    likely : tuple of tuple of str
        Fewest classes that together have 90 % of the probability.
    gap : GapMap
    selection : ModelSelection
    detectability : tuple of Detectability
        What this campaign could have told of each effect.
    unknown_with, unknown_in : str
        Where something unknown is likeliest: beside which effect or pair or none, in which block.
    checks : tuple of PredictiveCheck
        Signs of something unknown beside what is named.
    explained_with : tuple of str
        What is named; if nothing is, the effect that explains most by itself.
    explained, explained_other_sweep : ExplainedFraction or None
        By these, on numbers left out; and in the condition that was left out whole.
    explained_by : dict of ExplainedFraction
        On all numbers, by each candidate that is better than none.
    gaps_in_units : tuple of GapInUnits
        The same gap in units that people know.
    condition : str
        That condition.
    next_experiments : tuple of RankedExperiment
        The best first, to tell the two likeliest apart.
    compared : (str, str)
        These two.
    missing, refused : tuple of str
    """

    kind: Kind
    effects: tuple[str, ...]
    probability: dict[str, float]
    classes: tuple[tuple[str, ...], ...]
    likely: tuple[tuple[str, ...], ...]
    gap: GapMap
    selection: ModelSelection
    detectability: tuple[Detectability, ...]
    unknown_with: str
    unknown_in: str
    checks: tuple[PredictiveCheck, ...]
    explained_with: tuple[str, ...]
    explained: ExplainedFraction | None
    explained_other_sweep: ExplainedFraction | None
    explained_by: dict[str, ExplainedFraction]
    gaps_in_units: tuple[GapInUnits, ...]
    condition: str
    next_experiments: tuple[RankedExperiment, ...]
    compared: tuple[str, str]
    missing: tuple[str, ...]
    refused: tuple[str, ...]


def diagnose(
    readings: Readings,
    reed_solver: ReedSolver,
    base: Twin | None = None,
    progress: Callable[[float], None] | None = None,
    without: Sequence[str] = (),
) -> Diagnosis:
    """Compare a campaign with the twin.

    Parameters
    ----------
    readings : Readings
    reed_solver : ReedSolver
        Of the kind of reed.
    base : Twin, optional
        What is known of the bench; nothing if not given.
    progress : callable, optional
        Told the share that is done.
    without : sequence of str
        Effects that the catalogue is to do without.
    """
    problem = inference_problem(readings, reed_solver, base or Twin())
    told = CampaignSummary(condition_of(readings), readings.missing, readings.refused)
    return diagnose_problem(problem, told, progress, without)


@dataclass(frozen=True)
class CampaignSummary:
    """What is known of a campaign beside its numbers.

    Attributes
    ----------
    condition : str
        Sweep that is left out whole; empty if there is none.
    missing, refused : tuple of str
    """

    condition: str = ""
    missing: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()


def diagnose_problem(
    problem: InferenceProblem,
    told: CampaignSummary,
    progress: Callable[[float], None] | None = None,
    without: Sequence[str] = (),
) -> Diagnosis:
    """Judge numbers that are beside the twin already; parameters as those of `diagnose`."""
    # Matrices are small: threads of linear algebra would wait for each other more than compute.
    with threadpool_limits(limits=1, user_api="blas"):
        return _judged(problem, told, progress, without)


def _judged(
    problem: InferenceProblem,
    told: CampaignSummary,
    progress: Callable[[float], None] | None,
    without: Sequence[str],
) -> Diagnosis:
    effects = [e for e in CATALOGUE if e.stage is not Stage.NUMERICS and e.id not in without]
    found = select_model(problem, effects, progress)
    reach = detectability_of(effects, found.signatures)
    classes = confusable_classes(reach)
    for _ in range(_MOST_CONFIRMED):
        # Nothing is named on one search's word.
        found = refit_candidate(
            problem, found, _likeliest(found.probability, classes), len(effects)
        )
    probability = found.probability
    kind, named = _named(found, classes)
    first, second = _two_likeliest(found)
    groups, condition = _groups(problem), told.condition
    chosen = found.candidate("+".join(named)) or _best_alone(found)
    acts = _touched(problem, found.null, chosen)
    named_or_none = chosen if named else found.null
    beside = likeliest_unknown(found, len(effects))
    return Diagnosis(
        kind=kind,
        effects=named,
        probability=probability,
        classes=classes,
        likely=_likely(probability, classes),
        gap=gap_map(problem),
        selection=found,
        detectability=reach,
        unknown_with=beside,
        unknown_in=_block_beside(problem, found.candidate(beside) or found.null),
        checks=predictive_checks(problem, named_or_none, _only(problem, condition)),
        explained_with=chosen.names,
        explained=explained_fraction(found.null, chosen, _where(groups, acts)),
        explained_other_sweep=(
            explained_fraction(found.null, chosen, _where(_only(problem, condition), acts))
            if condition
            else None
        ),
        explained_by={
            name: explained_fraction(found.null, candidate, groups)
            for name, candidate in _better(found).items()
        },
        gaps_in_units=tuple(gaps_in_units(problem, found.null, chosen)),
        condition=condition,
        next_experiments=tuple(rank_experiments(problem, first, second))
        if first and second
        else (),
        compared=(_name(first), _name(second)),
        missing=told.missing,
        refused=told.refused,
    )


def _block_beside(problem: InferenceProblem, candidate: Candidate) -> str:
    """Block in which something unknown is likeliest beside a candidate."""
    factors = group_discrepancies(problem, candidate)
    return max(factors, key=lambda name: float(factors[name][0]))


def inference_problem(readings: Readings, reed_solver: ReedSolver, base: Twin) -> InferenceProblem:
    """Put a campaign beside a twin with all that differs from bench to bench."""
    exchanged = of_fits(common_modes(readings.sweeps)) if readings.sweeps else ()
    return InferenceProblem(
        observable_groups(readings, reed_solver), base, (*NUISANCES, *exchanged)
    )


def _likeliest(probability: Mapping[str, float], classes: Sequence[tuple[str, ...]]) -> str:
    """Of the likeliest class the likeliest."""
    mass = _mass(probability, classes)
    group = max(mass, key=lambda group: mass[group])
    return max(group, key=lambda name: probability.get(name, 0.0))


def _named(
    found: ModelSelection, classes: Sequence[tuple[str, ...]]
) -> tuple[Kind, tuple[str, ...]]:
    """What is named, if its fit is one."""
    best = _likeliest(found.probability, classes)
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
    """Likeliest few candidates that are better than none."""
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


def _two_likeliest(found: ModelSelection) -> tuple[Candidate | None, Candidate | None]:
    """Likeliest two of no effect, each by itself, and pairs."""
    candidates = {NONE: found.null, **found.single, **found.pairs}
    ranked = sorted(candidates, key=lambda name: -found.log_probability[name])
    return (candidates[ranked[0]], candidates[ranked[1]]) if len(ranked) > 1 else (None, None)


def _name(candidate: Candidate | None) -> str:
    return "" if candidate is None else "+".join(candidate.names) or NONE


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
    moved = candidate.whitened_residual - problem.residuals(problem.twin(z))
    off = np.abs(null.whitened_residual) > _OFF
    touched: NDArray[np.bool_] = off | (np.abs(moved) > _MOVED)
    return touched


def _where(groups: Sequence[str], chosen: NDArray[np.bool_]) -> list[str]:
    """Groups of chosen numbers; empty elsewhere."""
    return [name if here else "" for name, here in zip(groups, chosen.tolist(), strict=True)]


def _groups(problem: InferenceProblem) -> list[str]:
    """Which numbers are left out together: those of a mode, of a band, of a time, of a block."""
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
