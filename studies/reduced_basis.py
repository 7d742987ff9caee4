"""How far the basis over materials lies from the finite elements that it was built from.

The basis is asked for reeds that it has never seen: half of them anywhere in its box, half at
corners of it, thickness offsets anywhere. Each of them is also solved by finite elements, on the
same mesh, and its modes are named by their shapes. `benchmarks.reduced_basis` measures time.

    python -m studies.reduced_basis [--reed NAME] [--reeds N] [--fast] [--json]
"""

import argparse
import json
import platform
import sys
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
from scipy.optimize import linear_sum_assignment

from physics.reed.cane.material import Cane
from physics.reed.elements.mesh import MeshLevel
from physics.reed.material_range.basis import MaterialBasis, modes
from physics.reed.material_range.constants import CONSTANTS
from physics.reed.material_range.snapshots import TrainingSettings
from physics.reed.material_range.training import build_material_basis
from physics.reed.modes import NamedMode, reed_modes
from physics.reed.reduction.cache import FAST, STANDARD
from protocols.reed import DEFAULT_REED, ReedFile

Array = npt.NDArray[np.float64]

ERROR_CENTS = 3.0
HIGHEST_HZ = 20e3
# Named beyond the limit: what the basis puts just below it may lie just above it.
SOLVED_HZ = 1.02 * HIGHEST_HZ
DENSITY_KG_M3 = (420.0, 620.0)
# A name that is borne out by less than this is shared with another mode.
CLEAR = 0.75
FEWEST_REEDS = 30


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
    """

    cents: dict[str, float]
    clear: dict[str, bool]
    same_name: dict[str, bool]


def random_inputs(basis: MaterialBasis, count: int, seed: int) -> tuple[Array, Array, Array]:
    """Constants (n, 9), densities and thickness offsets (n,); every other reed at a corner."""
    rng = np.random.default_rng(seed)
    fractions = rng.random((count, 10))
    fractions[1::2, :9] = np.round(fractions[1::2, :9])
    # Thickness ends the box in half of the corners; elsewhere it lies between the snapshots'.
    fractions[1::4, 9] = np.round(fractions[1::4, 9])
    low, high = np.asarray(astuple(basis.box)).T
    inputs = low + (high - low) * fractions
    return inputs[:, :9], rng.uniform(*DENSITY_KG_M3, count), inputs[:, 9]


def solved_modes(
    basis: MaterialBasis, level: MeshLevel, constants: Array, density: float, offset_m: float
) -> list[NamedMode]:
    """Solve one reed by finite elements."""
    whole_offset_m = basis.geometry.thickness_offset_m + offset_m
    reed = replace(basis.geometry, thickness_offset_m=float(whole_offset_m))
    elastic = dict(zip(CONSTANTS, constants.tolist(), strict=True))
    cane = replace(Cane(density_kg_m3=float(density)), **elastic)
    return reed_modes(reed, cane, level, SOLVED_HZ)


def compare(
    basis: MaterialBasis, level: MeshLevel, constants: Array, density: float, offset_m: float
) -> Comparison:
    """Solve one reed both ways."""
    solved = solved_modes(basis, level, constants, density, offset_m)
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
    return Comparison(cents, clear, same)


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


def build(reed: ReedFile, level: MeshLevel) -> MaterialBasis:
    """Build a basis and show progress."""

    def show(fraction: float) -> None:
        print(f"\rbuilding {fraction:4.0%}", end="", file=sys.stderr, flush=True)

    settings = TrainingSettings(cane=reed.cane())
    basis = build_material_basis(reed.geometry(), level, settings, show)
    print(file=sys.stderr)
    return basis


def study(reed: ReedFile, level: MeshLevel, reeds: int) -> dict[str, Any]:
    """Build and compare; the result is what ``--json`` prints."""
    basis = build(reed, level)
    comparisons = []
    for number, row in enumerate(zip(*random_inputs(basis, reeds, seed=2), strict=True), 1):
        comparisons.append(compare(basis, level, *row))
        print(f"\rsolving {number}/{reeds}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    table = by_mode(basis.names, comparisons)
    worst = max(row["max_cents"] for row in table.values())
    return {
        "reed": reed.name,
        "level": astuple(level),
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
        "error_met": worst <= ERROR_CENTS,
        "versions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a study for people."""
    print(report["reed"])
    for symmetry, row in report["halves"].items():
        print(
            f"{symmetry}: {row['coordinates']} coordinates, {row['with_mass']} with mass, "
            f"{row['components']} components, {row['error_cents']:.2f} cents in training"
        )
    print(f"{report['reeds']} reeds by finite elements, modes below {HIGHEST_HZ / 1e3:g} kHz")
    print(
        f"{'mode':5} {'reeds':>5} {'max cents':>10} {'p95':>5} {'rms':>5} "
        f"{'clear':>6} {'same name':>12} {'where clear':>12}"
    )
    for name, row in report["modes"].items():
        print(
            f"{name:5} {row['reeds']:5} {row['max_cents']:10.2f} {row['p95_cents']:5.2f} "
            f"{row['rms_cents']:5.2f} {row['clear']:6.0%} {row['same_name']:12.0%} "
            f"{row['same_name_where_clear']:12.0%}"
        )
    met = "met" if report["error_met"] else "missed"
    print(f"within {ERROR_CENTS:g} cents: {met} ({report['worst_cents']:.2f} cents)")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="A basis over materials against its own FEM.")
    parser.add_argument("--reed", default=DEFAULT_REED, help="reed file, or a shipped reed's name")
    parser.add_argument("--reeds", type=int, default=40, help="solved both ways, at least 30")
    parser.add_argument("--fast", action="store_true", help="on the fast mesh")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    level = FAST if arguments.fast else STANDARD
    reed = ReedFile.from_file(arguments.reed)
    report = study(reed, level, max(arguments.reeds, FEWEST_REEDS))
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
