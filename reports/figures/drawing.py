"""Pictures that people look at: the contact sheet and the response of the reed."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fitting.amplitudes.response import Response
from fitting.cane.sweep_fit import SweepFit
from fitting.resonance import Resonance
from holography.arrays import Array
from holography.fringes import block_mean, first_sideband_maxima_m
from reports.plain_text import visible
from runs.reader import Run
from runs.records import StepRecord

# The paper's Fig. 2 has 26 pictures to a row.
PER_ROW = 26
_SHRINK = 3
_GAP, _HEAD = 4, 16
# A cell must be this wide for its label, in pixels.
_LABEL_WIDTH = 52.0
# Brightness that is shown as white: few pixels of a speckle pattern are brighter.
_WHITE_PERCENTILE = 99.0
# A picture of nothing but noise is shown dark, not stretched to full contrast.
_DARKEST_WHITE = 12.0
# How far to either side of its peak the fringes of a mode are drawn.
_SHOWN_OCTAVES = 0.12
# Names of peaks: their least distance, width and height of three lines, and space next to them.
_LOWEST_PT, _LABEL_PT, _MARGIN = 8.0, (50.0, 34.0), 1.05
_CLASS_COLOUR = {"F": "#4cc9f0", "T": "#ffb703", "X": "#80ed99", "L": "#f4a3ff"}
_DARK_COLOUR = {"F": "#0077b6", "T": "#d97706", "X": "#2b8a3e", "L": "#8e44ad"}
# Modes of the heel, and such as have no name.
_OTHER_COLOUR = "#9d9d9d"
_LINE_COLOUR = "#ff5d5d"
# Lower end of the response plot: a displacement of 2.5 nm is about its own error.
_LOWEST_NM = 2.5
# Bright fringes of the first sideband that are marked: those that the paper quotes.
_FRINGES = (1, 5, 10)


def png_of(figure: Figure, dpi: int = 100, software: str = "reedbench") -> bytes:
    """Render a figure as PNG, which says by what software it was made (see `picture_kind`)."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(
        buffer, format="png", dpi=dpi, facecolor=figure.get_facecolor(),
        metadata={"Software": software},
    )  # fmt: skip
    return buffer.getvalue()


def _picture(run: Run, step: StepRecord) -> Array:
    """Amplitude of the reed's image as the paper shows it: tip down, left side left."""
    field = run.field(step.position)
    power = block_mean(field.real**2 + field.imag**2, _SHRINK, _SHRINK)
    bright = float(np.percentile(power, _WHITE_PERCENTILE))
    white = max(bright, _DARKEST_WHITE * step.noise_level)
    picture: Array = np.sqrt(np.clip(power / white, 0.0, 1.0))
    # Rows of a field are y, its columns x from the tip; positive y is the reed's left side.
    return picture.T[::-1, ::-1]


def contact_sheet(run: Run, resonances: dict[str, Resonance], lines_hz: Sequence[float]) -> Figure:
    """All pictures of a run in rows of 26, numbered, with modes and excitation peaks marked.

    Parameters
    ----------
    run : Run
    resonances : dict
        Modes to mark, by name.
    lines_hz : sequence of float
        Excitation peaks.

    Raises
    ------
    RunFileError
        If a picture cannot be read.
    """
    height, width = len(run.x_m) // _SHRINK, len(run.y_m) // _SHRINK
    columns = min(PER_ROW, len(run))
    rows = -(-len(run) // columns)
    cell_y, cell_x = height + _HEAD, width + _GAP
    canvas = np.full((rows * cell_y, columns * cell_x), 0.08)
    for position, step in enumerate(run.steps):
        if step.verdict.measured:
            top, left = _corner(position, columns, cell_y, cell_x)
            canvas[top : top + height, left : left + width] = _picture(run, step)
    scale = max(1.0, _LABEL_WIDTH / cell_x)
    figure = Figure(figsize=(scale * canvas.shape[1] / 100, scale * canvas.shape[0] / 100))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(canvas, cmap="gray", vmin=0, vmax=1, interpolation="nearest", aspect="auto")
    axes.axis("off")
    # Frames at the edge would else widen the view and leave white strips.
    axes.autoscale(False)
    marked = line_steps(run, lines_hz)
    for position, step in enumerate(run.steps):
        top, left = _corner(position, columns, cell_y, cell_x)
        _label(axes, run, step, resonances, marked, (left, top, width, height))
    return figure


def _corner(position: int, columns: int, cell_y: int, cell_x: int) -> tuple[int, int]:
    row, column = divmod(position, columns)
    return row * cell_y + _HEAD, column * cell_x + _GAP // 2


def _label(
    axes: Any,
    run: Run,
    step: StepRecord,
    resonances: dict[str, Resonance],
    lines: set[int],
    box: tuple[int, int, int, int],
) -> None:
    """Number a picture; name its modes, its excitation peak or what is wrong with it."""
    left, top, width, height = box
    main = step.order == run.sideband_order
    names = [name for name, found in resonances.items() if main and found.step_index == step.index]
    number = str(step.index) if main else f"{step.index}/{step.order}"
    text, colour = number, "#9a9a9a"
    if names:
        text, colour = f"{number} {'/'.join(names)}", _CLASS_COLOUR.get(names[0][0], "#e0e0e0")
        known_nm = [nm for name in names if (nm := resonances[name].amplitude_nm) is not None]
        if known_nm:
            above = "/".join(f"{nm:.0f}" for nm in known_nm)
            axes.text(
                left + width / 2, top + 2, f"{above} nm", color=colour, ha="center", va="top",
                fontsize=7, bbox={"facecolor": "black", "edgecolor": "none", "pad": 0.5},
            )  # fmt: skip
    elif step.index in lines:
        text, colour = f"{number} peak", _LINE_COLOUR
    elif step.verdict != "ok":
        words = str(step.verdict).replace("_", " ")
        axes.text(
            left + width / 2, top + height / 2, words, color=_LINE_COLOUR,
            ha="center", va="center", fontsize=7, rotation=90,
        )  # fmt: skip
    axes.text(
        left + width / 2, top - 3, text, color=colour, ha="center", va="bottom", fontsize=7,
        fontweight="bold" if names else "normal",
    )  # fmt: skip
    if colour != "#9a9a9a":
        edge = (
            [left, left + width, left + width, left, left],
            [top, top, *[top + height] * 2, top],
        )
        axes.plot(*edge, color=colour, linewidth=1.2)


def line_steps(run: Run, lines_hz: Sequence[float]) -> set[int]:
    """Return indices of the steps nearest to excitation peaks, if the sweep covers them."""
    answer = set()
    drive = np.array([float(step.drive_hz) for step in run.steps])
    for line in lines_hz:
        if drive.min() <= line <= drive.max():
            answer.add(run.steps[int(np.argmin(np.abs(drive - line)))].index)
    return answer


def response_plot(sweep: SweepFit, lines_hz: Sequence[float]) -> Figure:
    """Fringes of every found mode against frequency, with named peaks.

    Parameters
    ----------
    sweep : SweepFit
    lines_hz : sequence of float
        Excitation peaks that the fit found, or acoustic resonances that the bench file lists.
    """
    figure = Figure(figsize=(13, 6), layout="constrained")
    draw_response(figure.add_subplot(), sweep, lines_hz)
    return figure


def draw_response(axes: Axes, sweep: SweepFit, lines_hz: Sequence[float]) -> None:
    """Draw fringes of every found mode against frequency, with named peaks; see `response_plot`."""
    response = sweep.response
    hz, amplitude = response.drive_hz, response.amplitude_nm
    axes.plot(hz, response.peak.nm, color="0.25", linewidth=1.2, label="whole reed, largest")
    _dress(axes, response)
    peaks = [
        (name, found.frequency_hz, found.amplitude_nm, found.amplitude_error_nm)
        for name, found in sweep.measured.items()
        if found.amplitude_nm is not None
    ]
    for name, peak_hz, nm, error_nm in peaks:
        near = np.abs(np.log2(hz / peak_hz)) < _SHOWN_OCTAVES
        colour = _colour(name)
        axes.plot(hz[near], amplitude[near, response.names.index(name)], color=colour, linewidth=1)
        axes.errorbar(peak_hz, nm, error_nm, fmt="o", color=colour, markersize=5)
    what = "excitation peak" if sweep.joint else "acoustic resonance"
    for line in lines_hz:
        if hz.min() <= line <= hz.max():
            axes.axvline(line, color=_LINE_COLOUR, linestyle="--", linewidth=1)
            axes.annotate(
                f"{what} {line:.0f} Hz", (line, 0.02), xycoords=("data", "axes fraction"),
                rotation=90, ha="right", va="bottom", fontsize=8, color=_LINE_COLOUR,
            )  # fmt: skip
    for letter, word in (
        ("F", "flexural"), ("T", "transverse"), ("X", "generic"), ("L", "lateral"),
    ):  # fmt: skip
        if letter in {name[0] for name in sweep.measured}:
            axes.plot([], [], color=_DARK_COLOUR[letter], label=f"{letter}: {word} modes")
    # To the right of the axes, because peaks and their names may be anywhere on them, and below the
    # names of fringes.
    axes.legend(loc="lower left", bbox_to_anchor=(1.0, 0.0), frameon=False)
    how = "peak amplitude of every mode" if sweep.joint else "fringes counted for each mode shape"
    title = f"Reed {visible(sweep.reed)}, series {visible(sweep.series)}: {how}"
    # A name may hold what matplotlib takes for mathematics.
    axes.set_title(title, parse_math=False)
    _name_peaks(axes, {name: (peak_hz, nm) for name, peak_hz, nm, _ in peaks})


def _colour(name: str) -> str:
    return _DARK_COLOUR.get(name[0], _OTHER_COLOUR)


def _name_peaks(axes: Axes, peaks: Mapping[str, tuple[float, float]]) -> None:
    """Write a name above each peak (Hz, nm), after the layout has given axes their final size."""
    figure = axes.get_figure(root=True)
    layout = figure.get_layout_engine() if figure else None
    if figure and layout:
        layout.execute(figure)
    dots = axes.transData.transform(list(peaks.values())) if peaks else np.empty((0, 2))
    heights = label_heights(axes.figure.dpi_scale_trans.inverted().transform(dots) * 72)
    for (name, (peak_hz, nm)), height in zip(peaks.items(), heights, strict=True):
        colour = _colour(name)
        axes.annotate(
            f"{name}\n{peak_hz:.0f} Hz\n{nm:.0f} nm", (peak_hz, nm),
            xytext=(0, height), textcoords="offset points", ha="center", fontsize=8, color=colour,
            arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.5},
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.3},
        )  # fmt: skip


def label_heights(peaks_pt: Array) -> list[float]:
    """Heights in points at which names stand above peaks (n, 2) and not on each other."""
    placed: list[tuple[float, float]] = []
    heights = []
    for x, y in np.asarray(peaks_pt):
        height = _LOWEST_PT
        while any(
            abs(x - there) < _LABEL_PT[0] and abs(y + height - at) < _LABEL_PT[1]
            for there, at in placed
        ):
            height += 1.0
        placed.append((float(x), float(y) + height))
        heights.append(height)
    return heights


def _dress(axes: Any, response: Response) -> None:
    """Axes of the response plot: logarithmic, with plain numbers."""
    hz = response.drive_hz
    largest_nm = float(np.nanmax(np.append(response.peak.nm, response.amplitude_nm)))
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(hz.min() / _MARGIN, hz.max() * _MARGIN)
    axes.set_ylim(_LOWEST_NM, 4 * max(largest_nm, 20 * _LOWEST_NM))
    heights = [10**n for n in range(1, 6) if _LOWEST_NM < 10**n < axes.get_ylim()[1]]
    axes.set_yticks(heights, [f"{height:g}" for height in heights])
    ticks = [1500, 2000, 3000, 4000, 5000, 7000, 10000, 14000, 20000]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("drive frequency (Hz)")
    axes.set_ylabel("displacement, rest to largest deflection (nm)")
    maxima_nm = 1e9 * first_sideband_maxima_m(max(_FRINGES), response.wavelength_m)
    for fringe in _FRINGES:
        nm = float(maxima_nm[fringe - 1])
        if nm > axes.get_ylim()[1]:
            continue
        axes.axhline(nm, color="0.6", linewidth=0.8, linestyle=":")
        axes.annotate(
            f"bright fringe {fringe}: {nm:.0f} nm", (1.005, nm),
            xycoords=("axes fraction", "data"), fontsize=8, color="0.4", va="center",
        )  # fmt: skip
    axes.grid(True, which="major", alpha=0.2)
