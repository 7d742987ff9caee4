"""How far each mode of the reed lies from what ever finer meshes lead to.

The paper's reed is solved on the shipped levels and on a family of meshes whose elements next to
the edges of the clamping strip, where stress is singular, shrink fivefold from one to the next.
What the singularity still hides is extrapolated from the family (Aitken) and taken off a mesh of
high order; the shipped levels are judged by their distance from the limit so found.

    python -m studies.convergence [--json]
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from physics.reed.cane.material import Cane
from physics.reed.elements.mesh import FAST, FINE, STANDARD, MeshLevel
from physics.reed.geometry import ReedGeometry
from physics.reed.modes import reed_modes

HIGHEST_HZ = 20e3
FINE_CENTS, FAST_S = 10.0, 0.3


def _both(*distances_m: float) -> tuple[float, ...]:
    """Distances to both sides of the strip's edges."""
    return tuple(side * distance for distance in distances_m for side in (1, -1))


# Next to an edge an element is 0.25, 0.05 and 0.01 mm wide, and a tenth, a fiftieth and a 250th of
# the thickness high.
_EDGES = (_both(0.25e-3), _both(0.25e-3, 0.05e-3), _both(0.25e-3, 0.05e-3, 0.01e-3))
_LAYERS = ((0.0, 0.9, 1.0), (0.0, 0.9, 0.98, 1.0), (0.0, 0.9, 0.98, 0.996, 1.0))
# Of lower order, so that three members fit into memory; halved below, where layers are thick.
FAMILY = {
    f"{step}": MeshLevel(orders=(3, 4, 2), edge_breaks_m=edges, z_breaks=(0.0, 0.5, *layers[1:]))
    for step, (edges, layers) in enumerate(zip(_EDGES, _LAYERS, strict=True), 1)
}
# The second member at high order: what order alone still changes.
HIGH = MeshLevel(orders=(4, 4, 3), edge_breaks_m=_EDGES[1], z_breaks=_LAYERS[1])


@dataclass(frozen=True)
class Solved:
    """Modes of one mesh: what it cost, and frequencies by name."""

    unknowns: int
    seconds: float
    hz: dict[str, float]


def solve(level: MeshLevel) -> Solved:
    """Solve the paper's reed on one mesh, both symmetries, from geometry to named modes."""
    start_s = time.perf_counter()
    modes = reed_modes(ReedGeometry(), Cane(), level, HIGHEST_HZ)
    seconds = time.perf_counter() - start_s
    return Solved(modes[0].shape.size, seconds, {mode.name: mode.frequency_hz for mode in modes})


def cents(upper_hz: float, lower_hz: float) -> float:
    """Interval in cents."""
    return float(1200 * np.log2(upper_hz / lower_hz))


def limit_hz(coarse_hz: float, middle_hz: float, fine_hz: float) -> float:
    """Limit of three members of a family whose errors shrink by a constant factor (Aitken)."""
    first, second = coarse_hz - middle_hz, middle_hz - fine_hz
    # A mode that hardly changes has converged; its differences are rounding.
    if abs(second) < 1e-6 * fine_hz or abs(first) <= abs(second):
        return fine_hz
    return fine_hz - second**2 / (first - second)


def benchmark() -> dict[str, Any]:
    """Solve all meshes; the result is what ``--json`` prints."""
    family = {}
    for name, level in FAMILY.items():
        family[name] = solve(level)
        level_solved = family[name]
        print(
            f"{name}: {level_solved.unknowns} unknowns, {level_solved.seconds:.1f} s",
            file=sys.stderr,
        )
    shipped = {"fast": solve(FAST), "standard": solve(STANDARD), "fine": solve(FINE)}
    high = solve(HIGH)
    limits = {
        name: high_hz * limit_hz(*(s.hz[name] for s in family.values())) / family["2"].hz[name]
        for name, high_hz in high.hz.items()
    }
    solved = family | {"high": high} | shipped
    modes = {
        name: {
            "limit_hz": limit,
            **{f"{step}_cents": cents(s.hz[name], limit) for step, s in solved.items()},
        }
        for name, limit in limits.items()
    }
    # The first solve of a process pays for what is loaded; the second is what a user waits for.
    fast_s = min(solve(FAST).seconds for _ in range(3))
    worst = {
        step: max(modes, key=lambda name: abs(modes[name][f"{step}_cents"])) for step in shipped
    }
    return {
        "modes": modes,
        "unknowns": {name: s.unknowns for name, s in solved.items()},
        "seconds": {name: s.seconds for name, s in solved.items()},
        "fast_s": fast_s,
        "worst": worst,
        "fine_met": abs(modes[worst["fine"]]["fine_cents"]) <= FINE_CENTS,
        "fast_met": fast_s <= FAST_S,
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    steps = list(report["unknowns"])
    print(f"{'cents above its limit':>22}" + "".join(f"{step:>10}" for step in steps))
    for name, row in report["modes"].items():
        line = "".join(f"{row[f'{step}_cents']:10.1f}" for step in steps)
        print(f"{name:4} {row['limit_hz']:14.1f} Hz {line}")
    for what in ("unknowns", "seconds"):
        line = "".join(f"{report[what][step]:10.4g}" for step in steps)
        print(f"{what:22}{line}")
    for step, name in report["worst"].items():
        print(f"{step}: farthest is {name}, {report['modes'][name][f'{step}_cents']:.1f} cents")
    claims = {
        f"fine, the default of acquire modes: all within {FINE_CENTS:g} cents": "fine_met",
        f"fast: {report['fast_s']:.2f} s a solve, both symmetries (up to {FAST_S})": "fast_met",
    }
    for claim, key in claims.items():
        print(f"{claim}: {'met' if report[key] else 'missed'}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Distance of the reed's modes from their limits.")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    report = benchmark()
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
