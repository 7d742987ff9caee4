"""The comparison as an HTML page, and as a table for the command line."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from reports.figures.drawing import png_of
from reports.own_output import Output, page_kind, write_output
from reports.pages import Picture, render
from reports.tables import Column, Table
from reproduction.rows import Agreement, Drawing, Group, Row
from reproduction.whole import PaperComparison

_TITLE: Final = "The paper, number by number"
_PAPER: Final = (
    "P.-A. Taillard, F. Laloë, M. Gross, J.-P. Dalmont and J. Kergomard, “Statistical estimation "
    "of mechanical parameters of clarinet reeds using experimental and numerical approaches”"
)
_PAGE: Final = page_kind("paper")
# Shades of what differs, up to how many tolerances.
_SHADES: Final = ((2.0, "near"), (4.0, "far"), (float("inf"), "farthest"))
_SHADE_WORDS: Final = {
    "near": "differs by up to 2 tolerances",
    "far": "by up to 4",
    "farthest": "by more",
    "refuted": "refuted: the page shows why the printed number is wrong",
}
# A hyphen that is a minus.
_SIGNED: Final = re.compile(r"(?<!\w)-(?=\d)")
# Shown at once; the others unfold.
_SHOWN: Final = (Agreement.DIFFERS, Agreement.REFUTED, Agreement.NOT_PRINTED)


def shown_number(value: float | None) -> str:
    """Four or five digits, and all of a great number."""
    if value is None:
        return ""
    size = abs(value)
    text = f"{value:.0f}" if size >= 1e4 else f"{value:.5g}" if size >= 1e3 else f"{value:.4g}"
    return text.replace("-", "−")


def _shown_difference(row: Row) -> str:
    """Return ours less printed, with its unit if that is another than the numbers'."""
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


_COLUMNS: Final = (
    Column("table", "table", meaning="where the paper prints the number"),
    Column("quantity", "quantity"),
    Column("printed", "printed", "", shown_number),
    Column("ours", "ours", "", shown_number),
    Column("unit", "unit"),
    Column("difference", "difference", "", str,
           "ours less printed; of frequencies in cents"),
    Column("tolerance", "tolerated", "", _short,
           "largest difference that counts as reproduced"),
    Column("basis", "basis", meaning="text: the paper's text suffices; population: the same "
           "procedure on synthetic populations of reeds; none: cannot be computed"),
    Column("remark", "remark"),
)  # fmt: skip


def page_output(page: Path) -> Output:
    """Return the page as an output, for `reports.own_output.require_writable`."""
    return Output(page, _PAGE)


def write_page(comparison: PaperComparison, page: Path) -> None:
    """Write the page.

    Parameters
    ----------
    comparison : PaperComparison
    page : Path
        An older page of the paper there is replaced, and nothing else.

    Raises
    ------
    OutputRefusedError, OutputFailedError
        If it must not or cannot be written.
    """
    write_output(page_output(page), document(comparison))


def document(comparison: PaperComparison) -> str:
    """Return the whole page."""
    return render(
        "paper.html",
        _PAGE,
        _TITLE,
        paper=_PAPER,
        lead=_lead(comparison),
        findings=comparison.findings,
        verdicts=list(Agreement),
        shades=list(_SHADE_WORDS.items()),
        columns=Table(_COLUMNS, ()).meanings,
        groups=[_section(group) for group in comparison.groups],
    )


def counts_table(comparison: PaperComparison) -> Table:
    """Return numbers of rows by group and agreement, for the command line."""
    columns = (
        Column("group", "group"),
        *(Column(agreement.name.lower(), str(agreement), "", "d") for agreement in Agreement),
    )
    rows = [
        (group.title.partition(":")[0], *map(group.count, Agreement)) for group in comparison.groups
    ]
    rows.append(("all", *map(comparison.count, Agreement)))
    return Table(columns, tuple(rows), "The paper's numbers compared with ours", total=True)


def _lead(comparison: PaperComparison) -> str:
    count = {agreement: comparison.count(agreement) for agreement in Agreement}
    printed = len(comparison.rows) - count[Agreement.NOT_PRINTED]
    computed = printed - count[Agreement.NOT_REPRODUCIBLE]
    return (
        f"{printed} comparisons with printed numbers. {computed} of them can be computed, from the "
        "text alone or from synthetic populations of reeds in place of the 55 measured reeds: "
        f"{count[Agreement.REPRODUCED]} are reproduced within their tolerance, "
        f"{count[Agreement.DIFFERS]} differ, and {count[Agreement.REFUTED]} are refuted. "
        f"{count[Agreement.NOT_REPRODUCIBLE]} cannot be computed."
    )


@dataclass(frozen=True)
class _Section:
    """What the page shows of a group: method, pictures, rows of interest, and the others."""

    key: str
    title: str
    method: str
    counts: list[int]
    pictures: list[Picture]
    shown: Table | None
    others: Table | None
    others_words: str


def _section(group: Group) -> _Section:
    shown = [row for row in group.rows if row.agreement in _SHOWN]
    others = [row for row in group.rows if row.agreement not in _SHOWN]
    return _Section(
        group.key,
        group.title,
        group.method,
        [group.count(agreement) for agreement in Agreement],
        [_picture(drawing) for drawing in group.drawings],
        _rows_table(shown) if shown else None,
        _rows_table(others) if others else None,
        f"{'The other ' if shown else ''}{len(others)} rows: {_agreements(others)}",
    )


def _agreements(rows: Sequence[Row]) -> str:
    counts = {agreement: sum(row.agreement is agreement for row in rows) for agreement in Agreement}
    return ", ".join(f"{n} {agreement}" for agreement, n in counts.items() if n)


def _picture(drawing: Drawing) -> Picture:
    # The caption says what is drawn, so that it serves readers who do not see it as well.
    return Picture(png_of(drawing.draw(), dpi=120), drawing.caption, drawing.caption)


def _rows_table(rows: Sequence[Row]) -> Table:
    cells = tuple(
        (
            row.table,
            row.quantity,
            row.printed,
            row.ours,
            row.unit,
            _shown_difference(row),
            None if row.difference is None else row.tolerance,
            str(row.basis),
            _SIGNED.sub("−", row.remark),
        )
        for row in rows
    )
    return Table(_COLUMNS, cells, row_kinds=tuple(map(_shade, rows)))


def _shade(row: Row) -> str:
    if row.agreement is Agreement.REFUTED:
        return "refuted"
    if row.agreement is not Agreement.DIFFERS or row.difference is None:
        return ""
    tolerances = abs(row.difference) / row.tolerance if row.tolerance else float("inf")
    return next(name for most, name in _SHADES if tolerances <= most)
