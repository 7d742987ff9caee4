"""The catalogue of effects, for people and for programs."""

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from physics.effects.form import Effect, Parameter


def effects_table(effects: Sequence[Effect]) -> Table:
    """Table of effects: names, stages, sizes with the spread of their priors, what tells them."""
    table = Table(box=None, pad_edge=False)
    table.add_column("effect", no_wrap=True)
    for heading in ("stage", "what it is", "sizes", "what tells it apart"):
        table.add_column(heading, overflow="fold")
    for effect in effects:
        sizes = "; ".join(_size(parameter) for parameter in effect.parameters)
        table.add_row(effect.id, effect.stage.value, effect.title, sizes, effect.action)
    return table


def _size(parameter: Parameter) -> str:
    if parameter.places:
        low, high = min(parameter.places), max(parameter.places)
        return f"{parameter.name} {low:.3g} to {high:.3g} {parameter.unit}".strip()
    sign = "" if parameter.positive else "±"
    return f"{parameter.name} {sign}{parameter.spread:g} {parameter.unit}".strip()


def effects_to_json(effects: Sequence[Effect]) -> list[dict[str, Any]]:
    """Effects with stable keys (documented in ``docs/json.md``)."""
    return [
        {
            "id": effect.id,
            "title": effect.title,
            "stage": effect.stage.value,
            "parameters": [
                {"name": p.name, "unit": p.unit, "spread": p.spread, "positive": p.positive,
                 "places": list(p.places), "source": p.source}
                for p in effect.parameters
            ],
            "moves": sorted(effect.moves),
            "keeps": sorted(effect.keeps),
            "neighbours": list(effect.neighbours),
            "action": effect.action,
            "reference": effect.reference,
        }
        for effect in effects
    ]  # fmt: skip
