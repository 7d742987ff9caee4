"""Who was tried against whom: counts of tests that passed, instrument by instrument.

A driver that only ever met a simulated instrument of the same authors may share their mistakes.
This runs the tests of drivers and peers and sorts them by who wrote which side.

    python -m studies.independence [--json]

What is not installed is skipped and counted as such; `make test-all` makes an environment that has
everything (``.venv-all/bin/python -m studies.independence``).
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from fnmatch import fnmatch
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

COLUMNS = {
    "ours-ours": "our driver, our instrument",
    "theirs-ours": "others' program, our instrument or file",
    "ours-theirs": "our driver, others' instrument",
    "transcript": "literal lines of manuals, public drivers and a real instrument",
}
# The first pattern that fits a test says what it counts for; `file::test`, without parameters.
CELLS: tuple[tuple[str, str, str], ...] = (
    ("test_novatech::*literal_bytes", "Novatech 409B", "transcript"),
    ("test_novatech::*what_the_sources_say", "Novatech 409B", "transcript"),
    ("test_novatech::*that_others_found", "Novatech 409B", "transcript"),
    ("test_novatech::*", "Novatech 409B", "ours-ours"),
    ("test_srs::*literal_bytes", "SRS SG380", "transcript"),
    ("test_srs::*what_the_sources_say", "SRS SG380", "transcript"),
    ("test_srs::*", "SRS SG380", "ours-ours"),
    ("test_siglent::*as_the_real_one_did", "Siglent SDG2000X", "transcript"),
    ("test_siglent::*", "Siglent SDG2000X", "ours-ours"),
    ("test_keysight::*", "Keysight 33500", "ours-ours"),
    ("test_generators::*33500*", "Keysight 33500", "theirs-ours"),
    ("test_generators::test_pymeasure*", "Keysight 33500", "theirs-ours"),
    ("test_generators::*", "Siglent SDG2000X", "theirs-ours"),
    ("test_tweeter::*", "both generators", "ours-ours"),
    ("test_visa::*", "lines of text (VISA)", "ours-ours"),
    ("test_serving::*", "lines of text (VISA)", "ours-ours"),
    ("test_soundcard::*", "sound card", "ours-ours"),
    ("test_portaudio::*", "sound card", "ours-theirs"),
    ("test_genicam::*", "GenICam cameras", "ours-ours"),
    ("test_frames::*", "GenICam cameras", "ours-ours"),
    ("test_camera_clock::*", "GenICam cameras", "ours-ours"),
    ("test_pylon::*", "Basler (pylon emulator)", "ours-theirs"),
    ("test_aravis::*", "GigE Vision (Aravis)", "ours-theirs"),
    ("test_tiled::*", "run files (Tiled, bluesky)", "theirs-ours"),
)
FOLDERS = ("tests/drivers", "tests/peers")


def cell_of(file: str, test: str) -> tuple[str, str] | None:
    """Instrument and column that a test counts for; None if it is about neither side of a wire."""
    name = f"{file}::{test.partition('[')[0]}"
    return next(((row, column) for p, row, column in CELLS if fnmatch(name, p)), None)


def benchmark() -> dict[str, Any]:
    """Run the tests; the result is what ``--json`` prints."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "tests.xml")
        command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile"]
        # What pytest prints is for the eyes of who waits.
        subprocess.run([*command, f"--junitxml={report}", *FOLDERS], check=False, stdout=sys.stderr)
        cases = list(ElementTree.parse(report).iter("testcase"))
    counted: dict[str, Counter[tuple[str, str]]] = {
        outcome: Counter() for outcome in ("passed", "failed", "skipped")
    }
    for case in cases:
        # A file that is skipped whole is a case without a class, of that file's name.
        where, name = case.get("classname") or case.get("name") or "", case.get("name") or ""
        cell = cell_of(where.split(".")[2], name)
        if cell is not None:
            counted[_outcome(case)][cell] += 1
    rows: dict[str, dict[str, dict[str, int]]] = {row: {} for _, row, _ in CELLS}
    for _, row, column in CELLS:
        rows[row][column] = {name: count[row, column] for name, count in counted.items()}
    return {"columns": COLUMNS, "rows": rows, "failed": counted["failed"].total()}


def _outcome(case: ElementTree.Element) -> str:
    if case.find("skipped") is not None:
        return "skipped"
    spoilt = case.find("failure") is not None or case.find("error") is not None
    return "failed" if spoilt else "passed"


def _shown(cell: dict[str, int] | None) -> str:
    if cell is None:
        return "-"
    others = [f"{cell[name]} {name}" for name in ("failed", "skipped") if cell[name]]
    return ", ".join([str(cell["passed"]), *others])


def print_report(report: dict[str, Any]) -> None:
    """Print the matrix for people."""
    print(f"{'tests passed':28}" + "".join(f"{column:>22}" for column in COLUMNS))
    for row, cells in report["rows"].items():
        print(f"{row:28}" + "".join(f"{_shown(cells.get(column)):>22}" for column in COLUMNS))
    for column, meaning in COLUMNS.items():
        print(f"{column}: {meaning}")


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description="Who was tried against whom.")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    report = benchmark()
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)
    return 1 if report["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
