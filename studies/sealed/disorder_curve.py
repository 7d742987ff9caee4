"""False alarms of clean benches of the second laboratory against their disorder.

    python -m studies.sealed.disorder_curve FOLDER [--amounts 0.3 1 3 5] [--each N] [--jobs N]

Records and diagnoses N benches with nothing wrong for each amount of disorder, in multiples of the
ordinary one, and prints how many raise an alarm, and the mean probability of "no effect" where what
would not show counts as none. FOLDER keeps campaigns and answers; a later call goes on from it.
"""

import argparse
import json
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from blind.scoring import NONE, share
from studies.sealed.answer_cases import answer
from studies.sealed.second_laboratory import recorded
from studies.second_laboratory.campaigns.case import draw_case

AMOUNTS = 0.3, 0.5, 1.0, 2.0, 3.0, 5.0
_SEED = 31_415_926


@dataclass(frozen=True)
class CleanBench:
    """One bench with nothing wrong.

    Attributes
    ----------
    amount : float
        Of ordinary disorder.
    number : int
        Benches of one number differ in the amount only.
    """

    amount: float
    number: int

    @property
    def name(self) -> str:
        """Of its folder, and of its answer."""
        return f"{self.amount:g}-{self.number}"

    def recorded_in(self, campaigns: Path) -> Path:
        """Return the folder of its campaign, which is recorded if it is not there."""
        campaign = campaigns / self.name
        if not campaign.exists():
            recorded(campaign, draw_case("clean", self.amount, _SEED, self.number))
        return campaign


def answered(bench: CleanBench, folder: Path) -> dict[str, Any] | None:
    """Return the answer to a bench, which is recorded if it is not there; None if there is none."""
    campaign, answers = bench.recorded_in(folder / "campaigns"), folder / "answers"
    answers.mkdir(parents=True, exist_ok=True)
    kept = answers / f"{bench.name}.json"
    if not kept.exists():
        print(answer(campaign, answers), flush=True)
    found: dict[str, Any] | None = (
        json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else None
    )
    return found


def line(amount: float, answers: list[Mapping[str, Any] | None]) -> str:
    """Return one line of the curve; what was not answered is an alarm."""
    alarms = share([each is None or each["verdict"] != NONE for each in answers])
    given = [each["probability_of_what_shows"].get(NONE, 0.0) for each in answers if each]
    mean = sum(given) / len(given) if given else float("nan")
    said = ", ".join("no answer" if each is None else each["verdict"] for each in answers)
    return (
        f"disorder × {amount:<4g} {alarms.hits} of {alarms.cases} false alarms "
        f"[{alarms.low:.0%}, {alarms.high:.0%}], mean probability of none {mean:.2f} ({said})"
    )


def main() -> None:
    """Print the curve."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--amounts", type=float, nargs="+", default=AMOUNTS)
    parser.add_argument("--each", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    with ProcessPoolExecutor(asked.jobs) as pool:
        waiting = {
            amount: [
                pool.submit(answered, CleanBench(amount, number), asked.folder)
                for number in range(asked.each)
            ]
            for amount in asked.amounts
        }
        for amount, each in waiting.items():
            print(line(amount, [one.result() for one in each]), flush=True)


if __name__ == "__main__":
    main()
