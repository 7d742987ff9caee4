"""How good answers to sealed cases are, with intervals; what was not answered counts as wrong.

An answer is what `acquire diagnose --json` prints. Classes, groups of effects that such data do not
tell apart, are fixed before any case is answered.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from blind.cases import Label, true_sizes

Array = NDArray[np.floating[Any]]

NONE, UNKNOWN = "none", "unknown"
# Effects from this signal to noise on are to be named.
RESOLVED: Final = 5.0
# An answer is sure of a class from these probabilities on.
_SURE: Final = 0.9
_SUREST: Final = 0.99
_FALSE_OPEN: Final = 0.05
_BINS = 10
_DRAWS = 2000
_LEAST_GIVEN = 1e-6


@dataclass(frozen=True)
class Share:
    """A share of cases, with its 95 % interval by Wilson.

    Attributes
    ----------
    hits, cases : int
    low, high : float
    """

    hits: int
    cases: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share; NaN of no cases."""
        return self.hits / self.cases if self.cases else float("nan")


def share(hits: Sequence[bool]) -> Share:
    """Count, and tell how sure the share is."""
    n, k, z = len(hits), int(np.sum(np.asarray(hits, dtype=bool))), 1.959964
    if not n:
        return Share(0, 0, 0.0, 1.0)
    middle = (k + z**2 / 2) / (n + z**2)
    half = z / (n + z**2) * np.sqrt(k * (n - k) / n + z**2 / 4)
    return Share(k, n, float(max(0.0, middle - half)), float(min(1.0, middle + half)))


@dataclass(frozen=True)
class Case:
    """A label and what was answered.

    Attributes
    ----------
    name : str
    label : Label
    answer : dict, optional
        None if there is none.
    """

    name: str
    label: Label
    answer: Mapping[str, Any] | None

    @property
    def truth(self) -> str:
        """Key of the truth among an answer's probabilities."""
        if not self.label.effects:
            return NONE
        return "+".join(name for name, _ in self.label.effects) if self.label.known else UNKNOWN

    @property
    def answered(self) -> bool:
        """Whether anything was answered."""
        return self.answer is not None and self.answer["verdict"] != "not converged"

    @property
    def probability(self) -> Mapping[str, float]:
        """Of every hypothesis; nothing where nothing was answered."""
        if self.answer is None or not self.answered:
            return {}
        found: Mapping[str, float] = self.answer["probability"]
        return found

    @property
    def d_prime(self) -> float:
        """By how many deviations the weakest true effect stands out, by the answer; 0 of none."""
        if self.answer is None:
            return float("inf")
        effects = self.answer["effects"]
        found = [effects.get(name, {}).get("d_prime", 0.0) for name, _ in self.label.effects]
        return float(min(found, default=0.0))

    @property
    def resolved(self) -> bool:
        """Whether every true effect stands out of the noise; not answered is no excuse."""
        return self.d_prime >= RESOLVED

    @property
    def foreseen(self) -> bool:
        """Whether every true effect should stand out, by its true size and the reach of the data.

        No fit of the effect has a say in it.
        """
        if self.answer is None:
            return True
        sizes = true_sizes(self.label)
        found = [
            _foreseen(self.answer, name, sizes.get(name, {})) for name, _ in self.label.effects
        ]
        return min(found, default=0.0) >= RESOLVED


def _foreseen(answer: Mapping[str, Any], effect: str, sizes: Mapping[str, float]) -> float:
    """By how many deviations an effect of true sizes should stand out."""
    least = answer["effects"].get(effect, {}).get("detectable", {})
    found = [RESOLVED * value / least[name] for name, value in sizes.items() if least.get(name)]
    return float(np.linalg.norm(found))


class Classes:
    """Effects that count as one.

    Parameters
    ----------
    groups : sequence of sequences of str
    """

    def __init__(self, groups: Sequence[Sequence[str]]) -> None:
        self._of = {name: "|".join(sorted(group)) for group in groups for name in group}

    def of(self, key: str) -> str:
        """Class of a hypothesis; of a pair, the pair of its classes."""
        return "+".join(sorted(self._of.get(part, part) for part in key.split("+")))

    def mass(self, probability: Mapping[str, float]) -> dict[str, float]:
        """Probability of every class."""
        total: dict[str, float] = {}
        for key, value in probability.items():
            total[self.of(key)] = total.get(self.of(key), 0.0) + value
        return total


def best(mass: Mapping[str, float]) -> str:
    """Likeliest class; empty if nothing was answered."""
    return max(mass, key=lambda key: mass[key]) if mass else ""


def false_alarms(cases: Sequence[Case], classes: Classes) -> Share:
    """Clean cases in which anything but nothing is named or likeliest, or nothing is answered."""
    clean = [case for case in cases if case.truth == NONE]
    return share([_alarm(case, classes) for case in clean])


def _alarm(case: Case, classes: Classes) -> bool:
    verdict = None if case.answer is None else case.answer["verdict"]
    return verdict != NONE or best(classes.mass(case.probability)) != NONE


def named(cases: Sequence[Case], classes: Classes, first: int = 1) -> Share:
    """Cases whose true class is among the first few."""
    hits = []
    for case in cases:
        mass = classes.mass(case.probability)
        ranked = sorted(mass, key=lambda key: -mass[key])[:first]
        hits.append(classes.of(case.truth) in ranked)
    return share(hits)


def shuffled(cases: Sequence[Case], classes: Classes) -> tuple[float, float, float]:
    """Share of cases named rightly if labels are shuffled, and where 95 % of shuffles lie.

    What answers know of their own case, and of no other, is lost by it.
    """
    if not cases:
        return float("nan"), float("nan"), float("nan")
    masses = [classes.mass(case.probability) for case in cases]
    named = np.array([max(mass, key=lambda key: mass[key]) if mass else "" for mass in masses])
    truth = np.array([classes.of(case.truth) for case in cases])
    rng = np.random.default_rng(0)
    right = np.array([np.mean(named == rng.permutation(truth)) for _ in range(_DRAWS)])
    low, high = np.percentile(right, [2.5, 97.5])
    return float(right.mean()), float(low), float(high)


def mean_probability(cases: Sequence[Case], classes: Classes) -> tuple[float, float, float]:
    """Mean probability given to the true class (FIA), and its 95 % interval by bootstrap."""
    given = np.array([classes.mass(c.probability).get(classes.of(c.truth), 0.0) for c in cases])
    return _bootstrapped(given)


def _bootstrapped(values: Array) -> tuple[float, float, float]:
    if not len(values):
        return float("nan"), float("nan"), float("nan")
    rng = np.random.default_rng(0)
    drawn = values[rng.integers(len(values), size=(_DRAWS, len(values)))].mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(values.mean()), float(low), float(high)


def open_set(cases: Sequence[Case]) -> tuple[Share, float, float]:
    """Unknown kinds found, at the threshold that takes 5 % of the known for unknown.

    A known kind that was not answered looks as unknown as can be, an unknown one not at all.

    Returns
    -------
    found : Share
    threshold : float
    area : float
        Probability that an unknown kind looks more unknown than a known one.
    """
    known = np.array([_unknown(c, 1.0) for c in cases if c.label.known and c.label.effects])
    others = np.array([_unknown(c, 0.0) for c in cases if not c.label.known])
    if not len(known) or not len(others):
        return share([]), float("nan"), float("nan")
    threshold = float(np.quantile(known, 1 - _FALSE_OPEN, method="higher"))
    above = others[:, None] > known
    same = others[:, None] == known
    return share((others > threshold).tolist()), threshold, float(np.mean(above + 0.5 * same))


def _unknown(case: Case, unanswered: float) -> float:
    return case.probability.get(UNKNOWN, 0.0) if case.answered else unanswered


def confident_wrong(cases: Sequence[Case], classes: Classes) -> Share:
    """Unknown kinds for which a class of known effects has more than 90 %."""
    masses = [classes.mass(case.probability) for case in cases if not case.label.known]
    return share(
        [
            any(p > _SURE and key not in (NONE, UNKNOWN) for key, p in mass.items())
            for mass in masses
        ]
    )


def sure_and_right(cases: Sequence[Case], classes: Classes) -> tuple[Array, NDArray[np.bool_]]:
    """How sure each answer (n,) is of its likeliest class, and whether it is right.

    What is not answered counts as wrong, and as sure.
    """
    masses = [classes.mass(case.probability) for case in cases]
    sure = np.array([mass.get(best(mass), 1.0) for mass in masses])
    truths = [classes.of(case.truth) for case in cases]
    right = [best(mass) == truth for mass, truth in zip(masses, truths, strict=True)]
    return sure, np.array(right, dtype=bool)


def sure_of_wrong(cases: Sequence[Case], classes: Classes) -> Share:
    """Cases in which a class has 90 % or more and is not the truth, nothing answered included."""
    sure, right = sure_and_right(cases, classes)
    return share(((sure >= _SURE) & ~right).tolist())


def surest_right(cases: Sequence[Case], classes: Classes) -> Share:
    """Cases that are right, of those in which a class has 99 % or more."""
    sure, right = sure_and_right(cases, classes)
    return share(right[sure >= _SUREST].tolist())


def calibration_error(cases: Sequence[Case], classes: Classes) -> float:
    """Mean distance between how sure answers are and how often they are right (ECE)."""
    if not cases:
        return float("nan")
    sure, right = sure_and_right(cases, classes)
    pieces = [piece for piece in np.array_split(np.argsort(sure), _BINS) if len(piece)]
    apart = [len(p) * abs(np.mean(sure[p]) - np.mean(right[p].astype(float))) for p in pieces]
    return float(np.sum(apart) / len(cases))


def brier(cases: Sequence[Case], classes: Classes) -> float:
    """Mean square distance of probabilities from the truth, over all classes.

    1 of what is not answered, as of probabilities that are spread over very many classes.
    """
    scores = []
    for case in cases:
        mass = dict(classes.mass(case.probability))
        truth = classes.of(case.truth)
        mass.setdefault(truth, 0.0)
        scores.append(sum((p - (key == truth)) ** 2 for key, p in mass.items()))
    return float(np.mean(scores)) if scores else float("nan")


def sets(cases: Sequence[Case], classes: Classes) -> tuple[Share, float]:
    """Cases whose truth is in the set that is said to have 90 %, and its mean size."""
    hits, sizes = [], []
    for case in cases:
        groups = case.answer["likely"] if case.answer is not None and case.answered else []
        named = {classes.of(name) for group in groups for name in group}
        hits.append(classes.of(case.truth) in named)
        sizes.append(len(groups))
    return share(hits), float(np.mean(sizes)) if sizes else float("nan")


def log_score(cases: Sequence[Case], classes: Classes) -> float:
    """Mean log of the probability given to the truth, of a millionth at least."""
    given = [classes.mass(c.probability).get(classes.of(c.truth), 0.0) for c in cases]
    return float(np.mean(np.log(np.maximum(given, _LEAST_GIVEN)))) if given else float("nan")


def size_errors(cases: Sequence[Case], classes: Classes) -> dict[str, float | int | None]:
    """Mean bias and error of sizes of rightly named effects, as shares, and mean square of both."""
    apart, errors, deviations = [], [], []
    for case in cases:
        name = case.label.effects[0][0]
        if case.answer is None or best(classes.mass(case.probability)) != classes.of(name):
            continue
        for parameter, true in true_sizes(case.label).get(name, {}).items():
            size = case.answer["effects"].get(name, {}).get("sizes", {}).get(parameter)
            if size is not None and true:
                apart.append((size["value"] - true) / abs(true))
                errors.append(size["error"] / abs(true))
                deviations.append((size["value"] - true) / size["error"])
    if not apart:
        return {"sizes": 0, "bias": None, "error": None, "chi2": None}
    return {
        "sizes": len(apart),
        "bias": float(np.mean(apart)),
        "error": float(np.mean(errors)),
        "chi2": float(np.mean(np.square(deviations))),
    }


def closures(cases: Sequence[Case]) -> dict[str, float | int | None]:
    """Gap that what is named closes, over what the true effects close once they are fitted.

    A true effect that stands out and was not fitted counts as missed.
    """
    ratios = [ratio for case in cases if (ratio := _closure(case)) is not None]
    if not ratios:
        return {"cases": 0, "median": None, "low": None}
    return {
        "cases": len(ratios),
        "median": float(np.median(ratios)),
        "low": float(np.quantile(ratios, 0.1)),
    }


def _closure(case: Case) -> float | None:
    """That ratio of one case; None where the truth closes nothing that could be seen."""
    if case.answer is None or not case.answered:
        return 0.0
    by = {
        frozenset(name.split("+")): gap
        for name, gap in case.answer["explained_fraction"]["by"].items()
        if gap["before"] is not None and gap["after"] is not None
    }
    truth = by.get(frozenset(name for name, _ in case.label.effects))
    if truth is None:
        return 0.0 if case.resolved else None
    if truth["before"] <= truth["after"]:
        return None
    given = by.get(frozenset(case.answer["effects_named"]))
    if given is None:
        return 0.0
    return float((given["before"] - given["after"]) / (truth["before"] - truth["after"]))
