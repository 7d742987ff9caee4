"""Sweeps from Python: load a protocol, change it, plan it, run it.

What `acquire run` does, for those who script sweeps; the README shows it in ten lines.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from acquire.bench_file import DEFAULT_BENCH, BenchFile
from acquire.campaign_file import CampaignFile, Task, tasks_of
from acquire.control import controllable
from acquire.errors import RunFileError
from acquire.packing import pack
from acquire.plan import Plan, make_plan
from acquire.protocol import Protocol
from acquire.recorder import StepReport, make_folder, require_writable
from acquire.resuming import unfinished
from acquire.runfile import RunLabels
from acquire.runner import RunState, RunSummary
from acquire.runner import run as measure
from drivers.registry import open_bench
from drivers.roles import Arrangement, Bench


def load(name_or_path: str | Path) -> Protocol:
    """Read a protocol file, or a shipped protocol by its name.

    Raises
    ------
    ProtocolError
        If there is no such file or anything in it is wrong.
    """
    return Protocol.from_file(name_or_path)


def plan(protocol: Protocol, bench: str | Path | BenchFile = DEFAULT_BENCH) -> Plan:
    """Work out every setting of a sweep on a bench, without touching an instrument.

    Raises
    ------
    ProtocolError
        If the bench file is wrong. What the bench cannot do stands in `Plan.violations`.
    """
    described = bench if isinstance(bench, BenchFile) else BenchFile.from_file(bench)
    return make_plan(protocol, described)


def run(
    plan: Plan,
    path: str | Path,
    *,
    reed: str = "unnamed",
    labels: RunLabels | None = None,
    seed: int = 0,
    progress: Callable[[StepReport], None] | None = None,
    packing: Callable[[float], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> RunSummary:
    """Open the plan's bench, measure, and close it; pack the frames of a complete run.

    Parameters
    ----------
    plan : Plan
    path : path
        Of the run file, which must not exist; its folder is made.
    reed : str
        Name that tells this reed from all others. On a simulated bench it is also which reed.
    labels : RunLabels, optional
        Strength, note and operator.
    seed : int
        Of everything random on a simulated bench.
    progress, packing, announce : callable, optional
        Told of every step, of the share of the frames that is packed, and of what people should
        know.

    Raises
    ------
    ProtocolError
        If the bench cannot carry out the plan; nothing was opened or written.
    InstrumentError, RunFileError
        See `acquire.runner.run`.
    """
    plan.require_possible()
    path = Path(path)
    make_folder(path)
    require_writable(plan, path)
    with controllable(path):
        with open_bench(plan.bench, plan.preparation(reed), seed, announce) as bench:
            summary = measure(plan, bench, path, labels, progress, announce=announce)
        _pack(summary, plan, packing, announce)
    return summary


def run_campaign(
    campaign: CampaignFile,
    folder: str | Path,
    bench: str | Path | BenchFile = DEFAULT_BENCH,
    *,
    reed: str = "unnamed",
    labels: RunLabels | None = None,
    seed: int = 0,
    begin: Callable[[Task, Plan], None] | None = None,
    wait_for: Callable[[str], None] | None = None,
    progress: Callable[[StepReport], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> list[RunSummary]:
    """Measure all parts of a campaign, on a bench that stays open, into a folder.

    Parameters
    ----------
    campaign : CampaignFile
    folder : path
        Gets ``NAME.h5`` for each part; must not exist.
    bench, reed, labels, seed, progress, announce
        As for `plan` and `run`.
    begin : callable, optional
        Told of each part before it is measured.
    wait_for : callable, optional
        Told what somebody is to do at the bench; returns when it is done. Asked only on benches
        that cannot do it by themselves.

    Returns
    -------
    list of RunSummary
        Of the parts that were measured; the last is not complete if somebody ended it.

    Raises
    ------
    ProtocolError
        If a part is wrong, or the bench cannot carry it out; nothing was opened or written.
    InstrumentError, RunFileError
        As for `run`; parts measured before are kept.
    """
    tasks = tasks_of(campaign)
    plans = [plan(task.protocol, bench) for task in tasks]
    for planned in plans:
        planned.require_possible()
    folder, said = Path(folder), labels or RunLabels()
    if folder.exists():
        raise RunFileError(f"{folder}: exists already; choose another place with --out")
    make_folder(folder / f"{tasks[0].part.name}.h5")
    summaries: list[RunSummary] = []
    tell = begin or (lambda _task, _plan: None)
    with open_bench(plans[0].bench, plans[0].preparation(reed), seed, announce) as opened:
        for task, planned in zip(tasks, plans, strict=True):
            path = folder / f"{task.part.name}.h5"
            require_writable(planned, path)
            _arrange(opened, task, wait_for or (lambda _what: None))
            tell(task, planned)
            own = replace(said, campaign=folder.name, part=task.part.name, clamping=task.clamping)
            with controllable(path):
                summaries.append(measure(planned, opened, path, own, progress, announce=announce))
                _pack(summaries[-1], planned, None, announce)
            if summaries[-1].status is not RunState.COMPLETE:
                break
    return summaries


def _arrange(bench: Bench, task: Task, wait_for: Callable[[str], None]) -> None:
    """Have shutters, lamp and clamp as a part needs them."""
    around, calibration = bench.surroundings, task.protocol.calibration
    if around is None:
        if task.part.do:
            wait_for(task.part.do)
        return
    if task.part.clamp_anew:
        around.clamp_anew()
    plain = calibration is not None and calibration.kind != "order0"
    around.arrange(
        Arrangement(calibration.kind) if plain and calibration else Arrangement.HOLOGRAMS
    )


def resume(
    plan: Plan,
    path: str | Path,
    *,
    progress: Callable[[StepReport], None] | None = None,
    packing: Callable[[float], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> RunSummary:
    """Go on with a run that was interrupted, failed, or whose process is gone.

    Reed, labels and seed are those that the run file holds.

    Parameters
    ----------
    plan : Plan
        Of the same protocol, bench and kind of reed as the run was begun with.
    path : path
        Of the run file.
    progress, packing, announce : callable, optional
        As for `run`.

    Raises
    ------
    RunFileError
        If the run is complete, or was begun with another protocol, bench or kind of reed.
    ProtocolError, InstrumentError
        As for `run`.
    """
    plan.require_possible()
    run = unfinished(path, plan)
    with controllable(run.path):
        with open_bench(plan.bench, plan.preparation(run.reed), run.seed, announce) as bench:
            summary = measure(plan, bench, path, None, progress, announce=announce, resume=True)
        _pack(summary, plan, packing, announce)
    return summary


def _pack(
    summary: RunSummary,
    plan: Plan,
    progress: Callable[[float], None] | None,
    announce: Callable[[str], None] | None,
) -> None:
    """Pack the frames of a complete run; a disk that does not let us harms nothing."""
    if summary.status is not RunState.COMPLETE or plan.protocol.keep != "frames":
        return
    tell = announce or (lambda _: None)
    try:
        pack(summary.path, progress)
    except RunFileError as error:
        tell(str(error))
    except KeyboardInterrupt:
        tell(f"{summary.path}: is complete, but its frames are not packed")
        raise
