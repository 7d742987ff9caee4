"""A reed's modes as people look at them: a table, and a sheet of pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import FuncNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, zoom

from fitting.errors import FitInputError
from holography.arrays import Array
from physics.reed.elements.fem import Symmetry
from physics.reed.elements.mesh import (
    HalfReedMesh,
    MeshLevel,
    ReedMesh,
    build_least_mesh,
)
from physics.reed.modes import HIGHEST_HZ, NamedMode
from physics.reed.reduction.metamodel import REFERENCE_HZ
from protocols.reed import ReedFile
from reports.figures.drawing import png_of
from reports.own_output import (
    Output,
    picture_kind,
    require_writable,
    write_output,
)
from reports.plain_text import visible
from reports.tables import Column, Table

PER_ROW = 9
_SHEET = picture_kind("reed modes")
_MODULI = ("E_L", "E_T", "E_R", "G_LT", "G_LR", "G_TR")
_POISSON_RATIOS = ("nu_LT", "nu_LR", "nu_TR")
# Width of a panel, and what stands between, above and below the panels.
_PANEL_IN, _GAP_IN, _TITLE_IN, _HEAD_IN, _FOOT_IN = 1.0, 0.12, 0.3, 0.4, 0.75
_LEAST_COLUMNS = 4
_DPI = 130
_COLOURS = "RdBu_r"
# Nodes of the mesh are too far apart for smooth lines.
_FINER = 3
# Lines across the reed that move less than this share of the whole have no nodal line to show.
_STILL_SHARE = 0.02


def modes_table(reed: ReedFile, modes: Sequence[NamedMode]) -> Table:
    """Return name, frequency, interval above F6, class and symmetry of every mode."""
    columns = (
        Column("mode", "mode", wraps=False),
        Column("hz", "frequency", "Hz", ".1f"),
        Column("cents", "above F6", "cents", ".0f"),
        Column("class", "class"),
        Column("symmetry", "symmetry"),
    )
    rows = tuple(
        (
            mode.name,
            mode.frequency_hz,
            1200 * np.log2(mode.frequency_hz / REFERENCE_HZ),
            str(mode.klass),
            str(mode.symmetry),
        )
        for mode in modes
    )
    return Table(columns, rows, f"{reed.name}: modes", _cane_words(reed))


def _cane_words(reed: ReedFile) -> str:
    low, high = reed.cane(), reed.cane(HIGHEST_HZ)
    moduli = {name: f"{1e-6 * getattr(low, f'{name}_pa'):.0f}" for name in _MODULI}
    words = ", ".join(f"{name} {value}" for name, value in moduli.items()) + " MPa"
    ratios = ", ".join(f"{name} {getattr(low, name):g}" for name in _POISSON_RATIOS)
    words = f"{words}; {ratios}; {low.density_kg_m3:g} kg/m³"
    if reed.viscoelastic() is None:
        return words
    return (
        f"{words}. Each mode has the E_L and G_LT of its own frequency: these at "
        f"{REFERENCE_HZ:.0f} Hz, {1e-6 * high.E_L_pa:.0f} and {1e-6 * high.G_LT_pa:.0f} MPa at "
        f"{1e-3 * HIGHEST_HZ:.0f} kHz"
    )


@dataclass(frozen=True)
class BarkSide:
    """Deflection of the whole bark side at places (nx, ny), y ascending from side to side.

    Attributes
    ----------
    x_m, y_m : (nx, ny) float
    deflection : (nx, ny) float
        The largest of either sign is 1.
    clamped : (nx, ny) bool
    """

    x_m: Array
    y_m: Array
    deflection: Array
    clamped: NDArray[np.bool_]


def bark_side(mesh: ReedMesh, mode: NamedMode) -> BarkSide:
    """Deflection of a whole reed as it is, of half a reed with its mirror image."""

    def whole(values: NDArray[Any], sign: int) -> NDArray[Any]:
        bark = values.reshape(mesh.block)[:, :, -1]
        if isinstance(mesh, HalfReedMesh):
            return np.hstack([sign * bark[:, :0:-1], bark])
        return bark

    parity = 1 if mode.symmetry is Symmetry.SYMMETRIC else -1
    u = whole(mode.shape[:, 2], parity)
    return BarkSide(
        whole(mesh.nodes_m[:, 0], 1),
        whole(mesh.nodes_m[:, 1], -1),
        u / u.flat[np.abs(u).argmax()],
        whole(mesh.clamped, 1) > 0,
    )


def mode_sheet(reed: str, mesh: ReedMesh, modes: Sequence[NamedMode]) -> Figure:
    """Every mode on the bark side, seen from above with the tip down, and its nodal lines.

    Parameters
    ----------
    reed : str
        For the title.
    mesh : ReedMesh
        On which the modes were computed.
    modes : sequence of NamedMode
    """
    columns = min(PER_ROW, max(len(modes), _LEAST_COLUMNS))
    rows = -(-len(modes) // columns)
    length_m, width_m = mesh.nodes_m[:, 0].max(), 2 * mesh.nodes_m[:, 1].max()
    tall_in = _PANEL_IN * length_m / width_m
    width_in = _GAP_IN + columns * (_PANEL_IN + _GAP_IN)
    height_in = _HEAD_IN + rows * (tall_in + _TITLE_IN) + _FOOT_IN
    figure = Figure(figsize=(width_in, height_in))

    def box(
        left: float, bottom: float, width: float, height: float
    ) -> tuple[float, float, float, float]:
        return left / width_in, bottom / height_in, width / width_in, height / height_in

    for number, mode in enumerate(modes):
        row, column = divmod(number, columns)
        left = _GAP_IN + column * (_PANEL_IN + _GAP_IN)
        bottom = _FOOT_IN + (rows - 1 - row) * (tall_in + _TITLE_IN)
        axes = figure.add_axes(box(left, bottom, _PANEL_IN, tall_in))
        _draw(axes, bark_side(mesh, mode))
        axes.set_title(f"{mode.name} {mode.frequency_hz:.0f} Hz", fontsize=8.5, pad=3)
    title = f"{visible(reed)}: bark side, tip down"
    # A name may hold what matplotlib takes for mathematics.
    figure.suptitle(title, y=1 - 0.15 / height_in, va="top", parse_math=False)
    scale = figure.add_axes(box(0.5 * width_in - 1.5, _FOOT_IN - 0.25, 3.0, 0.1))
    bar = figure.colorbar(ScalarMappable(_norm(), _COLOURS), cax=scale, orientation="horizontal")
    bar.set_ticks([-1, -0.5, -0.1, 0, 0.1, 0.5, 1])
    bar.set_label("deflection, 1 where a mode moves most; black: nodal lines, grey: clamp")
    return figure


def _norm() -> FuncNorm:
    """Shades by the root of the deflection: the tip moves so much more than the rest."""
    return FuncNorm((lambda u: np.sign(u) * np.sqrt(np.abs(u)), lambda v: np.sign(v) * v**2), -1, 1)


def _draw(axes: Any, side: BarkSide) -> None:
    """Draw one mode; axes in mm, positive y on the left as seen from above with the tip down."""
    x, y, u = (zoom(part, _FINER, order=3) for part in (side.x_m, side.y_m, side.deflection))
    held = zoom(side.clamped.astype(float), _FINER, order=0) > 0
    x, y = 1e3 * x, 1e3 * y
    axes.pcolormesh(y, x, u, cmap=_COLOURS, norm=_norm(), shading="gouraud", rasterized=True)
    moving = maximum_filter1d(np.abs(u).max(axis=1), len(u) // 8) > _STILL_SHARE
    nodal = np.ma.masked_where(held | ~moving[:, None], u)
    axes.contour(y, x, nodal, levels=[0.0], colors="black", linewidths=0.9)
    axes.contourf(y, x, held, levels=[0.5, 1.5], colors="0.6")
    for edge in (np.s_[:, 0], np.s_[:, -1], np.s_[0], np.s_[-1]):
        axes.plot(y[edge], x[edge], color="0.4", linewidth=0.6)
    axes.set_aspect("equal")
    axes.invert_xaxis()
    axes.axis("off")


def require_png(path: Path) -> None:
    """Refuse a sheet that cannot be written, before anything is computed.

    Raises
    ------
    FitInputError
        If its name is not a picture's.
    OutputRefusedError
        If it must not or cannot be written there.
    """
    if path.suffix.lower() != ".png":
        raise FitInputError(f"{path}: pictures are written as PNG; give a name that ends in .png")
    require_writable([_output(path)])


def _output(path: Path) -> Output:
    return Output(path, _SHEET, "--pictures")


def write_mode_sheet(
    reed: ReedFile, level: MeshLevel, modes: Sequence[NamedMode], path: Path
) -> None:
    """Write the sheet of a reed's modes, computed at a mesh level, as PNG.

    Raises
    ------
    OutputRefusedError, OutputFailedError
        If the file must not or cannot be written.
    """
    mesh = build_least_mesh(reed.geometry(), level)
    write_output(_output(path), png_of(mode_sheet(reed.name, mesh, modes), _DPI, _SHEET.mark))
