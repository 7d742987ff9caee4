"""Populations of reeds: time, memory, and what comes back of the components.

Reeds are drawn from N(0, 1) (hypothesis H4; those outside physics in either series, 2 % of them,
are drawn again), their modes have the moduli of their own frequencies, and the sweep sees each at
the nearest picture of its 25-cent grid.

    python -m benchmarks.populations [--kind REED] [--reeds N] [--workers N] [--basis-reeds N]
                                     [--json]

* 55 reeds × 2 series, fitted at once.
* A stream of a million reeds, with the paper's Eq. 1 and with polynomials that follow the finite
  elements: reeds per second and peak memory, beside scipy's least squares reed by reed. The stream
  repeats the same 65 536 reeds, so that making them takes no part of the time.
* Recovery of e1…e4 on 1000 reeds whose modes are those of the metamodel.
* How far the polynomials are from the reduced basis, and the recovery on reeds whose modes are
  those of the basis: by name, crossings and all.
"""

import argparse
import json
import os
import resource
import statistics
import sys
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

from fitting.cane.reed_fit import COMPONENTS
from fitting.forward import (
    basis_of,
    cents_of,
    hz_of,
)
from fitting.paper.constants import adjusted_metamodel
from fitting.populations.flags import count_flags
from fitting.populations.population import fit_population, fit_stream
from holography.arrays import Array
from physics.reed.basis import ReducedReed
from physics.reed.geometry import ReedGeometry
from physics.reed.log_polynomial import LogPolynomial, finite_element_polynomial
from physics.reed.metamodel import Metamodel
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.response import viscoelastic_mode
from physics.reed.viscoelastic import (
    Components,
    Series,
    h4_matrix,
    storage_modulus,
    viscoelastic_cane,
)
from protocols.reed import DEFAULT_REED, ReedFile

SMALL_S, REEDS_PER_S, GROWTH = 1.0, 50_000.0, 1.05
RMS_SD, COVERAGE = 0.12, (0.62, 0.74)
# What no unbiased estimate can beat at 25 cents, from the research on identifiability.
CRAMER_RAO_SD = (0.05, 0.07, 0.08, 0.11)
PICTURE_CENTS, PICTURES = 25.0, 184
ERROR_CENTS = PICTURE_CENTS / np.sqrt(12)
CHUNK, CHUNKS = 8192, 8
PEER_REEDS, RECOVERED_REEDS, SMALL_REEDS, ROUNDS = 50, 1000, 55, 5
PROCESSES = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
# Each pass gains a factor of about 5.
PASSES = 20


# --- Reeds -------------------------------------------------------------------------------------


def draw_canes(rng: np.random.Generator, count: int) -> Array:
    """Components (count, 4); draws with a spring that is not positive are drawn again."""
    kept: list[Array] = []
    while sum(map(len, kept)) < count:
        drawn = rng.standard_normal((count, 4))
        springs = np.stack([_zener(drawn, series)[:, [0, 1, 3, 4]] for series in Series])
        kept.append(drawn[(springs > 0).all(axis=(0, 2))])
    return np.concatenate(kept)[:count]


def _zener(components: Array, series: Series) -> Array:
    """E1, E2, E3, G1, G2, G3, (n, 6)."""
    return np.column_stack([np.ones(len(components)), components]) @ h4_matrix(series).T


def population_cents(components: Array, metamodel: Metamodel) -> Array:
    """Cents (n, 2, m) of a population, each mode with the moduli of its own frequency."""
    cents = np.full((len(components), len(Series), len(metamodel.modes)), 2400.0)
    for column, series in enumerate(Series):
        E1, E2, E3, G1, G2, G3 = _zener(components, series).T[..., None]
        for _ in range(PASSES):
            hz = hz_of(cents[:, column])
            E, G = storage_modulus(E1, E2, E3, hz), storage_modulus(G1, G2, G3, hz)
            cents[:, column] = metamodel.evaluate(1e6 * E.value_mpa, 1e6 * G.value_mpa)[0]
    return cents


def pictures(cents: Array) -> Array:
    """Resonances where the sweep sees them; NaN for those beyond its ends."""
    k = np.round(cents / PICTURE_CENTS)
    return np.where((k >= 1) & (k <= PICTURES), PICTURE_CENTS * k, np.nan)


# --- Time and memory ---------------------------------------------------------------------------


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
    """Yield chunks over and over until there are so many reeds."""
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


# --- Recovery ----------------------------------------------------------------------------------


def recovery(canes: Array, observed: Array, metamodel: Metamodel) -> dict[str, Any]:
    """How far fits lie from the truth, in standard deviations of the population."""
    fit = fit_population(observed, ERROR_CENTS, metamodel)
    missed = fit.components - canes
    rms, covered = np.sqrt(np.mean(missed**2, axis=0)), np.mean(np.abs(missed) < fit.errors, axis=0)
    return {
        "reeds": len(canes),
        "resonances": int(fit.used.sum()),
        "rms_sd": _by_component(rms),
        "robust_sd": _by_component(1.4826 * np.median(np.abs(missed), axis=0)),
        "median_error": _by_component(np.median(fit.errors, axis=0)),
        "coverage": _by_component(covered),
        "mean_reduced_chi2": float(np.mean(fit.reduced_chi2)),
        "flags": count_flags(fit.flags),
        "rms_met": bool((rms <= RMS_SD).all()),
        "coverage_met": bool(((covered >= COVERAGE[0]) & (covered <= COVERAGE[1])).all()),
    }


def _by_component(values: Array) -> dict[str, float]:
    return dict(zip(COMPONENTS, map(float, values), strict=True))


# --- The basis itself --------------------------------------------------------------------------


def basis_cents(reed: ReducedReed, canes: Array, starts: Array) -> Array:
    """Cents (n, 2, m) by name from the reduced basis, NaN where a name does not settle."""
    cents = np.full(starts.shape, np.nan)
    for n, column, m in np.ndindex(*starts.shape):
        series = list(Series)[column]
        cane = viscoelastic_cane(Components(*map(float, canes[n])), series)
        start_hz = float(hz_of(starts[n, column, m]))
        try:
            mode = viscoelastic_mode(reed, cane, PAPER_MODES[m], start_hz)
        except ValueError:
            continue
        cents[n, column, m] = cents_of(mode.frequency_hz)
    return cents


def against_basis(reed: ReducedReed, polynomial: LogPolynomial, reeds: int) -> dict[str, Any]:
    """Accuracy of the polynomials, and recovery of reeds of the basis."""
    canes = draw_canes(np.random.default_rng(4), reeds)
    predicted = population_cents(canes, polynomial)
    true = basis_cents(reed, canes, predicted)
    deviation = np.abs(predicted - true)
    by_mode = {
        name: {
            "median_cents": float(np.nanmedian(deviation[..., m])),
            "p95_cents": float(np.nanpercentile(deviation[..., m], 95)),
            "largest_cents": float(np.nanmax(deviation[..., m])),
            "without_settled_name": int(np.isnan(deviation[..., m]).sum()),
        }
        for m, name in enumerate(PAPER_MODES)
    }
    seen = pictures(true)
    left_out = fit_population(seen, ERROR_CENTS, polynomial).left_out
    for name, share in zip(polynomial.modes, left_out.mean(axis=(0, 1)), strict=True):
        by_mode[name]["left_out"] = float(share)
    return {
        "modes": by_mode,
        "followed": recovery(canes, seen, polynomial),
        "straight_through": recovery(canes, seen, replace(polynomial, cells=None)),
    }


# --- All of it ---------------------------------------------------------------------------------


def benchmark(kind: ReedFile, reeds: int, workers: int, basis_reeds: int) -> dict[str, Any]:
    """Measure everything; the result is what ``--json`` prints."""
    load_before = os.getloadavg()[0]
    reed = basis_of(kind, lambda what: print(what, file=sys.stderr))
    polynomial = finite_element_polynomial(reed)
    metamodels: dict[str, Metamodel] = {"finite elements": polynomial}
    if kind.geometry() == ReedGeometry():
        metamodels = {"paper": adjusted_metamodel(PAPER_MODES), **metamodels}
    canes = draw_canes(np.random.default_rng(5), RECOVERED_REEDS)
    return {
        "reed": kind.name,
        "workers": workers,
        "load_before": load_before,
        "metamodels": {
            name: _benchmark_one(metamodel, canes, reeds, workers)
            for name, metamodel in metamodels.items()
        },
        "against_basis": against_basis(reed, polynomial, basis_reeds) if basis_reeds else None,
    }


def _benchmark_one(metamodel: Metamodel, canes: Array, reeds: int, workers: int) -> dict[str, Any]:
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
        "recovery": recovery(canes, pictures(population_cents(canes, metamodel)), metamodel),
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    workers, load = report["workers"], report["load_before"]
    print(f"{report['reed']}, {workers} workers, load average before {load:.1f}")
    for name, row in report["metamodels"].items():
        print(f"\n{name}")
        _print_times(row)
        _print_recovery(row["recovery"])
        _print_claims(row["recovery"])
    if report["against_basis"]:
        _print_basis(report["against_basis"])


def _verdict(met: bool) -> str:
    return "met" if met else "missed"


def _print_times(row: dict[str, Any]) -> None:
    print(
        f"{SMALL_REEDS} reeds x 2 series: {1e3 * row['small_s']:.0f} ms "
        f"(up to {SMALL_S:g} s: {_verdict(row['small_met'])})"
    )
    for stream in row["streams"]:
        print(
            f"stream of {stream['reeds']} reeds: {stream['reeds_per_s']:.0f} reeds/s, "
            f"{stream['reeds_per_cpu_s']:.0f} per second of a processor, "
            f"peak {stream['peak_mib']:.0f} MiB, flags {stream['flags'] or 'none'}"
        )
    print(f"at least {REEDS_PER_S:.0f} reeds/s with errors: {_verdict(row['speed_met'])}")
    print(f"same memory for ten times the reeds: {_verdict(row['memory_met'])}")
    peer = row["peer"]
    print(
        f"scipy reed by reed: {peer['scipy_reeds_per_s']:.0f} reeds/s, ours on the same "
        f"{peer['reeds']} reeds, one process: {peer['ours_reeds_per_s']:.0f}; they differ by "
        f"{peer['largest_difference_in_errors']:.4f} standard errors at most"
    )


def _print_recovery(row: dict[str, Any]) -> None:
    print(f"recovery on {row['reeds']} reeds, {row['resonances']} resonances")
    print(f"{'':4}{'rms SD':>8}{'robust':>8}{'error':>8}{'bound':>8}{'coverage':>10}")
    for name, bound in zip(COMPONENTS, CRAMER_RAO_SD, strict=True):
        print(
            f"{name:4}{row['rms_sd'][name]:8.3f}{row['robust_sd'][name]:8.3f}"
            f"{row['median_error'][name]:8.3f}{bound:8.2f}{row['coverage'][name]:10.1%}"
        )
    print(f"mean reduced chi2 {row['mean_reduced_chi2']:.2f}, flags {row['flags'] or 'none'}")


def _print_claims(row: dict[str, Any]) -> None:
    for claim, met in (
        (f"rms error up to {RMS_SD} SD", row["rms_met"]),
        (f"coverage {COVERAGE[0]:.0%} to {COVERAGE[1]:.0%}", row["coverage_met"]),
    ):
        print(f"{claim}, each component: {_verdict(met)}")


def _print_basis(row: dict[str, Any]) -> None:
    print("\npolynomials less reduced basis, cents")
    print(f"{'mode':5}{'median':>8}{'95 %':>8}{'largest':>9}{'unsettled':>11}{'left out':>10}")
    for name, mode in row["modes"].items():
        print(
            f"{name:5}{mode['median_cents']:8.2f}{mode['p95_cents']:8.1f}"
            f"{mode['largest_cents']:9.1f}{mode['without_settled_name']:11d}"
            f"{mode['left_out']:10.1%}"
        )
    print("\nreeds of the basis; modes that the polynomials do not follow are left out of fits")
    _print_recovery(row["followed"])
    _print_claims(row["followed"])
    print("\nthe same if none were left out")
    _print_recovery(row["straight_through"])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Time, memory and recovery of populations.")
    parser.add_argument("--reeds", type=int, default=1_000_000, help="length of the stream")
    parser.add_argument("--workers", type=int, default=2, help="processes that share the stream")
    parser.add_argument("--basis-reeds", type=int, default=1000, help="0 leaves them out")
    parser.add_argument("--kind", default=DEFAULT_REED, help="reed file, or a shipped reed's name")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    kind = ReedFile.from_file(arguments.kind)
    report = benchmark(kind, arguments.reeds, arguments.workers, arguments.basis_reeds)
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
