"""Microseconds in which the reduced reed solves one reed, with all derivatives.

Each contestant answers for one reed after another, in turn with the others, on one thread. "modes"
is every mode below 24 kHz of a reed of viscoelastic cane, each with the moduli of its own
frequency, thicker than the drawing by 2 µm, clamp rigid. "derivatives" are those of all these
frequencies by the 9 elastic constants, density, two growths, air, thickness and clamp compliance.
The limits are LAPACK's eigenproblem of the same size, once per symmetry, and one reed by finite
elements. `studies.reduced_basis` prints how exact the reduced reed is, and its time to build.

    OMP_NUM_THREADS=1 python -m benchmarks.reduced_basis [--reed NAME] [--rounds N] [--json]
"""

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from fitting.forward import basis_of
from holography.arrays import Array, ComplexArray
from physics.air import pressure_shape
from physics.parameters.chamber import Chamber
from physics.reed.cane.material import stiffness_terms_pa
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.elements.mesh import STANDARD
from physics.reed.modes import reed_modes
from physics.reed.reduced.changes import layer, yielding_clamp
from physics.reed.reduced.derivatives import derivatives
from physics.reed.reduced.dynamics import CaneLaw, State
from physics.reed.reduced.elastic import reduced_modes
from physics.reed.reduced.reed import ReducedReed
from physics.reed.reduced.response import pressure_force, pressure_forces
from physics.reed.reduced.vibrations import vibrations
from protocols.reed import DEFAULT_REED, ReedFile

AIM_US, OVER_FLOOR = 100.0, 1.5
FLOOR, SOLVED, EVERYTHING = "LAPACK eigh of this size", "modes", "modes and derivatives"
HIGHEST_HZ, FEWEST_ROUNDS = 24e3, 9


def contestants(reed: ReducedReed) -> dict[str, Callable[[int], object]]:
    """What is timed; each takes the number of the round, so that nothing can be remembered."""
    cane = viscoelastic_cane(Components(), Series.A)
    unit = layer(reed, lambda x, _y: np.ones_like(x))
    thicker = layer(reed, lambda x, _y: np.full(x.shape, 2e-6))
    changes = unit, yielding_clamp(reed, 1.0, 1.0)
    terms = stiffness_terms_pa(reed.cane)
    chamber = Chamber()

    def pressure(hz: float, x: Array, y: Array) -> ComplexArray:
        return pressure_shape(chamber, hz, x, y).astype(complex)

    projected = pressure_force(reed, pressure)

    def state(number: int) -> State:
        return State(CaneLaw(reed.cane, cane, log_E_L=1e-3 * (number % 50)), thicker)

    return {
        FLOOR: lambda _: [reduced_modes(part, terms, 520.0) for part in reed.parts.values()],
        SOLVED: lambda number: vibrations(reed, state(number), HIGHEST_HZ),
        EVERYTHING: lambda number: derivatives(
            vibrations(reed, state(number), HIGHEST_HZ), changes
        ),
        "force by polynomials": lambda number: projected.at(1e3 + number),
        "force projected": lambda number: pressure_forces(reed, 1e3 + number, pressure),
    }


def time_rounds(reed: ReducedReed, rounds: int) -> dict[str, dict[str, float]]:
    """Microseconds per reed; the contestants take turns."""
    tasks = contestants(reed)
    taken: dict[str, list[float]] = {name: [] for name in tasks}
    for number in range(rounds):
        for name, task in tasks.items():
            start_s = time.perf_counter()
            task(number)
            taken[name].append(1e6 * (time.perf_counter() - start_s))
    return {
        name: {"median_us": statistics.median(times), "fastest_us": min(times)}
        for name, times in taken.items()
    }


def benchmark(reed: ReedFile, rounds: int) -> dict[str, Any]:
    """Time everything; the result is what ``--json`` prints."""
    model = basis_of(reed, lambda what: print(what, file=sys.stderr))
    load = os.getloadavg()[0]
    speed = time_rounds(model, rounds)
    start_s = time.perf_counter()
    reed_modes(reed.geometry(), reed.cane(), STANDARD)
    return {
        "reed": reed.name,
        "omp_num_threads": os.environ.get("OMP_NUM_THREADS", "not set"),
        "coordinates": {str(key): part.held for key, part in model.parts.items()},
        "fem_s": time.perf_counter() - start_s,
        "load_before_timing": load,
        "per_reed": speed,
        "over_floor": speed[EVERYTHING]["median_us"] / speed[FLOOR]["median_us"],
        "aim_met": speed[EVERYTHING]["median_us"] <= AIM_US,
        "versions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    print(
        f"{report['reed']}: coordinates {report['coordinates']}, OMP_NUM_THREADS "
        f"{report['omp_num_threads']}, load average before {report['load_before_timing']:.1f}"
    )
    for name, row in report["per_reed"].items():
        print(f"{name:26} median {row['median_us']:8.0f} µs  fastest {row['fastest_us']:8.0f} µs")
    print(f"{'finite elements':26}        {1e6 * report['fem_s']:8.0f} µs")
    everything = report["per_reed"][EVERYTHING]["median_us"]
    met = "met" if report["aim_met"] else "missed"
    print(f"{AIM_US:g} µs for modes and derivatives: {met} ({everything:.0f} µs)")
    met = "met" if report["over_floor"] <= OVER_FLOOR else "missed"
    print(f"{OVER_FLOOR:g} times LAPACK's eigh: {met} ({report['over_floor']:.2f} times)")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Time of a reduced reed.")
    parser.add_argument("--reed", default=DEFAULT_REED, help="reed file, or a shipped reed's name")
    parser.add_argument("--rounds", type=int, default=99, help="rounds of timing, at least 9")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    reed = ReedFile.from_file(arguments.reed)
    report = benchmark(reed, max(arguments.rounds, FEWEST_ROUNDS))
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
