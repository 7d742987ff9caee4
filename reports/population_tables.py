"""Tables of populations: resonances of a folder's runs, components of every reed, a summary."""

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TextIO

import numpy as np

from fitting.cane.fit_runs import MethodName
from fitting.cane.sweep_fit import SweepFit
from fitting.populations.flags import Flag, PopulationFit
from fitting.populations.resonance_table import COLUMNS, ERROR_COLUMN, RUN_COLUMN
from fitting.populations.table import COMPONENTS, Measured, PopulationSummary, measure_resonances
from reports.own_output import Output, replacing, table_kind
from reports.plain_text import one_line
from reports.tables import Column, Table, write_csv

_REED, _SERIES, _MODE, _HZ = COLUMNS
_RESONANCE_COLUMNS: Final = (
    Column(_REED, "reed"),
    Column(_SERIES, "series"),
    Column(_MODE, "mode"),
    Column(_HZ, "frequency", "Hz", ".3f"),
    Column(ERROR_COLUMN, "±", "cents", ".4g"),
    # With the run of each resonance: a table with these columns is not one that a person typed.
    Column(RUN_COLUMN, "run file"),
)
_NUMBER: Final = ".6g"
_COMPONENT_COLUMNS: Final = (
    Column("reed", "reed"),
    *(
        Column(f"e{k}{of}", f"e{k}{of}", "population SD", _NUMBER)
        for k in range(1, COMPONENTS + 1)
        for of in ("", "_error")
    ),
    Column("rms_cents", "residual", "cents", _NUMBER),
    Column("reduced_chi2", "χ² per degree of freedom", "", _NUMBER),
    Column("excess_scatter_cents", "excess scatter", "cents", _NUMBER),
    Column("resonances", "resonances", "", "d"),
    Column("flags", "flags"),
)
_RESONANCES = table_kind("resonances", [column.key for column in _RESONANCE_COLUMNS])
_COMPONENTS = table_kind("components", [column.key for column in _COMPONENT_COLUMNS])


def components_output(path: Path) -> Output:
    """Table of the components of every reed."""
    return Output(path, _COMPONENTS)


def resonances_output(path: Path) -> Output:
    """Table of the resonances of a folder's runs."""
    return Output(path, _RESONANCES, None)


@contextmanager
def opened_table(output: Output) -> Iterator[TextIO]:
    """Open a table for writing, with its header; it appears whole or not at all.

    Raises
    ------
    OutputRefusedError, OutputFailedError
        If it must not or cannot be written.
    """
    with replacing(output) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        text.write(output.kind.mark)
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
        for sweep, run in measured.sweeps:
            write_csv(file, _RESONANCE_COLUMNS, _resonance_rows(sweep, run))
    return measured


def _resonance_rows(sweep: SweepFit, run: Path) -> Iterator[Sequence[Any]]:
    # Names of files may hold bytes that are not UTF-8.
    source = one_line(str(run))
    for name, found in sweep.resonances.items():
        yield sweep.reed, sweep.series, name, found.frequency_hz, found.error_cents, source


def write_components(file: TextIO, reeds: Sequence[str], fit: PopulationFit) -> None:
    """Write fits of n reeds as CSV: components, errors, residual, χ², scatter, count and flags.

    Parameters
    ----------
    file : text file
        See `opened_table`.
    reeds : sequence of str
        n names.
    fit : PopulationFit
    """
    write_csv(file, _COMPONENT_COLUMNS, _component_rows(reeds, fit))


def _component_rows(reeds: Sequence[str], fit: PopulationFit) -> Iterator[Sequence[Any]]:
    pairs = np.stack([fit.components, fit.errors], axis=2).reshape(len(reeds), -1)
    for n, reed in enumerate(reeds):
        flags = " ".join(str(flag.name) for flag in Flag(int(fit.flags[n])))
        quality = fit.rms_cents[n], fit.reduced_chi2[n], fit.excess_scatter_cents[n]
        yield reed, *pairs[n], *quality, int(fit.used[n]), flags


def summary_table(summary: PopulationSummary) -> Table:
    """Return mean and standard deviation of each component."""
    known = summary.to_json()
    rms = "" if known["rms_cents"] is None else f", rms {known['rms_cents']:.1f} cents"
    unit = "population SD"
    columns = (
        Column("component", "component"),
        Column("reeds", "reeds", "", "d", "reeds whose fit gives the component"),
        Column("mean", "mean", unit, ".2f"),
        Column("sd", "SD", unit, ".2f", "standard deviation from reed to reed"),
        Column("rms_error", "± s.e.", unit, ".2f", "root mean square of the standard errors"),
    )
    rows = tuple(
        (name, row["reeds"], row["mean"], row["sd"], row["rms_error"])
        for name, row in known["components"].items()
    )
    title = f"{summary.reeds} reeds, {summary.resonances} resonances{rms}"
    return Table(columns, rows, title)


def remarks(summary: PopulationSummary, measured: Measured | None = None) -> list[str]:
    """Return acoustic resonances, rows that were not used, and flags of fits, a line each.

    Parameters
    ----------
    summary : PopulationSummary
    measured : Measured, optional
        What the runs of a folder gave, if they were measured.
    """
    lines = (measured.acoustic_lines if measured else None) or ()
    said = [
        f"acoustic resonance at {line.hz:.1f} ± {line.error_hz:.1f} Hz ({line.height_db:+.1f} dB): "
        f"{line.reeds} of {line.of} reeds show it, so it belongs to the air or the loudspeaker"
        for line in lines
    ]
    if summary.passed_over:
        said.append(f"{summary.passed_over} resonances not used: the model does not know the mode")
    flags = summary.flags.items()
    return [*said, *(f"{count} reeds: {flag.lower().replace('_', ' ')}" for flag, count in flags)]
