"""What sealed cases have shown, and what an answer takes: scores of all sets whose keys are out.

    python -m studies.sealed_sets [--again N]

Of each set in `studies/sealed`: whether its keys fit the hashes that were committed before it
was answered, and its scores next to their targets: from what is kept of its answers
(`studies.sealed.answers`), or as they were made if nothing is. Then N cases of the last set are
recorded again from its key and diagnosed on two processors. Exit status 1 if a key does not fit.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from blind.cases import Label, record_case
from blind.classes import CLASSES
from blind.files import BlindError, labels_of
from blind.report import report
from blind.scoring import Classes
from studies.sealed.answers import kept_cases
from studies.sealed.names import SealedNames

FOLDER = Path(__file__).parent / "sealed"
SETS = "first", "second", "third", "fourth"
# Score, the number in it, its target, and whether more is better.
TARGETS = (
    ("false alarms", ("false_alarms", "share"), 0.05, False),
    ("class right at d' of 5 or more", ("class_right", "resolved", "share"), 0.90, True),
    ("probability on the truth, there", ("probability_of_truth", "resolved", "mean"), 0.75, True),
    ("unknown kinds at 5 % false-open", ("unknown_found", "share"), 0.80, True),
    ("confidently wrong", ("confident_wrong", "share"), 0.05, False),
    ("calibration error", ("calibration_error",), 0.08, False),
    ("truth in sets of 90 %, at least", ("sets", "share"), 0.85, True),
    ("truth in sets of 90 %, at most", ("sets", "share"), 0.95, False),
    ("kappa over the oracle's, median", ("kappa_over_oracle", "median"), 0.90, True),
    ("two effects exact", ("two_effects_exact", "all", "share"), 0.60, True),
)
_LONGEST_S, _PROCESSORS = 60.0, 2
_TIERS = 0, 1, 3, 4


def published(folder: Path) -> dict[str, Label]:
    """Return the labels of a set by case, in today's names, if its keys fit what was sealed.

    Raises
    ------
    SystemExit
        If one does not.
    """
    labels: dict[str, Label] = {}
    names = SealedNames.read()
    for sealed in sorted(folder.glob("tier*.json")):
        try:
            found = labels_of(sealed, _beside(sealed, "key"))
        except BlindError as error:
            raise SystemExit(f"sealed_sets: {error}") from None
        labels |= {case: names.label(label) for case, label in found.items()}
    return labels


def _beside(sealed: Path, what: str) -> Path:
    return sealed.with_name(sealed.name.replace("tier", what))


def scores_of(folder: Path) -> dict[str, Any] | None:
    """Scores of a set: of what is kept of answers to it, else as they were published, if they are.

    Parameters
    ----------
    folder : Path
        With ``tierN.json`` and ``keyN.json``, and either ``answersN.json`` of each or
        ``scores.json``.
    """
    kept = [_beside(sealed, "answers") for sealed in sorted(folder.glob("tier*.json"))]
    if all(path.exists() for path in kept):
        return report(kept_cases(published(folder), kept), Classes(CLASSES))
    scored = folder / "scores.json"
    if not scored.exists():
        return None
    published_then: dict[str, Any] = json.loads(scored.read_text(encoding="utf-8"))
    return published_then


def against_targets(scores: dict[str, Any]) -> Iterator[str]:
    """Each score, its target, and whether it is met."""
    for name, path, target, more in TARGETS:
        value: Any = scores
        for part in path:
            value = value[part]
        sign = "at least" if more else "at most"
        if value is None:
            yield f"{name:34s}      -  {sign} {target:.2f}  not seen"
            continue
        met = value >= target if more else value <= target
        yield f"{name:34s} {value:6.3f}  {sign} {target:.2f}  {'met' if met else 'missed'}"


def timed(case: Path) -> tuple[dict[str, Any], float]:
    """Answer of a case on two processors, and how many seconds it took."""
    mine = set(sorted(os.sched_getaffinity(0))[:_PROCESSORS])
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "acquire", "diagnose", str(case), "--json"],
        capture_output=True, text=True, check=False,
        preexec_fn=lambda: os.sched_setaffinity(0, mine),
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"sealed_sets: {case.name}: {done.stderr.strip()}")
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer, time.perf_counter() - begun


def again(labels: dict[str, Label], count: int) -> Iterator[float]:
    """Record cases again, of one tier after the other, and answer them; yield seconds."""
    by_tier = [[n for n, label in labels.items() if label.tier == tier] for tier in _TIERS]
    chosen = [names[k] for k in range(count) for names in by_tier if k < len(names)][:count]
    for name in chosen:
        with tempfile.TemporaryDirectory() as place:
            record_case(Path(place), name, labels[name])
            answer, took_s = timed(Path(place) / name)
        truth = "+".join(n for n, _ in labels[name].effects) or "none"
        said = "+".join(answer["effects_named"]) or answer["verdict"]
        print(f"{name}  {truth:40s} answered {said:40s} {took_s:5.0f} s", flush=True)
        yield took_s


def main() -> None:
    """Print what all published sets have shown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--again", type=int, default=4)
    asked = parser.parse_args()
    labels: dict[str, Label] = {}
    for folder in (FOLDER / name for name in SETS):
        scores = scores_of(folder)
        if scores is None:
            print(f"{folder.name} sets: not scored yet")
            continue
        labels = published(folder)
        print(f"{folder.name} sets: {len(labels)} cases, whose keys fit what was sealed")
        for line in against_targets(scores):
            print(f"  {line}")
    took_s = list(again(labels, asked.again))
    if took_s:
        middle, longest = statistics.median(took_s), max(took_s)
        print(
            f"a case on {_PROCESSORS} processors: median {middle:.0f} s, longest {longest:.0f} s; "
            f"at most {_LONGEST_S:.0f} s are asked for"
        )


if __name__ == "__main__":
    main()
