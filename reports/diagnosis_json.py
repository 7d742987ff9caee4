"""A diagnosis for programs: JSON with stable keys (documented in ``docs/reference/json.md``)."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from diagnosis.campaign_diagnosis import Diagnosis
from diagnosis.explained_fraction import ExplainedFraction, KnownGap
from diagnosis.floor_certificate import Floor
from diagnosis.inference.candidates import d_prime
from physics.effects.effect import Parameter

# Standard deviations of its prior beyond which a parameter is not plausible. Chosen: three sigma.
_LEAST_TOLD = 1e-6


def to_json(verdict: Diagnosis) -> dict[str, Any]:
    """Verdict with stable keys."""
    return {
        "verdict": verdict.kind,
        "effects_named": list(verdict.effects),
        "probability": _likeliest_first(verdict.probability),
        "classes": [list(group) for group in verdict.classes if len(group) > 1],
        "likely": [list(group) for group in verdict.likely],
        "probability_of_what_shows": _likeliest_first(verdict.probability_of_what_shows),
        "shown": [list(group) for group in verdict.shown],
        "likeliest_range": list(verdict.likeliest_range),
        "gap": _gap(verdict),
        "explained_fraction": _explained(verdict),
        "known": _known(verdict.known),
        "next": {
            "between": list(verdict.compared),
            "experiments": [
                {
                    "id": w.experiment.id,
                    "description": w.experiment.description,
                    "minutes": w.experiment.minutes,
                    "expected_nats": w.expected_nats,
                    "nats_per_minute": w.nats_per_minute,
                }
                for w in verdict.next_experiments
            ],
        },
        "effects": _effects(verdict),
        "unseen": {
            each.effect: {
                "deviations": each.deviations,
                "experiment": each.experiment.id if each.experiment else None,
                "times": each.times,
                "minutes": each.minutes,
            }
            for each in verdict.unseen
        },
        "pairs": {
            name: {
                "log_bayes": _finite(candidate.log_evidence - verdict.selection.null.log_evidence),
                "sizes": {
                    effect: _sizes(told) for effect, told in candidate.size_estimates.items()
                },
            }
            for name, candidate in verdict.selection.pairs.items()
        },
        "unknown": {
            "log_bayes": dict(verdict.selection.group_log_bayes),
            "log_bayes_with": dict(verdict.selection.unknown_log_bayes_with),
            "with": verdict.unknown_with,
            "group": verdict.unknown_in,
            "checks": [asdict(t) | {"significant": t.significant} for t in verdict.checks],
        },
        "floor": [_floor(floor) for floor in verdict.floor],
        "missing": list(verdict.missing),
        "refused": list(verdict.refused),
    }


def _floor(floor: Floor) -> dict[str, Any]:
    fields = "scatter", "even_scatter", "order_chance"
    numbers = {name: _finite(getattr(floor, name)) for name in fields}
    return asdict(floor) | numbers | {"wrong": list(floor.wrong), "trusted": floor.trusted}


def _likeliest_first(probability: Mapping[str, float]) -> dict[str, float]:
    above = {name: p for name, p in probability.items() if p > _LEAST_TOLD}
    return dict(sorted(above.items(), key=lambda item: -item[1]))


def _gap(verdict: Diagnosis) -> dict[str, Any]:
    gap = verdict.gap
    return {
        "first_failing_observable": gap.first_failing,
        "observables": {
            observable: {
                "gap": worst.gap,
                "chance": worst.chance,
                "group": worst.group,
                "axis": worst.axis,
                "label": worst.label,
            }
            for observable, worst in gap.observables.items()
        },
        "ladder": [asdict(rung) for rung in gap.ladder],
        "cells": [asdict(cell) | {"resolvable": cell.resolvable} for cell in gap.cells],
    }


def _explained(verdict: Diagnosis) -> dict[str, Any]:
    return {
        "of": list(verdict.explained_with),
        "left_out": _fraction(verdict.explained),
        "condition": verdict.condition,
        "other_condition": _fraction(verdict.explained_other_sweep),
        "by": {name: _fraction(closed) for name, closed in verdict.explained_by.items()},
        "in_units": [asdict(entry) for entry in verdict.gaps_in_units],
    }


def _known(known: KnownGap | None) -> dict[str, Any] | None:
    if known is None:
        return None
    return {
        "effects": {
            sized.effect.id: {
                p.name: {
                    "value": sized.values[p.name],
                    "error": sized.errors.get(p.name, 0.0),
                    "unit": p.unit,
                }
                for p in sized.effect.parameters
            }
            for sized in known.effects
        },
        "before_the_runs": known.foreseen,
        "explained_fraction": _fraction(known.explained),
        "in_units": [asdict(entry) for entry in known.in_units],
    }


def _fraction(closed: ExplainedFraction | None) -> dict[str, float | None] | None:
    if closed is None:
        return None
    return {k: None if np.isnan(v) else v for k, v in asdict(closed).items()}


def _effects(verdict: Diagnosis) -> dict[str, Any]:
    found, null = verdict.selection, verdict.selection.null
    reach = {entry.effect: entry for entry in verdict.detectability}
    told = {}
    for name, candidate in found.single.items():
        own = reach[name]
        told[name] = {
            "log_bayes": _finite(candidate.log_evidence - null.log_evidence),
            "d_prime": d_prime(null, candidate),
            "sizes": _sizes(candidate.size_estimates[name]),
            "location": dict(candidate.effects[0].location),
            "converged": candidate.estimate.converged,
            "absorbed": None if np.isnan(own.absorbed) else own.absorbed,
            "detectable": {k: v if np.isfinite(v) else None for k, v in own.detectable.items()},
            "confusable": own.confusable,
            "refuted_by": [asdict(each) for each in verdict.selection.refuted.get(name, ())],
        }
    return told


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _sizes(told: Sequence[tuple[Parameter, float, float]]) -> dict[str, Any]:
    return {
        p.name: {
            "value": p.scale * z,
            "error": p.scale * error,
            "unit": p.unit,
        }
        for p, z, error in told
    }
