"""A diagnosis as one self-contained HTML page, and as words for the command line."""

import base64
import html
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from acquire.errors import RunFileError
from diagnosis.how_far import Shrinkage
from diagnosis.verdict import Verdict
from diagnosis.where import Cell, Map
from fitting.drawing import png_of
from physics.effects.catalogue import BY_ID
from physics.effects.form import Tap

TAP_WORDS: Final[Mapping[Tap, str]] = {
    Tap.LOG: "logs",
    Tap.DRIVE: "drive",
    Tap.SENSOR: "sensor",
    Tap.HOLOGRAM: "holograms",
    Tap.FIELD: "field of the reed at rest",
    Tap.MAPS: "sideband maps",
    Tap.RESPONSE: "response",
    Tap.MODES: "modes",
    Tap.MATERIAL: "material",
}
_AXES: Final = (("band", "frequency band"), ("mode", "mode"), ("time", "time"), ("level", "level"))
_NOT_PROOF: Final = "Closing a gap does not prove its cause: a wrong effect may close it as well."
_LARGEST = 30.0
_SHOWN = 12
_STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c1c1c; max-width: 1100px;
       margin: 2rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.4rem; }
.lead { font-size: 1.15rem; }
table { border-collapse: collapse; margin: 0.6rem 0; }
th, td { padding: 0.15rem 0.7rem; text-align: left; border-bottom: 1px solid #ddd; }
td.number { text-align: right; }
img { max-width: 100%; display: block; } .facts { color: #555; }
"""


def words(verdict: Verdict) -> list[str]:
    """What the diagnosis says, in sentences."""
    said = [_headline(verdict), _where(verdict.where)]
    likely = "; ".join(_class_words(group, verdict) for group in verdict.likely)
    said.append(f"Likely, 90 % together: {likely}.")
    if verdict.closed is not None and verdict.effects:
        said.append(_closed_words(verdict))
        said.append(_NOT_PROOF)
    if verdict.next_actions:
        best = verdict.next_actions[0]
        one, other = verdict.rivals
        said.append(
            f"To tell {_title(one)} from {_title(other)}: {best.action.words} "
            f"({best.action.minutes:g} min, about {best.nats:.1f} nats)."
        )
    said += [f"Not measured: {what}." for what in verdict.missing]
    said += [f"Not used: {why}." for why in verdict.refused]
    return said


def _headline(verdict: Verdict) -> str:
    if verdict.kind == "none":
        p = verdict.probability.get("none", 0.0)
        return f"Nothing is seen to be wrong with the twin ({p:.0%})."
    if verdict.kind == "unknown":
        p = verdict.probability.get("unknown", 0.0)
        worst = max(verdict.contest.unknown, key=lambda name: verdict.contest.unknown[name])
        return f"Something that the catalogue does not have ({p:.0%}), seen in: {worst}."
    if verdict.kind == "not converged":
        return "Not converged: no fit can be trusted, so no effect is named."
    name = "+".join(verdict.effects)
    titles = " and ".join(_title(effect) for effect in verdict.effects)
    return f"The twin leaves out: {titles} ({verdict.probability.get(name, 0.0):.0%})."


def _where(where: Map) -> str:
    tap = where.first_failing
    if tap is None:
        return "No tap differs by more than its floor: what is there is not resolvable."
    gap, _ = where.taps[tap]
    return f"First tap that differs: {tap} ({TAP_WORDS[tap]}), {gap:.1f} times its floor."


def _class_words(group: tuple[str, ...], verdict: Verdict) -> str:
    p = sum(verdict.probability.get(name, 0.0) for name in group)
    titles = " or ".join(_title(name) for name in group)
    return f"{titles} ({p:.0%})"


def _title(name: str) -> str:
    parts = [BY_ID[part].title if part in BY_ID else part for part in name.split("+")]
    return " and ".join(parts) if name != "none" else "no effect"


def _closed_words(verdict: Verdict) -> str:
    said = f"It closes {_share(verdict.closed)} of the gap on numbers left out"
    if verdict.transferred is not None:
        said += f", {_share(verdict.transferred)} in sweep '{verdict.condition}', left out whole"
    return said + "."


def _share(closed: Shrinkage | None) -> str:
    if closed is None or math.isnan(closed.kappa):
        return "no resolvable part"
    if math.isnan(closed.low):
        return f"{closed.kappa:.0%}"
    return f"{closed.kappa:.0%} [{closed.low:.0%}, {closed.high:.0%}]"


def write_page(verdict: Verdict, title: str, page: Path) -> None:
    """Write the page.

    Raises
    ------
    RunFileError
        If it cannot be written.
    """
    try:
        page.write_text(document(verdict, title), encoding="utf-8")
    except OSError as error:
        raise RunFileError(
            f"{page}: cannot be written ({error.strerror}); choose another place with --out"
        ) from error


def document(verdict: Verdict, title: str) -> str:
    """The whole page."""
    said = words(verdict)
    picture = base64.b64encode(png_of(draw_map(verdict.where), dpi=110)).decode()
    body = [
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="lead">{html.escape(said[0])}</p>',
        *(f"<p>{html.escape(sentence)}</p>" for sentence in said[1:]),
        "<h2>Where</h2>",
        f'<img alt="Gap of every cell" src="data:image/png;base64,{picture}">',
        '<p class="facts">Gap in units of its floor: errors of data, numerics and inputs. Below 1 '
        "it is not resolvable, which does not mean that twin and bench agree.</p>",
        "<h2>Which</h2>",
        _effects(verdict),
        "<h2>What to measure next</h2>",
        _actions(verdict),
    ]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>"
        f"<body>{''.join(body)}</body></html>"
    )


def _effects(verdict: Verdict) -> str:
    found = verdict.contest
    rows = []
    shown = sorted(verdict.probability.items(), key=lambda item: -item[1])[:_SHOWN]
    for name, p in shown:
        rival = found.alone.get(name)
        size = ""
        if rival is not None:
            sized = rival.effects[0]
            z = rival.estimate.z[len(rival.estimate.z) - len(sized.sizes) :]
            size = "; ".join(
                f"{parameter.name} {parameter.spread * float(v):.2g} {parameter.unit}".strip()
                for parameter, v in zip(sized.sizes, z, strict=True)
            )
        effect = BY_ID.get(name)
        action = effect.action if effect else ""
        rows.append(
            f'<tr><td>{html.escape(_title(name))}</td><td class="number">{p:.1%}</td>'
            f"<td>{html.escape(size)}</td><td>{html.escape(action)}</td></tr>"
        )
    return (
        "<table><tr><th>effect</th><th>probability</th><th>size</th><th>what tells it apart</th>"
        f"</tr>{''.join(rows)}</table>"
    )


def _actions(verdict: Verdict) -> str:
    rows = [
        f'<tr><td>{html.escape(w.action.words)}</td><td class="number">{w.action.minutes:g}</td>'
        f'<td class="number">{w.nats:.1f}</td><td class="number">{w.nats_per_minute:.2f}</td></tr>'
        for w in verdict.next_actions
    ]
    one, other = verdict.rivals
    between = f"to tell {_title(one)} from {_title(other)}" if one else ""
    return (
        f'<p class="facts">Expected log odds {html.escape(between)}.</p><table><tr><th>action</th>'
        f"<th>minutes</th><th>nats</th><th>nats per minute</th></tr>{''.join(rows)}</table>"
    )


def draw_map(where: Map) -> Figure:
    """Draw the gap of all cells: blocks of numbers by band, mode, time and level."""
    blocks = [cell for cell in where.cells if cell.axis == "block"]
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
    for ax, (axis, title, labels) in zip(axes, [("block", "all", ["all"]), *panels], strict=True):
        table = np.full((len(blocks), len(labels)), np.nan)
        for cell in where.cells:
            if cell.axis == axis:
                column = 0 if axis == "block" else labels.index(_short(cell))
                row = next(k for k, block in enumerate(blocks) if block.block == cell.block)
                own = cell.gap if cell.resolvable else 0.5
                table[row, column] = np.nanmax([table[row, column], own])
        image = ax.imshow(np.clip(table, 0.5, _LARGEST), cmap=colours, norm=norm, aspect="auto")
        ax.set_xticks(range(len(labels)), labels, rotation=90, fontsize=7)
        ax.set_yticks(range(len(blocks)), [])
        ax.set_title(title, fontsize=8)
        ax.set_facecolor("white")
    names = [f"{block.block}  {block.tap}" for block in blocks]
    axes[0].set_yticks(range(len(blocks)), names, fontsize=8)
    bar = figure.colorbar(image, ax=list(axes), fraction=0.03, pad=0.01, extend="max")
    bar.ax.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"], minor=False)
    bar.set_label("gap in units of its floor (grey: not resolvable)", fontsize=8)
    return figure


def _short(cell: Cell) -> str:
    """Label of a cell, sweeps without their pieces."""
    in_pieces = cell.axis == "time" and cell.label[-1:].isdigit()
    return cell.label.rsplit(" ", 1)[0] if in_pieces else cell.label
