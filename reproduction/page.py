"""The comparison as one self-contained HTML page, and as a table for the command line."""

import base64
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from rich.table import Table

from reports.drawing import png_of
from reports.own_output import (
    Output,
    page_kind,
    write_output,
)
from reports.plain_text import escaped
from reproduction.rows import (
    Drawing,
    Group,
    Row,
    Verdict,
)
from reproduction.whole import Comparison

_TITLE: Final = "The paper, number by number"
_PAPER: Final = (
    "P.-A. Taillard, F. Laloë, M. Gross, J.-P. Dalmont and J. Kergomard, “Statistical estimation "
    "of mechanical parameters of clarinet reeds using experimental and numerical approaches”"
)
_PAGE: Final = page_kind("paper")
_STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c1c1c; max-width: 1320px;
       margin: 2rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.5rem; margin-bottom: 0.2rem; }
h2 { font-size: 1.15rem; margin-top: 2.6rem; }
table { border-collapse: collapse; margin: 0.6rem 0; width: 100%; }
th, td { padding: 0.15rem 0.6rem; text-align: right; border-bottom: 1px solid #ddd;
         vertical-align: top; white-space: nowrap; }
th { font-weight: 600; border-bottom: 1px solid #999; }
td.words, th.words { text-align: left; }
td.remark { text-align: left; color: #555; font-size: 13px; white-space: normal; }
td.quantity { text-align: left; white-space: normal; min-width: 15rem; }
table.short { width: auto; }
img { max-width: 100%; display: block; margin: 0.8rem 0 0.2rem; }
figcaption, .facts { color: #555; } figure { margin: 1rem 0; }
summary { cursor: pointer; color: #0055a4; margin: 0.6rem 0; }
.key { padding: 0 0.5rem; }
.near { background: #fff6d6; } .far { background: #ffe0c2; } .farthest { background: #ffc9c2; }
.refuted { background: #dde7f7; }
"""
# Shades of what differs, up to how many tolerances.
_SHADES: Final = ((2.0, "near"), (4.0, "far"), (float("inf"), "farthest"))
_SHADE_WORDS: Final = {
    "near": "differs by up to 2 tolerances",
    "far": "by up to 4",
    "farthest": "by more",
    "refuted": "refuted: the page shows why the printed number is off",
}
_HEAD: Final = (
    "table", "quantity", "printed", "ours", "unit", "difference", "tolerated", "basis", "remark",
)  # fmt: skip
_WORDS: Final = ("table", "quantity", "unit", "basis", "remark")
# A hyphen that is a minus.
_SIGNED: Final = re.compile(r"(?<!\w)-(?=\d)")
# Shown at once; the others unfold.
_SHOWN: Final = (Verdict.DIFFERS, Verdict.REFUTED, Verdict.NOT_PRINTED)


def page_output(page: Path) -> Output:
    """Page as an output, for `reports.own_output.require_writable`."""
    return Output(page, _PAGE)


def write_page(comparison: Comparison, page: Path) -> None:
    """Write the page.

    Parameters
    ----------
    comparison : Comparison
    page : Path
        An older page of the paper there is replaced, and nothing else.

    Raises
    ------
    OutputRefusedError, OutputFailedError
        If it must not or cannot be written.
    """
    write_output(page_output(page), document(comparison))


def document(comparison: Comparison) -> str:
    """The whole page."""
    body = [_summary(comparison), *map(_section, comparison.groups)]
    return (
        f"{_PAGE.mark}<title>{_TITLE}</title>"
        f"<style>{_STYLE}</style></head><body>{''.join(body)}</body></html>"
    )


def counts_table(comparison: Comparison) -> Table:
    """Numbers of rows by group and verdict, for the command line."""
    table = Table(title="The paper's numbers compared with ours")
    table.add_column("group")
    for verdict in Verdict:
        table.add_column(str(verdict), justify="right")
    for group in comparison.groups:
        table.add_row(
            group.title.partition(":")[0], *(str(group.count(verdict)) for verdict in Verdict)
        )
    table.add_section()
    table.add_row("all", *(str(comparison.count(verdict)) for verdict in Verdict))
    return table


def _summary(comparison: Comparison) -> str:
    count = {verdict: comparison.count(verdict) for verdict in Verdict}
    printed = len(comparison.rows) - count[Verdict.NOT_PRINTED]
    had = printed - count[Verdict.NOT_REPRODUCIBLE]
    lead = (
        f"{printed} comparisons with printed numbers. For {had} of them the text suffices, or "
        "synthetic populations of reeds whose truth is known stand in for the 55 reeds: "
        f"{count[Verdict.REPRODUCED]} are reproduced within the tolerance that stands at each "
        f"table, {count[Verdict.DIFFERS]} differ, and {count[Verdict.REFUTED]} are refuted. "
        f"{count[Verdict.NOT_REPRODUCIBLE]} cannot be had at all."
    )
    rows = "".join(
        f'<tr><td class="words"><a href="#{group.key}">{escaped(group.title)}</a></td>'
        + "".join(f"<td>{group.count(verdict) or '–'}</td>" for verdict in Verdict)
        + "</tr>"
        for group in comparison.groups
    )
    head = "".join(f"<th>{verdict}</th>" for verdict in Verdict)
    shades = " ".join(
        f'<span class="key {name}">{words}</span>' for name, words in _SHADE_WORDS.items()
    )
    said = "".join(f"<li>{escaped(sentence)}</li>" for sentence in comparison.findings)
    return (
        f'<h1>{_TITLE}</h1><p class="facts">{escaped(_PAPER)}. Tables are called as in its '
        f"source.</p><p>{escaped(lead)}</p><ul>{said}</ul>"
        f'<table class="short"><tr><th class="words">group</th>{head}</tr>{rows}</table>'
        f'<p class="facts">Colours: {shades}. Basis: <i>text</i>, the text suffices; '
        "<i>population</i>, the same procedure on synthetic populations; <i>none</i>, not to be "
        "had.</p>"
    )


def _section(group: Group) -> str:
    """One group: method, pictures, what is of interest, and the rest to unfold."""
    shown = [row for row in group.rows if row.verdict in _SHOWN]
    others = [row for row in group.rows if row.verdict not in _SHOWN]
    parts = [
        f'<h2 id="{group.key}">{escaped(group.title)}</h2>',
        f'<p class="facts">{escaped(group.method)}</p>',
        *map(_figure, group.drawings),
    ]
    if shown:
        parts.append(_table(shown))
    if others:
        words = f"{'The other ' if shown else ''}{len(others)} rows: {_verdicts(others)}"
        parts.append(f"<details><summary>{words}</summary>{_table(others)}</details>")
    return "".join(parts)


def _verdicts(rows: Sequence[Row]) -> str:
    counts = {verdict: sum(row.verdict is verdict for row in rows) for verdict in Verdict}
    return ", ".join(f"{n} {verdict}" for verdict, n in counts.items() if n)


def _figure(drawing: Drawing) -> str:
    data = base64.b64encode(png_of(drawing.draw(), dpi=120)).decode()
    caption = escaped(drawing.caption)
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _table(rows: Iterable[Row]) -> str:
    head = "".join(
        f'<th class="words">{name}</th>' if name in _WORDS else f"<th>{name}</th>" for name in _HEAD
    )
    return f"<table><tr>{head}</tr>{''.join(map(_line, rows))}</table>"


def _line(row: Row) -> str:
    known = row.difference is not None
    cells = (
        ("words", row.table),
        ("quantity", row.quantity),
        ("", shown_number(row.printed)),
        ("", shown_number(row.ours)),
        ("words", row.unit),
        ("", _shown_difference(row)),
        ("", _short(row.tolerance) if known else ""),
        ("words", str(row.basis)),
        ("remark", _SIGNED.sub("−", row.remark)),
    )
    inner = "".join(f'<td class="{kind}">{escaped(text)}</td>' for kind, text in cells)
    return f'<tr class="{_shade(row)}">{inner}</tr>'


def _shade(row: Row) -> str:
    if row.verdict is Verdict.REFUTED:
        return "refuted"
    if row.verdict is not Verdict.DIFFERS or row.difference is None:
        return ""
    tolerances = abs(row.difference) / row.tolerance if row.tolerance else float("inf")
    return next(name for most, name in _SHADES if tolerances <= most)


def shown_number(value: float | None) -> str:
    """Four or five digits, and all of a great number."""
    if value is None:
        return ""
    size = abs(value)
    text = f"{value:.0f}" if size >= 1e4 else f"{value:.5g}" if size >= 1e3 else f"{value:.4g}"
    return text.replace("-", "−")


def _shown_difference(row: Row) -> str:
    if row.difference is None:
        return ""
    # What is rounding of zero is shown as zero.
    small = abs(row.difference) < 1e-9 * max(abs(row.printed or 0.0), 1e-3)
    text = "0" if small else _short(row.difference, "+").replace("-", "−")
    other = row.difference_unit if row.difference_unit != row.unit else ""
    return f"{text} {other}".strip()


def _short(value: float, sign: str = "") -> str:
    """Three digits, and all of a whole number."""
    return f"{value:{sign}.0f}" if abs(value) >= 100 else f"{value:{sign}.3g}"
