"""Tables of resonances of many reeds, read piece by piece.

A table of resonances is a CSV file with the columns reed, series, mode and hz, and error_cents if
errors differ; the rows of one reed stand together.
"""

import csv
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from fitting.errors import FitInputError
from fitting.forward import cents_of
from holography.arrays import Array
from physics.reed.cane.viscoelastic import Series
from protocols.units import invisible_character, shown_value

COLUMNS = ("reed", "series", "mode", "hz")
ERROR_COLUMN = "error_cents"
RUN_COLUMN = "run"
# A picture of the paper's 25-cent grid may be off by half its distance to its neighbours.
GRID_ERROR_CENTS = 25 / math.sqrt(12)
_SERIES = tuple(Series)
# Chosen: from the lowest tone that an ear hears to five times the highest mode that is computed.
# Below it lies what was written in kHz, above it what lost its decimal point.
_LEAST_HZ, _MOST_HZ = 20.0, 100_000.0
# Chosen: a millionth of a cent is finer than any counter, ten octaves are more than any reed has.
_LEAST_CENTS, _MOST_CENTS = 1e-6, 12_000.0
# Python's own numbers may also have underscores, and digits of any script.
_DECIMAL = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class Resonances:
    """Resonances of n reeds.

    Attributes
    ----------
    reeds : tuple of str
        n names.
    cents : (n, 2, m) float
        Above F6, series A and B; NaN where missing.
    error_cents : (n, 2, m) float
    passed_over : int
        Rows whose mode the metamodel does not know.
    """

    reeds: tuple[str, ...]
    cents: Array
    error_cents: Array
    passed_over: int


@dataclass(frozen=True)
class _Row:
    line: int
    reed: str
    series: int
    mode: str
    cents: float
    error_cents: float


def read_resonances(path: Path, modes: tuple[str, ...], reeds: int = 8192) -> Iterator[Resonances]:
    """Read a table of resonances, some thousands of reeds at a time.

    Parameters
    ----------
    path : Path
    modes : tuple of str
        m modes to keep.
    reeds : int
        Most reeds of one piece.

    Raises
    ------
    FitInputError
        Naming the file, the line and the remedy.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = _rows(path, file)
            by_reed = _one_reed_each(path, rows)
            while piece := list(islice(by_reed, reeds)):
                yield _gathered(path, piece, modes)
    except OSError as error:
        raise FitInputError(f"{path}: {error.strerror}; name a table of resonances") from error
    except UnicodeDecodeError:
        raise FitInputError(f"{path}: is no text in UTF-8; save it as CSV (UTF-8)") from None


def _rows(path: Path, file: TextIO) -> Iterator[_Row]:
    reader = csv.DictReader(file, strict=True)
    try:
        _require_columns(path, reader.fieldnames or ())
        for row in reader:
            yield _row(path, reader.line_num, row)
    except csv.Error as error:
        raise FitInputError(f"{path}: line {reader.line_num}: {error}; mend the line") from None


def _require_columns(path: Path, columns: Sequence[str]) -> None:
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        raise FitInputError(
            f"{path}: line 1: has no column {', '.join(missing)}; a table of resonances has the "
            f"columns {', '.join(COLUMNS)}"
        )
    for name in (*COLUMNS, ERROR_COLUMN):
        if columns.count(name) > 1:
            raise FitInputError(f"{path}: line 1: has the column {name} twice; keep one")


def _row(path: Path, line: int, row: dict[str, Any]) -> _Row:
    """Check a row; csv keeps cells that have no column under None.

    Raises
    ------
    FitInputError
    """

    def refuse(column: str, remedy: str) -> FitInputError:
        shown = shown_value(row.get(column) or "")
        return FitInputError(f"{path}: line {line}: {column} {shown}; {remedy}")

    def number(column: str, least: float, most: float, remedy: str) -> float:
        text = (row.get(column) or "").strip()
        value = float(text) if _DECIMAL.fullmatch(text) else math.nan
        if not least <= value <= most:
            raise refuse(column, remedy)
        return value

    if any(row.get(None) or ()):  # type: ignore[call-overload]  # the key that csv gives them
        raise FitInputError(
            f"{path}: line {line}: has more cells than the table has columns; write decimals with "
            "a point, and names that have a comma in quotes"
        )
    reed, series, mode = ((row[column] or "").strip() for column in COLUMNS[:3])
    unseen = invisible_character(reed + mode)
    if unseen:
        raise FitInputError(f"{path}: line {line}: holds the character {unseen}; leave it out")
    if not reed:
        raise refuse("reed", "write a name that tells this reed from others")
    if series not in _SERIES:
        raise refuse("series", "write A or B")
    if not mode:
        raise refuse("mode", "write its name, such as F1")
    hz = number("hz", _LEAST_HZ, _MOST_HZ, "write a frequency in Hz, such as 1996.2")
    error = GRID_ERROR_CENTS
    if ERROR_COLUMN in row:
        error = number(ERROR_COLUMN, _LEAST_CENTS, _MOST_CENTS, "write cents above 0, such as 7.5")
    return _Row(line, reed, _SERIES.index(Series(series)), mode, float(cents_of(hz)), error)


def _one_reed_each(path: Path, rows: Iterable[_Row]) -> Iterator[list[_Row]]:
    """Rows of one reed after the other."""
    gathered: list[_Row] = []
    # Names alone: a table sorted by mode would else pass for thousands of reeds of one row.
    seen: set[str] = set()
    for row in rows:
        if gathered and row.reed != gathered[0].reed:
            seen.add(gathered[0].reed)
            yield gathered
            gathered = []
        if row.reed in seen:
            raise FitInputError(
                f"{path}: line {row.line}: reed {shown_value(row.reed)} comes back after another; "
                "sort the table by reed"
            )
        gathered.append(row)
    if gathered:
        yield gathered


def _gathered(path: Path, piece: list[list[_Row]], modes: tuple[str, ...]) -> Resonances:
    places = {name: m for m, name in enumerate(modes)}
    cents = np.full((len(piece), len(_SERIES), len(modes)), np.nan)
    errors = np.full_like(cents, GRID_ERROR_CENTS)
    passed_over = 0
    for n, rows in enumerate(piece):
        for row in rows:
            m = places.get(row.mode)
            if m is None:
                passed_over += 1
                continue
            if not np.isnan(cents[n, row.series, m]):
                raise FitInputError(
                    f"{path}: line {row.line}: reed {shown_value(row.reed)} has a second "
                    f"{row.mode} in series {_SERIES[row.series]}; keep one"
                )
            cents[n, row.series, m], errors[n, row.series, m] = row.cents, row.error_cents
    return Resonances(tuple(rows[0].reed for rows in piece), cents, errors, passed_over)
