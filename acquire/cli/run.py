"""The verb `acquire run`: a sweep, or a campaign."""

import contextlib
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.app import AsJson, BenchOption, Debug
from acquire.cli.console import messages, show_json, show_message
from acquire.cli.fit import finish, report_runs
from acquire.cli.option_group import takes_options
from acquire.errors import UsageError
from holography.errors import BenchError
from reports.errors import OutputFailedError
from reports.plain_text import one_line

if TYPE_CHECKING:
    from acquire.results.measurement import CampaignResult, RunResult
    from acquire.runner.callbacks import Callbacks
    from protocols.plan import Plan
    from runs.layout import RunLabels

_UNNAMED = "unnamed"


@dataclass(frozen=True)
class RunOptions:
    """Options of `acquire run`."""

    reed: Annotated[str, typer.Option(help="Name of this reed, unique in your laboratory.")] = (
        _UNNAMED
    )
    strength: Annotated[
        float | None, typer.Option(help="Nominal strength of the reed, such as 3.5.")
    ] = None
    series: Annotated[
        str | None, typer.Option(help="Series, if it differs from the one in the protocol.")
    ] = None
    note: Annotated[str, typer.Option(help="Free text, stored in the run file.")] = ""
    operator: Annotated[str, typer.Option(help="Name of the person at the bench.")] = ""
    out: Annotated[
        Path | None,
        typer.Option(
            help="Run file to write (default: measurements/TIME_SERIES_REED.h5), or for a campaign "
            "the folder to write (default: measurements/TIME_campaign_REED)."
        ),
    ] = None
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the random numbers of a simulated bench.")
    ] = 0
    resume: Annotated[
        Path | None,
        typer.Option(metavar="RUN|FOLDER", help="Continue this unfinished run or campaign."),
    ] = None

    def labels(self) -> "RunLabels":
        """Return what a person says about the run."""
        from runs.layout import RunLabels

        return RunLabels(self.strength, self.note, self.operator)


@takes_options
def run(
    protocol: Annotated[
        str, typer.Argument(help="Protocol or campaign: a file, or the name of a shipped one.")
    ],
    options: RunOptions,
    bench: BenchOption = "simulated",
    fit: Annotated[bool, typer.Option(help="Fit the reed and write the report at the end.")] = True,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Measure a sweep, fit the reed and write a report; or measure all parts of a campaign."""
    from protocols.campaign import names_campaign

    _require_consistent(options)
    if names_campaign(protocol):
        _run_campaign(protocol, bench, options, as_json)
        return
    measured = _measure(protocol, bench, options, fit, as_json)
    answer = measured.to_json()
    listed = [f"run file      {measured.path}"]
    if measured.exit_status or not fit:
        finish(answer, as_json, listed)
        raise typer.Exit(measured.exit_status)
    try:
        report_runs([measured.path], "fem", None, as_json, answer)
    except (KeyboardInterrupt, OutputFailedError):
        finish(answer, as_json, listed)
        raise


def _measure(
    protocol: str, bench: str, options: RunOptions, fit: bool, as_json: bool
) -> "RunResult":
    """Measure a sweep, or its missing steps, with a progress bar; show how it ended."""
    import acquire
    from acquire.cli.display import bad_steps_of, run_summary, sweep_progress

    asked = acquire.load(protocol)
    if options.series is not None:
        asked = asked.replace(series=options.series)
    planned = acquire.plan(asked, bench)
    planned.plan.require_possible()
    path = options.resume or options.out or _default_path(asked.series, options.reed)
    if fit:
        from reports.run_page import page_of, require_report

        require_report([path], page_of(path), measured=False)
    with (
        _failing_in_json({"run": str(path)}, as_json),
        sweep_progress(messages(), len(planned.steps)) as bar,
    ):
        calls = acquire.Callbacks(step=bar.step, packing=bar.packing, announce=_announce())
        if options.resume is not None:
            measured = acquire.resume(planned, path, callbacks=calls)
        else:
            measured = acquire.run(
                planned,
                path,
                reed=options.reed,
                labels=options.labels(),
                seed=options.seed,
                callbacks=calls,
            )
    with acquire.open_run(path) as finished:
        closing = run_summary(measured.summary, bad_steps_of(finished))
    for line in closing:
        show_message(line)
    return measured


def _announce() -> Any:
    """Return a function that prints one line among the lines of a progress bar."""
    return functools.partial(messages().print, markup=False, soft_wrap=True)


@contextlib.contextmanager
def _failing_in_json(answer: dict[str, Any], as_json: bool) -> Iterator[None]:
    """Print, with --json, how a run ended that failed after its instruments were opened."""
    try:
        yield
    except BenchError as error:
        if as_json and (error.exit_status != 2 or error.unconfirmed):
            said = {"status": "failed", "reason": str(error)}
            show_json({**answer, **said, "unconfirmed": list(error.unconfirmed)})
        raise


def _run_campaign(name: str, bench: str, options: RunOptions, as_json: bool) -> None:
    """Measure all parts of a campaign into a folder, or those that are missing there."""
    import acquire
    from acquire.cli.display import run_summary

    if options.series is not None:
        raise UsageError("--series: a campaign has several runs; leave it out, or run one protocol")
    campaign = acquire.load_campaign(name)
    folder = (
        options.resume or options.out or _default_path("campaign", options.reed).with_suffix("")
    )
    with _failing_in_json({"folder": str(folder)}, as_json), _campaign_callbacks() as calls:
        if options.resume is not None:
            measured = acquire.resume_campaign(campaign, folder, bench, callbacks=calls)
        else:
            measured = acquire.run_campaign(
                campaign,
                folder,
                bench,
                reed=options.reed,
                labels=options.labels(),
                seed=options.seed,
                callbacks=calls,
            )
    if measured.exit_status:
        for line in run_summary(measured.parts[-1].summary, []):
            show_message(line)
    finish(measured.to_json(), as_json, _campaign_lines(measured, name, bench))
    if measured.exit_status:
        raise typer.Exit(measured.exit_status)


def _campaign_lines(measured: "CampaignResult", name: str, bench: str) -> list[str]:
    """Return where the campaign is, and the command that comes next."""
    resume = f"continue with acquire run {name} --bench {bench} --resume {measured.folder}"
    following = f"next          acquire diagnose {measured.folder}"
    return [f"campaign      {measured.folder}", resume if measured.exit_status else following]


@contextlib.contextmanager
def _campaign_callbacks() -> Iterator["Callbacks"]:
    """Show a progress bar for each part, and ask for what a person must do between parts."""
    from acquire.cli.display import sweep_progress
    from acquire.runner.callbacks import Callbacks

    announce = _announce()
    with contextlib.ExitStack() as shown:
        bars: list[Any] = []

        def part(task: Any, planned: "Plan") -> None:
            shown.close()
            announce(f"{task.part.name}: {len(planned.steps)} steps")
            bars[:] = [shown.enter_context(sweep_progress(messages(), len(planned.steps)))]

        def wait_for(what: str) -> None:
            shown.close()
            asked = f"Please {what}; then press Enter"
            try:
                typer.prompt(one_line(asked), default="", show_default=False, err=True)
            except typer.Abort:
                raise KeyboardInterrupt from None

        yield Callbacks(
            step=lambda report: bars[0].step(report),
            announce=announce,
            part=part,
            wait_for=wait_for,
        )


def _require_consistent(options: RunOptions) -> None:
    """Refuse to change, in an unfinished run, what its file already holds."""
    if options.resume is None:
        return
    given = {
        "--out": options.out is not None,
        "--reed": options.reed != _UNNAMED,
        "--seed": options.seed != 0,
        "--strength": options.strength is not None,
        "--note": options.note != "",
        "--operator": options.operator != "",
    }
    for option, is_given in given.items():
        if is_given:
            raise UsageError(f"{option}: the unfinished run has its own already; leave it out")


def _default_path(series: str, reed: str) -> Path:
    kept = "".join(c if c.isalnum() or c in "-." else "-" for c in f"{series}_{reed}")
    # With its extensions a name of a file may have 255 bytes.
    return Path("measurements", f"{datetime.now():%Y-%m-%dT%H-%M-%S}_{kept:.60}.h5")
