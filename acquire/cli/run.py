"""The verb `acquire run`: a sweep, or a campaign."""

import contextlib
import functools
import math
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.app import (
    INTERRUPTED,
    AsJson,
    BenchOption,
    Debug,
    plan_of,
)
from acquire.cli.console import messages, show_json, show_message
from acquire.cli.fit import finish, report_runs
from holography.errors import BenchError
from reports.errors import OutputFailedError
from reports.plain_text import one_line

if TYPE_CHECKING:
    from acquire.runner.summary import RunSummary
    from protocols.plan import Plan
    from runs.reader import RunLabels


def run(
    protocol: Annotated[
        str, typer.Argument(help="Protocol or campaign: a file, or the name of a shipped one.")
    ],
    bench: BenchOption = "simulated",
    reed: Annotated[
        str, typer.Option(help="Name of this reed, unique in your laboratory.")
    ] = "unnamed",
    strength: Annotated[
        float | None, typer.Option(help="Nominal strength of the reed, such as 3.5.")
    ] = None,
    series: Annotated[
        str | None, typer.Option(help="Series, if it differs from the one in the protocol.")
    ] = None,
    note: Annotated[str, typer.Option(help="Free text, stored in the run file.")] = "",
    operator: Annotated[str, typer.Option(help="Name of the person at the bench.")] = "",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Run file to write (default: measurements/TIME_SERIES_REED.h5), or for a campaign "
            "the folder to write (default: measurements/TIME_campaign_REED)."
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the random numbers of a simulated bench.")
    ] = 0,
    resume: Annotated[
        Path | None,
        typer.Option(metavar="RUN|FOLDER", help="Continue this unfinished run or campaign."),
    ] = None,
    fit: Annotated[bool, typer.Option(help="Fit the reed and write the report at the end.")] = True,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Measure a sweep, fit the reed and write a report; or measure all parts of a campaign."""
    from acquire.cli.display import (
        run_summary,
        sweep_progress,
        troubles_of,
    )
    from acquire.runner import script
    from protocols.campaign import names_campaign
    from runs.reader import Run, RunLabels

    labels = RunLabels(strength, note, operator)
    _require_keepable(reed, labels)
    if resume is not None:
        said = labels != RunLabels()
        _require_nothing_new(out=out, reed=reed != "unnamed", seed=seed, labels=said)
    if names_campaign(protocol):
        _require_single(series=series)
        _run_campaign(protocol, bench, out, reed, labels, seed, resume, as_json)
        return
    planned = plan_of(protocol, bench, series)
    planned.require_possible()
    path = resume or out or _default_path(planned.protocol.series, reed)
    if fit:
        from reports.run_page import page_of, require_report

        require_report([path], page_of(path), measured=False)
    words = messages()
    with (
        _failing_in_json({"run": str(path)}, as_json),
        sweep_progress(words, len(planned.steps)) as bar,
    ):
        tell = functools.partial(words.print, markup=False, soft_wrap=True)
        heard: Any = {"progress": bar.step, "packing": bar.packing, "announce": tell}
        if resume is not None:
            summary = script.resume(planned, path, **heard)
        else:
            summary = script.run(planned, path, reed=reed, labels=labels, seed=seed, **heard)
    with Run.open(path) as finished:
        closing = run_summary(summary, troubles_of(finished))
    for line in closing:
        show_message(line)
    answer: dict[str, Any] = {"run": str(path), "status": str(summary.status)}
    answer["reason"] = summary.reason
    answer["unconfirmed"] = list(summary.unconfirmed)
    answer["remarks"] = list(summary.remarks)
    answer["verdicts"] = {str(verdict): n for verdict, n in summary.counts.items()}
    status = _exit_status(summary)
    if status or not fit:
        finish(answer, as_json, [f"run file      {path}"])
        raise typer.Exit(status)
    try:
        report_runs([path], "fem", None, as_json, answer)
    except (KeyboardInterrupt, OutputFailedError):
        finish(answer, as_json, [f"run file      {path}"])
        raise


def _exit_status(summary: "RunSummary") -> int:
    """Exit status of a run that ended without an error."""
    if summary.unconfirmed or summary.ended_by == "policy":
        return 1
    return INTERRUPTED if summary.ended_by == "person" else 0


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


def _require_single(**asked: object) -> None:
    """Refuse what campaigns have not."""
    from protocols.errors import ProtocolError

    for option, value in asked.items():
        if value is not None:
            raise ProtocolError(
                f"--{option}: a campaign has several runs; leave it out, or run one protocol"
            )


def _run_campaign(
    name: str,
    bench: str,
    out: Path | None,
    reed: str,
    labels: "RunLabels",
    seed: int,
    resume: Path | None,
    as_json: bool,
) -> None:
    """Measure all parts of a campaign into a folder, or those that are missing there."""
    from acquire.cli.display import run_summary, sweep_progress
    from acquire.runner import script
    from protocols.campaign import CampaignFile

    campaign = CampaignFile.from_file(name)
    folder = resume or out or _default_path("campaign", reed).with_suffix("")
    words = messages()
    tell = functools.partial(words.print, markup=False, soft_wrap=True)
    with contextlib.ExitStack() as shown:
        bars: list[Any] = []

        def begin(task: Any, planned: "Plan") -> None:
            shown.close()
            tell(f"{task.part.name}: {len(planned.steps)} steps")
            bars[:] = [shown.enter_context(sweep_progress(words, len(planned.steps)))]

        def wait_for(what: str) -> None:
            shown.close()
            asked = f"Please {what}; then press Enter"
            try:
                typer.prompt(one_line(asked), default="", show_default=False, err=True)
            except typer.Abort:
                raise KeyboardInterrupt from None

        heard: Any = {"begin": begin, "wait_for": wait_for, "announce": tell}
        heard["progress"] = lambda report: bars[0].step(report)
        with _failing_in_json({"folder": str(folder)}, as_json):
            if resume is not None:
                summaries = script.resume_campaign(campaign, folder, bench, **heard)
            else:
                summaries = script.run_campaign(
                    campaign, folder, bench, reed=reed, labels=labels, seed=seed, **heard
                )
    last = summaries[-1]
    answer = {
        "folder": str(folder),
        "status": str(last.status),
        "reason": last.reason,
        "unconfirmed": list(last.unconfirmed),
        "parts": {
            summary.path.stem: {str(verdict): n for verdict, n in summary.counts.items()}
            for summary in summaries
        },
    }
    for line in run_summary(last, []) if _exit_status(last) else []:
        show_message(line)
    done = _exit_status(last) == 0
    lines = [f"campaign      {folder}"]
    lines.append(
        f"next          acquire diagnose {folder}"
        if done
        else f"continue with acquire run {name} --bench {bench} --resume {folder}"
    )
    finish(answer, as_json, lines)
    if not done:
        raise typer.Exit(_exit_status(last))


def _require_nothing_new(**asked: object) -> None:
    """Refuse to change, in an unfinished run, what its file already says."""
    from runs.errors import RunFileError

    for option, value in asked.items():
        if value:
            names = "--strength, --note or --operator" if option == "labels" else f"--{option}"
            raise RunFileError(f"{names}: the unfinished run has its own already; leave it out")


def _require_keepable(reed: str, labels: "RunLabels") -> None:
    """Refuse, before anything is opened, what a run file cannot hold."""
    from runs.errors import RunFileError

    if labels.strength is not None and not 0 < labels.strength < math.inf:
        raise RunFileError(
            f"--strength: {labels.strength} is not a strength; write one such as 3.5"
        )
    if not reed.strip():
        raise RunFileError("--reed: is blank; write a name that tells this reed from others")
    for option, text in (("reed", reed), ("note", labels.note), ("operator", labels.operator)):
        try:
            text.encode("utf-8")
        except UnicodeEncodeError:
            raise RunFileError(f"--{option}: is not UTF-8 text; type it again") from None
        if "\0" in text:
            raise RunFileError(f"--{option}: holds a null character; leave it out")


def _default_path(series: str, reed: str) -> Path:
    kept = "".join(c if c.isalnum() or c in "-." else "-" for c in f"{series}_{reed}")
    # With its extensions a name of a file may have 255 bytes.
    return Path("measurements", f"{datetime.now():%Y-%m-%dT%H-%M-%S}_{kept:.60}.h5")
