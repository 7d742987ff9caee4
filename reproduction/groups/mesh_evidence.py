"""Effect of the paper's mesh on frequencies: ever finer tetrahedra and converged hexahedra."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from fitting.paper.printed import Printed
from holography.arrays import Array
from physics.reed.cane.material import Cane
from physics.reed.elements.fem import ReedMatrices, assemble
from physics.reed.elements.mesh import STANDARD, build_mesh
from physics.reed.elements.tetrahedra import PLAIN, tetrahedral_reed
from physics.reed.geometry import ReedGeometry
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.modes import NamedMode, reed_modes
from physics.reed.reduction.sensitivity import CONSTANTS, rayleigh_sensitivities
from reproduction.models import Announce
from reproduction.rows import (
    Drawing,
    Group,
    Row,
    not_printed,
)

STIFF_MODES: Final = ("T3", "X3", "T4")
# Longest edges, and those at the tip, m, and whether graded towards the edges of the strip. Those
# of 1.7 mm have as many points as the paper's.
_MESHES: Final = (
    (2e-3, 2e-3, False),
    (1.7e-3, 1.7e-3, False),
    (1.5e-3, 1.5e-3, False),
    (2e-3, 1e-3, False),
    (1e-3, 1e-3, False),
    (0.7e-3, 0.7e-3, False),
    (1e-3, 1e-3, True),
)
# The heel mode of a coarse mesh lies here.
_HIGHEST_HZ = 22.5e3
_WHERE = "Table 9 and meshes"
_TRANSVERSAL = ("T1", "T2", "T3", "T4")
# T3 and X3 of the paper are equally far off: labels to the left and to the right.
_LABEL_SIDE = {"T3": "right", "X3": "left", "T4": "left"}
_COLOURS = {"T3": "#d97706", "X3": "#2b8a3e", "T4": "#9b2226"}


@dataclass(frozen=True, eq=False)
class MeshResult:
    """The reed of reference material on one mesh.

    Attributes
    ----------
    words : str
    points : int
        Of the whole reed.
    hz : mapping
        Frequencies by name.
    sensitivities : mapping of (9,) float
        Exact derivatives, see `rayleigh_sensitivities`.
    uniform : bool
        Whether its elements have one size everywhere.
    """

    words: str
    points: int
    hz: Mapping[str, float]
    sensitivities: Mapping[str, Array]
    uniform: bool


@dataclass(frozen=True, eq=False)
class MeshEvidence:
    """The same reed on several meshes.

    Attributes
    ----------
    tetrahedra : tuple of MeshResult
        Quadratic; the first is the paper's, as far as its text says.
    converged : MeshResult
        High-order hexahedra.
    """

    tetrahedra: tuple[MeshResult, ...]
    converged: MeshResult

    def spans(self, value: float, of: Callable[[MeshResult], float | None]) -> bool:
        """Whether a value lies between the converged one and that of some tetrahedra."""
        known = [
            found for found in map(of, (self.converged, *self.tetrahedra)) if found is not None
        ]
        return min(known) <= value <= max(known)


def gather_evidence(announce: Announce) -> MeshEvidence:
    """Solve the paper's reed on all meshes.

    Parameters
    ----------
    announce : callable
        Called with what is being waited for.
    """
    geometry, cane = ReedGeometry(), Cane()
    announce("solving converged finite elements")
    named = {level: reed_modes(geometry, cane, level, _HIGHEST_HZ) for level in (PLAIN, STANDARD)}
    results = []
    for size_m, tip_m, graded in _MESHES:
        words = f"tetrahedra of {1e3 * size_m:g} mm"
        words += f", {1e3 * tip_m:g} mm at the tip" if tip_m != size_m else ""
        words += ", graded towards the strip" if graded else ""
        announce(f"solving {words}")
        level = STANDARD if graded else PLAIN
        reed = tetrahedral_reed(geometry, cane, named[level], size_m, tip_size_m=tip_m, level=level)
        uniform = tip_m == size_m and not graded
        results.append(_result(words, reed.nodes, reed.matrices, reed.modes, uniform=uniform))
    mesh = build_mesh(geometry, STANDARD)
    points = 2 * len(mesh.nodes_m) - int(np.count_nonzero(mesh.midplane))
    words, matrices = "converged hexahedra", assemble(mesh)
    converged = _result(words, points, matrices, named[STANDARD], uniform=False)
    return MeshEvidence(tuple(results), converged)


def _result(
    words: str,
    points: int,
    matrices: ReedMatrices,
    modes: Sequence[NamedMode],
    *,
    uniform: bool,
) -> MeshResult:
    hz = {mode.name: mode.frequency_hz for mode in modes}
    return MeshResult(words, points, hz, rayleigh_sensitivities(matrices, modes, Cane()), uniform)


def compare_meshes(
    numbers: Printed, evidence: MeshEvidence, table_9_hz: Mapping[str, float]
) -> Group:
    """Show what smaller tetrahedra do.

    Parameters
    ----------
    numbers : Printed
    evidence : MeshEvidence
    table_9_hz : mapping
        Frequencies of the reference material by Eq. 1, by name.
    """
    return Group(
        "meshes",
        "The paper's mesh",
        "The paper's elements were quadratic tetrahedra of 2 mm, "
        f"{numbers.text['mesh_points']:.0f} points. The same reed and clamp in such tetrahedra, "
        "one layer, on the nodes of a regular block: as they shrink, T3 and T4 fall "
        "through the paper's frequencies towards the converged ones, X3 does as "
        "they are graded towards the edges of the clamping strip, and the transversal modes lose "
        "a sensitivity to G_TR that they do not have. In Tables 3 and 9 a number that differs, "
        "but lies within what these meshes span, counts as refuted.",
        tuple(_mesh_rows(numbers, evidence, table_9_hz)),
        (
            Drawing(
                "T3, X3 and T4 against the number of points of the mesh. Dots: tetrahedra of one "
                "size; squares: finer at the tip, and graded towards the strip; crosses: the "
                "paper; 0: converged hexahedra.",
                lambda: draw_evidence(numbers, evidence, table_9_hz),
            ),
        ),
    )


def _mesh_rows(
    numbers: Printed, evidence: MeshEvidence, table_9_hz: Mapping[str, float]
) -> Iterator[Row]:
    meshes = (*evidence.tetrahedra, evidence.converged)
    for name in STIFF_MODES:
        for mesh in meshes:
            off = 1200 * np.log2(mesh.hz[name] / table_9_hz[name])
            yield not_printed(
                _WHERE, f"{name}, {mesh.words}", mesh.hz[name], "Hz",
                f"{off:+.0f} cents from Table 9 ({table_9_hz[name]:.0f} Hz)",
            )  # fmt: skip
    said = f"the paper: {numbers.text['mesh_points']:.0f}"
    for mesh in meshes:
        yield not_printed(_WHERE, f"points, {mesh.words}", mesh.points, "", said)
    for mesh in meshes:
        off_cents = [1200 * np.log2(mesh.hz[name] / table_9_hz[name]) for name in PAPER_MODES]
        yield not_printed(
            _WHERE, f"rms distance from Table 9, {mesh.words}", float(np.std(off_cents)), "cents",
            f"of eleven modes, after a common shift of {np.mean(off_cents):+.0f} cents",
        )  # fmt: skip
    column = CONSTANTS.index("G_TR")
    said = f"the paper: {numbers.sensitivity_oat_10_percent['GTR']['T']}"
    for mesh in meshes:
        slopes = [mesh.sensitivities[name][column] for name in _TRANSVERSAL]
        yield not_printed(
            "Table 3 and meshes", f"class T to G_TR, {mesh.words}", float(np.mean(slopes)), "",
            said,
        )  # fmt: skip


def draw_evidence(
    numbers: Printed, evidence: MeshEvidence, table_9_hz: Mapping[str, float]
) -> Figure:
    """Cents above converged hexahedra against the number of points."""
    figure = Figure(figsize=(8.5, 4.6), layout="constrained")
    axes = figure.add_subplot()
    uniform = sorted(
        (mesh for mesh in evidence.tetrahedra if mesh.uniform), key=lambda mesh: mesh.points
    )
    others = [mesh for mesh in evidence.tetrahedra if not mesh.uniform]
    for name in STIFF_MODES:
        limit_hz, colour = evidence.converged.hz[name], _COLOURS[name]

        def cents(mesh: MeshResult, name: str = name, limit_hz: float = limit_hz) -> float:
            return 1200 * float(np.log2(mesh.hz[name] / limit_hz))

        axes.plot(
            [mesh.points for mesh in uniform], [cents(mesh) for mesh in uniform], "o-",
            color=colour, label=name,
        )  # fmt: skip
        axes.plot(
            [mesh.points for mesh in others], [cents(mesh) for mesh in others], "s",
            color=colour, fillstyle="none",
        )  # fmt: skip
        points = numbers.text["mesh_points"]
        paper_cents = 1200 * np.log2(table_9_hz[name] / limit_hz)
        axes.plot(points, paper_cents, "x", color=colour, markersize=11, markeredgewidth=2.5)
        axes.annotate(
            f"{name} of the paper", (points, paper_cents),
            xytext=(9 if _LABEL_SIDE[name] == "left" else -9, -12), textcoords="offset points",
            ha=_LABEL_SIDE[name], color=colour, fontsize=9,
        )  # fmt: skip
    axes.axhline(0, color="0.6", linewidth=0.8)
    axes.set_xscale("log")
    ticks = [5000, 7000, 10000, 15000, 20000, 30000]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("points of the mesh (whole reed)")
    axes.set_ylabel("cents above converged hexahedra")
    axes.grid(visible=True, alpha=0.2)
    axes.legend(frameon=False)
    return figure
