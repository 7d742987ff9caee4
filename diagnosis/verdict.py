"""The answer of a diagnosis: where, which, how far, and what to measure next."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from diagnosis.actions import Worth, ranked_actions
from diagnosis.contest import (
    NONE,
    UNKNOWN,
    Contest,
    confirmed,
    contest,
    unknown_beside,
)
from diagnosis.discrepancy import discrepancies
from diagnosis.how_far import (
    Plain,
    Shrinkage,
    plain_gaps,
    shrinkage,
)
from diagnosis.likeness import (
    Reach,
    classes_of,
    reach_of,
)
from diagnosis.nuisances import NUISANCES, of_fits
from diagnosis.observing import blocks
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.sweeps import common_modes
from diagnosis.rivals import Comparison, Rival
from diagnosis.triggers import Trigger, triggers
from diagnosis.where import Map, gap_map
from physics.effects.catalogue import CATALOGUE
from physics.effects.effect import Stage
from physics.mechanics import ReedSolver
from physics.twin import Twin

Array = NDArray[np.floating[Any]]
Kind = Literal["none", "effect", "pair", "unknown", "not converged"]

COVERAGE: Final = 0.9
# A number off by so many deviations, or moved by an effect by so many, is part of a gap.
_OFF, _MOVED = 3.0, 0.5
# Of so many rivals it is told what they close.
_MOST_CLOSED = 8
# Rivals that turn out to be the likeliest are fitted again, so many one after the other.
_MOST_CONFIRMED = 8
# A doubtful fit without effects does not matter to what is likelier by so many nats.
_BEYOND_DOUBT = 20.0


@dataclass(frozen=True)
class Verdict:
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
    where : Map
    contest : Contest
    reach : tuple of Reach
        What this campaign could have told of each effect.
    unknown_beside, unknown_in : str
        Where something unknown is likeliest: beside which effect or pair or none, in which block.
    triggers : tuple of Trigger
        Signs of something unknown beside what is named.
    closing : tuple of str
        What is named; if nothing is, the effect that explains most by itself.
    closed, transferred : Shrinkage or None
        By these, on numbers left out; and in the condition that was left out whole.
    closed_by : dict of Shrinkage
        On all numbers, by each rival that is better than none.
    plain : tuple of Plain
        The same gap in units that people know.
    condition : str
        That condition.
    next_actions : tuple of Worth
        The best first, to tell the two likeliest apart.
    rivals : (str, str)
        These two.
    missing, refused : tuple of str
    """

    kind: Kind
    effects: tuple[str, ...]
    probability: dict[str, float]
    classes: tuple[tuple[str, ...], ...]
    likely: tuple[tuple[str, ...], ...]
    where: Map
    contest: Contest
    reach: tuple[Reach, ...]
    unknown_beside: str
    unknown_in: str
    triggers: tuple[Trigger, ...]
    closing: tuple[str, ...]
    closed: Shrinkage | None
    transferred: Shrinkage | None
    closed_by: dict[str, Shrinkage]
    plain: tuple[Plain, ...]
    condition: str
    next_actions: tuple[Worth, ...]
    rivals: tuple[str, str]
    missing: tuple[str, ...]
    refused: tuple[str, ...]


def diagnose(
    readings: Readings,
    reed_solver: ReedSolver,
    base: Twin | None = None,
    progress: Callable[[float], None] | None = None,
    without: Sequence[str] = (),
) -> Verdict:
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
    comparison = compared(readings, reed_solver, base or Twin())
    told = Told(condition_of(readings), readings.missing, readings.refused)
    return judged(comparison, told, progress, without)


@dataclass(frozen=True)
class Told:
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


def judged(
    comparison: Comparison,
    told: Told,
    progress: Callable[[float], None] | None = None,
    without: Sequence[str] = (),
) -> Verdict:
    """Judge numbers that are beside the twin already; parameters as those of `diagnose`."""
    # Matrices are small: threads of linear algebra would wait for each other more than compute.
    with threadpool_limits(limits=1, user_api="blas"):
        return _judged(comparison, told, progress, without)


def _judged(
    comparison: Comparison,
    told: Told,
    progress: Callable[[float], None] | None,
    without: Sequence[str],
) -> Verdict:
    effects = [e for e in CATALOGUE if e.stage is not Stage.NUMERICS and e.id not in without]
    found = contest(comparison, effects, progress)
    reach = reach_of(effects, found.signatures)
    classes = classes_of(reach)
    for _ in range(_MOST_CONFIRMED):
        # Nothing is named on one search's word.
        found = confirmed(comparison, found, _likeliest(found.probability, classes), len(effects))
    probability = found.probability
    kind, named = _named(found, classes)
    first, second = _two_likeliest(found)
    groups, condition = _groups(comparison), told.condition
    chosen = found.rival("+".join(named)) or _best_alone(found)
    acts = _touched(comparison, found.null, chosen)
    named_or_none = chosen if named else found.null
    beside = unknown_beside(found, len(effects))
    return Verdict(
        kind=kind,
        effects=named,
        probability=probability,
        classes=classes,
        likely=_likely(probability, classes),
        where=gap_map(comparison),
        contest=found,
        reach=reach,
        unknown_beside=beside,
        unknown_in=_block_beside(comparison, found.rival(beside) or found.null),
        triggers=triggers(comparison, named_or_none, _only(comparison, condition)),
        closing=chosen.names,
        closed=shrinkage(found.null, chosen, _where(groups, acts)),
        transferred=(
            shrinkage(found.null, chosen, _where(_only(comparison, condition), acts))
            if condition
            else None
        ),
        closed_by={
            name: shrinkage(found.null, rival, groups) for name, rival in _better(found).items()
        },
        plain=tuple(plain_gaps(comparison, found.null, chosen)),
        condition=condition,
        next_actions=tuple(ranked_actions(comparison, first, second)) if first and second else (),
        rivals=(_name(first), _name(second)),
        missing=told.missing,
        refused=told.refused,
    )


def _block_beside(comparison: Comparison, rival: Rival) -> str:
    """Block in which something unknown is likeliest beside a rival."""
    factors = discrepancies(comparison, rival)
    return max(factors, key=lambda name: float(factors[name][0]))


def compared(readings: Readings, reed_solver: ReedSolver, base: Twin) -> Comparison:
    """Put a campaign beside a twin with all that differs from bench to bench."""
    exchanged = of_fits(common_modes(readings.sweeps)) if readings.sweeps else ()
    return Comparison(blocks(readings, reed_solver), base, (*NUISANCES, *exchanged))


def _likeliest(probability: Mapping[str, float], classes: Sequence[tuple[str, ...]]) -> str:
    """Of the likeliest class the likeliest."""
    mass = _mass(probability, classes)
    group = max(mass, key=lambda group: mass[group])
    return max(group, key=lambda name: probability.get(name, 0.0))


def _named(found: Contest, classes: Sequence[tuple[str, ...]]) -> tuple[Kind, tuple[str, ...]]:
    """What is named, if its fit is one."""
    best = _likeliest(found.probability, classes)
    beyond = found.log_probability[best] - found.log_probability[NONE]
    if not found.null.estimate.certified and beyond < _BEYOND_DOUBT:
        return "not converged", ()
    if best == NONE:
        return "none", ()
    if best == UNKNOWN:
        return "unknown", ()
    names = tuple(best.split("+"))
    rival = found.rival(best)
    if rival is not None and (not rival.estimate.certified or rival.estimate.starts < 2):
        return "not converged", ()
    return ("effect" if len(names) == 1 else "pair"), names


def _better(found: Contest) -> dict[str, Rival]:
    """Likeliest few rivals that are better than none."""
    rivals = {**found.alone, **found.pairs}
    better = [name for name in rivals if rivals[name].log_evidence > found.null.log_evidence]
    ranked = sorted(better, key=lambda name: -rivals[name].log_evidence)
    return {name: rivals[name] for name in ranked[:_MOST_CLOSED]}


def _best_alone(found: Contest) -> Rival:
    """Effect that explains most by itself; none if none was fitted."""
    return max(found.alone.values(), key=lambda rival: rival.log_evidence, default=found.null)


def _two_likeliest(found: Contest) -> tuple[Rival | None, Rival | None]:
    """Likeliest two of no effect, each by itself, and pairs."""
    rivals = {NONE: found.null, **found.alone, **found.pairs}
    ranked = sorted(rivals, key=lambda name: -found.log_probability[name])
    return (rivals[ranked[0]], rivals[ranked[1]]) if len(ranked) > 1 else (None, None)


def _name(rival: Rival | None) -> str:
    return "" if rival is None else "+".join(rival.names) or NONE


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


def _touched(comparison: Comparison, null: Rival, rival: Rival) -> NDArray[np.bool_]:
    """Numbers where there is anything to close: off without effects, or moved by the rival's."""
    z = rival.estimate.z[: len(comparison.nuisances)]
    moved = rival.left - comparison.residuals(comparison.twin(z))
    off = np.abs(null.left) > _OFF
    touched: NDArray[np.bool_] = off | (np.abs(moved) > _MOVED)
    return touched


def _where(groups: Sequence[str], chosen: NDArray[np.bool_]) -> list[str]:
    """Groups of chosen numbers; empty elsewhere."""
    return [name if here else "" for name, here in zip(groups, chosen.tolist(), strict=True)]


def _groups(comparison: Comparison) -> list[str]:
    """Which numbers are left out together: those of a mode, of a band, of a time, of a block."""
    names = []
    for block in comparison.blocks:
        for place in block.places:
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


def _only(comparison: Comparison, condition: str) -> list[str]:
    """Group that holds one sweep's numbers; empty elsewhere.

    Means of all sweeps have some of it, and stay.
    """
    return [
        condition if _of_sweep(place.time, condition) or place.level == condition else ""
        for block in comparison.blocks
        for place in block.places
    ]
