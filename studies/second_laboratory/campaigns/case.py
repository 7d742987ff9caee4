"""Cases: which reed, which bench, how much disorder, and what is wrong."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from studies.second_laboratory.campaigns.disorder import LEVELS
from studies.second_laboratory.campaigns.drawing import (
    CampaignBench,
    Day,
    draw_campaign_bench,
    draw_campaign_reed,
    draw_day,
)
from studies.second_laboratory.campaigns.effects.base import Effect
from studies.second_laboratory.campaigns.effects.catalogue import BY_ID, LISTED, UNLISTED
from studies.second_laboratory.parameters import ReedParameters

Kind = Literal["clean", "single", "unknown", "pair"]
KINDS: tuple[Kind, ...] = ("clean", "single", "unknown", "pair")
# Streams of random numbers, each with a generator of its own, so that what one draws changes no
# other: labels, sizes, series, bench and reed, days, clampings, hands, noise, effects at work.
_LABEL, _SIZES, _SERIES, _SEEDS, _DAY, _CLAMPING, _HANDS, _NOISE, _EFFECTS = range(20, 29)


@dataclass(frozen=True)
class Case:
    """One bench with one reed.

    Attributes
    ----------
    kind : {'clean', 'single', 'unknown', 'pair'}
        Nothing is wrong; one or two effects of the list; one that is on no list.
    effects : tuple of Effect
    amount : float
        Of ordinary disorder; see `disorder_at`.
    series : {'A', 'B'}
    seed, number : int
        From which everything is drawn. Cases of all kinds with the same two have the same reed and
        bench.
    """

    kind: Kind
    effects: tuple[Effect, ...]
    amount: float
    series: str
    seed: int
    number: int

    def rng(self, stream: int, *more: int) -> np.random.Generator:
        """Return the generator of a stream."""
        return np.random.default_rng([self.seed, self.number, stream, *more])

    def to_json(self) -> dict[str, Any]:
        """Return plain values from which `case_from_json` makes this case again."""
        listed = [{"id": each.id, **vars(each)} for each in self.effects]
        return {**vars(self), "effects": listed}


def case_from_json(content: dict[str, Any]) -> Case:
    """Return the case of plain values."""
    effects = []
    for each in content["effects"]:
        values = dict(each)
        effects.append(BY_ID[values.pop("id")](**values))
    return Case(**{**content, "effects": tuple(effects)})


def draw_case(
    kind: Kind,
    level: str | float,
    seed: int,
    number: int,
    labels: Sequence[str] | None = None,
) -> Case:
    """Draw a case.

    Parameters
    ----------
    kind : {'clean', 'single', 'unknown', 'pair'}
    level : {'quiet', 'ordinary', 'rough'} or float
        Amount of disorder.
    seed : int
        Of a set of cases.
    number : int
        Of the case in its set. In 40 numbers in a row each effect of the list comes once, in 15
        each of the others.
    labels : sequence of str, optional
        Identifiers of the effects, in place of those that `number` selects.
    """
    names = tuple(labels) if labels is not None else _labels(kind, seed, number)
    count = {"clean": 0, "single": 1, "unknown": 1, "pair": 2}[kind]
    if len(names) != count:
        raise ValueError(f"a case of kind {kind} has {count} effects, not {len(names)}")
    series = "AB"[int(np.random.default_rng([seed, number, _SERIES]).integers(2))]
    for name in names:
        series = series if series in BY_ID[name].series else BY_ID[name].series[0]
    effects = tuple(
        BY_ID[name].draw(np.random.default_rng([seed, number, _SIZES, place]))
        for place, name in enumerate(names)
    )
    return Case(kind, effects, amount_of(level), series, seed, number)


def amount_of(level: str | float) -> float:
    """Return the amount of disorder of a level."""
    return LEVELS[level] if isinstance(level, str) else float(level)


def _labels(kind: Kind, seed: int, number: int) -> tuple[str, ...]:
    names = sorted(UNLISTED if kind == "unknown" else LISTED)
    block, place = divmod(number, len(names))
    rng = np.random.default_rng([seed, _LABEL, KINDS.index(kind), block])
    order = rng.permutation(len(names))
    if kind == "clean":
        return ()
    first = names[order[place]]
    if kind != "pair":
        return (first,)
    others = [name for name in names if name != first]
    return first, others[int(rng.permutation(len(others))[place % len(others)])]


@dataclass(frozen=True)
class Setup:
    """Everything about a campaign before it begins.

    Attributes
    ----------
    case : Case
    repeat : int
        0 for the first campaign of a case; others are on other days.
    bench : CampaignBench
    reed : ReedParameters
    day : Day
    """

    case: Case
    repeat: int
    bench: CampaignBench
    reed: ReedParameters
    day: Day

    def clamping(self, number: int) -> np.random.Generator:
        """Return the generator of one clamping: the reed's place, and its speckle."""
        return self.case.rng(_CLAMPING, self.repeat, number)

    def hands(self) -> np.random.Generator:
        """Return the generator of times that hands take."""
        return self.case.rng(_HANDS, self.repeat)

    def noise(self) -> np.random.Generator:
        """Return the generator of everything that differs from frame to frame."""
        return self.case.rng(_NOISE, self.repeat)

    def body(self) -> np.random.Generator:
        """Return the generator of patterns of this camera and these beams."""
        return self.case.rng(_SEEDS, 1)

    def effects(self) -> tuple[int, ...]:
        """Return the seed of effects at work."""
        return self.case.seed, self.case.number, _EFFECTS, self.repeat


def setup_of(case: Case, repeat: int = 0) -> Setup:
    """Draw reed, bench and day of a case, before its effects change them."""
    seed = int(case.rng(_SEEDS, 0).integers(2**31))
    return Setup(
        case,
        repeat,
        draw_campaign_bench(case.amount, seed),
        draw_campaign_reed(case.amount, case.series, seed),
        draw_day(case.amount, case.rng(_DAY, repeat)),
    )
