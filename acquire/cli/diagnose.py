"""The verbs `acquire diagnose` and `acquire effects`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from acquire.cli.app import (
    AsJson,
    Debug,
)
from acquire.cli.console import messages, results, show_json, show_message
from acquire.errors import UsageError

RunsOrTable = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="[RUN …]",
        help="Run files of one reed in one series, folders of run files, or a CSV table of "
        "resonances of clarinet reeds.",
    ),
]
Adopt = Annotated[
    Path | None,
    typer.Option(
        metavar="BENCH.yaml",
        help="Bench file of the runs: write the cause that is found into its section known:, with "
        "size and standard error. The next diagnosis, and the simulated bench, then include it.",
    ),
]


def diagnose(
    runs: RunsOrTable = None,
    published: Annotated[
        bool,
        typer.Option("--published", help="Use Table 1 of the paper as data, instead of run files."),
    ] = False,
    bench: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="Bench file whose section known: lists known effects of this bench.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="PAGE.html", help="HTML page to write.")
    ] = None,
    following: Annotated[
        Path | None,
        typer.Option(
            "--next",
            metavar="FILE.yaml",
            help="Campaign file to write, which would best separate the likeliest causes.",
        ),
    ] = None,
    adopt: Adopt = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Find where measurement and simulation differ, the likeliest cause, and how much it explains.

    Give it all runs of a campaign (dark, flat, local oscillator alone, the reed at rest, and sweeps
    up, down, at low amplitude, shuffled and after a new clamping). With fewer runs the answer is
    less certain, and the missing runs are listed.
    """
    tables = [path for path in runs or () if path.suffix.lower() == ".csv"]
    if published or tables:
        _require_no_runs(runs or [], tables, published)
        if out or following or bench or adopt:
            raise UsageError(
                "--bench, --out, --next and --adopt are for runs, not for a table of resonances"
            )
        _diagnose_resonances(tables[0] if tables else None, as_json)
        return
    if not runs:
        raise UsageError("no data: give run files, a table of resonances, or --published")
    _diagnose_runs(runs, bench, out, following, adopt, as_json)


def _require_no_runs(runs: Sequence[Path], tables: Sequence[Path], published: bool) -> None:
    """Refuse run files together with a table of resonances, and two tables."""
    if len(runs) != len(tables) or (published and tables):
        raise UsageError(
            "run files, a table of resonances and --published exclude each other; give one"
        )
    if len(tables) > 1:
        raise UsageError(f"{len(tables)} tables of resonances were given; give one")


def _diagnose_runs(
    runs: Sequence[Path],
    bench: str | None,
    out: Path | None,
    following: Path | None,
    adopt: Path | None,
    as_json: bool,
) -> None:
    """Diagnose the runs of one campaign."""
    import acquire
    from acquire.cli.display import stage_progress
    from reports.diagnosis_page import adopted_words, words

    with stage_progress(messages()) as progress:
        found = acquire.diagnose(
            *runs,
            bench=bench,
            out=out,
            next_campaign=following,
            adopt=adopt,
            announce=show_message,
            progress=progress,
        )
    if as_json:
        show_json(found.to_json())
        return
    console = results()
    lines = words(found.verdict)
    if adopt is not None:
        lines.append(adopted_words(found.adopted, adopt))
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def _diagnose_resonances(table: Path | None, as_json: bool) -> None:
    """Diagnose resonances without a run: those of a table, or the paper's."""
    import acquire
    from acquire.cli.display import stage_progress
    from physics.effects.catalogue import BY_ID
    from reports.resonance_diagnosis import gap_of_modes, trials_table, words
    from reports.tables import terminal_table

    with stage_progress(messages()) as progress:
        found = acquire.diagnose_resonances(table, announce=show_message, progress=progress)
    if as_json:
        show_json(found.to_json())
        return
    console = results()
    console.print(terminal_table(gap_of_modes(found.diagnosis)))
    console.print(terminal_table(trials_table(found.diagnosis)))
    for line in words(found.diagnosis, BY_ID):
        console.print(line, markup=False, soft_wrap=True)


def effects(as_json: AsJson = False, debug: Debug = False) -> None:
    """List the causes that `acquire diagnose` can recognise, each with its usual size."""
    from physics.effects.catalogue import CATALOGUE
    from reports.effects import effects_table, effects_to_json
    from reports.tables import terminal_table

    if as_json:
        show_json(effects_to_json(CATALOGUE))
        return
    results().print(terminal_table(effects_table(CATALOGUE)))
