"""Time to build the basis over materials, and microseconds for each reed that it solves.

Speed is measured next to that of the finite elements and of the paper's Eq. 1, all in this process.
`studies.reduced_basis` prints how far the basis lies from the finite elements.

    OMP_NUM_THREADS=1 python -m benchmarks.reduced_basis
        [--reed NAME] [--rounds N] [--fast] [--json]
"""

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import astuple
from typing import Any

import numpy as np
import scipy

from fitting.paper.constants import adjusted_metamodel
from physics.reed.elements.mesh import MeshLevel
from physics.reed.material_range.basis import MaterialBasis, modes
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduction.cache import FAST, STANDARD
from protocols.reed import DEFAULT_REED, ReedFile
from studies.reduced_basis import build, random_inputs, solved_modes

BUILD_S, PER_REED_US = 60.0, 200.0
FEWEST_ROUNDS, TIMED_REEDS, SOLVED_REEDS = 5, 2000, 10


def time_rounds(basis: MaterialBasis, rounds: int) -> dict[str, dict[str, float]]:
    """Microseconds per reed; the contestants take turns."""
    constants, density, offset_m = random_inputs(basis, TIMED_REEDS, seed=1)
    eq1 = adjusted_metamodel(PAPER_MODES)
    E, G = (np.repeat(constants[:, [i]], len(eq1.modes), axis=1) for i in (0, 3))

    def ours(threads: int, *, slopes: bool) -> Callable[[], object]:
        return lambda: modes(basis, constants, density, offset_m, slopes=slopes, threads=threads)

    contestants: dict[str, Callable[[], object]] = {
        "2 threads, slopes": ours(2, slopes=True),
        "1 thread, slopes": ours(1, slopes=True),
        "2 threads": ours(2, slopes=False),
        "1 thread": ours(1, slopes=False),
        "Eq. 1, 2 slopes, 11 modes": lambda: eq1.evaluate(E, G),
    }
    taken: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, task in contestants.items():
            start_s = time.perf_counter()
            task()
            taken[name].append(1e6 * (time.perf_counter() - start_s) / TIMED_REEDS)
    return {
        name: {"median_us": statistics.median(times), "fastest_us": min(times)}
        for name, times in taken.items()
    }


def time_finite_elements(basis: MaterialBasis, level: MeshLevel) -> float:
    """Median seconds of one reed by finite elements."""
    taken_s = []
    for row in zip(*random_inputs(basis, SOLVED_REEDS, seed=2), strict=True):
        start_s = time.perf_counter()
        solved_modes(basis, level, *row)
        taken_s.append(time.perf_counter() - start_s)
    return statistics.median(taken_s)


def timed_build(reed: ReedFile, level: MeshLevel) -> tuple[MaterialBasis, dict[str, float]]:
    """Build a basis and measure the time."""
    load, wall_s, cpu_s = os.getloadavg()[0], time.perf_counter(), time.process_time()
    basis = build(reed, level)
    return basis, {
        "wall_s": time.perf_counter() - wall_s,
        "cpu_s": time.process_time() - cpu_s,
        "load_before": load,
    }


def benchmark(reed: ReedFile, level: MeshLevel, rounds: int) -> dict[str, Any]:
    """Build and time; the result is what ``--json`` prints."""
    basis, built = timed_build(reed, level)
    load = os.getloadavg()[0]
    speed = time_rounds(basis, rounds)
    return {
        "reed": reed.name,
        "level": astuple(level),
        "omp_num_threads": os.environ.get("OMP_NUM_THREADS", "not set"),
        "build": built,
        "fem_median_s": time_finite_elements(basis, level),
        "load_before_timing": load,
        "per_reed": speed,
        "build_met": built["wall_s"] <= BUILD_S,
        "speed_met": speed["2 threads, slopes"]["median_us"] <= PER_REED_US,
        "versions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    built = report["build"]
    print(
        f"{report['reed']}: built in {built['wall_s']:.1f} s ({built['cpu_s']:.1f} s of processor, "
        f"load average before {built['load_before']:.1f}), "
        f"OMP_NUM_THREADS {report['omp_num_threads']}"
    )
    print(f"microseconds a reed, load average before {report['load_before_timing']:.1f}")
    for contestant, row in report["per_reed"].items():
        print(f"{contestant:26} median {row['median_us']:8.1f} fastest {row['fastest_us']:8.1f}")
    print(f"{'finite elements (eigsh)':26} median {1e6 * report['fem_median_s']:8.0f}")
    claims = {
        f"built in {BUILD_S:g} s": ("build_met", f"{built['wall_s']:.1f} s"),
        f"{PER_REED_US:g} µs a reed with slopes on 2 threads": (
            "speed_met",
            f"{report['per_reed']['2 threads, slopes']['median_us']:.0f} µs",
        ),
    }
    for claim, (key, figure) in claims.items():
        print(f"{claim}: {'met' if report[key] else 'missed'} ({figure})")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Time of a basis over materials.")
    parser.add_argument("--reed", default=DEFAULT_REED, help="reed file, or a shipped reed's name")
    parser.add_argument("--rounds", type=int, default=9, help="rounds of timing, at least 5")
    parser.add_argument("--fast", action="store_true", help="on the fast mesh")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    level = FAST if arguments.fast else STANDARD
    reed = ReedFile.from_file(arguments.reed)
    report = benchmark(reed, level, max(arguments.rounds, FEWEST_ROUNDS))
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
