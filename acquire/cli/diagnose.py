"""The verbs `acquire diagnose` and `acquire effects`."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.app import (
    AsJson,
    Debug,
)
from acquire.cli.console import messages, results, show_json, show_message

if TYPE_CHECKING:
    pass


def diagnose(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[RUN …]",
            help="Run files of one reed in one series, folders of run files, or a CSV table of "
            "resonances of clarinet reeds.",
        ),
    ] = None,
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
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Find where measurement and simulation differ, the likeliest cause, and its share.

    Give it all runs of a campaign (dark, flat, local oscillator alone, order 0 at rest, and sweeps
    up, down, at low amplitude, shuffled and after a new clamping). With fewer runs the answer is
    less certain, and the missing runs are listed.
    """
    from fitting.errors import FitInputError

    tables = [path for path in runs or () if path.suffix.lower() == ".csv"]
    if published or tables:
        if len(runs or ()) != len(tables) or (published and tables):
            raise FitInputError(
                "run files, a table of resonances and --published exclude each other; give one"
            )
        if len(tables) > 1:
            raise FitInputError(f"{len(tables)} tables of resonances were given; give one")
        if out or following or bench:
            raise FitInputError(
                "--bench, --out and --next are for runs, not for a table of resonances"
            )
        _diagnose_resonances(tables[0] if tables else None, as_json)
        return
    if not runs:
        raise FitInputError("no data: give run files, a table of resonances, or --published")
    _diagnose_runs(runs, bench, out, following, as_json)


def _diagnose_runs(
    paths: Sequence[Path],
    bench_name: str | None,
    out: Path | None,
    following: Path | None,
    as_json: bool,
) -> None:
    """Diagnose the runs of one campaign."""
    from acquire.cli.display import share_progress
    from diagnosis.campaign import Campaign
    from diagnosis.known_bench import (
        base_twin,
        bench_of,
        only_once,
    )
    from diagnosis.observing import read
    from diagnosis.verdict import diagnose as judge
    from fitting.errors import FitError
    from physics.mechanics import ReedSolver
    from physics.reed.cache import anatomy
    from protocols.bench import BenchFile
    from reports.diagnosis_json import to_json
    from reports.diagnosis_page import (
        page_output,
        words,
        write_page,
    )
    from reports.next_campaign import (
        next_outputs,
        require_repeatable,
        write_next,
    )
    from reports.own_output import require_writable
    from runs.reader import Run

    bench = BenchFile.from_file(bench_name) if bench_name else None
    files = [file for path in paths for file in _run_files(path)]
    outputs = [] if out is None else [page_output(out)]
    outputs += [] if following is None else next_outputs(following)
    require_writable(outputs, [*files, *([Path(bench_name)] if bench_name else [])])
    with contextlib.ExitStack() as opened:
        campaign = Campaign.of([opened.enter_context(Run.open(file)) for file in files])
        if following is not None:
            require_repeatable(campaign.sweeps[0].run, following)
        bench = bench or bench_of(campaign.sweeps[0].run)
        base = base_twin(bench)
        geometry = campaign.sweeps[0].run.reed_file().geometry()
        reed_solver = ReedSolver(anatomy(geometry, announce=show_message), show_message)
        with share_progress(messages(), "fitting sweeps") as told:
            readings = read(campaign, bench, told)
    with share_progress(messages(), "fitting causes") as told:
        try:
            verdict = judge(readings, reed_solver, base, told, only_once(bench))
        except ValueError as error:
            raise FitError(
                f"{campaign.sweeps[0].run.path}: no reed of its kind is near what its campaign "
                f"shows ({error}); check the reed, the series and the bench file"
            ) from error
    if out is not None:
        runs = [file.name for file in files]
        write_page(verdict, f"Diagnosis of {campaign.sweeps[0].run.reed}", out, runs)
    if as_json:
        show_json(to_json(verdict))
    else:
        console = results()
        for line in words(verdict):
            console.print(line, markup=False, soft_wrap=True)
    if following is not None:
        first = campaign.sweeps[0].run
        write_next(verdict.next_actions, verdict.rivals, first.protocol_text, first.reed, following)


def _run_files(path: Path) -> list[Path]:
    """Run files of a folder, or the one that is named.

    Raises
    ------
    FitInputError
        If a folder has none.
    """
    from fitting.errors import FitInputError

    files = sorted(path.glob("*.h5")) if path.is_dir() else [path]
    if not files:
        raise FitInputError(f"{path}: holds no run files (*.h5)")
    return files


def _diagnose_resonances(table: Path | None, as_json: bool) -> None:
    """Diagnose resonances without a run: a table's, or the paper's."""
    from acquire.cli.display import share_progress
    from diagnosis.mean_reed import printed_reeds, tabled_reeds
    from diagnosis.published import diagnose_resonances
    from fitting.errors import FitInputError
    from physics.effects.catalogue import BY_ID, CATALOGUE
    from physics.mechanics import ReedSolver
    from physics.reed.cache import anatomy
    from reports.resonance_diagnosis_page import (
        gap_of_modes,
        to_json,
        trials_table,
        words,
    )

    reeds = tabled_reeds(table, show_message) if table else printed_reeds()
    reed_solver = ReedSolver(anatomy(announce=show_message), show_message)
    with share_progress(messages(), "fitting causes") as told:
        try:
            diagnosis = diagnose_resonances(reeds, reed_solver, CATALOGUE, told)
        except ValueError as error:
            raise FitInputError(
                f"{table or 'Table 1'}: no clarinet reed has resonances near these ({error}); "
                "check frequencies and names of modes"
            ) from error
    if as_json:
        show_json(to_json(diagnosis))
        return
    console = results()
    console.print(gap_of_modes(diagnosis))
    console.print(trials_table(diagnosis))
    for line in words(diagnosis, BY_ID):
        console.print(line, markup=False, soft_wrap=True)


def effects(as_json: AsJson = False, debug: Debug = False) -> None:
    """List the causes that `acquire diagnose` can recognise, each with its expected size."""
    from physics.effects.catalogue import CATALOGUE
    from reports.effects import effects_table, effects_to_json

    if as_json:
        show_json(effects_to_json(CATALOGUE))
        return
    results().print(effects_table(CATALOGUE))
