"""Kill `acquire run` at random instants and read what is left with plain h5py.

Every killed run has the seed of a run that was left alone: whatever a file calls finished must
equal that run's step, bit for bit.

    python -m benchmarks.kills [--kills N] [--json]
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np

_UNFINISHED = (b"pending", b"interrupted")


def command(path: Path) -> list[str]:
    """Return the command of one run."""
    run = [sys.executable, "-m", "acquire", "run", "quick", "--reed", "R01", "--seed", "5"]
    return [*run, "--no-fit", "--out", str(path)]


def finished_steps(path: Path) -> dict[int, Any]:
    """Fields of the steps that a file calls finished, by position."""
    with h5py.File(path, "r") as file:
        verdicts = file["entry/steps/verdict"][()]
        done = [k for k, verdict in enumerate(verdicts) if verdict not in _UNFINISHED]
        return {k: file["entry/data/field"][k] for k in done}


def kill_one(path: Path, after_s: float) -> None:
    """Start a run and kill it some time after its file has appeared."""
    process = subprocess.Popen(command(path), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not path.exists():
        time.sleep(0.005)
    time.sleep(after_s)
    process.kill()
    process.wait()


def benchmark(kills: int, seed: int = 1) -> dict[str, Any]:
    """Kill runs; the result is what ``--json`` prints."""
    rng = random.Random(seed)
    counts, damaged = [], 0
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder, "whole.h5")
        start_s = time.perf_counter()
        subprocess.run(command(whole), check=True, capture_output=True)
        # What starting takes is left out: the runs are to be killed while they measure.
        measuring_s = 0.7 * (time.perf_counter() - start_s)
        expected = finished_steps(whole)
        for number in range(kills):
            path = Path(folder, f"killed{number}.h5")
            kill_one(path, rng.uniform(0.0, measuring_s))
            found = finished_steps(path)
            counts.append(len(found))
            damaged += sum(not np.array_equal(found[k], expected[k]) for k in found)
    return {
        "kills": kills,
        "steps": len(expected),
        "finished": counts,
        "damaged_steps": damaged,
        "met": damaged == 0,
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="What a killed run leaves.")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    report = benchmark(arguments.kills)
    if arguments.json:
        print(json.dumps(report, indent=2))
        return
    print(
        f"{report['kills']} runs of {report['steps']} steps killed after {report['finished']} "
        f"steps: every file opens, {report['damaged_steps']} finished steps differ from an "
        f"undisturbed run ({'met' if report['met'] else 'missed'})"
    )


if __name__ == "__main__":
    main()
