"""Pictures of what a joint fit found of each mode."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from fitting.cane.residual_map import squared_residual
from fitting.modal.identify import JointFit
from fitting.resonance import Resonance
from holography.arrays import Array

# Modes side by side, and the panels of each.
_PER_ROW, _PANELS = 2, ("hologram", "fitted shape", "residual")
_PANEL_IN, _HEAD_IN, _FOOT_IN = (2.35, 1.0), 0.72, 1.0
# What is left is drawn up to this many times the noise.
_MOST_LEFT = 4.0
# Percentile of the blocks' brightness that is drawn white.
_WHITE_PERCENTILE = 99
# Corners of triangles between blocks are not longer than this, in spacings of blocks.
_LONGEST = 3.0


@dataclass(frozen=True)
class _Place:
    """Blocks on the reed, in mm, and triangles between neighbours."""

    triangles: Triangulation

    @classmethod
    def of(cls, x_m: Array, y_m: Array) -> "_Place":
        triangles = Triangulation(1e3 * x_m, 1e3 * y_m)
        corners = np.stack([triangles.x, triangles.y], axis=1)[triangles.triangles]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        triangles.set_mask(sides > _LONGEST * np.median(sides))
        return cls(triangles)


def mode_sheet(fit: JointFit, resonances: dict[str, Resonance]) -> Figure:
    """Draw hologram, fitted shape and residual, for every identified mode.

    Parameters
    ----------
    fit : JointFit
    resonances : dict
        Modes to draw, by name.
    """
    rows = -(-max(len(resonances), 1) // _PER_ROW)
    width = _PER_ROW * len(_PANELS) * _PANEL_IN[0]
    height = rows * (_PANEL_IN[1] + _HEAD_IN) + _FOOT_IN
    figure = Figure(figsize=(width, height), facecolor="white")
    place = _Place.of(fit.block_amplitudes.x_m, fit.block_amplitudes.y_m)
    for number, (name, found) in enumerate(resonances.items()):
        row, column = divmod(number, _PER_ROW)
        for panel, values in enumerate(_values(fit, name)):
            left = (column * len(_PANELS) + panel) * _PANEL_IN[0] + 0.08
            bottom = height - (row + 1) * (_PANEL_IN[1] + _HEAD_IN)
            box = (
                left / width,
                bottom / height,
                (_PANEL_IN[0] - 0.16) / width,
                _PANEL_IN[1] / height,
            )
            _draw(figure.add_axes(box), place, panel, values)
            if panel == 1:
                scale = (box[0] + 0.2 * box[2], box[1] - 0.09 / height, 0.6 * box[2], 0.06 / height)
                _shape_scale(figure, scale, found.amplitude_nm)
            if panel == 0:
                figure.text(
                    box[0], box[1] + box[3] + 0.1 / height, _words(name, found), fontsize=9
                )  # fmt: skip
    _scales(figure, width, height)
    return figure


def _words(name: str, found: Resonance) -> str:
    words = f"{name}   {found.frequency_hz:.1f} Hz ± {found.error_cents:.1f} cents"
    if found.amplitude_nm is not None:
        error = "" if found.amplitude_error_nm is None else f" ± {found.amplitude_error_nm:.1f}"
        words += f"   {found.amplitude_nm:.1f}{error} nm"
    if found.loss_factor is not None:
        words += f"   loss factor {found.loss_factor:.4f}"
    if found.similarity is not None:
        words += f"   MAC {found.similarity:.2f}"
    return f"{words}   step {found.step_index}"


def _values(fit: JointFit, name: str) -> tuple[Array, Array, Array]:
    """Amplitude of the hologram nearest to a resonance, shape, and residual of the hologram."""
    m = fit.names.index(name)
    nearest = int(np.abs(np.log(fit.block_amplitudes.drive_hz / fit.modal.hz[m])).argmin())
    blocks = fit.block_amplitudes
    amplitude = np.abs(blocks.value[:, nearest]) * np.sqrt(blocks.noise_variance)
    white = np.percentile(amplitude, _WHITE_PERCENTILE)
    shape = fit.basis.functions @ fit.modal.shapes[m]
    largest = shape[np.abs(shape).argmax()]
    return (
        np.clip(amplitude / white, 0, 1),
        shape / largest,
        squared_residual(fit, np.array([nearest]))[0],
    )


def _draw(axes: Any, place: _Place, panel: int, values: Array) -> None:
    if panel == 0:
        axes.tripcolor(place.triangles, values, cmap="gray", vmin=0, vmax=1, shading="gouraud")
    elif panel == 1:
        axes.tripcolor(place.triangles, values, cmap="RdBu_r", vmin=-1, vmax=1, shading="gouraud")
        if values.min() < 0 < values.max():
            axes.tricontour(place.triangles, values, levels=[0.0], colors="0.2", linewidths=0.8)
    else:
        axes.tripcolor(
            place.triangles, values, cmap="viridis", vmin=0, vmax=_MOST_LEFT, shading="gouraud"
        )
    x, y = place.triangles.x, place.triangles.y
    axes.set(xlim=(x.min(), x.max()), ylim=(y.min(), y.max()), aspect="equal")
    axes.axis("off")


def _shape_scale(
    figure: Figure, box: tuple[float, float, float, float], amplitude_nm: float | None
) -> None:
    """Colour bar of a fitted shape, in nm: each mode has its own."""
    bar = figure.colorbar(
        ScalarMappable(Normalize(-1, 1), "RdBu_r"), cax=figure.add_axes(box),
        orientation="horizontal",
    )  # fmt: skip
    top = "1" if amplitude_nm is None else f"{amplitude_nm:.0f} nm"
    bar.set_ticks([-1, 0, 1], labels=[f"−{top}", "0", f"+{top}"])
    bar.ax.tick_params(labelsize=7, length=2, pad=1)


def _scales(figure: Figure, width: float, height: float) -> None:
    """Colour bars below, for the panels that have the same scale for all modes."""
    kinds = (
        ("gray", Normalize(0, 1), "hologram: amplitude of the light, relative"),
        (
            "viridis",
            Normalize(0, _MOST_LEFT),
            "residual of the fit: square, 1 is noise",
        ),
    )
    for number, (colours, scale, words) in enumerate(kinds):
        box = ((0.04 + 0.64 * number), 0.5 / height, 0.26, 0.12 / height)
        bar = figure.colorbar(
            ScalarMappable(scale, colours), cax=figure.add_axes(box), orientation="horizontal"
        )
        bar.set_label(words, fontsize=9)
        bar.ax.tick_params(labelsize=8)
    figure.text(
        0.5, 0.45 / height, "fitted shape: displacement at resonance;\nline: at rest",
        fontsize=9, ha="center",
    )  # fmt: skip
