"""All scores of a set of sealed cases, as one mapping and as sentences."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from blind.scoring import (
    Case,
    Classes,
    Share,
    best,
    brier,
    calibration_error,
    closures,
    confident_wrong,
    false_alarms,
    log_score,
    mean_probability,
    named,
    open_set,
    sets,
    shuffled,
    size_errors,
    sure_of_wrong,
    surest_right,
)

# Edges of signal to noise, in deviations.
_D_PRIME: Final = (0.0, 2.0, 5.0, 10.0, 20.0, 50.0, float("inf"))


def report(cases: Sequence[Case], classes: Classes) -> dict[str, Any]:
    """Score cases.

    Parameters
    ----------
    cases : sequence of Case
    classes : Classes
        Effects that count as one.
    """
    sick = [case for case in cases if case.label.known and case.label.effects]
    single = [case for case in sick if len(case.label.effects) == 1]
    double = [case for case in sick if len(case.label.effects) > 1]
    resolved = [case for case in single if case.resolved]
    foreseen = [case for case in single if case.foreseen]
    found, threshold, area = open_set(cases)
    covered, size = sets(cases, classes)
    return {
        "cases": len(cases),
        "answered": sum(case.answered for case in cases),
        "false_alarms": _share(false_alarms(cases, classes)),
        "class_right": {"all": _share(named(single, classes)),
                        "resolved": _share(named(resolved, classes)),
                        "foreseen": _share(named(foreseen, classes)),
                        "shuffled": _mean(shuffled(resolved, classes))},
        "class_among_three": {"all": _share(named(single, classes, 3)),
                              "resolved": _share(named(resolved, classes, 3))},
        "name_right": {"all": _share(named(single, Classes(()))),
                       "resolved": _share(named(resolved, Classes(())))},
        "probability_of_truth": {"all": _mean(mean_probability(cases, classes)),
                                 "single": _mean(mean_probability(single, classes)),
                                 "resolved": _mean(mean_probability(resolved, classes))},
        "two_effects_exact": {
            "all": _share(named(double, classes)),
            "resolved": _share(named([case for case in double if case.resolved], classes)),
        },
        "unknown_found": {**_share(found), "threshold": _number(threshold), "area": _number(area)},
        "confident_wrong": _share(confident_wrong(cases, classes)),
        "sure_of_wrong": _share(sure_of_wrong(cases, classes)),
        "surest_right": _share(surest_right(cases, classes)),
        "calibration_error": _number(calibration_error(cases, classes)),
        "brier": _number(brier(cases, classes)),
        "log_score": _number(log_score(cases, classes)),
        "sets": {**_share(covered), "mean_size": _number(size)},
        "sizes": size_errors(resolved, classes),
        "kappa_over_oracle": closures(resolved + double),
        "by_effect": _by(sick, classes, lambda case: "+".join(n for n, _ in case.label.effects)),
        "by_unknown": _by(
            [case for case in cases if not case.label.known], classes,
            lambda case: case.label.effects[0][0],
        ),
        "by_d_prime": _by(single, classes, _interval),
    }  # fmt: skip


def _by(
    cases: Sequence[Case], classes: Classes, key: Callable[[Case], str]
) -> dict[str, dict[str, Any]]:
    groups: dict[str, list[Case]] = {}
    for case in cases:
        groups.setdefault(key(case), []).append(case)
    return {
        name: {
            "right": _share(named(group, classes)),
            "probability_of_truth": mean_probability(group, classes)[0],
            "answers": [best(classes.mass(case.probability)) or "none given" for case in group],
            "d_prime": [_number(case.d_prime) for case in group],
        }
        for name, group in sorted(groups.items())
    }


def _interval(case: Case) -> str:
    if case.answer is None:
        return "not answered"
    number = int(np.searchsorted(_D_PRIME, case.d_prime, side="right"))
    low, high = _D_PRIME[number - 1 : number + 1]
    return f"{low:02g} to {high:g}" if np.isfinite(high) else f"{low:02g} on"


def _share(share: Share) -> dict[str, Any]:
    return {**asdict(share), "share": _number(share.value)}


def _mean(triple: tuple[float, float, float]) -> dict[str, float | None]:
    return dict(zip(("mean", "low", "high"), map(_number, triple), strict=True))


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def sentences(scores: Mapping[str, Any]) -> list[str]:
    """Scores in words."""

    def shown(share: Mapping[str, Any]) -> str:
        if not share["cases"]:
            return "no case"
        return (
            f"{share['hits']} of {share['cases']} "
            f"({share['share']:.0%}, [{share['low']:.0%}, {share['high']:.0%}])"
        )

    def number(value: float | None, form: str = ".2f") -> str:
        return "-" if value is None else format(value, form)

    right, truth = scores["class_right"], scores["probability_of_truth"]
    unknown, kappa, sizes = scores["unknown_found"], scores["kappa_over_oracle"], scores["sizes"]
    return [
        f"{scores['answered']} of {scores['cases']} cases answered; the others count as wrong.",
        f"False alarms: {shown(scores['false_alarms'])}.",
        f"Class right: {shown(right['all'])}; of effects that stand out by 5 deviations "
        f"{shown(right['resolved'])}, among the first three "
        f"{shown(scores['class_among_three']['resolved'])}, by name "
        f"{shown(scores['name_right']['resolved'])}; of effects that should stand out by "
        f"their true size {shown(right['foreseen'])}; of those that stand out, "
        f"with shuffled labels, "
        f"{number(right['shuffled']['mean'])} [{number(right['shuffled']['low'])}, "
        f"{number(right['shuffled']['high'])}].",
        f"Mean probability given to the truth: {number(truth['all']['mean'])}; of single effects "
        f"{number(truth['single']['mean'])}, of those that stand out "
        f"{number(truth['resolved']['mean'])} [{number(truth['resolved']['low'])}, "
        f"{number(truth['resolved']['high'])}].",
        f"Two effects, both right: {shown(scores['two_effects_exact']['all'])}; where both stand "
        f"out {shown(scores['two_effects_exact']['resolved'])}.",
        f"Unknown kinds found at 5 % false-open: {shown(unknown)}; area {number(unknown['area'])}.",
        f"Confidently wrong on unknown kinds: {shown(scores['confident_wrong'])}; sure of a wrong "
        f"class: {shown(scores['sure_of_wrong'])}; right where 99 % sure: "
        f"{shown(scores['surest_right'])}.",
        f"Calibration error {number(scores['calibration_error'], '.3f')}, Brier score "
        f"{number(scores['brier'])}, log score {number(scores['log_score'])}.",
        f"Truth in the set of 90 %: {shown(scores['sets'])}; a set has "
        f"{number(scores['sets']['mean_size'])} classes in the mean.",
        f"Sizes of {sizes['sizes']} parameters: bias {number(sizes['bias'], '+.1%')}, errors "
        f"{number(sizes['error'], '.1%')}, mean square of deviations {number(sizes['chi2'])}.",
        f"Gap closed over what the true effect closes, {kappa['cases']} cases: median "
        f"{number(kappa['median'])}, lowest tenth {number(kappa['low'])}.",
    ]
