"""The answer of a diagnosis: where, which, how far, and what to measure next."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from diagnosis.actions import Worth, ranked_actions
from diagnosis.contest import NONE, UNKNOWN, Contest, contest, signatures
from diagnosis.how_far import Shrinkage, shrinkage
from diagnosis.likeness import classes_of, cosines
from diagnosis.nuisances import NUISANCES
from diagnosis.observing import Readings, blocks
from diagnosis.rivals import Comparison, Rival
from diagnosis.where import Map, gap_map
from physics.effects.catalogue import CATALOGUE
from physics.effects.form import Stage
from physics.mechanics import Workshop
from physics.twin import Twin

Array = NDArray[np.floating[Any]]
Kind = Literal["none", "effect", "pair", "unknown", "not converged"]

COVERAGE: Final = 0.9
# A parameter beyond so many deviations of its prior is not plausible.
_PLAUSIBLE = 3.0
_LEAST_TOLD = 1e-6


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
    closed, transferred : Shrinkage or None
        By what is named, on numbers left out; and in the condition that was left out whole.
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
    closed: Shrinkage | None
    transferred: Shrinkage | None
    condition: str
    next_actions: tuple[Worth, ...]
    rivals: tuple[str, str]
    missing: tuple[str, ...]
    refused: tuple[str, ...]


def diagnose(
    readings: Readings,
    workshop: Workshop,
    base: Twin | None = None,
    progress: Callable[[float], None] | None = None,
    without: Sequence[str] = (),
) -> Verdict:
    """Compare a campaign with the twin.

    Parameters
    ----------
    readings : Readings
    workshop : Workshop
        Of the kind of reed.
    base : Twin, optional
        What is known of the bench; nothing if not given.
    progress : callable, optional
        Told the share that is done.
    without : sequence of str
        Effects that the catalogue is to do without.
    """
    effects = [e for e in CATALOGUE if e.stage is not Stage.NUMERICS and e.id not in without]
    comparison = Comparison(blocks(readings, workshop), base or Twin(), NUISANCES)
    found = contest(comparison, effects, progress)
    probability = {name: float(np.exp(log)) for name, log in found.log_probability.items()}
    alike = cosines(signatures(comparison, found.null, found.alone))
    classes = classes_of([effect.id for effect in effects], alike)
    kind, named = _named(found, probability)
    winner = _rival(found, named)
    first, second = _two_best(found)
    groups = _groups(comparison)
    condition = _condition(readings)
    chosen = winner if winner is not None else first
    return Verdict(
        kind=kind,
        effects=named,
        probability=probability,
        classes=classes,
        likely=_likely(probability, classes),
        where=gap_map(comparison),
        contest=found,
        closed=shrinkage(comparison, found.null, chosen, groups) if chosen else None,
        transferred=(
            shrinkage(comparison, found.null, chosen, _only(comparison, condition))
            if chosen and condition
            else None
        ),
        condition=condition,
        next_actions=tuple(_next(comparison, first, second)) if first and second else (),
        rivals=(_name(first), _name(second)),
        missing=readings.missing,
        refused=readings.refused,
    )


def _named(found: Contest, probability: Mapping[str, float]) -> tuple[Kind, tuple[str, ...]]:
    """What the likeliest answer is, if its fit is one."""
    best = max(probability, key=lambda name: probability[name])
    if not found.null.estimate.certified:
        return "not converged", ()
    if best == NONE:
        return "none", ()
    if best == UNKNOWN:
        return "unknown", ()
    names = tuple(best.split("+"))
    rival = _rival(found, names)
    if rival is not None and not rival.estimate.certified:
        return "not converged", names
    return ("effect" if len(names) == 1 else "pair"), names


def _rival(found: Contest, names: tuple[str, ...]) -> Rival | None:
    if len(names) == 1:
        return found.alone.get(names[0])
    return found.pairs.get((names[0], names[1])) if len(names) > 1 else None


def _two_best(found: Contest) -> tuple[Rival | None, Rival | None]:
    """Best two of no effect and each by itself, the best that is an effect first."""
    ranked = sorted(found.alone.values(), key=lambda rival: -rival.log_evidence)
    if not ranked:
        return None, None
    return ranked[0], max([found.null, *ranked[1:2]], key=lambda rival: rival.log_evidence)


def _name(rival: Rival | None) -> str:
    return "" if rival is None else "+".join(rival.names) or NONE


def _next(comparison: Comparison, one: Rival, other: Rival) -> list[Worth]:
    p = len(comparison.nuisances)

    def twin(rival: Rival) -> Twin:
        twin, rest = comparison.twin(rival.estimate.z[:p]), rival.estimate.z[p:]
        for sized in rival.effects:
            twin = sized.change(twin, rest[: len(sized.sizes)])
            rest = rest[len(sized.sizes) :]
        return twin

    return ranked_actions(comparison, one, other, (twin(one), twin(other)))


def _likely(
    probability: Mapping[str, float], classes: Sequence[tuple[str, ...]]
) -> tuple[tuple[str, ...], ...]:
    """Fewest classes that cover the probability; pairs stand by themselves."""
    mass: dict[tuple[str, ...], float] = {}
    of = {name: group for group in classes for name in group}
    for name, value in probability.items():
        group = of.get(name, (name,))
        mass[group] = mass.get(group, 0.0) + value
    covered, chosen = 0.0, []
    for group in sorted(mass, key=lambda group: -mass[group]):
        chosen.append(group)
        covered += mass[group]
        if covered >= COVERAGE:
            break
    return tuple(chosen)


def _groups(comparison: Comparison) -> list[str]:
    """Which numbers are left out together: those of a mode, of a band, of a time, of a block."""
    names = []
    for block in comparison.blocks:
        for place in block.places:
            label = place.mode or place.band or place.time or place.quantity
            names.append(f"{block.name} {label}")
    return names


def _condition(readings: Readings) -> str:
    """Sweep that is left out whole: of another clamping if there is one, else of another level."""
    sweeps = readings.sweeps
    if len(sweeps) < 2:
        return ""
    other = [s.name for s in sweeps if s.clamping != sweeps[0].clamping]
    if other:
        return other[-1]
    return min(sweeps, key=lambda sweep: sweep.loudness).name


def _only(comparison: Comparison, condition: str) -> list[str]:
    """Group that holds one sweep's numbers; empty elsewhere."""
    return [
        condition if place.time.split(" ")[0] == condition else ""
        for block in comparison.blocks
        for place in block.places
    ]


def to_json(verdict: Verdict) -> dict[str, Any]:
    """Verdict with stable keys (documented in ``docs/diagnosis.md``)."""
    found = verdict.contest
    null = found.null.estimate.cost
    effects = {}
    for name, rival in found.alone.items():
        sized = rival.effects[0]
        count = len(sized.sizes)
        z = rival.estimate.z[-count:]
        errors = np.sqrt(np.diag(rival.estimate.covariance))[-count:]
        effects[name] = {
            "log_bayes": rival.log_evidence - found.null.log_evidence,
            "d_prime": float(np.sqrt(max(null - rival.estimate.cost, 0.0))),
            "sizes": {
                p.name: {"value": p.spread * float(v), "error": p.spread * float(e), "unit": p.unit,
                         "z": float(v), "plausible": bool(abs(v) < _PLAUSIBLE)}
                for p, v, e in zip(sized.sizes, z, errors, strict=True)
            },
            "places": dict(sized.places),
            "certified": rival.estimate.certified,
        }  # fmt: skip
    told = {n: p for n, p in verdict.probability.items() if p > _LEAST_TOLD}
    return {
        "verdict": verdict.kind,
        "effects_named": list(verdict.effects),
        "probability": dict(sorted(told.items(), key=lambda item: -item[1])),
        "classes": [list(group) for group in verdict.classes if len(group) > 1],
        "likely": [list(group) for group in verdict.likely],
        "where": {
            "first_failing_tap": verdict.where.first_failing,
            "taps": {
                tap: {"gap": gap, "chance": chance}
                for tap, (gap, chance) in verdict.where.taps.items()
            },
            "cells": [asdict(c) | {"resolvable": c.resolvable} for c in verdict.where.cells],
        },
        "how_far": {
            "left_out": _json_of(verdict.closed),
            "condition": verdict.condition,
            "other_condition": _json_of(verdict.transferred),
        },
        "next": {
            "between": list(verdict.rivals),
            "actions": [
                {"id": w.action.id, "words": w.action.words, "minutes": w.action.minutes,
                 "nats": w.nats, "nats_per_minute": w.nats_per_minute}
                for w in verdict.next_actions
            ],
        },
        "effects": effects,
        "unknown": dict(found.unknown),
        "missing": list(verdict.missing),
        "refused": list(verdict.refused),
    }  # fmt: skip


def _json_of(closed: Shrinkage | None) -> dict[str, float | None] | None:
    if closed is None:
        return None
    return {k: None if np.isnan(v) else v for k, v in asdict(closed).items()}
