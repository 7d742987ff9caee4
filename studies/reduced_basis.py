"""How far the reduced reed lies from the finite elements that it was built from.

It is asked for canes that it has never seen, half of them at corners of its box, the others
anywhere in it; each is also solved by finite elements on the same mesh. Then the reed is made
thicker and its clamp is moved, once to first order and once by a new mesh.
`benchmarks.reduced_basis` measures time.

    OMP_NUM_THREADS=1 python -m studies.reduced_basis [--reed NAME] [--canes N] [--fast] [--json]
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import astuple, replace
from typing import Any

import numpy as np
import scipy

from holography.arrays import Array
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.mesh import FAST, STANDARD, MeshLevel
from physics.reed.geometry import ReedGeometry
from physics.reed.modes import reed_modes
from physics.reed.reduced.build import build_reduced_reed
from physics.reed.reduced.changes import Change, layer, moved_clamp
from physics.reed.reduced.dynamics import CaneLaw, State
from physics.reed.reduced.elastic import reduced_modes
from physics.reed.reduced.reed import CONSTANTS, BasisSettings, ReducedReed, ReedBox
from physics.reed.reduced.vibrations import vibrations
from protocols.reed import DEFAULT_REED, ReedFile

ERROR_CENTS, BUILD_S = 3.0, 60.0
HIGHEST_HZ = 20e3
FEWEST_CANES, SEED = 12, 2
OFFSETS_UM = (-12.0, -7.0, -4.0, 4.0, 7.0, 12.0)
EDGES_MM = (-0.3, -0.1, 0.1, 0.3)


def random_canes(box: ReedBox, count: int) -> list[Cane]:
    """Canes of a box; every other one at a corner."""
    places = np.random.default_rng(SEED).random((count, len(CONSTANTS)))
    places[::2] = np.round(places[::2])
    return box.at(places)


def off_cents(reed: ReducedReed, level: MeshLevel, cane: Cane) -> Array:
    """Cents by which modes below 20 kHz lie above those of the finite elements, by number."""
    solved = reed_modes(reed.geometry, cane, level, 1.02 * HIGHEST_HZ)
    terms, found = stiffness_terms_pa(cane), []
    for key, part in reed.parts.items():
        true = [mode.frequency_hz for mode in solved if key in (None, mode.symmetry)]
        hz = reduced_modes(part, terms, cane.density_kg_m3)[0]
        below = np.array(true)[np.array(true) < HIGHEST_HZ]
        found.append(1200 * np.log2(hz[: len(below)] / below))
    return np.concatenate(found)


def accuracy(reed: ReducedReed, level: MeshLevel, count: int) -> dict[str, float]:
    """Errors over the box."""
    errors = []
    for number, cane in enumerate(random_canes(reed.box, count), 1):
        errors.append(off_cents(reed, level, cane))
        print(f"\rsolving {number}/{count}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    together = np.concatenate(errors)
    return {
        "canes": count,
        "modes": len(together),
        "largest_cents": float(together.max()),
        "least_cents": float(together.min()),
        "p95_cents": float(np.percentile(together, 95)),
        "rms_cents": float(np.sqrt(np.mean(together**2))),
    }


def first_order(reed: ReducedReed, level: MeshLevel) -> Iterator[dict[str, Any]]:
    """Compare changes to first order with new meshes, on the reference cane."""

    def thicker(um: float) -> tuple[ReedGeometry, Change]:
        drawn = replace(
            reed.geometry, thickness_offset_m=reed.geometry.thickness_offset_m + 1e-6 * um
        )
        return drawn, layer(reed, lambda x, _y: np.full(x.shape, 1e-6 * um))

    def clamped(mm: float) -> tuple[ReedGeometry, Change]:
        front, back = reed.geometry.clamp.x_m
        moved = replace(reed.geometry.clamp, x_m=(front + 1e-3 * mm, back))
        return replace(reed.geometry, clamp=moved), moved_clamp(reed, 1e-3 * mm)

    both: tuple[tuple[str, tuple[float, ...], Callable[[float], tuple[ReedGeometry, Change]]], ...]
    both = (("thickness_um", OFFSETS_UM, thicker), ("clamp_mm", EDGES_MM, clamped))
    start, _ = _solved_both_ways(reed, level, reed.geometry, Change())
    for kind, amounts, change_of in both:
        for amount in amounts:
            true, found = _solved_both_ways(reed, level, *change_of(amount))
            count = min(len(true), len(start))
            yield {
                "change": kind,
                "amount": amount,
                "largest_shift_cents": _largest_cents(true[:count], start[:count]),
                "largest_error_cents": _largest_cents(found[:count], true[:count]),
            }


def _solved_both_ways(
    reed: ReducedReed, level: MeshLevel, drawn: ReedGeometry, change: Change
) -> tuple[Array, Array]:
    true = [mode.frequency_hz for mode in reed_modes(drawn, reed.cane, level, HIGHEST_HZ)]
    state = State(CaneLaw(reed.cane), change)
    return np.array(true), vibrations(reed, state, 1.1 * HIGHEST_HZ).hz


def _largest_cents(one: Array, other: Array) -> float:
    return float(np.abs(1200 * np.log2(one / other)).max())


def timed_build(reed: ReedFile, level: MeshLevel) -> tuple[ReducedReed, dict[str, float]]:
    """Build a reduced reed, show progress and measure the time."""

    def show(fraction: float) -> None:
        print(f"\rbuilding {fraction:4.0%}", end="", file=sys.stderr, flush=True)

    load, wall_s, cpu_s = os.getloadavg()[0], time.perf_counter(), time.process_time()
    settings = BasisSettings(ReedBox(reed.constants()))
    built = build_reduced_reed(reed.geometry(), level, settings, show)
    print(file=sys.stderr)
    return built, {
        "wall_s": time.perf_counter() - wall_s,
        "cpu_s": time.process_time() - cpu_s,
        "load_before": load,
    }


def study(reed: ReedFile, level: MeshLevel, canes: int) -> dict[str, Any]:
    """Build and compare; the result is what ``--json`` prints."""
    built, taken = timed_build(reed, level)
    errors = accuracy(built, level, canes)
    return {
        "reed": reed.name,
        "level": astuple(level),
        "coordinates": {str(key): part.held for key, part in built.parts.items()},
        "build": taken,
        "build_met": taken["wall_s"] <= BUILD_S,
        "box": built.box.ranges,
        "accuracy": errors,
        "error_met": errors["largest_cents"] <= ERROR_CENTS,
        "first_order": list(first_order(built, level)),
        "versions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a study for people."""
    built, errors = report["build"], report["accuracy"]
    print(f"{report['reed']}: coordinates {report['coordinates']}")
    met = "met" if report["build_met"] else "missed"
    print(
        f"built in {BUILD_S:g} s: {met} ({built['wall_s']:.1f} s, {built['cpu_s']:.1f} s of "
        f"processor, load average before {built['load_before']:.1f})"
    )
    met = "met" if report["error_met"] else "missed"
    print(
        f"within {ERROR_CENTS:g} cents: {met} (largest {errors['largest_cents']:.2f}, least "
        f"{errors['least_cents']:.4f}, p95 {errors['p95_cents']:.2f}, rms "
        f"{errors['rms_cents']:.2f} cents; {errors['canes']} canes, {errors['modes']} modes below "
        f"{HIGHEST_HZ / 1e3:g} kHz)"
    )
    print(f"{'change':>14} {'amount':>7} {'largest shift':>14} {'largest error':>14}")
    for row in report["first_order"]:
        print(
            f"{row['change']:>14} {row['amount']:7g} {row['largest_shift_cents']:14.1f} "
            f"{row['largest_error_cents']:14.2f}"
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="The reduced reed against its own FEM.")
    parser.add_argument("--reed", default=DEFAULT_REED, help="reed file, or a shipped reed's name")
    parser.add_argument("--canes", type=int, default=32, help="solved both ways, at least 12")
    parser.add_argument("--fast", action="store_true", help="on the fast mesh")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    level = FAST if arguments.fast else STANDARD
    reed = ReedFile.from_file(arguments.reed)
    report = study(reed, level, max(arguments.canes, FEWEST_CANES))
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
