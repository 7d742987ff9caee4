"""Translate labels and answers of published sealed sets to today's names.

Sealed data are never changed: their hashes were published. ``studies/sealed/names.json`` states
which identifier of an effect, which size of an effect and which key of an answer has which name
today; identifiers that are not in the table have kept their names.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from blind.cases import Label

TABLE = Path(__file__).parent / "names.json"


class SealedNames:
    """The table of names.

    Parameters
    ----------
    table : mapping
        ``effects``: identifiers, old to new; ``sizes``: for each new identifier the names of its
        sizes, old to new; ``keys``: keys of an answer, old to new.
    """

    def __init__(self, table: Mapping[str, Any]) -> None:
        self._effects: dict[str, str] = dict(table["effects"])
        self._sizes: dict[str, dict[str, str]] = dict(table["sizes"])
        self._keys: dict[str, str] = dict(table["keys"])

    @classmethod
    def read(cls, path: Path = TABLE) -> "SealedNames":
        """Read the table."""
        return cls(json.loads(path.read_text(encoding="utf-8")))

    def hypothesis(self, key: str) -> str:
        """Return an effect's identifier, or several joined by '+', in today's names."""
        return "+".join(self._effects.get(part, part) for part in key.split("+"))

    def label(self, label: Label) -> Label:
        """Return a label in today's names."""
        effects, told = (
            tuple((self.hypothesis(name), size) for name, size in pairs)
            for pairs in (label.effects, label.told)
        )
        return replace(label, effects=effects, told=told)

    def answer(self, answer: Mapping[str, Any]) -> dict[str, Any]:
        """Return what is kept of an answer (see `studies.sealed.answers`) in today's names."""
        effects = {self.hypothesis(name): entry for name, entry in answer["effects"].items()}
        answer = {self._keys.get(key, key): value for key, value in answer.items()}
        by = answer["explained_fraction"]["by"]
        return {
            **answer,
            "effects_named": [self.hypothesis(name) for name in answer["effects_named"]],
            "likely": [[self.hypothesis(name) for name in group] for group in answer["likely"]],
            "probability": {self.hypothesis(k): p for k, p in answer["probability"].items()},
            "effects": {name: self._effect(name, entry) for name, entry in effects.items()},
            "explained_fraction": {"by": {self.hypothesis(n): gap for n, gap in by.items()}},
        }

    def _effect(self, effect: str, entry: Mapping[str, Any]) -> dict[str, Any]:
        names = self._sizes.get(effect, {})
        renamed = {
            key: {names.get(size, size): value for size, value in entry[key].items()}
            for key in ("detectable", "sizes")
            if key in entry
        }
        return {**entry, **renamed}
