"""The catalogue of effects, for people and for programs."""

from collections.abc import Sequence
from typing import Any

from diagnosis.effect_notes import notes_of
from diagnosis.inference.candidates import Candidate
from diagnosis.observable_groups import Observable
from physics.effects.effect import Effect, Parameter
from reports.tables import Column, Table


def effects_table(effects: Sequence[Effect]) -> Table:
    """Return names, stages, usual and largest sizes, and how to check each."""
    columns = (
        Column("effect", "effect", wraps=False),
        Column("stage", "stage"),
        Column("title", "what it is"),
        Column("sizes", "usual size, and largest strength"),
        Column("check", "how to check it"),
    )
    rows = tuple(
        (
            effect.id,
            effect.stage.value,
            effect.title,
            "; ".join(map(_size, effect.parameters)),
            notes_of(effect).check,
        )
        for effect in effects
    )
    return Table(columns, rows)


def _size(parameter: Parameter) -> str:
    if parameter.grid:
        low, high = min(parameter.grid), max(parameter.grid)
        return f"{parameter.name} {low:.3g} to {high:.3g} {parameter.unit}".strip()
    sign = "" if parameter.positive else "±"
    usual = f"{parameter.name} {sign}{parameter.spread:g} {parameter.unit}".strip()
    return f"{usual}, at most {parameter.most:g}" if parameter.most else usual


def size_words(candidate: Candidate | None, *, strengths_only: bool = False) -> str:
    """Return the sizes of a candidate's effects, as fitted, with errors, and where they act.

    Parameters
    ----------
    candidate : Candidate or None
        Of none, nothing is said.
    strengths_only : bool
        Whether second sizes are left out.
    """
    if candidate is None:
        return ""
    said = []
    for located in candidate.effects:
        effect, at = located.effect, located.location
        own = [
            f"{p.name} {p.scale * z:.2g} ± {p.scale * error:.1g} {p.unit}".strip()
            for p, z, error in candidate.size_estimates[effect.id]
            if p.most or not strengths_only
        ]
        own += [f"{p.name} {at[p.name]:.4g} {p.unit}".strip() for p in effect.gridded]
        alone = len(candidate.effects) == 1
        said.append(("" if alone else f"{effect.title}: ") + "; ".join(own))
    return "; ".join(said)


def effects_to_json(effects: Sequence[Effect]) -> list[dict[str, Any]]:
    """Effects with stable keys (documented in ``docs/reference/json.md``)."""
    return [
        {
            "id": effect.id,
            "title": effect.title,
            "stage": effect.stage.value,
            "parameters": [
                {"name": p.name, "unit": p.unit, "spread": p.spread, "most": p.most,
                 "positive": p.positive, "grid": list(p.grid), "source": p.source}
                for p in effect.parameters
            ],
            "unaffected": [o.value for o in Observable if o in notes_of(effect).unaffected],
            "similar": list(notes_of(effect).similar),
            "check": notes_of(effect).check,
            "reference": effect.reference,
        }
        for effect in effects
    ]  # fmt: skip
