"""Tables of resonances of many reeds, read piece by piece, and of the components fitted to them.

A table of resonances is a CSV file with the columns reed, series, mode and hz, and error_cents if
errors differ; the rows of one reed stand together.
"""

import csv
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FitInputError
from fitting.forward import cents_of
from fitting.populations import Flag, PopulationFit
from physics.reed.viscoelastic import Series

Array = NDArray[np.floating[Any]]

COLUMNS = ("reed", "series", "mode", "hz")
ERROR_COLUMN = "error_cents"
# A picture of the paper's 25-cent grid may be off by half its distance to its neighbours.
GRID_ERROR_CENTS = 25 / math.sqrt(12)
_SERIES = tuple(Series)


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
        with path.open(newline="", encoding="utf-8") as file:
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
        missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise FitInputError(
                f"{path}: line 1: has no column {', '.join(missing)}; a table of resonances has "
                f"the columns {', '.join(COLUMNS)}"
            )
        for row in reader:
            yield _row(path, reader.line_num, row)
    except csv.Error as error:
        raise FitInputError(f"{path}: line {reader.line_num}: {error}; mend the line") from None


def _row(path: Path, line: int, row: dict[str, str | None]) -> _Row:
    def refuse(column: str, remedy: str) -> FitInputError:
        shown = repr(row.get(column) or "")[:40]
        return FitInputError(f"{path}: line {line}: {column} {shown}; {remedy}")

    def positive(column: str, remedy: str) -> float:
        try:
            value = float(row.get(column) or "")
        except ValueError:
            value = math.nan
        if not 0 < value < math.inf:
            raise refuse(column, remedy)
        return value

    reed, series, mode = ((row[column] or "").strip() for column in COLUMNS[:3])
    if not reed:
        raise refuse("reed", "write a name that tells this reed from others")
    if series not in _SERIES:
        raise refuse("series", "write A or B")
    if not mode:
        raise refuse("mode", "write its name, such as F1")
    hz = positive("hz", "write a frequency in Hz, such as 1996.2")
    stated = ERROR_COLUMN in row
    error = positive(ERROR_COLUMN, "write cents above 0") if stated else GRID_ERROR_CENTS
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
                f"{path}: line {row.line}: reed {row.reed!r} comes back after another; sort the "
                "table by reed"
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
                    f"{path}: line {row.line}: reed {row.reed!r} has a second {row.mode} in "
                    f"series {_SERIES[row.series]}; keep one"
                )
            cents[n, row.series, m], errors[n, row.series, m] = row.cents, row.error_cents
    return Resonances(tuple(rows[0].reed for rows in piece), cents, errors, passed_over)


def write_components(
    file: TextIO, pieces: Iterable[tuple[tuple[str, ...], PopulationFit]], count: int
) -> None:
    """Write fits as CSV: components, errors, rms, χ², misfit, number of resonances and flags.

    Parameters
    ----------
    file : text file
    pieces : iterable of (names of n reeds, fits of n reeds)
    count : int
        Components of a reed, 3 or 4.
    """
    names = [f"e{k}" for k in range(1, count + 1)]
    out = csv.writer(file, lineterminator="\n")
    heads = [column for name in names for column in (name, f"{name}_error")]
    out.writerow(
        ["reed", *heads, "rms_cents", "reduced_chi2", "misfit_cents", "resonances", "flags"]
    )
    for reeds, fit in pieces:
        pairs = np.stack([fit.components, fit.errors], axis=2).reshape(len(reeds), -1)
        for n, reed in enumerate(reeds):
            told = fit.rms_cents[n], fit.reduced_chi2[n], fit.misfit_cents[n]
            numbers = *pairs[n], *told
            values = ["" if np.isnan(v) else f"{v:.6g}" for v in numbers]
            flags = " ".join(str(flag.name) for flag in Flag(int(fit.flags[n])))
            out.writerow([reed, *values, int(fit.used[n]), flags])
