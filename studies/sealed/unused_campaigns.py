"""How far a gap shrinks on a campaign that was not used to find its cause.

    python -m studies.sealed.unused_campaigns CASES KEY ANSWERS FOLDER [--set SET]
        [--count N] [--jobs N]

CASES, KEY, ANSWERS and SET are those of a scored set, see `studies.sealed.second_scores`. N of its
cases whose effects were named rightly are taken, in the order of their names. The cause is adopted
into a copy of the bench file, and the same reed and bench are measured with it on another day. The
fraction of the gap that the adopted effects explain there is divided by the fraction that the true
effects explain if they are fitted to that campaign itself. FOLDER keeps everything; a later call
goes on from it.
"""

import statistics
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from blind.classes import CLASSES
from blind.scoring import RESOLVED, Case, Classes, best
from protocols.bench import BenchFile
from runs.reader import Run
from studies.sealed.answer_cases import diagnosed
from studies.sealed.second_laboratory import SealedCase, recorded
from studies.sealed.second_scores import asked_set, label_of

_BENCH, _NEXT = "bench.yaml", "next"


@dataclass(frozen=True)
class Closed:
    """Fractions of the gap of a campaign that effects explain.

    Attributes
    ----------
    adopted, low, high : float or None
        By what was adopted before it was measured, with its 95 % interval; None if there is no
        gap to close.
    oracle : float or None
        By the true effects, fitted to this campaign.
    """

    adopted: float | None
    low: float | None
    high: float | None
    oracle: float | None

    @property
    def ratio(self) -> float | None:
        """What was adopted over the oracle."""
        if self.adopted is None or not self.oracle:
            return None
        return self.adopted / self.oracle


def named_rightly(
    cases: Mapping[str, SealedCase], answers: Mapping[str, Mapping[str, Any]]
) -> Iterator[str]:
    """Names of cases whose known effects stand out and were named."""
    classes = Classes(CLASSES)
    for name, each in cases.items():
        case = Case(name, label_of(each), answers.get(name))
        if each.case.kind in ("single", "pair") and case.d_prime >= RESOLVED and case.answered:
            right = best(classes.mass(case.probability)) == classes.of(case.truth)
            if right and case.answer is not None and case.answer["effects_named"]:
                yield name


def closed_on_next(sealed: SealedCase, campaign: Path, folder: Path) -> Closed | None:
    """Adopt the cause of a case, measure it again, and see what the cause explains; None of none.

    Parameters
    ----------
    sealed : SealedCase
    campaign : Path
        What was recorded of it.
    folder : Path
        For what is made here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    bench, following = folder / _BENCH, folder / _NEXT
    with Run.open(min(campaign.glob("*.h5"))) as run:
        before = run.bench_text
    bench.write_text(before, encoding="utf-8")
    found = diagnosed(folder / "adopted.json", [campaign], "--adopt", str(bench))
    if not found["adopted"]:
        return None
    if not following.exists():
        recorded(following, sealed.case, repeat=1, bench=BenchFile.from_file(bench))
    known = diagnosed(folder / "known.json", [following])["known"]["explained_fraction"]
    original = folder / "original.yaml"
    original.write_text(before, encoding="utf-8")
    alone = diagnosed(folder / "alone.json", [following], "--bench", str(original))
    return Closed(known["fraction"], known["low"], known["high"], _oracle(sealed, alone))


def _oracle(sealed: SealedCase, alone: Mapping[str, Any]) -> float | None:
    """Return the fraction that the true effects explain; None where it is not known."""
    true = frozenset(each.id for each in sealed.case.effects)
    for key, gap in alone["explained_fraction"]["by"].items():
        if frozenset(key.split("+")) == true and gap["fraction"] is not None:
            return float(gap["fraction"])
    return None


def main() -> None:
    """Print the fractions of each case, and the median of the ratios."""
    asked, cases, answers = asked_set(__doc__.splitlines()[0], 12)
    names = list(named_rightly(cases, answers))[: asked.count]
    campaigns, folders = ([place / name for name in names] for place in (asked.cases, asked.folder))
    sealed = [cases[name] for name in names]
    ratios = []
    with ProcessPoolExecutor(asked.jobs) as pool:
        closed = pool.map(closed_on_next, sealed, campaigns, folders)
        for name, found in zip(names, closed, strict=True):
            true = "+".join(each.id for each in cases[name].case.effects)
            print(f"{name}  {cases[name].level:9s}{true:40s} {_said(found)}", flush=True)
            if found is not None and found.ratio is not None:
                ratios.append(found.ratio)
    if ratios:
        print(f"median over {len(ratios)} cases: {statistics.median(ratios):.3f} of the oracle")


def _said(found: Closed | None) -> str:
    if found is None:
        return "nothing was adopted"
    values = (found.adopted, found.low, found.high, found.oracle, found.ratio)
    adopted, low, high, oracle, ratio = ("-" if v is None else f"{v:.3f}" for v in values)
    return f"adopted {adopted} [{low}, {high}], oracle {oracle}, ratio {ratio}"


if __name__ == "__main__":
    main()
