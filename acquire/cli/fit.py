"""The verbs `acquire fit` and `acquire report`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.app import AsJson, Debug, MethodOption, ModelOption, RunFiles
from acquire.cli.console import results, show_json, show_message

if TYPE_CHECKING:
    from rich.console import Console

    from fitting.cane.sweep_fit import ReedFit


def fit(
    runs: RunFiles,
    method: MethodOption = "joint",
    model: ModelOption = "fem",
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Find the resonances of a reed and fit its material parameters.

    Series A and B together determine all four parameters.
    """
    import acquire

    fitted = acquire.fit(*runs, method=method, model=model, announce=show_message)
    finish(fitted.to_json(), as_json, [], fitted.fit)


def acoustics(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Run files of several reeds, one bench.")
    ],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Find the acoustic resonances of the bench: excitation peaks that runs of several reeds share.

    A peak that most of three or more reeds show at the same frequency belongs to the loudspeaker,
    the chamber or the air. Each run is fitted first, in some seconds.
    """
    import acquire
    from acquire.cli.console import messages
    from reports.fit_tables import acoustics_table
    from reports.tables import terminal_table

    words = messages()
    with words.status("fitting"):
        found = acquire.acoustics(*runs, announce=words.print)
    if as_json:
        show_json(found.to_json())
        return
    results().print(terminal_table(acoustics_table(found.measured)))


def report(
    runs: RunFiles,
    out: Annotated[
        Path | None, typer.Option(help="Page to write (default: next to the run file).")
    ] = None,
    method: MethodOption = "joint",
    model: ModelOption = "fem",
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write a self-contained HTML report of a run, and its pictures as PNG files."""
    report_runs(runs, model, out, as_json, {}, method)


def report_runs(
    runs: list[Path],
    model: str,
    page: Path | None,
    as_json: bool,
    answer: dict[str, Any],
    method: str = "joint",
) -> None:
    """Fit, write the page and print the result; without a fit, the page has the pictures only."""
    import acquire
    from fitting.errors import FitError, FitInputError
    from reports.run_page import (
        page_of,
        require_report,
        write_bare_report,
        write_report,
    )

    page = page or page_of(runs[0])
    require_report(runs, page)
    fitted, failure = None, None
    try:
        fitted = acquire.fit(*runs, method=method, model=model, announce=show_message)
        files = write_report(fitted.fit, page)
    except FitInputError:
        raise
    except FitError as error:
        failure = error
        files = write_bare_report(runs, page, str(error))
    answer |= {
        "fit": fitted.to_json() if fitted else None,
        "files": {name: str(file) for name, file in files.items()},
    }
    listed = ({"run file": answer["run"]} if "run" in answer else {}) | files
    lines = [f"{name:13} {file}" for name, file in listed.items()]
    finish(answer, as_json, lines, fitted.fit if fitted else None)
    if failure:
        raise failure


def finish(
    answer: dict[str, Any], as_json: bool, lines: list[str], fitted: "ReedFit | None" = None
) -> None:
    """Print the result of a verb, as JSON or for people."""
    if as_json:
        show_json(answer)
        return
    console = results()
    if fitted is not None:
        _show_fit(console, fitted)
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def _show_fit(console: "Console", fitted: "ReedFit") -> None:
    from reports.fit_tables import parameters_table, remarks, short_resonances_table
    from reports.tables import terminal_table

    for sweep in fitted.sweeps:
        console.print(terminal_table(short_resonances_table(sweep)))
        for line in remarks(sweep):
            console.print(line, markup=False, soft_wrap=True)
    table = parameters_table(fitted)
    if table is None:
        console.print(f"no parameters: {fitted.reason}", markup=False, soft_wrap=True)
    else:
        console.print(terminal_table(table))
