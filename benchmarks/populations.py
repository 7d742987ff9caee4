"""Time and memory of fits of populations of reeds, which `studies.populations` draws.

    python -m benchmarks.populations [--kind REED] [--reeds N] [--workers N] [--json]

* 55 reeds × 2 series, fitted at once.
* A stream of a million reeds, with the paper's Eq. 1 and with polynomials that follow the finite
  elements: reeds per second and peak memory, compared with scipy's least squares reed by reed. The
  stream repeats the same 65 536 reeds, so that drawing them takes none of the time.
"""

import argparse
import json
import os
import resource
import statistics
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import cycle
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from fitting.populations.flags import count_flags
from fitting.populations.population import fit_population, fit_stream
from physics.reed.reduction.log_polynomial import LogPolynomial, finite_element_polynomial
from physics.reed.reduction.metamodel import Metamodel
from protocols.reed import DEFAULT_REED, ReedFile
from studies.populations import (
    ERROR_CENTS,
    Array,
    draw_canes,
    metamodels_of,
    pictures,
    population_cents,
    reduced_reed,
    verdict,
)

SMALL_S, REEDS_PER_S, GROWTH = 1.0, 50_000.0, 1.05
CHUNK, CHUNKS = 8192, 8
PEER_REEDS, SMALL_REEDS, ROUNDS = 50, 55, 5
PROCESSES = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)


def time_small(metamodel: Metamodel) -> float:
    """Median seconds for the number of reeds of the paper, both series."""
    canes = draw_canes(np.random.default_rng(1), SMALL_REEDS)
    observed, taken_s = pictures(population_cents(canes, metamodel)), []
    for _ in range(ROUNDS):
        start_s = time.perf_counter()
        fit_population(observed, ERROR_CENTS, metamodel)
        taken_s.append(time.perf_counter() - start_s)
    return statistics.median(taken_s)


@dataclass(frozen=True)
class Stream:
    """One pass through a stream: time on the wall and of all processors, the start included."""

    reeds: int
    seconds: float
    cpu_s: float
    peak_mib: float
    flags: dict[str, int]


def run_stream(metamodel: Metamodel, chunks: Sequence[Array], reeds: int, workers: int) -> Stream:
    """Fit a stream, and say what memory each of its processes had at most, together."""
    flags: Counter[str] = Counter()
    peak_mib: dict[int, float] = {}
    start_s, start_cpu_s = time.perf_counter(), _cpu_s()
    for fit in fit_stream(_repeated(chunks, reeds), ERROR_CENTS, metamodel, workers):
        flags.update(count_flags(fit.flags))
        # The workers are gone once the stream has ended.
        for pid in (os.getpid(), *(worker.pid for worker in active_children() if worker.pid)):
            peak_mib[pid] = _peak_mib(pid)
    taken_s, cpu_s = time.perf_counter() - start_s, _cpu_s() - start_cpu_s
    return Stream(reeds, taken_s, cpu_s, sum(peak_mib.values()), dict(flags))


def _peak_mib(pid: int) -> float:
    """Largest resident memory that a process has had; Linux.

    What `resource` says includes the memory of the program that started it.
    """
    status = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in status if line.startswith("VmHWM:")) / 1024


def _cpu_s() -> float:
    """Time that this process and those that it started and outlived took of the processors."""
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, PROCESSES))


def _repeated(chunks: Sequence[Array], reeds: int) -> Iterator[Array]:
    """Yield chunks over and over until there are enough reeds."""
    for chunk in cycle(chunks):
        yield chunk[:reeds]
        reeds -= len(chunk)
        if reeds <= 0:
            return


def stream_alone(metamodel: Metamodel, reeds: int, workers: int) -> Stream:
    """Run a stream in a process of its own, whose peak memory is the stream's."""
    canes = draw_canes(np.random.default_rng(2), CHUNK * CHUNKS)
    chunks = [pictures(population_cents(part, metamodel)) for part in np.array_split(canes, CHUNKS)]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
        return alone.submit(run_stream, metamodel, chunks, reeds, workers).result()


def time_scipy(metamodel: Metamodel) -> dict[str, float]:
    """Fit reeds one by one with scipy, in this process, and compare; all modes count in both."""
    if isinstance(metamodel, LogPolynomial):
        metamodel = replace(metamodel, cells=None)
    canes = draw_canes(np.random.default_rng(3), PEER_REEDS)
    observed = pictures(population_cents(canes, metamodel))

    def weighted(components: Array, seen: Array) -> Array:
        residual = seen - population_cents(components[None], metamodel)[0]
        return np.asarray((residual / ERROR_CENTS)[~np.isnan(seen)])

    start_s = time.perf_counter()
    found = [least_squares(weighted, np.zeros(4), args=(seen,)).x for seen in observed]
    scipy_s = time.perf_counter() - start_s
    start_s = time.perf_counter()
    fit = fit_population(observed, ERROR_CENTS, metamodel)
    ours_s = time.perf_counter() - start_s
    return {
        "reeds": PEER_REEDS,
        "scipy_reeds_per_s": PEER_REEDS / scipy_s,
        "ours_reeds_per_s": PEER_REEDS / ours_s,
        "largest_difference_in_errors": float(np.max(np.abs(found - fit.components) / fit.errors)),
    }


def benchmark(kind: ReedFile, reeds: int, workers: int) -> dict[str, Any]:
    """Measure everything; the result is what ``--json`` prints."""
    load_before = os.getloadavg()[0]
    metamodels = metamodels_of(kind, finite_element_polynomial(reduced_reed(kind)))
    return {
        "reed": kind.name,
        "workers": workers,
        "load_before": load_before,
        "metamodels": {
            name: _benchmark_one(metamodel, reeds, workers)
            for name, metamodel in metamodels.items()
        },
    }


def _benchmark_one(metamodel: Metamodel, reeds: int, workers: int) -> dict[str, Any]:
    short, long = (stream_alone(metamodel, n, workers) for n in (max(reeds // 10, 1), reeds))
    small_s = time_small(metamodel)
    growth = long.peak_mib / short.peak_mib
    return {
        "small_s": small_s,
        "small_met": small_s <= SMALL_S,
        "streams": [
            asdict(stream)
            | {
                "reeds_per_s": stream.reeds / stream.seconds,
                "reeds_per_cpu_s": stream.reeds / stream.cpu_s,
            }
            for stream in (short, long)
        ],
        "speed_met": long.reeds / long.seconds >= REEDS_PER_S,
        "memory_met": growth <= GROWTH,
        "peer": time_scipy(metamodel),
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    workers, load = report["workers"], report["load_before"]
    print(f"{report['reed']}, {workers} workers, load average before {load:.1f}")
    for name, row in report["metamodels"].items():
        print(f"\n{name}")
        _print_times(row)


def _print_times(row: dict[str, Any]) -> None:
    print(
        f"{SMALL_REEDS} reeds x 2 series: {1e3 * row['small_s']:.0f} ms "
        f"(up to {SMALL_S:g} s: {verdict(row['small_met'])})"
    )
    for stream in row["streams"]:
        print(
            f"stream of {stream['reeds']} reeds: {stream['reeds_per_s']:.0f} reeds/s, "
            f"{stream['reeds_per_cpu_s']:.0f} per second of a processor, "
            f"peak {stream['peak_mib']:.0f} MiB, flags {stream['flags'] or 'none'}"
        )
    print(f"at least {REEDS_PER_S:.0f} reeds/s with errors: {verdict(row['speed_met'])}")
    print(f"same memory for ten times the reeds: {verdict(row['memory_met'])}")
    peer = row["peer"]
    print(
        f"scipy reed by reed: {peer['scipy_reeds_per_s']:.0f} reeds/s, ours on the same "
        f"{peer['reeds']} reeds, one process: {peer['ours_reeds_per_s']:.0f}; they differ by "
        f"{peer['largest_difference_in_errors']:.4f} standard errors at most"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Time and memory of populations.")
    parser.add_argument("--reeds", type=int, default=1_000_000, help="length of the stream")
    parser.add_argument("--workers", type=int, default=2, help="processes that share the stream")
    parser.add_argument("--kind", default=DEFAULT_REED, help="reed file, or a shipped reed's name")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    kind = ReedFile.from_file(arguments.kind)
    report = benchmark(kind, arguments.reeds, arguments.workers)
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
