"""The map of a gap as a picture: blocks of numbers by band, mode, time, level and region."""

from typing import Final

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from diagnosis.gap_map import GapCell, GapMap
from diagnosis.observable_groups import Observable
from reports.plain_text import visible

_AXES: Final = (
    ("band", "frequency band"), ("mode", "mode"), ("time", "time"), ("level", "level"),
    ("region", "region"),
)  # fmt: skip
_LARGEST = 30.0


def draw_map(where: GapMap) -> Figure:
    """Draw the gap of all cells: blocks of numbers by band, mode, time, level and region."""
    blocks = sorted(
        (c for c in where.cells if c.axis == "group"),
        key=lambda c: list(Observable).index(c.observable),
    )
    panels = [
        (axis, words, list(dict.fromkeys(_short(c) for c in where.cells if c.axis == axis)))
        for axis, words in _AXES
    ]
    panels = [panel for panel in panels if panel[2]]
    widths = [1, *(len(labels) for _, _, labels in panels)]
    figure = Figure(
        figsize=(3.2 + 0.3 * sum(widths), 1.9 + 0.28 * len(blocks)), layout="constrained"
    )
    axes = figure.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0]
    norm = LogNorm(1.0, _LARGEST)
    colours = colormaps["YlOrRd"].with_extremes(under="#d5d8dc", bad="white")
    for ax, (axis, title, labels) in zip(axes, [("group", "all", ["all"]), *panels], strict=True):
        table = np.full((len(blocks), len(labels)), np.nan)
        for cell in where.cells:
            if cell.axis == axis:
                column = 0 if axis == "group" else labels.index(_short(cell))
                row = next(k for k, block in enumerate(blocks) if block.group == cell.group)
                own = cell.gap if cell.resolvable else 0.5
                table[row, column] = np.nanmax([table[row, column], own])
        image = ax.imshow(np.clip(table, 0.5, _LARGEST), cmap=colours, norm=norm, aspect="auto")
        # Names of sweeps may hold what matplotlib takes for mathematics.
        shown = [visible(label) for label in labels]
        ax.set_xticks(range(len(labels)), shown, rotation=90, fontsize=7, parse_math=False)
        ax.set_yticks(range(len(blocks)), [])
        ax.set_title(title, fontsize=8)
        ax.set_facecolor("white")
    names = [f"{block.group}  {block.observable}" for block in blocks]
    axes[0].set_yticks(range(len(blocks)), names, fontsize=8)
    bar = figure.colorbar(image, ax=list(axes), fraction=0.03, pad=0.01, extend="max")
    bar.ax.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"], minor=False)
    bar.set_label("gap / standard error", fontsize=8)
    return figure


def _short(cell: GapCell) -> str:
    """Label of a cell, sweeps without their pieces."""
    in_pieces = cell.axis == "time" and cell.label[-1:].isdigit()
    return cell.label.rsplit(" ", 1)[0] if in_pieces else cell.label
