"""How much a reader slows a run in work, and what checksums cost.

One sweep is measured in rounds of three runs, at the camera's real pace, each in a process of its
own:

* alone;
* watched: another process opens the run file ten times a second, lists it, and reads every field
  that is there;
* busy: another process does the same with the file of an earlier run. It takes the same share of
  the processors, and never touches the file of the run in work.

Compared are the time and the processor time of the runner from its first step to its last. Watched
over busy is what access to the file costs; watched over alone is that and the processors' share.
Runs alone, compared with each other in the same way, show the noise of the machine.

    python -m benchmarks.watching [--rounds N] [--json]
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

import acquire
from acquire.cli.display import catalogue_entry
from acquire.runner.recorder import StepReport
from protocols.bench import BenchFile
from runs.errors import RunFileError
from runs.integrity.checksums import pixel_checksum
from runs.reader import Run

# Small frames: what is compared is mostly the run file's own work. 30 steps take some 13 s.
_SMALL: Final = {
    "camera.width": 320,
    "camera.height": 256,
    "sweep.first": 14,
    "sweep.last": 72,
    "sweep.stride": 2,
}
_WATCHING_HZ: Final = 10.0
# The project's goal: reading the file slows its run by less than this.
_LIMIT: Final = 0.01
# A hologram of series A as its run file keeps it, and four frames of the full sensor.
_PIXELS: Final = {
    "hologram": ((282, 266), np.complex64),
    "frames": ((4, 1024, 1280), np.uint16),
}


@dataclass(frozen=True)
class Arm:
    """One kind of run: alone, or with a reader of its own file or of another.

    Attributes
    ----------
    name : str
    reads : {'nothing', 'the run', 'another'}
    """

    name: str
    reads: str


_ARMS: Final = (Arm("alone", "nothing"), Arm("watched", "the run"), Arm("busy", "another"))
_RATIOS: Final = (("watched", "alone"), ("watched", "busy"), ("busy", "alone"))


def measure(path: Path, done: Any, answer: Any) -> None:
    """Measure a sweep; send seconds and processor seconds for each step."""
    bench = BenchFile.from_file().replace({"twin": {"mesh": "coarse", "pace": "realtime"}})
    plan = acquire.plan(acquire.load("quick").replace(_SMALL), bench).plan
    times: list[tuple[float, float]] = []

    def note(report: StepReport) -> None:
        times.append((time.perf_counter(), time.process_time()))
        done.value = report.done

    acquire.run(plan, path, reed="watched", callbacks=acquire.Callbacks(step=note))
    steps = len(times) - 1
    first, last = times[0], times[-1]
    answer.send([(end - start) / steps for start, end in zip(first, last, strict=True)])


def watch(path: Path, done: Any, over: Any, answer: Any) -> None:
    """Read a run file again and again, as many fields as are done; send how often, and how many."""
    readings = fields = 0
    while not over.is_set():
        start_s = time.perf_counter()
        with contextlib.suppress(RunFileError), Run.open(path) as run:
            catalogue_entry(run)
            for position in np.flatnonzero(run.good)[: done.value]:
                run.field(int(position))
                fields += 1
            readings += 1
        time.sleep(max(1 / _WATCHING_HZ - (time.perf_counter() - start_s), 0.0))
    answer.send((readings, fields))


def _run_once(path: Path, read: Path | None) -> tuple[list[float], tuple[int, int]]:
    """Seconds and processor seconds of each step; readings and fields read."""
    context = multiprocessing.get_context("spawn")
    done, over = context.Value("i", 0), context.Event()
    heard, said = context.Pipe(duplex=False)
    seen, sees = context.Pipe(duplex=False)
    runner = context.Process(target=measure, args=(path, done, said))
    watcher = context.Process(target=watch, args=(read, done, over, sees))
    if read is not None:
        watcher.start()
    runner.start()
    took = heard.recv()
    runner.join()
    over.set()
    if read is None:
        return took, (0, 0)
    count = seen.recv()
    watcher.join()
    return took, count


def benchmark(rounds: int) -> dict[str, Any]:
    """Measure rounds of runs; the result is what ``--json`` prints."""
    took: dict[str, list[list[float]]] = {arm.name: [] for arm in _ARMS}
    readings = fields = 0
    with tempfile.TemporaryDirectory() as folder:
        another = Path(folder, "another.h5")
        _run_once(another, None)
        for number in range(rounds):
            # Each arm comes first as often as the others: what drifts counts for all.
            turn = number % len(_ARMS)
            for arm in (*_ARMS[turn:], *_ARMS[:turn]):
                path = Path(folder, f"{number}-{arm.name}.h5")
                reads = {"nothing": None, "the run": path, "another": another}[arm.reads]
                seconds, count = _run_once(path, reads)
                took[arm.name].append(seconds)
                if arm.reads == "the run":
                    readings, fields = readings + count[0], fields + count[1]
            print(f"round {number + 1} of {rounds}", file=sys.stderr)
    report: dict[str, Any] = {"rounds": rounds, "load": os.getloadavg()[0]}
    report |= {"readings": readings, "fields_read": fields, "checksum_ms": checksum_ms()}
    for index, name in enumerate(("seconds", "cpu_seconds")):
        columns = {arm: [one[index] for one in runs] for arm, runs in took.items()}
        report[name] = {arm: statistics.median(column) for arm, column in columns.items()}
        ratios = {
            f"{one}/{other}": [a / b for a, b in zip(columns[one], columns[other], strict=True)]
            for one, other in _RATIOS
        }
        ratios["alone/alone before"] = [b / a for a, b in pairwise(columns["alone"])]
        report[name]["ratios"] = {key: _quartiles(found) for key, found in ratios.items()}
        median = report[name]["ratios"]["watched/busy"][1]
        report[name]["met"] = median < 1 + _LIMIT
    return report


def checksum_ms() -> dict[str, float]:
    """Milliseconds of a step's checksum of pixels."""
    rng, taken = np.random.default_rng(0), {}
    for name, (shape, dtype) in _PIXELS.items():
        pixels: np.ndarray[Any, Any] = rng.integers(0, 4096, shape).astype(dtype)
        times = []
        for _ in range(20):
            start_s = time.perf_counter()
            pixel_checksum(pixels)
            times.append(time.perf_counter() - start_s)
        taken[name] = 1e3 * statistics.median(times)
    return taken


def _quartiles(values: Sequence[float]) -> list[float]:
    """Lower quartile, median and upper quartile."""
    return [float(q) for q in np.quantile(values, (0.25, 0.5, 0.75))] if values else []


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="How much a reader slows a run in work.")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    report = benchmark(arguments.rounds)
    if arguments.json:
        print(json.dumps(report, indent=2))
        return
    for key, words in (("seconds", "time"), ("cpu_seconds", "processor time")):
        found = report[key]
        print(
            f"{words} of a step: "
            + ", ".join(f"{1e3 * found[arm.name]:.2f} ms {arm.name}" for arm in _ARMS)
            + f"; watched over busy below {1 + _LIMIT:.2f}: {'met' if found['met'] else 'missed'}"
        )
        for name, ratios in found["ratios"].items():
            if ratios:
                low, median, high = ratios
                print(f"  {name}: median {median:.4f}, quartiles {low:.4f} to {high:.4f}")
    sizes = ", ".join(
        f"{name} of {np.prod(shape) * np.dtype(dtype).itemsize / 1e6:.1f} MB "
        f"{report['checksum_ms'][name]:.1f} ms"
        for name, (shape, dtype) in _PIXELS.items()
    )
    print(
        f"{report['readings']} readings of {report['fields_read']} fields; load "
        f"{report['load']:.1f}; checksum of a {sizes}"
    )


if __name__ == "__main__":
    main()
