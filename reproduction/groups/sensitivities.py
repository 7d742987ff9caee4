"""Table 3: how frequencies follow the elastic constants."""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from fitting.paper.printed import TABLE_3_CONSTANTS, Printed
from holography.arrays import Array
from physics.reed.cane.material import Cane
from physics.reed.elements.mesh import MeshLevel
from physics.reed.geometry import ReedGeometry
from physics.reed.reduction.sensitivity import (
    CLASSES,
    CONSTANTS,
    MODULI,
    TABLE_3_MODES,
    class_means,
    one_at_a_time,
)
from reproduction.groups.mesh_evidence import MeshEvidence, MeshResult
from reproduction.models import Announce
from reproduction.rows import (
    Drawing,
    Group,
    Row,
    from_text,
)

_TOLERANCE: Final = 0.005
# One layer, not graded towards the strip's edges: 38 solutions of it take ten seconds.
_LEVEL = MeshLevel(orders=(4, 4, 3), edge_breaks_m=(), z_breaks=(0.0, 1.0))
_CLASS_WORDS = {
    "F": "flexural",
    "T": "transversal",
    "X": "generic",
    "L": "lateral (and heel)",
    "all": "all 16 modes",
}


def compute_table_3(announce: Announce) -> dict[str, Array]:
    """Sensitivities by finite elements, one constant at a time, (9,) by mode."""

    def done(constant: str) -> None:
        announce(f"varied {constant} by 10 %")

    return one_at_a_time(ReedGeometry(), Cane(), _LEVEL, done=done)


def compare_sensitivities(
    numbers: Printed, by_mode: Mapping[str, Array], evidence: MeshEvidence
) -> Group:
    """Compare Table 3.

    Parameters
    ----------
    numbers : Printed
    by_mode : mapping of (9,) float
        One constant at a time, see `compute_table_3`.
    evidence : MeshEvidence
        Has the exact derivatives of converged finite elements and of tetrahedra.
    """
    ours, exact = class_means(by_mode), class_means(evidence.converged.sensitivities)
    table = {
        (letter, TABLE_3_CONSTANTS[name]): value
        for name, row in numbers.sensitivity_oat_10_percent.items()
        for letter, value in row.items()
    }
    return Group(
        "sensitivities",
        "Table 3: sensitivity to the elastic constants",
        "Each constant varied by ±10 % and all modes computed again by finite elements (one layer "
        "of hexahedra of degree 4); remarks give the exact derivative on the converged mesh. "
        "Classes as in the paper; its L2 is taken for the heel mode, the only one with such "
        "sensitivities. Tolerated: 0.005.",
        (*_class_rows(table, ours, exact, evidence), *_sum_rows(table, ours)),
        (
            Drawing(
                "Sensitivities of the classes: the paper's (left of each pair) and ours.",
                lambda: draw_sensitivities(table, ours),
            ),
        ),
    )


def _class_mean(mesh: MeshResult, letter: str, column: int) -> float | None:
    """Mean over a class, if all of its modes are known on a mesh."""
    names = CLASSES.get(letter, TABLE_3_MODES)
    if not all(name in mesh.sensitivities for name in names):
        return None
    return float(np.mean([mesh.sensitivities[name][column] for name in names]))


def _class_rows(
    table: Mapping[tuple[str, str], float],
    ours: Mapping[str, Array],
    exact: Mapping[str, Array],
    evidence: MeshEvidence,
) -> Iterator[Row]:
    for (letter, constant), value in table.items():
        column = CONSTANTS.index(constant)
        of_class = partial(_class_mean, letter=letter, column=column)
        remark = f"exact derivative {exact[letter][column]:.4f}"
        tetrahedra = of_class(evidence.tetrahedra[1])
        if tetrahedra is not None:
            remark += f"; {evidence.tetrahedra[1].words} {tetrahedra:.4f}"
        yield from_text(
            "Table 3", f"{_CLASS_WORDS[letter]}: {constant}", value, ours[letter][column],
            _TOLERANCE, remark=remark, refuted=evidence.spans(value, of_class),
        )  # fmt: skip


def _sum_rows(table: Mapping[tuple[str, str], float], ours: Mapping[str, Array]) -> Iterator[Row]:
    """Frequencies go with the root of all moduli together."""
    for letter, words in _CLASS_WORDS.items():
        total = sum(table[letter, constant] for constant in MODULI)
        yield from_text(
            "Table 3", f"{words}: sum of the six moduli", total,
            float(ours[letter][: len(MODULI)].sum()), _TOLERANCE,
            remark="exactly 1/2 for small variations, 0.5006 for ±10 % of all moduli at once",
        )  # fmt: skip
    weights = {letter: len(names) for letter, names in CLASSES.items()}
    off = max(
        abs(
            table["all", constant]
            - np.average([table[k, constant] for k in weights], weights=list(weights.values()))
        )
        for constant in CONSTANTS
    )
    yield from_text(
        "Table 3", "all modes, farthest from the mean of the classes", 0, off, 1e-4,
        remark="of the printed numbers, by the numbers of modes",
    )  # fmt: skip


def draw_sensitivities(table: Mapping[tuple[str, str], float], ours: Mapping[str, Array]) -> Figure:
    """Bars of the six moduli per class, printed and ours side by side."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    panels = figure.subplots(1, len(CLASSES), sharey=True)
    place = np.arange(len(MODULI))
    for axes, letter in zip(panels, CLASSES, strict=True):
        printed = [table[letter, constant] for constant in MODULI]
        axes.bar(place - 0.2, printed, 0.4, color="0.65", label="paper")
        axes.bar(place + 0.2, ours[letter][: len(MODULI)], 0.4, color="#0077b6", label="ours")
        axes.set_xticks(place, MODULI, rotation=60)
        axes.set_title(_CLASS_WORDS[letter], fontsize=11)
        axes.grid(visible=True, axis="y", alpha=0.2)
    panels[0].set_ylabel("∂ ln f / ∂ ln constant")
    panels[0].legend(frameon=False)
    return figure
