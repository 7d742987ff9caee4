"""Kill `acquire run` at random instants, read what is left with plain h5py, and go on with it.

Every killed run has the seed of a run that was left alone: whatever a file calls finished must
equal that run's step, bit for bit. Then another process goes on with the run. What had been
finished must stay as it was, all other steps must be measured well, and the documents must hold
each step once, between one beginning and one end. Every other run keeps its frames.

    python -m benchmarks.kills [--kills N] [--json]
"""

import argparse
import hashlib
import json
import random
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

from protocols.protocol import Protocol

_UNFINISHED = (b"pending", b"interrupted", b"skipped")


def command(protocol: Path, *options: str | Path) -> list[str]:
    """Return the command of one run."""
    run = [sys.executable, "-m", "acquire", "run", str(protocol), "--no-fit"]
    return [*run, *(str(option) for option in options)]


def new_run(protocol: Path, path: Path) -> list[str]:
    """Return the command of a run from its beginning."""
    return command(protocol, "--reed", "R01", "--seed", "5", "--out", path)


def finished_steps(path: Path) -> dict[int, bytes]:
    """Hashes of the pictures of the steps that a file calls finished, by position."""
    with h5py.File(path, "r") as file:
        verdicts, data = file["entry/steps/verdict"][()], file["entry/data"]
        pictures = data[data.attrs["signal"]]
        done = [k for k, verdict in enumerate(verdicts) if verdict not in _UNFINISHED]
        return {k: hashlib.sha256(pictures[k].tobytes()).digest() for k in done}


def differing(found: dict[int, bytes], expected: dict[int, bytes]) -> int:
    """How many steps of one file are not those of another, bit for bit."""
    return sum(picture != expected[k] for k, picture in found.items())


def kill_one(protocol: Path, path: Path, after_s: float) -> None:
    """Start a run and kill it some time after its file has appeared."""
    process = subprocess.Popen(
        new_run(protocol, path), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while not path.exists():
        time.sleep(0.005)
    time.sleep(after_s)
    process.kill()
    process.wait()


def is_complete(path: Path) -> bool:
    """Whether a file says that its run came to its end."""
    with h5py.File(path, "r") as file:
        return bool(file["entry/status"][()] == b"complete")


def is_whole(path: Path) -> bool:
    """Whether a run is complete, all its steps are good, and its documents hold each once."""
    with h5py.File(path, "r") as file:
        good = (file["entry/steps/verdict"][()] == b"ok").all()
        indices = file["entry/steps/index"][()].tolist()
    lines = path.with_suffix(".documents.jsonl").read_text(encoding="utf-8").splitlines()
    documents = [json.loads(line) for line in lines]
    names = [name for name, _ in documents]
    written = sorted(document["data"]["index"] for name, document in documents if name == "event")
    once = names.count("start") == names.count("stop") == 1 and names[-1] == "stop"
    return bool(is_complete(path) and good and once and written == indices)


@dataclass(frozen=True)
class Undisturbed:
    """A protocol, and what it gives if it is not killed.

    Attributes
    ----------
    protocol : Path
    steps : dict of int to bytes
        See `finished_steps`.
    measuring_s : float
        How long it measures.
    """

    protocol: Path
    steps: dict[int, bytes]
    measuring_s: float


def undisturbed(keep: str, folder: Path) -> Undisturbed:
    """Measure the quick protocol, keeping holograms or frames."""
    protocol, path = folder / f"{keep}.yaml", folder / f"{keep}.h5"
    protocol.write_text(Protocol.from_file("quick").replace(keep=keep).text, encoding="utf-8")
    start_s = time.perf_counter()
    subprocess.run(new_run(protocol, path), check=True, capture_output=True)
    # What starting takes is left out: the runs are to be killed while they measure.
    measuring_s = 0.7 * (time.perf_counter() - start_s)
    steps = finished_steps(path)
    path.unlink()
    return Undisturbed(protocol, steps, measuring_s)


def benchmark(kills: int, seed: int = 1) -> dict[str, Any]:
    """Kill runs and go on with them; the result is what ``--json`` prints."""
    rng, counts = random.Random(seed), []
    damaged = changed = whole_again = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kinds = [undisturbed(keep, folder) for keep in ("holograms", "frames")]
        for number in range(kills):
            kind, path = kinds[number % 2], folder / f"killed{number}.h5"
            kill_one(kind.protocol, path, rng.uniform(0.0, kind.measuring_s))
            found = finished_steps(path)
            counts.append(len(found))
            damaged += differing(found, kind.steps)
            if not is_complete(path):
                going_on = command(kind.protocol, "--resume", path)
                subprocess.run(going_on, check=False, capture_output=True)
            changed += differing(found, finished_steps(path))
            whole_again += is_whole(path)
            path.unlink()
    return {
        "kills": kills,
        "steps": len(kinds[0].steps),
        "finished": counts,
        "damaged_steps": damaged,
        "whole_again": whole_again,
        "changed_steps": changed,
        "met": damaged == changed == 0 and whole_again == kills,
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="What a killed run leaves, and how it goes on.")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    report = benchmark(arguments.kills)
    if arguments.json:
        print(json.dumps(report, indent=2))
        return
    print(
        f"{report['kills']} runs of {report['steps']} steps killed after {report['finished']} "
        f"steps: every file opens, {report['damaged_steps']} finished steps differ from an "
        f"undisturbed run; {report['whole_again']} runs were gone on with to their end, which "
        f"changed {report['changed_steps']} finished steps ({'met' if report['met'] else 'missed'})"
    )


if __name__ == "__main__":
    main()
