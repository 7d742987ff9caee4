"""Tables of populations: resonances of a folder's runs, components of every reed, a summary."""

import csv
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from rich.table import Table

from fitting.cane.fit_runs import MethodName, SweepFit
from fitting.populations.resonance_table import COLUMNS, ERROR_COLUMN, RUN_COLUMN, component_columns
from fitting.populations.table import COMPONENTS, Measured, PopulationSummary, measure_resonances
from reports.own_output import Output, replacing, table_kind
from reports.plain_text import one_line

# With the run of each resonance: a table with these columns is not one that a person typed.
_RESONANCE_COLUMNS = (*COLUMNS, ERROR_COLUMN, RUN_COLUMN)
_RESONANCES = table_kind("resonances", _RESONANCE_COLUMNS)
_COMPONENTS = table_kind("components", component_columns(COMPONENTS))


def components_output(path: Path) -> Output:
    """Table of the components of every reed."""
    return Output(path, _COMPONENTS)


def resonances_output(path: Path) -> Output:
    """Table of the resonances of a folder's runs."""
    return Output(path, _RESONANCES, None)


@contextmanager
def opened_table(output: Output) -> Iterator[TextIO]:
    """Open a table for writing; it appears whole or not at all.

    Raises
    ------
    OutputRefusedError, OutputFailedError
        If it must not or cannot be written.
    """
    with replacing(output) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        yield text
        # Hands over what it holds, and leaves the file open.
        text.detach()


def write_resonances(
    folder: Path,
    table: Path,
    announce: Callable[[str], None] | None = None,
    method: MethodName = "joint",
) -> Measured:
    """Find the resonances of every complete run of a folder and write them as a table.

    See `measure_resonances`.

    Raises
    ------
    FitInputError
        If no run gives resonances, or the runs are of several kinds of reeds.
    OutputRefusedError, OutputFailedError
        If the table must not or cannot be written.
    """
    measured = measure_resonances(folder, announce, method)
    with opened_table(resonances_output(table)) as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(_RESONANCE_COLUMNS)
        for sweep, run in measured.sweeps:
            out.writerows(_rows(sweep, run))
    return measured


def _rows(sweep: SweepFit, run: Path) -> list[tuple[str, ...]]:
    # Names of files may hold bytes that are not UTF-8.
    source = one_line(str(run))
    found = sweep.resonances.items()
    cells = ((name, f"{one.frequency_hz:.3f}", f"{one.error_cents:.4g}") for name, one in found)
    return [(sweep.reed, sweep.series, *own, source) for own in cells]


def summary_table(summary: PopulationSummary) -> Table:
    """What the command line shows of a population."""
    told = summary.to_json()
    rms = "" if told["rms_cents"] is None else f", rms {told['rms_cents']:.1f} cents"
    table = Table(title=f"{summary.reeds} reeds, {summary.resonances} resonances{rms}")
    for head in ("component", "reeds", "mean", "SD", "± s.e. (rms)"):
        table.add_column(head, justify="right")
    for name, row in told["components"].items():
        values = (row["mean"], row["sd"], row["rms_error"])
        shown = ["-" if value is None else f"{value:.2f}" for value in values]
        table.add_row(name, str(row["reeds"]), *shown)
    return table


def remarks(summary: PopulationSummary, measured: Measured | None = None) -> list[str]:
    """What is to be said beside the table, of a folder's runs too if they were measured."""
    lines = (measured.lines if measured else None) or ()
    of_all = measured.reeds if measured else 0
    said = [
        f"line of the air at {line.hz:.0f} Hz, {line.height_db:+.1f} dB: {line.reeds} of {of_all} "
        "reeds show it, it is none of theirs"
        for line in lines
    ]
    if summary.passed_over:
        said.append(f"{summary.passed_over} resonances of modes that the model does not know")
    flags = summary.flags.items()
    return [*said, *(f"{count} reeds: {flag.lower().replace('_', ' ')}" for flag, count in flags)]
