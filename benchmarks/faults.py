"""What becomes of a run when something goes wrong: a table of faults and their outcomes.

Faults strike a small sweep that runs through the real drivers of Novatech and Siglent
(``benches/emulated.yaml``). Afterwards the laboratory itself is asked what it really played during
each exposure: a step that is marked good must have had the planned frequencies and volts from
the first frame to the last. Then either the sweep is complete, or it stopped with all off (or said
what could not be confirmed) and said why. Signals strike in every phase of a run, processes are
killed at random instants, disks fill, benches cannot be opened.

    python -m benchmarks.faults [--kills N] [--json]
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.striking.fault_list import FAULTS, NO_FAULT
from benchmarks.striking.fault_openings import OPENINGS, in_use, opened
from benchmarks.striking.fault_openings import as_expected as as_opened
from benchmarks.striking.fault_processes import (
    PHASES,
    SIGNALS,
    clock_set_back,
    full_disk,
    impatience,
    killed,
    locked,
    signalled,
)
from benchmarks.striking.struck import Outcome, as_expected, struck

# The target for two SIGINT.
_OFF_WITHIN_S = 3.0
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes
    ----------
    fault, outcome, said : str
        What went wrong, what became of the run, and the words of the program.
    wrong : int
        Steps marked good that are not.
    left_on : bool
        Whether an output is on at the end.
    unconfirmed : tuple of str
        What the program says that may be on.
    met : bool
        Whether the outcome is the expected one.
    """

    fault: str
    outcome: str
    said: str
    wrong: int
    left_on: bool
    unconfirmed: tuple[str, ...]
    met: bool


def _row(name: str, outcome: Outcome, met: bool) -> Row:
    parts = [f"{outcome.good} good"]
    parts += [f"{outcome.bad} bad"] if outcome.bad else []
    parts += [f"{outcome.repeated} measured again"] if outcome.repeated else []
    return Row(
        fault=name,
        outcome=f"{outcome.ending}: {', '.join(parts)}",
        said=outcome.reason or "; ".join(outcome.sentences),
        wrong=outcome.wrong,
        left_on=not outcome.off,
        unconfirmed=outcome.unconfirmed,
        met=met,
    )


def wire_rows(folder: Path) -> Iterator[Row]:
    """Faults of instruments, wires, camera and light."""
    for fault in FAULTS:
        outcome = struck(fault, folder)
        yield _row(fault.name, outcome, as_expected(fault, outcome))


def opening_rows() -> Iterator[Row]:
    """Benches that cannot be opened, with outputs that an earlier program left on."""
    for opening in OPENINGS:
        found = opened(opening)
        on = found.tweeter_on or found.rf_on
        met = as_opened(opening, found)
        yield Row(opening.name, "refused", found.message, 0, on, found.unconfirmed, met)
    found = in_use()
    met = "is in use by process" in found.message and found.tweeter_on and found.rf_on
    yield Row(
        "opening: another program uses the bench", "refused", found.message, 0, False, (), met
    )


def signal_rows(folder: Path) -> Iterator[Row]:
    """Each signal in each phase of a run."""
    for number in SIGNALS:
        for phase in PHASES:
            outcome = signalled(number, phase, folder)
            complete = phase in ("repeat", "packing")
            ended = "complete" if complete else "stopped"
            met = outcome.wrong == 0 and outcome.off and not outcome.unconfirmed
            met &= outcome.ending == ended or phase == "repeat"
            yield _row(f"{number.name} during {phase}", outcome, met)
    seconds, off, left = impatience(folder)
    said = f"off {seconds:.2f} s after the second"
    met = seconds <= _OFF_WITHIN_S and off
    yield Row("SIGINT twice, every reply 1 s late", "stopped", said, 0, not off, left, met)


def process_rows(folder: Path) -> Iterator[Row]:
    """Disks, clocks and other programs."""
    for phase in ("beginning", "amid", "packing"):
        outcome = full_disk(folder, phase)
        if outcome is None:
            continue
        met = outcome.wrong == 0 and outcome.off
        met &= outcome.ending == ("complete" if phase == "packing" else "stopped")
        yield _row(f"disk full: {phase}", outcome, met)
    outcome = clock_set_back(folder)
    yield _row("computer's clock set back", outcome, as_expected(NO_FAULT, outcome))
    said, outcome = locked(folder)
    met = "is being measured by process" in said and as_expected(NO_FAULT, outcome)
    yield _row(f"gone on with by two programs ({said})", outcome, met)


def benchmark(kills: int, tell: Tell = lambda _: None) -> dict[str, Any]:
    """Let every fault strike; the result is what ``--json`` prints."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for group in (
            wire_rows(folder),
            opening_rows(),
            signal_rows(folder),
            process_rows(folder),
        ):
            for row in group:
                rows.append(row)
                tell(row.fault)
        tell(f"{kills} kills")
        after_kills = killed(kills, folder)
    kills_met = not (after_kills.damaged or after_kills.wrong or after_kills.bad)
    return {
        "faults": [asdict(row) for row in rows],
        "kills": asdict(after_kills),
        "rows": len(rows),
        "wrong": sum(row.wrong for row in rows),
        "left_on_untold": sum(row.left_on and not row.unconfirmed for row in rows),
        "missed": [row.fault for row in rows if not row.met],
        "met": all(row.met for row in rows) and kills_met,
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    print(f"{'fault':44}  {'outcome':34} {'WRONG':>5}  what was said")
    for row in report["faults"]:
        mark = " " if row["met"] else "!"
        print(
            f"{row['fault']:44.44}{mark} {row['outcome']:34.34} {row['wrong']:5}  "
            f"{row['said'] or '-':.110}"
        )
        for line in row["unconfirmed"]:
            print(f"{'':46}not confirmed off: {line:.100}")
    kills = report["kills"]
    print(
        f"SIGKILL at {kills['kills']} random instants, on every second run with frames kept: "
        f"{len(kills['finished'])} files, all open; {kills['resumed']} gone on with to the end; "
        f"steps damaged: {kills['damaged']}, marked good but wrong: {kills['wrong']}, not good: "
        f"{kills['bad']}; files left over: {kills['left']}"
    )
    print(
        f"{report['rows']} faults: {report['wrong']} steps marked good when wrong, "
        f"{report['left_on_untold']} outputs left on without a word, "
        f"{len(report['missed'])} outcomes that are not as expected "
        f"({'met' if report['met'] else 'missed'})"
    )


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description="What becomes of runs when things go wrong.")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()

    def tell(what: str) -> None:
        if sys.stderr.isatty():
            print(f"\r\033[K{what:.70}", end="", file=sys.stderr, flush=True)

    report = benchmark(arguments.kills, tell)
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)
    return 0 if report["met"] else 1


if __name__ == "__main__":
    sys.exit(main())
