"""The verbs about run files: `acquire list`, `show`, `pack`, `pause` and `continue`."""

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.app import (
    AsJson,
    Debug,
)
from acquire.cli.console import messages, results, show_json, show_message
from acquire.errors import UsageError
from holography.errors import BenchError

if TYPE_CHECKING:
    from acquire.runner.control import Order


def list_runs(
    folder: Annotated[Path, typer.Argument(help="Folder with run files.")] = Path("measurements"),
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """List the run files of a folder with reed, series and status."""
    from acquire.cli.display import catalogue_entry
    from reports.run_tables import runs_table
    from reports.tables import terminal_table
    from runs.errors import RunFileError
    from runs.reader import Run

    if not folder.is_dir():
        state = "is no folder" if folder.exists() else "there is no such folder"
        raise UsageError(f"{folder}: {state}; name the one with your run files")
    entries = []
    for path in sorted(folder.rglob("*.h5")):
        try:
            with Run.open(path) as run_:
                entries.append(catalogue_entry(run_))
        except RunFileError as error:
            show_message(f"acquire: {error}")
    if as_json:
        show_json(entries)
    else:
        results().print(terminal_table(runs_table(entries)))


def show_run(
    run_file: Annotated[Path, typer.Argument(metavar="RUN", help="Run file.")],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Show the contents of a run file: labels, instruments, bad steps and interruptions."""
    from acquire.cli.display import details_table, run_details
    from runs.reader import Run

    with Run.open(run_file) as run_:
        details = run_details(run_)
    if as_json:
        show_json(details)
    else:
        results().print(details_table(details))


def pack_runs(
    run_files: Annotated[
        list[Path], typer.Argument(metavar="RUN …", help="Run files of complete runs with frames.")
    ],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compress the frames of complete runs without loss, and verify the result.

    `acquire run` does this at the end. Use this command if that was interrupted.
    """
    import acquire
    from acquire.cli.display import (
        packing_line,
        packing_to_json,
        stage_progress,
    )

    answers, worst = [], 0
    for path in run_files:
        try:
            with stage_progress(messages()) as show:
                stage = functools.partial(show, f"packing {path.name}")
                packed = acquire.pack(path, callbacks=acquire.Callbacks(packing=stage))
        except BenchError as error:
            if debug:
                raise
            # One bad file does not keep the others from being packed.
            show_message(f"acquire: {error}")
            worst = max(worst, error.exit_status)
            continue
        answers.append(packing_to_json(str(path), packed))
        if not as_json:
            results().print(packing_line(str(path), packed), soft_wrap=True)
    if as_json:
        show_json(answers)
    if worst:
        raise typer.Exit(worst)


def pause_run(
    run_file: Annotated[
        Path,
        typer.Argument(
            metavar="RUN", help="Run file, or folder of a campaign, that is being measured."
        ),
    ],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Pause a running measurement after the current step and switch all outputs off."""
    _order(run_file, "pause", as_json)


def continue_run(
    run_file: Annotated[
        Path,
        typer.Argument(metavar="RUN", help="Run file, or folder of a campaign, that is paused."),
    ],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Continue a paused measurement."""
    _order(run_file, "continue", as_json)


def _order(run_file: Path, what: "Order", as_json: bool) -> None:
    from acquire.runner.control import order

    process = order(run_file, what)
    if as_json:
        show_json({"run": str(run_file), "order": what, "process": process})
    else:
        show_message(f"{run_file}: sent {what!r} to process {process}")
