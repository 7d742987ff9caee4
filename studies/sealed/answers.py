"""The part of the answers that scores need: a fortieth of them, small enough to publish.

    python -m studies.sealed.answers DIR ANSWERS KEY

DIR is what `acquire blind make` made, ANSWERS the folder of NAME.json, as `acquire diagnose --json`
prints them, KEY what fits DIR. What is printed goes into `studies/sealed/SET/answersN.json`, of
which `studies.sealed_sets` makes the scores of the set.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from blind.cases import Label
from blind.files import BlindError, answered_cases
from blind.scoring import UNKNOWN, Case
from studies.sealed.names import SealedNames

# Effects and pairs that are less likely count for nothing in any score.
_LEAST = 1e-7


def essence(case: Case) -> dict[str, Any] | None:
    """What scores read of an answer; None of none.

    Parameters
    ----------
    case : Case
    """
    answer = case.answer
    if answer is None:
        return None
    true = {name for name, _ in case.label.effects}
    closed = {frozenset(true), frozenset(answer["effects_named"])}
    by = answer["explained_fraction"]["by"]
    return {
        "verdict": answer["verdict"],
        "effects_named": answer["effects_named"],
        "likely": answer["likely"],
        "probability": {key: p for key, p in answer["probability"].items()
                        if p >= _LEAST or key == UNKNOWN},
        "effects": {name: _of_effect(t) for name, t in answer["effects"].items() if name in true},
        "explained_fraction": {"by": {key: {end: by[key][end] for end in ("before", "after")}
                           for key in by if frozenset(key.split("+")) in closed}},
    }  # fmt: skip


def _of_effect(effect: Mapping[str, Any]) -> dict[str, Any]:
    sizes = {
        name: {"value": size["value"], "error": size["error"]}
        for name, size in effect.get("sizes", {}).items()
    }
    kept = {key: effect[key] for key in ("d_prime", "detectable") if key in effect}
    return kept | {"sizes": sizes}


def kept_cases(labels: Mapping[str, Label], kept: Sequence[Path]) -> list[Case]:
    """Return the cases of a published set, in today's names.

    Parameters
    ----------
    labels : mapping of str to Label
        In today's names.
    kept : sequence of Path
        What this program has printed of the same sets, in the names of that time.
    """
    answers: dict[str, Any] = {}
    for path in kept:
        answers |= json.loads(path.read_text(encoding="utf-8"))
    names = SealedNames.read()
    today = {case: names.answer(answer) for case, answer in answers.items() if answer is not None}
    return [Case(name, label, today.get(name)) for name, label in labels.items()]


def main() -> None:
    """Print what scores read of each answer to a set, one case in a line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for what in ("folder", "answers", "key"):
        parser.add_argument(what, type=Path)
    asked = parser.parse_args()
    try:
        cases = answered_cases(asked.folder, asked.answers, asked.key)
    except BlindError as error:
        raise SystemExit(f"sealed_answers: {error}") from None
    silent = [case.name for case in cases if case.answer is None]
    if silent:
        print(f"sealed_answers: no answer to {', '.join(silent)}: counts as wrong", file=sys.stderr)
    lines = [
        f" {json.dumps(c.name)}: {json.dumps(essence(c), separators=(',', ':'))}" for c in cases
    ]
    print("{\n" + ",\n".join(lines) + "\n}")


if __name__ == "__main__":
    main()
