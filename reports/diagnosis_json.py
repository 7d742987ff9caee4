"""A diagnosis for programs: JSON with stable keys (documented in ``docs/json.md``)."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from diagnosis.how_far import Shrinkage
from diagnosis.rivals import d_prime
from diagnosis.verdict import Verdict
from physics.effects.effect import Parameter

# A parameter beyond so many deviations of its prior is not plausible.
_PLAUSIBLE = 3.0
_LEAST_TOLD = 1e-6


def to_json(verdict: Verdict) -> dict[str, Any]:
    """Verdict with stable keys."""
    told = {name: p for name, p in verdict.probability.items() if p > _LEAST_TOLD}
    return {
        "verdict": verdict.kind,
        "effects_named": list(verdict.effects),
        "probability": dict(sorted(told.items(), key=lambda item: -item[1])),
        "classes": [list(group) for group in verdict.classes if len(group) > 1],
        "likely": [list(group) for group in verdict.likely],
        "where": _where(verdict),
        "how_far": _how_far(verdict),
        "next": {
            "between": list(verdict.rivals),
            "actions": [
                {"id": w.action.id, "words": w.action.words, "minutes": w.action.minutes,
                 "nats": w.nats, "nats_per_minute": w.nats_per_minute}
                for w in verdict.next_actions
            ],
        },
        "effects": _effects(verdict),
        "pairs": {
            name: {
                "log_bayes": rival.log_evidence - verdict.contest.null.log_evidence,
                "sizes": {effect: _sizes(told) for effect, told in rival.told.items()},
            }
            for name, rival in verdict.contest.pairs.items()
        },
        "unknown": {
            "log_bayes": dict(verdict.contest.unknown),
            "log_bayes_beside": dict(verdict.contest.beside),
            "beside": verdict.unknown_beside,
            "block": verdict.unknown_in,
            "triggers": [asdict(t) | {"fired": t.fired} for t in verdict.triggers],
        },
        "sampled": {name: asdict(s) for name, s in verdict.contest.sampled.items()},
        "missing": list(verdict.missing),
        "refused": list(verdict.refused),
    }  # fmt: skip


def _where(verdict: Verdict) -> dict[str, Any]:
    where = verdict.where
    return {
        "first_failing_tap": where.first_failing,
        "taps": {
            tap: {"gap": worst.gap, "chance": worst.chance, "block": worst.block,
                  "axis": worst.axis, "label": worst.label}
            for tap, worst in where.taps.items()
        },
        "ladder": [asdict(rung) for rung in where.ladder],
        "cells": [asdict(cell) | {"resolvable": cell.resolvable} for cell in where.cells],
    }  # fmt: skip


def _how_far(verdict: Verdict) -> dict[str, Any]:
    return {
        "of": list(verdict.closing),
        "left_out": _shrinkage(verdict.closed),
        "condition": verdict.condition,
        "other_condition": _shrinkage(verdict.transferred),
        "by": {name: _shrinkage(closed) for name, closed in verdict.closed_by.items()},
        "plain": [asdict(gap) for gap in verdict.plain],
    }


def _shrinkage(closed: Shrinkage | None) -> dict[str, float | None] | None:
    if closed is None:
        return None
    return {k: None if np.isnan(v) else v for k, v in asdict(closed).items()}


def _effects(verdict: Verdict) -> dict[str, Any]:
    found, null = verdict.contest, verdict.contest.null
    reach = {entry.effect: entry for entry in verdict.reach}
    told = {}
    for name, rival in found.alone.items():
        own = reach[name]
        told[name] = {
            "log_bayes": rival.log_evidence - null.log_evidence,
            "d_prime": d_prime(null, rival),
            "sizes": _sizes(rival.told[name]),
            "places": dict(rival.effects[0].places),
            "certified": rival.estimate.certified,
            "absorbed": None if np.isnan(own.absorbed) else own.absorbed,
            "detectable": {k: v if np.isfinite(v) else None for k, v in own.detectable.items()},
            "alike": own.alike,
        }
    return told


def _sizes(told: Sequence[tuple[Parameter, float, float]]) -> dict[str, Any]:
    return {
        p.name: {"value": p.spread * z, "error": p.spread * error, "unit": p.unit, "z": z,
                 "plausible": abs(z) < _PLAUSIBLE}
        for p, z, error in told
    }  # fmt: skip
