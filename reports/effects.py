"""The catalogue of effects, for people and for programs."""

from collections.abc import Sequence
from typing import Any

from diagnosis.effect_notes import notes_of
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
