"""Tables of results: described once, shown on the terminal, on HTML pages and in CSV files."""

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TextIO

import rich.table
from rich.box import SIMPLE
from rich.cells import cell_len
from rich.text import Text

from reports.plain_text import plain


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes
    ----------
    key : str
        Name for programs: header in CSV files, key in records.
    heading : str
        Name for people.
    unit : str
        Shown after the heading; empty for texts and plain numbers.
    format : str or callable
        Format specification such as ``.1f``, or a function from a value to its text. A column with
        a format holds numbers, which are set flush right.
    meaning : str
        What the column holds, in a few words, for readers who see such a table for the first time.
    wraps : bool
        Whether long texts are broken into lines on the terminal.

    Examples
    --------
    >>> column = Column("frequency_hz", "frequency", "Hz", ".1f")
    >>> column.title, column.shown(1996.25), column.shown(None)
    ('frequency (Hz)', '1996.2', '')
    """

    key: str
    heading: str
    unit: str = ""
    format: str | Callable[[Any], str] = ""
    meaning: str = ""
    wraps: bool = True

    @property
    def title(self) -> str:
        """Heading with unit."""
        return f"{self.heading} ({self.unit})" if self.unit else self.heading

    @property
    def is_number(self) -> bool:
        """Whether the column holds numbers."""
        return bool(self.format)

    def shown(self, value: Any) -> str:
        """Return the text of a value; empty for None and NaN."""
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return ""
        return format(value, self.format) if isinstance(self.format, str) else self.format(value)


@dataclass(frozen=True)
class Table:
    """Rows of values under columns.

    Attributes
    ----------
    columns : tuple of Column
    rows : tuple of sequences
        One value for each column; None or NaN where there is none.
    title, note : str
        Shown above and below the table.
    row_kinds : tuple of str
        Kind of each row, which pages colour; empty if all rows are of one kind.
    total : bool
        Whether the last row sums up the others.
    """

    columns: tuple[Column, ...]
    rows: tuple[Sequence[Any], ...]
    title: str = ""
    note: str = ""
    row_kinds: tuple[str, ...] = ()
    total: bool = False

    def select(self, *keys: str) -> "Table":
        """Return the table with these columns only, in this order."""
        at = [next(k for k, c in enumerate(self.columns) if c.key == key) for key in keys]
        rows = tuple([row[k] for k in at] for row in self.rows)
        columns = tuple(self.columns[k] for k in at)
        return Table(columns, rows, self.title, self.note, self.row_kinds, self.total)

    @property
    def texts(self) -> list[list[str]]:
        """Text of every cell."""
        return [
            [column.shown(value) for column, value in zip(self.columns, row, strict=True)]
            for row in self.rows
        ]

    @property
    def meanings(self) -> list[tuple[str, str]]:
        """Heading and meaning of every column whose meaning is known."""
        return [(column.heading, column.meaning) for column in self.columns if column.meaning]

    def records(self) -> list[dict[str, Any]]:
        """Return each row as a dict from column keys to values, for JSON and data frames."""
        keys = [column.key for column in self.columns]
        return [dict(zip(keys, row, strict=True)) for row in self.rows]


def records_table(title: str, records: Sequence[Mapping[str, Any]]) -> Table:
    """Return records as a table, with their keys as headings.

    Parameters
    ----------
    title : str
    records : sequence of mapping
        All with the same keys, which name quantity and unit.
    """
    columns = tuple(
        Column(
            key, key, "", _short if any(isinstance(r[key], int | float) for r in records) else ""
        )
        for key in (records[0] if records else ())
    )
    return Table(columns, tuple(list(record.values()) for record in records), title)


def _short(value: Any) -> str:
    """Return six digits of a float, and all of anything else."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def terminal_table(table: Table) -> rich.table.Table:
    """Return a table for the terminal, with as little space between columns as is readable."""
    shown = rich.table.Table(
        title=plain(table.title) if table.title else None,
        caption=plain(table.note) if table.note else None,
        title_justify="left",
        caption_justify="left",
        box=SIMPLE,
        pad_edge=False,
        padding=(0, 0, 0, 1),
    )
    texts = table.texts
    for at, column in enumerate(table.columns):
        # What does not fit is folded, never cut off: names of files must be whole to be of use.
        # Numbers are not folded either; the unit in a line of its own keeps their columns narrow.
        widest = max((cell_len(line) for row in texts for line in row[at].split("\n")), default=0)
        shown.add_column(
            Text(f"{column.heading}\n({column.unit})" if column.unit else column.heading),
            justify="right" if column.is_number else "left",
            no_wrap=column.is_number or not column.wraps,
            overflow="fold",
            min_width=widest if column.is_number else None,
        )
    for number, row in enumerate(texts, 1):
        if table.total and number == len(texts):
            shown.add_section()
        shown.add_row(*map(plain, row))
    return shown


def write_csv(file: TextIO, columns: Sequence[Column], rows: Iterable[Sequence[Any]]) -> None:
    """Write rows as CSV without a header."""
    out = csv.writer(file, lineterminator="\n")
    for row in rows:
        out.writerow([c.shown(value) for c, value in zip(columns, row, strict=True)])
