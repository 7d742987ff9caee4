"""The basis over materials: what it costs, what it saves and how far it is from its own FEM.

A basis is built anew, then asked for reeds that it has never seen: half of them anywhere in its
box, half at corners of it, thickness offsets anywhere. Every one of them is also solved by finite
elements, on the same mesh, and named by what its modes look like. Speed is measured beside the
finite elements' and that of the paper's Eq. 1, all in this process.

    OMP_NUM_THREADS=1 python -m benchmarks.reduced_basis
        [--reed NAME] [--reeds N] [--rounds N] [--fast] [--json]
"""

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
from scipy.optimize import linear_sum_assignment

from fitting.paper.constants import adjusted_metamodel
from physics.reed.cache import FAST, STANDARD
from physics.reed.material import Cane
from physics.reed.material_basis import MaterialBasis, modes
from physics.reed.material_constants import CONSTANTS
from physics.reed.material_snapshots import TrainingSettings
from physics.reed.material_training import build_material_basis
from physics.reed.mesh import MeshLevel
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.modes import NamedMode, reed_modes
from protocols.reed import DEFAULT_REED, ReedFile

Array = npt.NDArray[np.float64]

BUILD_S, ERROR_CENTS, PER_REED_US = 60.0, 3.0, 200.0
HIGHEST_HZ = 20e3
# Named beyond the limit: what the basis puts just below it may lie just above it.
SOLVED_HZ = 1.02 * HIGHEST_HZ
DENSITY_KG_M3 = (420.0, 620.0)
# A name that is borne out by less than this is shared with another mode.
CLEAR = 0.75
FEWEST_REEDS, FEWEST_ROUNDS, TIMED_REEDS = 30, 5, 2000


@dataclass(frozen=True)
class Comparison:
    """One reed by basis and by finite elements.

    Attributes
    ----------
    cents : dict
        Deviation per name, of modes below 20 kHz.
    clear : dict
        Whether the name is borne out by the shape.
    same_name : dict
        Whether the rules give the same name.
    solve_s : float
        Time of the finite elements.
    """

    cents: dict[str, float]
    clear: dict[str, bool]
    same_name: dict[str, bool]
    solve_s: float


def random_inputs(basis: MaterialBasis, count: int, seed: int) -> tuple[Array, Array, Array]:
    """Constants (n, 9), densities and thickness offsets (n,); every other reed at a corner."""
    rng = np.random.default_rng(seed)
    shares = rng.random((count, 10))
    shares[1::2, :9] = np.round(shares[1::2, :9])
    # Thickness ends the box in half of the corners; elsewhere it lies between the snapshots'.
    shares[1::4, 9] = np.round(shares[1::4, 9])
    low, high = np.asarray(astuple(basis.box)).T
    inputs = low + (high - low) * shares
    return inputs[:, :9], rng.uniform(*DENSITY_KG_M3, count), inputs[:, 9]


def compare(
    basis: MaterialBasis, level: MeshLevel, constants: Array, density: float, offset_m: float
) -> Comparison:
    """Solve one reed both ways."""
    start_s = time.perf_counter()
    whole_offset_m = basis.geometry.thickness_offset_m + offset_m
    reed = replace(basis.geometry, thickness_offset_m=float(whole_offset_m))
    elastic = dict(zip(CONSTANTS, constants.tolist(), strict=True))
    cane = replace(Cane(density_kg_m3=float(density)), **elastic)
    solved = reed_modes(reed, cane, level, SOLVED_HZ)
    solve_s = time.perf_counter() - start_s
    found = modes(basis, constants[None], density, offset_m, slopes=False)
    cents, clear, same = {}, {}, {}
    for symmetry, half in basis.halves.items():
        asked = [
            basis.names.index(name)
            for name in half.names
            if found.hz[0, basis.names.index(name)] < HIGHEST_HZ
        ]
        mine = [mode for mode in solved if mode.symmetry is symmetry]
        for m, mode, deviation in paired(found.hz[0], asked, mine):
            name = basis.names[m]
            cents[name], same[name] = deviation, mode.name == name
            clear[name] = bool(found.similarity[0, m] > CLEAR)
    return Comparison(cents, clear, same, solve_s)


def paired(
    hz: Array, asked: list[int], solved: list[NamedMode]
) -> list[tuple[int, NamedMode, float]]:
    """Each mode asked for, the one of the finite elements that it stands for, and the cents."""
    true_hz = np.array([mode.frequency_hz for mode in solved])
    cents = 1200 * np.log2(hz[asked][:, None] / true_hz)
    # One to one, and nothing gained by a mode that is far off anyway.
    rows, columns = linear_sum_assignment(np.minimum(np.abs(cents), 200.0))
    return [
        (asked[row], solved[column], float(cents[row, column]))
        for row, column in zip(rows, columns, strict=True)
    ]


def by_mode(names: tuple[str, ...], comparisons: list[Comparison]) -> dict[str, dict[str, float]]:
    """Errors in cents, and how often the rules give the same name."""
    table = {}
    for name in names:
        having = [c for c in comparisons if name in c.cents]
        errors = np.abs([c.cents[name] for c in having])
        clear = [c for c in having if c.clear[name]]
        table[name] = {
            "reeds": len(having),
            "max_cents": float(errors.max()),
            "p95_cents": float(np.percentile(errors, 95)),
            "rms_cents": float(np.sqrt(np.mean(errors**2))),
            "clear": len(clear) / len(having),
            "same_name": float(np.mean([c.same_name[name] for c in having])),
            "same_name_where_clear": float(np.mean([c.same_name[name] for c in clear])),
        }
    return table


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


def build(reed: ReedFile, level: MeshLevel) -> tuple[MaterialBasis, dict[str, float]]:
    """Build a basis and take the time."""
    load, wall_s, cpu_s = os.getloadavg()[0], time.perf_counter(), time.process_time()

    def show(share: float) -> None:
        print(f"\rbuilding {share:4.0%}", end="", file=sys.stderr, flush=True)

    settings = TrainingSettings(cane=reed.cane())
    basis = build_material_basis(reed.geometry(), level, settings, show)
    print(file=sys.stderr)
    return basis, {
        "wall_s": time.perf_counter() - wall_s,
        "cpu_s": time.process_time() - cpu_s,
        "load_before": load,
    }


def benchmark(reed: ReedFile, level: MeshLevel, reeds: int, rounds: int) -> dict[str, Any]:
    """Build, time and compare; the result is what ``--json`` prints."""
    basis, built = build(reed, level)
    load = os.getloadavg()[0]
    speed = time_rounds(basis, rounds)
    comparisons = []
    for number, row in enumerate(zip(*random_inputs(basis, reeds, seed=2), strict=True), 1):
        comparisons.append(compare(basis, level, *row))
        print(f"\rsolving {number}/{reeds}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    table = by_mode(basis.names, comparisons)
    worst = max(row["max_cents"] for row in table.values())
    typical = speed["2 threads, slopes"]["median_us"]
    return {
        "reed": reed.name,
        "level": astuple(level),
        "omp_num_threads": os.environ.get("OMP_NUM_THREADS", "not set"),
        "build": built,
        "halves": {
            str(symmetry): {
                "coordinates": half.components.shape[1],
                "with_mass": len(half.named_shapes),
                "components": len(half.components),
                "error_cents": half.error_cents,
            }
            for symmetry, half in basis.halves.items()
        },
        "reeds": reeds,
        "modes": table,
        "worst_cents": worst,
        "fem_median_s": statistics.median(c.solve_s for c in comparisons),
        "load_before_timing": load,
        "per_reed": speed,
        "build_met": built["wall_s"] <= BUILD_S,
        "error_met": worst <= ERROR_CENTS,
        "speed_met": typical <= PER_REED_US,
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
    for symmetry, row in report["halves"].items():
        print(
            f"{symmetry}: {row['coordinates']} coordinates, {row['with_mass']} with mass, "
            f"{row['components']} components, {row['error_cents']:.2f} cents in training"
        )
    print(f"{report['reeds']} reeds by finite elements, modes below {HIGHEST_HZ / 1e3:g} kHz")
    print(
        f"{'mode':5} {'reeds':>5} {'max cents':>10} {'p95':>5} {'rms':>5} "
        f"{'clear':>6} {'named alike':>12} {'where clear':>12}"
    )
    for name, row in report["modes"].items():
        print(
            f"{name:5} {row['reeds']:5} {row['max_cents']:10.2f} {row['p95_cents']:5.2f} "
            f"{row['rms_cents']:5.2f} {row['clear']:6.0%} {row['same_name']:12.0%} "
            f"{row['same_name_where_clear']:12.0%}"
        )
    print(f"microseconds a reed, load average before {report['load_before_timing']:.1f}")
    for contestant, row in report["per_reed"].items():
        print(f"{contestant:26} median {row['median_us']:8.1f} fastest {row['fastest_us']:8.1f}")
    print(f"{'finite elements (eigsh)':26} median {1e6 * report['fem_median_s']:8.0f}")
    told = {
        f"built in {BUILD_S:g} s": ("build_met", f"{built['wall_s']:.1f} s"),
        f"within {ERROR_CENTS:g} cents": ("error_met", f"{report['worst_cents']:.2f} cents"),
        f"{PER_REED_US:g} µs a reed with slopes on 2 threads": (
            "speed_met",
            f"{report['per_reed']['2 threads, slopes']['median_us']:.0f} µs",
        ),
    }
    for claim, (key, figure) in told.items():
        print(f"{claim}: {'met' if report[key] else 'missed'} ({figure})")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="A basis over materials against its own FEM.")
    parser.add_argument("--reed", default=DEFAULT_REED, help="reed file, or a shipped reed's name")
    parser.add_argument("--reeds", type=int, default=40, help="solved both ways, at least 30")
    parser.add_argument("--rounds", type=int, default=9, help="rounds of timing, at least 5")
    parser.add_argument("--fast", action="store_true", help="on the fast mesh")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    level = FAST if arguments.fast else STANDARD
    report = benchmark(
        ReedFile.from_file(arguments.reed),
        level,
        max(arguments.reeds, FEWEST_REEDS),
        max(arguments.rounds, FEWEST_ROUNDS),
    )
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
