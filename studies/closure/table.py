"""Print closures as a table for people, and as JSON."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import Any

from studies.closure.comparison import EffectClosure, GroupClosure, Number


def rows(closures: Sequence[EffectClosure], *, every: bool = False) -> Iterator[str]:
    """Yield the lines of a table: each effect, and its groups.

    Parameters
    ----------
    closures : sequence of EffectClosure
    every : bool
        Also every number; otherwise the number with the largest pull of each group.
    """
    yield (
        f"{'effect, group, worst number':58} {'n':>4} {'predicted':>10} {'rendered':>10} "
        f"{'error':>9} {'pull':>6} {'rms':>5} {'scale':>14}"
    )
    for closure in closures:
        sizes = ", ".join(f"{name} {value:g}" for name, value in closure.sizes.items())
        yield f"{closure.effect} ({sizes}): {closure.verdict}"
        for group in closure.groups:
            yield from _group_rows(group, every=every)
        for what in closure.lost:
            yield f"  only in one of both campaigns: {what}"


def _group_rows(group: GroupClosure, *, every: bool) -> Iterator[str]:
    scale = f"{group.scale:6.2f} ± {group.scale_error:.2f}" if group.tested else "not tested"
    mark = "" if group.closes else " <-- open"
    yield (
        _number_row(f"  {group.name}: ", group.worst, len(group.numbers))
        + f" {group.rms_pull:5.2f} {scale:>14}{mark}"
    )
    if every:
        for number in group.numbers:
            yield _number_row("    ", number, 1)


def _number_row(before: str, number: Number, count: int) -> str:
    name = f"{before}{label(number)}"[:58]
    return (
        f"{name:58} {count:4d} {number.predicted:10.3g} {number.rendered:10.3g} "
        f"{number.error:9.2g} {number.worst:+6.1f}"
    )


def label(number: Number) -> str:
    """Return what a number is, in words."""
    place = number.coordinates
    parts = (place.quantity, place.mode, place.band, place.region, place.time, place.level)
    return " ".join(filter(None, parts))


def summary(closures: Sequence[EffectClosure]) -> Iterator[str]:
    """Yield one line for each effect."""
    yield (
        f"{'effect':28} {'verdict':10} {'n':>4} {'signal':>7} {'rms':>5} {'worst':>6}  "
        "observable of the worst"
    )
    for closure in closures:
        group = closure.worst
        yield (
            f"{closure.effect:28} {closure.verdict:10} {closure.count:4d} "
            f"{closure.significance:7.1f} {closure.rms_pull:5.2f} {group.worst.worst:+6.1f}  "
            f"{group.name}: {label(group.worst)}"
        )


def as_json(closures: Iterable[EffectClosure]) -> list[dict[str, Any]]:
    """Return what ``--json`` prints."""
    return [
        {
            "effect": closure.effect,
            "sizes": closure.sizes,
            "verdict": closure.verdict,
            "observables": closure.count,
            "significance": closure.significance,
            "rms_pull": closure.rms_pull,
            "only_in_one": list(closure.lost),
            "groups": [_group_json(group) for group in closure.groups],
        }
        for closure in closures
    ]


def _group_json(group: GroupClosure) -> dict[str, Any]:
    tested = math.isfinite(group.scale_error)
    return {
        "name": group.name,
        "observable": group.observable,
        "closes": group.closes,
        "significance": group.significance,
        "scale": group.scale if tested else None,
        "scale_error": group.scale_error if tested else None,
        "rms_pull": group.rms_pull,
        "numbers": [
            asdict(number.coordinates)
            | {
                "predicted": number.predicted,
                "rendered": number.rendered,
                "error": number.error,
                "pull": number.pull,
                "pull_given_others": number.pull_given_others,
            }
            for number in group.numbers
        ],
    }
