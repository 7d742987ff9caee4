"""The command line: `acquire run`, `plan`, `fit`, `report`, `modes` and the other verbs.

Knows every room and does nothing itself. Results go to standard output, progress and messages to
standard error. Exit status: 2 for bad input, 1 for a failed run, 130 for an interrupt.
"""

import contextlib
import functools
import math
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.bench import bench_app
from acquire.cli.console import messages as _words
from acquire.cli.console import results
from acquire.cli.console import show_json as _show_json
from acquire.cli.console import show_message as _tell
from holography.errors import BenchError
from reports.errors import OutputFailedError
from reports.plain_text import one_line

if TYPE_CHECKING:
    from rich.console import Console

    from acquire.runner.control import Order
    from acquire.runner.runner import RunSummary
    from fitting.cane.fit_runs import ReedFit
    from protocols.plan import Plan
    from runs.reader import RunLabels

app = typer.Typer(
    name="acquire",
    help="Measure how musical reeds vibrate by sideband digital holography, and fit their cane.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
blind = typer.Typer(
    name="blind",
    help="Check diagnoses on campaigns whose cause is sealed.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(blind)
INTERRUPTED = 130

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON with stable keys instead.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
BenchOption = Annotated[str, typer.Option("--bench", help="Bench file, or a shipped bench's name.")]
RunFiles = Annotated[
    list[Path], typer.Argument(metavar="RUN [RUN_B]", help="One run, or series A and B of a reed.")
]
MethodOption = Annotated[
    str,
    typer.Option(
        "--method",
        help="How resonances are found: picture (the paper's way, by the pictures with most "
        "fringes) or joint (one fit of all holograms, with loss factors).",
    ),
]
ModelOption = Annotated[
    str, typer.Option("--model", help="Forward model: fem (finite elements) or paper (Table 9).")
]


def _constant(name: str, kind: str, meaning: str) -> Any:
    """Option of an elastic constant, `--e-l` or `--E-L`; without it the reed's own counts."""
    dashed = name.replace("_", "-")
    return typer.Option(f"--{dashed.lower()}", f"--{dashed}", metavar=kind, help=meaning)


def _verb(function: Callable[..., None]) -> Callable[..., None]:
    """Make a function a verb of `app`."""
    name = {"list_runs": "list", "proceed": "continue"}.get(function.__name__, function.__name__)
    return app.command(name)(_guarded(function))


def _blind_verb(function: Callable[..., None]) -> Callable[..., None]:
    """Make a function a verb of `blind`."""
    return blind.command(function.__name__.removeprefix("blind_"))(_guarded(function))


def _guarded(function: Callable[..., None]) -> Callable[..., None]:
    """Turn errors into one line and an exit status."""

    @functools.wraps(function)
    def guarded(*args: Any, debug: bool = False, **kwargs: Any) -> None:
        try:
            function(*args, debug=debug, **kwargs)
        except BenchError as error:
            if debug:
                raise
            for line in (str(error), *getattr(error, "__notes__", ())):
                _tell(one_line(f"acquire: {line}"))
            raise typer.Exit(1 if error.unconfirmed else error.exit_status) from None
        except OSError as error:
            if debug:
                raise
            for line in (_disk_words(error), *getattr(error, "__notes__", ())):
                _tell(one_line(f"acquire: {line}"))
            raise typer.Exit(1) from None
        except KeyboardInterrupt as stop:
            unconfirmed = getattr(stop, "__notes__", ())
            for line in ("interrupted", *unconfirmed):
                _tell(one_line(f"acquire: {line}"))
            raise typer.Exit(1 if unconfirmed else INTERRUPTED) from None

    return guarded


def _disk_words(error: OSError) -> str:
    """One line about a file that the system refused where nothing else says so."""
    where = "" if error.filename is None else f"{error.filename}: "
    reason = error.strerror or str(error) or type(error).__name__
    return one_line(f"{where}the system refused it ({reason}); check the disk, then try again")


app.add_typer(bench_app(_guarded))


def _plan(protocol: str, bench: str, series: str | None = None) -> "Plan":
    from acquire.runner import script

    described = script.load(protocol)
    if series is not None:
        described = described.replace(series=series)
    return script.plan(described, bench)


@_verb
def plan(
    protocol: Annotated[
        str, typer.Argument(help="Protocol or campaign: a file, or a shipped one's name.")
    ],
    bench: BenchOption = "simulated",
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Show every step of a protocol, its duration and size, without touching an instrument.

    Of a campaign, every part.
    """
    from acquire.cli.display import plan_summary, plan_table
    from protocols.campaign import names_campaign

    if names_campaign(protocol):
        _plan_campaign(protocol, bench, as_json)
        return
    planned = _plan(protocol, bench)
    if as_json:
        _show_json(planned.to_json())
    else:
        console = results()
        console.print(plan_table(planned))
        for line in plan_summary(planned):
            console.print(line, markup=False, soft_wrap=True)
    if planned.violations:
        raise typer.Exit(2)


def _plan_campaign(name: str, bench: str, as_json: bool) -> None:
    """Show every part of a campaign."""
    from acquire.cli.display import campaign_table
    from acquire.runner import script
    from protocols.campaign import CampaignFile, tasks_of

    tasks = tasks_of(CampaignFile.from_file(name))
    plans = [script.plan(task.protocol, bench) for task in tasks]
    if as_json:
        _show_json(
            [
                {"part": task.part.name, "do": task.part.do, "clamping": task.clamping}
                | planned.to_json()
                for task, planned in zip(tasks, plans, strict=True)
            ]
        )
    else:
        results().print(campaign_table(tasks, plans))
    for planned in plans:
        planned.require_possible()


@_verb
def run(
    protocol: Annotated[
        str, typer.Argument(help="Protocol or campaign: a file, or a shipped one's name.")
    ],
    bench: BenchOption = "simulated",
    reed: Annotated[str, typer.Option(help="Name that tells this reed from others.")] = "unnamed",
    strength: Annotated[float | None, typer.Option(help="Nominal strength, such as 3.5.")] = None,
    series: Annotated[str | None, typer.Option(help="Series, if not the protocol's own.")] = None,
    note: Annotated[str, typer.Option(help="Anything worth remembering.")] = "",
    operator: Annotated[str, typer.Option(help="Who is at the bench.")] = "",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Run file, runs/TIME_SERIES_REED.h5 if not given; or a campaign's folder, "
            "runs/TIME_campaign_REED."
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Of all that is random on a simulated bench.")
    ] = 0,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN|FOLDER", help="Go on with this unfinished run, or campaign's folder."
        ),
    ] = None,
    fit: Annotated[
        bool, typer.Option(help="Fit the reed and draw the pictures at the end.")
    ] = True,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Measure a sweep; then fit the reed and draw the pictures. Or measure a whole campaign."""
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
    planned = _plan(protocol, bench, series)
    planned.require_possible()
    path = resume or out or _default_path(planned.protocol.series, reed)
    if fit:
        from reports.run_page import page_of, require_report

        require_report([path], page_of(path), measured=False)
    words = _words()
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
        _tell(line)
    answer: dict[str, Any] = {"run": str(path), "status": str(summary.status)}
    answer["reason"] = summary.reason
    answer["unconfirmed"] = list(summary.unconfirmed)
    answer["remarks"] = list(summary.remarks)
    answer["verdicts"] = {str(verdict): n for verdict, n in summary.counts.items()}
    status = _exit_status(summary)
    if status or not fit:
        _finish(answer, as_json, [f"run file      {path}"])
        raise typer.Exit(status)
    try:
        _report([path], "fem", None, as_json, answer)
    except (KeyboardInterrupt, OutputFailedError):
        _finish(answer, as_json, [f"run file      {path}"])
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
            _show_json({**answer, **said, "unconfirmed": list(error.unconfirmed)})
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
    words = _words()
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
        _tell(line)
    done = _exit_status(last) == 0
    lines = [f"campaign      {folder}"]
    lines.append(
        f"next          acquire diagnose {folder}"
        if done
        else f"go on with    acquire run {name} --bench {bench} --resume {folder}"
    )
    _finish(answer, as_json, lines)
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
        raise RunFileError(f"--strength: {labels.strength} is no strength; write one such as 3.5")
    if not reed.strip():
        raise RunFileError("--reed: is blank; write a name that tells this reed from others")
    for option, text in (("reed", reed), ("note", labels.note), ("operator", labels.operator)):
        try:
            text.encode("utf-8")
        except UnicodeEncodeError:
            raise RunFileError(f"--{option}: is no text in UTF-8; write it anew") from None
        if "\0" in text:
            raise RunFileError(f"--{option}: holds a null character; leave it out")


def _default_path(series: str, reed: str) -> Path:
    kept = "".join(c if c.isalnum() or c in "-." else "-" for c in f"{series}_{reed}")
    # With its extensions a name of a file may have 255 bytes.
    return Path("runs", f"{datetime.now():%Y-%m-%dT%H-%M-%S}_{kept:.60}.h5")


def _finish(
    answer: dict[str, Any], as_json: bool, lines: list[str], fitted: "ReedFit | None" = None
) -> None:
    """Print the result of a verb, as JSON or for people."""
    if as_json:
        _show_json(answer)
        return
    console = results()
    if fitted is not None:
        _show_fit(console, fitted)
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def _show_fit(console: "Console", fitted: "ReedFit") -> None:
    from reports.tables import (
        modes_table,
        not_identified_lines,
        parameters_table,
    )

    for sweep in fitted.sweeps:
        console.print(modes_table(sweep))
        for line in not_identified_lines(sweep):
            console.print(line, markup=False, soft_wrap=True)
    table = parameters_table(fitted)
    if table is None:
        console.print(f"no parameters: {fitted.reason}", markup=False, soft_wrap=True)
    else:
        console.print(table)


def _fit(runs: list[Path], model: str, method: str = "joint") -> "ReedFit":
    from fitting.cane.fit_runs import (
        fit_runs,
        method_name,
        model_name,
    )

    return fit_runs(runs, model_name(model), _tell, method_name(method))


def _report(
    runs: list[Path],
    model: str,
    page: Path | None,
    as_json: bool,
    answer: dict[str, Any],
    method: str = "joint",
) -> None:
    """Fit, write the page and print the result; without a fit, the page has the pictures only."""
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
        fitted = _fit(runs, model, method)
        files = write_report(fitted, page)
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
    _finish(answer, as_json, [f"{name:13} {file}" for name, file in listed.items()], fitted)
    if failure:
        raise failure


@_verb
def fit(
    runs: RunFiles,
    method: MethodOption = "joint",
    model: ModelOption = "fem",
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Find the resonances in a run and fit the reed's cane; with A and B, all four components."""
    fitted = _fit(runs, model, method)
    _finish(fitted.to_json(), as_json, [], fitted)


@_verb
def report(
    runs: RunFiles,
    out: Annotated[Path | None, typer.Option(help="Page; beside the run if not given.")] = None,
    method: MethodOption = "joint",
    model: ModelOption = "fem",
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write one self-contained HTML page about a run, and its pictures beside it."""
    _report(runs, model, out, as_json, {}, method)


@_verb
def diagnose(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[RUN …]",
            help="Runs of one reed in one series, folders of such, or a table of resonances "
            "(CSV) of clarinet reeds.",
        ),
    ] = None,
    published: Annotated[
        bool, typer.Option("--published", help="Take the paper's Table 1 as data instead of runs.")
    ] = False,
    bench: Annotated[
        str | None,
        typer.Option(
            metavar="FILE", help="Bench file that says what is known of the bench, under known:."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="PAGE.html", help="Page to write besides.")
    ] = None,
    following: Annotated[
        Path | None,
        typer.Option(
            "--next", metavar="FILE.yaml", help="Campaign to write that tells the likeliest apart."
        ),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compare runs with the twin: where they differ, which effect it is, how far it closes that.

    Best are all runs of a campaign: dark, flat, the local oscillator alone, order 0 at rest, sweeps
    up, down, quiet, shuffled and after a new clamping. With less it says less, and what is missing.
    """
    from fitting.errors import FitInputError

    tables = [path for path in runs or () if path.suffix.lower() == ".csv"]
    if published or tables:
        if len(runs or ()) != len(tables) or (published and tables):
            raise FitInputError(
                "runs, a table of resonances and --published are three kinds of data; give one"
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
        raise FitInputError("name runs or a table of resonances, or give --published")
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
    from physics.mechanics import Workshop
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
        workshop = Workshop(anatomy(geometry, announce=_tell), _tell)
        with share_progress(_words(), "fitting sweeps") as told:
            readings = read(campaign, bench, told)
    with share_progress(_words(), "trying effects") as told:
        try:
            verdict = judge(readings, workshop, base, told, only_once(bench))
        except ValueError as error:
            raise FitError(
                f"{campaign.sweeps[0].run.path}: no reed of its kind is near what its campaign "
                f"shows ({error}); check the reed, the series and the bench file"
            ) from error
    if out is not None:
        runs = [file.name for file in files]
        write_page(verdict, f"Diagnosis of {campaign.sweeps[0].run.reed}", out, runs)
    if as_json:
        _show_json(to_json(verdict))
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
    from physics.mechanics import Workshop
    from physics.reed.cache import anatomy
    from reports.resonance_diagnosis_page import (
        gap_of_modes,
        to_json,
        trials_table,
        words,
    )

    reeds = tabled_reeds(table, _tell) if table else printed_reeds()
    workshop = Workshop(anatomy(announce=_tell), _tell)
    with share_progress(_words(), "trying effects") as told:
        try:
            diagnosis = diagnose_resonances(reeds, workshop, CATALOGUE, told)
        except ValueError as error:
            raise FitInputError(
                f"{table or 'Table 1'}: no clarinet reed has resonances near these ({error}); "
                "check frequencies and names of modes"
            ) from error
    if as_json:
        _show_json(to_json(diagnosis))
        return
    console = results()
    console.print(gap_of_modes(diagnosis))
    console.print(trials_table(diagnosis))
    for line in words(diagnosis, BY_ID):
        console.print(line, markup=False, soft_wrap=True)


@_verb
def effects(as_json: AsJson = False, debug: Debug = False) -> None:
    """List the effects that the twin leaves out and a diagnosis knows.

    Each with the standard deviation that its size is expected to have, or where it may be.
    """
    from physics.effects.catalogue import CATALOGUE
    from reports.effects import effects_table, effects_to_json

    if as_json:
        _show_json(effects_to_json(CATALOGUE))
        return
    results().print(effects_table(CATALOGUE))


@contextlib.contextmanager
def _blind_side() -> Iterator[None]:
    """Errors of the other side, which knows none of the house's."""
    from fitting.errors import FitInputError

    try:
        from blind.files import BlindDiskError, BlindError
    except ImportError as error:
        raise FitInputError(
            f"blind cases need {error.name}, which is not installed; install reedbench[blind]"
        ) from None
    try:
        yield
    except BlindDiskError as error:
        raise OutputFailedError(str(error)) from None
    except BlindError as error:
        raise FitInputError(str(error)) from None


@_blind_verb
def blind_make(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Gets a folder for each case.")],
    tier: Annotated[
        int,
        typer.Option(
            help="0: nothing wrong; 1: one effect; 2: one easily taken for another; 3: two; "
            "4: one that the catalogue lacks; 6: each effect in turn, beside others that are told."
        ),
    ],
    count: Annotated[int, typer.Option(min=1, help="How many cases.")],
    seed: Annotated[int, typer.Option(min=0, help="Mixed with what the key alone tells.")],
    key: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Gets the labels; DIR.key.json if not given."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Cases that are made at once.")] = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Make sealed cases: campaigns of laboratories with something wrong, and hashes of what it is.

    DIR/sealed.json holds the hashes; its own, to be published before any case is answered, is
    printed. A case takes half a minute to one, and 46 MB.
    """
    with _blind_side():
        from acquire.cli.display import share_progress
        from blind.files import make_set

        place = folder.resolve()
        kept = key or place.with_name(f"{place.name}.key.json")
        with share_progress(_words(), "making cases") as told:
            made = make_set(folder, kept, tier, count, seed, jobs, told)
    if as_json:
        _show_json({"cases": count, "folder": str(folder), "key": str(kept), "sealed_sha256": made})
        return
    cases = "1 case" if count == 1 else f"{count} cases"
    console = results()
    console.print(f"{cases} in {folder}, whose sealed.json has the SHA-256 {made}", soft_wrap=True)
    console.print(f"The key is {kept}: keep it from whoever answers.", soft_wrap=True)


@_blind_verb
def blind_score(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR…", help="What `blind make` made; scored as one.")
    ],
    answers: Annotated[
        list[Path],
        typer.Option(
            metavar="DIR",
            help="Folder of NAME.json, what `diagnose --json` printed of each case; "
            "one for each set, in the same order.",
        ),
    ],
    key: Annotated[
        list[Path],
        typer.Option(metavar="FILE", help="Labels, by `blind make`; one for each set."),
    ],
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Reliability plot to draw besides.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Score answers to sealed cases; what is not answered counts as wrong."""
    from reports.own_output import (
        Output,
        picture_kind,
        require_writable,
        write_output,
    )

    with _blind_side():
        from blind.classes import CLASSES
        from blind.drawing import draw_reliability
        from blind.files import BlindError, answered_cases
        from blind.report import report as blind_report
        from blind.report import sentences
        from blind.scoring import Classes

        if not len(folders) == len(answers) == len(key):
            raise BlindError(
                f"{len(folders)} sets of cases, {len(answers)} --answers and {len(key)} --key were "
                "given; give one of each for every set, in the same order"
            )
        plot = None
        if picture is not None:
            if picture.suffix.lower() != ".png":
                raise BlindError(f"{picture}: is drawn as PNG; give it a name that ends in .png")
            plot = Output(picture, picture_kind("reliability"), "--picture")
            require_writable([plot])
        sets = zip(folders, answers, key, strict=True)
        cases = [case for made in sets for case in answered_cases(*made)]
        names = [case.name for case in cases]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise BlindError(f"case {twice} is in two sets; give each set once")
        classes = Classes(CLASSES)
        scores = blind_report(cases, classes)
        if as_json:
            _show_json(scores)
        else:
            console = results()
            for line in sentences(scores):
                console.print(line, markup=False, soft_wrap=True)
        if plot is not None:
            write_output(plot, draw_reliability(cases, classes, plot.kind.mark))


@_verb
def modes(
    reed: Annotated[str, typer.Argument(help="Reed file, or a shipped reed's name.")] = "clarinet",
    E_L: Annotated[
        str | None, _constant("E_L", "MODULUS", "Young modulus along the grain, such as '13 GPa'.")
    ] = None,
    E_T: Annotated[
        str | None, _constant("E_T", "MODULUS", "Young modulus across the grain.")
    ] = None,
    E_R: Annotated[
        str | None, _constant("E_R", "MODULUS", "Young modulus through the thickness.")
    ] = None,
    G_LT: Annotated[
        str | None,
        _constant("G_LT", "MODULUS", "Shear modulus that resists torsion, such as '1.1 GPa'."),
    ] = None,
    G_LR: Annotated[
        str | None,
        _constant("G_LR", "MODULUS", "Shear modulus through the thickness, along the grain."),
    ] = None,
    G_TR: Annotated[
        str | None,
        _constant("G_TR", "MODULUS", "Shear modulus through the thickness, across the grain."),
    ] = None,
    nu_LT: Annotated[
        float | None,
        _constant(
            "nu_LT", "RATIO", "Contraction across under stress along the grain, such as 0.22."
        ),
    ] = None,
    nu_LR: Annotated[
        float | None,
        _constant(
            "nu_LR", "RATIO", "Contraction through the thickness under stress along the grain."
        ),
    ] = None,
    nu_TR: Annotated[
        float | None,
        _constant(
            "nu_TR", "RATIO", "Contraction through the thickness under stress across the grain."
        ),
    ] = None,
    density: Annotated[
        str | None, typer.Option(metavar="DENSITY", help="Such as '520 kg/m^3'.")
    ] = None,
    thickness_offset: Annotated[
        str | None, typer.Option(metavar="LENGTH", help="Added to the vamp, such as '10 um'.")
    ] = None,
    temperature: Annotated[
        str | None,
        typer.Option(metavar="TEMPERATURE", help="Of viscoelastic cane, such as '25 degC'."),
    ] = None,
    dryness: Annotated[
        float | None, typer.Option(help="Of viscoelastic cane: 0 as series A to 1 as series B.")
    ] = None,
    mesh: Annotated[
        str,
        typer.Option(
            help="Finite elements: fine, standard, or fast (some cents off); or basis: instant, "
            "once a basis has been built (about a minute, and kept)."
        ),
    ] = "fine",
    pictures: Annotated[
        Path | None, typer.Option(metavar="PATH.png", help="Draw every mode into this file.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """List every mode of a reed below 20 kHz by finite elements: name, frequency, class.

    What no option says is the reed's own.
    """
    from acquire.cli.display import share_progress
    from protocols.errors import ProtocolError
    from protocols.reed import (
        BASIS,
        ReedFile,
        changed,
        doubts_marked,
        mesh_level,
        modes_by_basis,
        modes_of,
        modes_to_json,
    )
    from reports.mode_pictures import (
        modes_table,
        require_png,
        write_mode_sheet,
    )

    level = None if mesh == BASIS else mesh_level(mesh)
    if pictures:
        if level is None:
            raise ProtocolError("--pictures: a basis has no shapes to draw; use --mesh fine")
        require_png(pictures)
    cane = {"E_L": E_L, "E_T": E_T, "E_R": E_R, "G_LT": G_LT, "G_LR": G_LR, "G_TR": G_TR}
    ratios = {"nu_LT": nu_LT, "nu_LR": nu_LR, "nu_TR": nu_TR}
    changes: dict[str, str | float | None] = {
        **{f"cane.{name}": value for name, value in {**cane, **ratios, "density": density}.items()},
        "geometry.thickness_offset": thickness_offset,
        "conditions.temperature": temperature,
        "conditions.dryness": dryness,
    }
    original = ReedFile.from_file(reed)
    described = changed(original, changes)
    if level is None:
        with share_progress(_words(), "building") as show:
            found = modes_by_basis(described, original, _tell, show)
    else:
        _tell("computing the reed's modes by finite elements")
        found = modes_of(described, level)
        if pictures:
            write_mode_sheet(described, level, found, pictures)
    if as_json:
        _show_json(modes_to_json(described, found))
        return
    console = results()
    console.print(modes_table(described, found if level else doubts_marked(found)))
    if pictures:
        console.print(f"pictures      {pictures}", markup=False, soft_wrap=True)


@_verb
def population(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="TABLE.csv|FOLDER",
            help="Resonances (columns reed, series, mode, hz), or a folder of run files.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Components of every reed; beside SOURCE if not given.")
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(
            help="Of a table: reed file, or a shipped reed's name; clarinet if not given. "
            "Run files say it themselves."
        ),
    ] = None,
    model: ModelOption = "fem",
    method: Annotated[
        str | None,
        typer.Option(
            help="Of a folder: how resonances are found, joint (if not given) or picture."
        ),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Fit the cane of many reeds: components with errors for each, and their spread.

    Of a folder's runs the resonances are found first, which takes some seconds a run, and what
    stays at the same frequency from reed to reed is told: lines of the air, not the reeds'.
    """
    from fitting.cane.fit_runs import method_name, model_name
    from fitting.errors import FitInputError
    from fitting.populations.table import fit_table, metamodel_of
    from protocols.reed import DEFAULT_REED, ReedFile
    from reports.own_output import require_writable
    from reports.population_tables import (
        components_output,
        opened_table,
        remarks,
        resonances_output,
        summary_table,
        write_resonances,
    )

    forward, way, table, files = model_name(model), method_name(method or "joint"), source, {}
    reed, measured = ReedFile.from_file(kind or DEFAULT_REED), None
    if method and not source.is_dir():
        raise FitInputError("--method: a table already holds resonances; leave it out")
    if source.is_dir() and kind:
        raise FitInputError("--kind: run files say which reed they measured; leave it out")
    outputs = []
    if source.is_dir():
        table = files["resonances"] = source / "resonances.csv"
        outputs.append(resonances_output(table))
    out = files["components"] = out or table.with_name(f"{table.stem}-components.csv")
    components = components_output(out)
    require_writable([*outputs, components], [source])
    if source.is_dir():
        measured = write_resonances(source, table, _tell, way)
        reed = measured.kind
    words = _words()
    with opened_table(components) as file, words.status("fitting") as status:
        summary = fit_table(
            table,
            metamodel_of(forward, reed, _tell),
            file,
            lambda reeds: status.update(f"{reeds} reeds fitted"),
        )
    answer = {**summary.to_json(), "files": {name: str(path) for name, path in files.items()}}
    if measured:
        answer["lines"] = measured.to_json()
    if as_json:
        _show_json(answer)
        return
    console = results()
    console.print(summary_table(summary))
    for remark in remarks(summary, measured):
        console.print(remark)
    for name, path in files.items():
        console.print(f"{name:13} {path}", markup=False, soft_wrap=True)


@_verb
def paper(
    out: Annotated[
        Path | None, typer.Option(metavar="PAGE.html", help="Page; paper.html if not given.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compare the paper's printed numbers with ours, on one self-contained HTML page.

    Takes about a minute. With --json alone no page is written.
    """
    from reports.own_output import require_writable
    from reproduction.page import (
        counts_table,
        page_output,
        write_page,
    )
    from reproduction.whole import compare_paper

    page = out or (None if as_json else Path("paper.html"))
    if page:
        require_writable([page_output(page)])
    comparison = compare_paper(_tell)
    if page:
        write_page(comparison, page)
    if as_json:
        _show_json(comparison.to_json() | {"page": str(page) if page else None})
        return
    console = results()
    console.print(counts_table(comparison))
    for sentence in comparison.findings:
        console.print(f"- {sentence}", markup=False)
    console.print(f"page          {page}", markup=False, soft_wrap=True)


@_verb
def list_runs(
    folder: Annotated[Path, typer.Argument(help="Folder with run files.")] = Path("runs"),
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """List the runs of a folder: which reed, which series, how they ended."""
    from acquire.cli.display import catalogue_entry, runs_table
    from runs.errors import RunFileError
    from runs.reader import Run

    if not folder.is_dir():
        state = "is no folder" if folder.exists() else "there is no such folder"
        raise RunFileError(f"{folder}: {state}; name the one with your run files")
    entries = []
    for path in sorted(folder.rglob("*.h5")):
        try:
            with Run.open(path) as run_:
                entries.append(catalogue_entry(run_))
        except RunFileError as error:
            _tell(f"acquire: {error}")
    if as_json:
        _show_json(entries)
    else:
        results().print(runs_table(entries))


@_verb
def show(
    run_file: Annotated[Path, typer.Argument(metavar="RUN", help="A run file.")],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Show what a run file says: who, what, with what, which steps are bad, where it has seams."""
    from acquire.cli.display import details_table, run_details
    from runs.reader import Run

    with Run.open(run_file) as run_:
        details = run_details(run_)
    if as_json:
        _show_json(details)
    else:
        results().print(details_table(details))


@_verb
def pack(
    run_files: Annotated[
        list[Path], typer.Argument(metavar="RUN …", help="Complete runs that kept frames.")
    ],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compress the frames of complete runs without loss, and read the result back.

    `acquire run` does this at the end of a run. Use it for runs where that was interrupted.
    """
    from acquire.cli.display import (
        packing_line,
        packing_to_json,
        share_progress,
    )
    from acquire.runner import script

    answers, worst = [], 0
    for path in run_files:
        try:
            with share_progress(_words(), f"packing {path.name}") as show:
                packed = script.pack(path, progress=show)
        except BenchError as error:
            if debug:
                raise
            # The other runs are packed all the same.
            _tell(f"acquire: {error}")
            worst = max(worst, error.exit_status)
            continue
        answers.append(packing_to_json(str(path), packed))
        if not as_json:
            results().print(packing_line(str(path), packed), soft_wrap=True)
    if as_json:
        _show_json(answers)
    if worst:
        raise typer.Exit(worst)


@_verb
def pause(
    run_file: Annotated[Path, typer.Argument(metavar="RUN", help="File of a run in work.")],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Let a run in work switch all off after its step, and wait."""
    _order(run_file, "pause", as_json)


@_verb
def proceed(
    run_file: Annotated[Path, typer.Argument(metavar="RUN", help="File of a paused run.")],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Let a paused run go on."""
    _order(run_file, "continue", as_json)


def _order(run_file: Path, what: "Order", as_json: bool) -> None:
    from acquire.runner.control import order

    process = order(run_file, what)
    if as_json:
        _show_json({"run": str(run_file), "order": what, "process": process})
    else:
        _tell(f"{run_file}: process {process} was told to {what}")


def main() -> None:
    """Entry point of the `acquire` command."""
    # The runner has two threads of its own; more of them within one matrix product only wait for
    # each other. Read by numpy's libraries when a verb first imports them.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    # An order that comes after the end of its run is lost, and ends nothing.
    for name in ("SIGUSR1", "SIGUSR2"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    app()
