"""Scores of sealed sets of the second laboratory, by level of disorder.

    python -m studies.sealed.second_scores KEY ANSWERS [--set FOLDER] [--begun] [--json]

FOLDER (``studies/sealed/second_laboratory`` if it is not given) has ``sealed.json``, as `make` of
`studies.sealed.second_laboratory` writes it, and ``answered.json``, as `studies.sealed.commitments`
prints it. Both must be committed before the key is opened: if not, nothing is scored.

What was not answered counts as wrong. With ``--begun`` cases behind the last one that was answered
are left out: cases are asked in the order of their names, which say nothing of them.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from blind.cases import Label
from blind.classes import CLASSES
from blind.scoring import (
    RESOLVED,
    UNKNOWN,
    Case,
    Classes,
    Share,
    calibration_error,
    closures,
    false_alarms,
    mean_probability,
    named,
    open_set,
    sure_of_wrong,
    surest_right,
)
from studies.sealed.commitments import committed, committed_answers, require_earlier
from studies.sealed.second_laboratory import SEALED, SealedCase, opened, read_cases

FOLDER = Path(__file__).parent / "second_laboratory"
LEVELS: Final = ("quiet", "ordinary", "rough")
# As tiers of `blind.cases`.
_TIERS: Final = {"clean": 0, "single": 1, "pair": 3, "unknown": 4}
# Score, its target at every level, and whether more is better.
TARGETS: Final = (
    ("false alarms", 0.05, False),
    ("class right at d' of 5 or more", 0.85, True),
    ("probability on the truth, there", 0.70, True),
    ("unknown kinds at 5 % false-open", 0.70, True),
    ("sure of a wrong class", 0.03, False),
    ("calibration error", 0.06, False),
    ("pairs where both stand out", 0.70, True),
)


def label_of(sealed: SealedCase) -> Label:
    """Return what scores read of a case; sizes in units of the usual are not known."""
    case = sealed.case
    effects = tuple((each.id, 1.0) for each in case.effects)
    return Label(_TIERS[case.kind], effects, case.kind != "unknown", 0)


def scores_of(cases: Sequence[Case]) -> dict[str, Any]:
    """Return the scores of cases, with Wilson's intervals of shares.

    What something unknown is taken for is compared with all known effects among the cases.
    """
    classes = Classes(CLASSES)
    known = [case for case in cases if case.label.known and case.label.effects]
    single = [c for c in known if len(c.label.effects) == 1 and c.d_prime >= RESOLVED]
    double = [c for c in known if len(c.label.effects) > 1 and c.d_prime >= RESOLVED]
    truth, low, high = mean_probability(single, classes)
    return {
        "cases": len(cases),
        "answered": sum(case.answered for case in cases),
        "false alarms": _plain(false_alarms(cases, classes)),
        "class right at d' of 5 or more": _plain(named(single, classes)),
        "probability on the truth, there": {"value": truth, "low": low, "high": high},
        "unknown kinds at 5 % false-open": _plain(open_set(cases)[0]),
        "unknown kinds called unknown": _plain(
            named([case for case in cases if case.truth == UNKNOWN], classes)
        ),
        "sure of a wrong class": _plain(sure_of_wrong(cases, classes)),
        "right where 99 % sure": _plain(surest_right(cases, classes)),
        "calibration error": {"value": calibration_error(cases, classes)},
        "pairs where both stand out": _plain(named(double, classes)),
        "gap closed over the oracle's, median": {"value": closures(single + double)["median"]},
    }


def _plain(found: Share) -> dict[str, Any]:
    return {**vars(found), "value": found.value}


def by_level(
    cases: Mapping[str, SealedCase], answers: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Return the scores of each level, and of all cases."""
    scored = {name: Case(name, label_of(each), answers.get(name)) for name, each in cases.items()}
    found = {
        level: scores_of([scored[name] for name, each in cases.items() if each.level == level])
        for level in LEVELS
    }
    return {**found, "all": scores_of(list(scored.values()))}


def begun(
    cases: Mapping[str, SealedCase], answers: Mapping[str, Mapping[str, Any]]
) -> dict[str, SealedCase]:
    """Return the cases up to the last one, in the order in which they are asked, with an answer.

    Those before it that have none were asked, too, and count as wrong.
    """
    last = max(answers)
    return {name: each for name, each in cases.items() if name <= last}


def lines(scores: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a table with a score in each row, a level in each column, and targets."""
    targets = {name: f"  {'≥' if more else '≤'} {limit:.2f}" for name, limit, more in TARGETS}
    columns = [*LEVELS, "all"]
    rows = [f"{'':40s}" + "".join(f"{level:>20s}" for level in columns)]
    for name in scores["all"]:
        cells = "".join(f"{_shown(scores[level][name]):>20s}" for level in columns)
        rows.append(f"{name:40s}{cells}{targets.get(name, '')}")
    return rows


def _shown(score: Any) -> str:
    if isinstance(score, int):
        return str(score)
    value = score["value"]
    if value is None or value != value:
        return "-"
    if "cases" in score:
        return f"{score['hits']} of {score['cases']} ({value:.0%})"
    return f"{value:.3f}"


def case_lines(
    cases: Mapping[str, SealedCase], answers: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Return a line for each case: what is true, and what was answered."""
    found = []
    for name, each in sorted(cases.items(), key=lambda pair: (pair[1].case.kind, pair[1].level)):
        case = Case(name, label_of(each), answers.get(name))
        mass = Classes(CLASSES).mass(case.probability)
        likeliest = sorted(mass, key=lambda key: -mass[key])[:2]
        said = ", ".join(f"{key} {mass[key]:.2f}" for key in likeliest)
        true = "+".join(effect.id for effect in each.case.effects) or "none"
        verdict = "no answer" if case.answer is None else case.answer["verdict"]
        found.append(
            f"{name}  {each.case.kind:8s}{each.level:9s} {true:45s} d' {case.d_prime:7.1f}  "
            f"{verdict:14s} {said}"
        )
    return found


def opened_set(
    key: Path, answers: Path, folder: Path
) -> tuple[dict[str, SealedCase], dict[str, dict[str, Any]]]:
    """Return the cases of a set and the answers to them, by name.

    Parameters
    ----------
    key, answers : Path
    folder : Path
        With what was committed of the set.

    Raises
    ------
    SystemExit
        If labels or answers are not those that were committed. The key is read last.
    """
    answered = committed_answers(answers, folder / "answered.json")
    sealed = committed(folder / SEALED)["cases"]
    require_earlier(folder / SEALED, folder / "answered.json")
    return opened(sealed, read_cases(key)), answered


def asked_set(
    description: str, count: int
) -> tuple[argparse.Namespace, dict[str, SealedCase], dict[str, dict[str, Any]]]:
    """Read the arguments of a program that goes on from a scored set, and open the set.

    Parameters
    ----------
    description : str
        Of the program.
    count : int
        How many cases it takes by default.

    Raises
    ------
    SystemExit
        As `opened_set`.
    """
    parser = argparse.ArgumentParser(description=description)
    for what in ("cases", "key", "answers", "folder"):
        parser.add_argument(what, type=Path)
    parser.add_argument("--count", type=int, default=count)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--set", type=Path, default=FOLDER)
    asked = parser.parse_args()
    return asked, *opened_set(asked.key, asked.answers, asked.set)


def main() -> None:
    """Print the scores of a set, and each case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("key", type=Path)
    parser.add_argument("answers", type=Path)
    parser.add_argument("--set", type=Path, default=FOLDER, dest="folder")
    parser.add_argument("--begun", action="store_true", help="leave out cases that were not asked")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    cases, answers = opened_set(asked.key, asked.answers, asked.folder)
    if asked.begun:
        cases = begun(cases, answers)
    scores = by_level(cases, answers)
    if asked.json:
        print(json.dumps(scores, indent=1))
        return
    print("\n".join([*case_lines(cases, answers), "", *lines(scores)]))


if __name__ == "__main__":
    main()
