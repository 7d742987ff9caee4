"""Sweeps from Python: load a protocol, change it, plan it, run it.

What `acquire run` does, for those who script sweeps; the README shows it in ten lines.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from acquire.runner.campaign_parts import (
    Arranging,
    Begun,
    PartState,
    PlannedPart,
    begun_campaign,
    planned_parts,
)
from acquire.runner.control import control_path, controllable
from acquire.runner.orders import Orders
from acquire.runner.recorder import StepReport
from acquire.runner.resuming import unfinished
from acquire.runner.run_folder import make_folder, require_writable
from acquire.runner.runner import run as measure
from acquire.runner.summary import RunState, RunSummary
from drivers.registry import open_bench
from drivers.roles import Bench
from protocols.bench import DEFAULT_BENCH, BenchFile
from protocols.campaign import CampaignFile, Task
from protocols.plan import Plan, make_plan
from protocols.preparation import Preparation
from protocols.protocol import Protocol
from runs.disk import error_class
from runs.errors import RunFileError
from runs.layout import short_reason
from runs.leftovers import clear_leftovers
from runs.packing import Packing
from runs.packing import pack as pack_frames
from runs.reader import Run, RunLabels


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
        See `acquire.runner.runner.run`.
    """
    plan.require_possible()
    path = Path(path)
    make_folder(path)
    with _held(path) as orders:
        _clear(path, announce)
        require_writable(plan, path)
        preparation = plan.preparation(reed)
        with _opened(plan, preparation, seed, announce, orders, f"measures {path}") as bench:
            summary = measure(plan, bench, path, labels, progress, announce=announce, orders=orders)
        return _packed(summary, plan, packing, announce, orders)


@contextmanager
def _opened(
    plan: Plan,
    preparation: Preparation,
    seed: int,
    announce: Callable[[str], None] | None,
    orders: Orders,
    does: str,
) -> Iterator[Bench]:
    """Open a plan's bench, unless somebody stops that."""
    # The first order to stop waits for the instrument that is being opened, the second does not.
    with orders.given_up_at(2):
        bench = open_bench(
            plan.bench, preparation, seed, announce, does=does, stopped=lambda: orders.stopped
        )
    with bench:
        yield bench


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
        Gets ``NAME.h5`` for each part; must be new or empty.
    bench, reed, labels, seed, progress, announce
        As for `plan` and `run`.
    begin : callable, optional
        Called with each part before it is measured.
    wait_for : callable, optional
        Called with what somebody is to do at the bench; returns when it is done. Called only on
        benches that cannot do it by themselves.

    Returns
    -------
    list of RunSummary
        Of the parts that were measured. The last one is not complete if the campaign was ended, and
        has outputs that are not confirmed off if that ended it.

    Raises
    ------
    ProtocolError
        If a part is wrong, or the bench cannot carry it out; nothing was opened or written.
    InstrumentError, RunFileError
        As for `run`; parts measured before are kept.
    """
    parts = planned_parts(campaign, Path(folder), bench)
    folder, said = Path(folder), labels or RunLabels()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise RunFileError(
            f"{folder}: exists already; choose another --out, or continue it with --resume"
        )
    make_folder(parts[0].path)
    begun = Begun(reed, replace(said, campaign=folder.name), seed)
    return _measured_parts(parts, begun, begin, wait_for, progress, announce)


def resume_campaign(
    campaign: CampaignFile,
    folder: str | Path,
    bench: str | Path | BenchFile = DEFAULT_BENCH,
    *,
    begin: Callable[[Task, Plan], None] | None = None,
    wait_for: Callable[[str], None] | None = None,
    progress: Callable[[StepReport], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> list[RunSummary]:
    """Go on with a campaign that was interrupted, failed, or whose process is gone.

    Parts that are complete stay as they are; the one that is not is gone on with. Reed, labels and
    seed are those that the run files hold.

    Parameters
    ----------
    campaign : CampaignFile
        The one that it was begun with.
    folder : path
    bench, begin, wait_for, progress, announce
        As for `run_campaign`.

    Returns
    -------
    list of RunSummary
        Of the parts that were measured now.

    Raises
    ------
    RunFileError
        If the folder holds no run of a campaign, all parts are complete, or a part was begun with
        another protocol, bench or kind of reed.
    ProtocolError, InstrumentError
        As for `run_campaign`.
    """
    parts = planned_parts(campaign, Path(folder), bench)
    begun = begun_campaign(parts, Path(folder))
    return _measured_parts(parts, begun, begin, wait_for, progress, announce)


def _measured_parts(
    parts: Sequence[PlannedPart],
    begun: Begun,
    begin: Callable[[Task, Plan], None] | None,
    wait_for: Callable[[str], None] | None,
    progress: Callable[[StepReport], None] | None,
    announce: Callable[[str], None] | None,
) -> list[RunSummary]:
    """Measure all parts that are not complete."""
    folder, first = parts[0].path.parent, parts[0].plan
    preparation, does = first.preparation(begun.reed), f"measures {folder}"
    summaries: list[RunSummary] = []
    with (
        _held(folder) as orders,
        _opened(first, preparation, begun.seed, announce, orders, does) as opened,
    ):
        surroundings = Arranging(opened.surroundings, wait_for or (lambda _what: None), orders)
        for part in parts:
            state = part.state
            surroundings.prepare(part, state)
            if state is PartState.COMPLETE:
                continue
            if begin is not None:
                begin(part.task, part.plan)
            summaries.append(_measured_part(part, state, begun, opened, progress, announce, orders))
            if summaries[-1].status is not RunState.COMPLETE or summaries[-1].unconfirmed:
                break
    return summaries


def _measured_part(
    part: PlannedPart,
    state: PartState,
    begun: Begun,
    opened: Bench,
    progress: Callable[[StepReport], None] | None,
    announce: Callable[[str], None] | None,
    orders: Orders,
) -> RunSummary:
    """Measure one part, or what is missing of it."""
    resumed = state is PartState.BEGUN
    own = replace(begun.labels, part=part.task.part.name, clamping=part.task.clamping)
    with _held(part.path, orders):
        _clear(part.path, announce)
        if not resumed:
            require_writable(part.plan, part.path)
        summary = measure(
            part.plan,
            opened,
            part.path,
            own,
            progress,
            announce=announce,
            resume=resumed,
            orders=orders,
        )
        return _packed(summary, part.plan, None, announce, orders)


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
    # Before the lock, whose file has a folder only if the run has one.
    path = unfinished(path, plan).path
    with _held(path) as orders:
        # Once more: another program may have completed it meanwhile.
        run = unfinished(path, plan)
        _clear(path, announce)
        preparation, does = plan.preparation(run.reed), f"measures {run.path}"
        with _opened(plan, preparation, run.seed, announce, orders, does) as bench:
            summary = measure(
                plan, bench, path, None, progress, announce=announce, resume=True, orders=orders
            )
        return _packed(summary, plan, packing, announce, orders)


def pack(path: str | Path, *, progress: Callable[[float], None] | None = None) -> Packing:
    """Compress the frames of a complete run without loss; see `runs.packing.pack`.

    Parameters
    ----------
    path : path
        Of the run file.
    progress : callable, optional
        Told of the share that is packed.

    Raises
    ------
    RunFileError
        If the run is in work, not complete, or damaged, or its disk refuses.
    """
    path = Path(path)
    # Before the lock, whose file has a folder only if the run has one.
    with Run.open(path):
        pass
    with _held(path) as orders, orders.given_up_at(1):
        clear_leftovers(path)
        return pack_frames(path, progress)


@contextmanager
def _held(path: Path, orders: Orders | None = None) -> Iterator[Orders]:
    """Hold a run's lock; a disk without room for the lock's file is said in one line."""
    with ExitStack() as lock:
        try:
            mine = lock.enter_context(controllable(path, orders))
        except OSError as error:
            raise error_class(error)(
                f"{control_path(path)}: cannot be written ({short_reason(error)}); make room on "
                "the disk"
            ) from error
        yield mine


def _clear(path: Path, announce: Callable[[str], None] | None) -> None:
    """Remove what a process that died left of this run, and say so."""
    tell = announce or (lambda _: None)
    for removed in clear_leftovers(path):
        tell(f"{removed}: was left by a process that is gone, and is removed")


def _packed(
    summary: RunSummary,
    plan: Plan,
    progress: Callable[[float], None] | None,
    announce: Callable[[str], None] | None,
    orders: Orders,
) -> RunSummary:
    """Pack the frames of a complete run; a disk that does not let us, or a stop, harms nothing."""
    if summary.status is not RunState.COMPLETE or plan.protocol.keep != "frames":
        return summary
    tell = announce or (lambda _: None)
    try:
        with orders.given_up_at(1):
            pack_frames(summary.path, progress)
    except RunFileError as error:
        tell(str(error))
    except KeyboardInterrupt:
        tell(f"{summary.path}: is complete, but not packed; pack it with: acquire pack")
        return replace(summary, ended_by="person")
    return summary
