"""Measure campaigns from Python: all sweeps and calibrations that a diagnosis can use."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from acquire.errors import UsageError
from acquire.measurement import bench_file, require_storable
from acquire.results.measurement import CampaignPlan, CampaignResult, RunResult
from acquire.runner.callbacks import Callbacks
from acquire.runner.campaign_parts import (
    BenchPreparation,
    PartState,
    PlannedPart,
    begun_campaign,
    planned_parts,
)
from acquire.runner.orders import Orders
from acquire.runner.run_folder import make_folder
from acquire.runner.run_session import (
    Sample,
    clear_dead,
    locked,
    measure_new,
    measure_rest,
    opened_bench,
    pack_complete,
    prepare_new,
)
from acquire.runner.summary import RunState, RunSummary
from drivers.roles import Bench
from protocols.bench import DEFAULT_BENCH, BenchFile
from protocols.campaign import CampaignFile, tasks_of
from protocols.plan import make_plan
from runs.layout import RunLabels


def load_campaign(name_or_path: str | Path) -> CampaignFile:
    """Read a campaign file, or a shipped campaign by its name.

    Raises
    ------
    ProtocolError
        If there is no such file or anything in it is wrong.
    """
    return CampaignFile.from_file(name_or_path)


def plan_campaign(
    campaign: CampaignFile, bench: str | Path | BenchFile = DEFAULT_BENCH
) -> CampaignPlan:
    """Plan every part of a campaign on a bench. No instrument is opened.

    Raises
    ------
    ProtocolError
        If a part or the bench file is wrong.
    """
    described, tasks = bench_file(bench), tuple(tasks_of(campaign))
    return CampaignPlan(tasks, tuple(make_plan(task.protocol, described) for task in tasks))


def run_campaign(
    campaign: CampaignFile,
    folder: str | Path,
    bench: str | Path | BenchFile = DEFAULT_BENCH,
    *,
    reed: str = "unnamed",
    labels: RunLabels | None = None,
    seed: int = 0,
    callbacks: Callbacks | None = None,
) -> CampaignResult:
    """Measure all parts of a campaign into a folder, on a bench that stays open.

    Parameters
    ----------
    campaign : CampaignFile
    folder : path
        Gets ``NAME.h5`` for each part. Must be new or empty.
    bench : str, path or BenchFile
    reed, labels, seed, callbacks
        As for `acquire.run`.

    Returns
    -------
    CampaignResult
        Of the parts that were measured. The last one is incomplete if the campaign was stopped, and
        has outputs that are not confirmed off if that stopped it.

    Raises
    ------
    ProtocolError
        If a part is wrong, or the bench cannot carry it out; nothing was opened or written.
    UsageError
        If the folder is not empty.
    InstrumentError, RunFileError
        As for `acquire.run`; parts that were measured before are kept.
    """
    folder, said = Path(folder), labels or RunLabels()
    sample = Sample(reed, replace(said, campaign=folder.name), seed)
    require_storable(sample)
    parts = planned_parts(campaign, folder, bench_file(bench))
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(
            f"{folder}: exists already; choose another folder, or resume the campaign in it"
        )
    make_folder(parts[0].path)
    return _measured(parts, sample, callbacks or Callbacks())


def resume_campaign(
    campaign: CampaignFile,
    folder: str | Path,
    bench: str | Path | BenchFile = DEFAULT_BENCH,
    *,
    callbacks: Callbacks | None = None,
) -> CampaignResult:
    """Continue a campaign that was interrupted, that failed, or whose process has ended.

    Parts that are complete stay as they are; the incomplete one is continued. Reed, labels and seed
    are those in the run files.

    Parameters
    ----------
    campaign : CampaignFile
        The one that the campaign was started with.
    folder : path
    bench, callbacks
        As for `run_campaign`.

    Returns
    -------
    CampaignResult
        Of the parts that were measured now.

    Raises
    ------
    RunFileError
        If the folder holds no run of a campaign, all parts are complete, or a part was started with
        another protocol, bench or kind of reed.
    ProtocolError, InstrumentError
        As for `run_campaign`.
    """
    parts = planned_parts(campaign, Path(folder), bench_file(bench))
    sample = begun_campaign(parts, Path(folder))
    return _measured(parts, sample, callbacks or Callbacks())


def _measured(parts: Sequence[PlannedPart], sample: Sample, callbacks: Callbacks) -> CampaignResult:
    """Measure all parts that are not complete."""
    folder, first = parts[0].path.parent, parts[0].plan
    results: list[RunResult] = []
    with (
        locked(folder) as orders,
        opened_bench(first, sample, folder, callbacks, orders) as bench,
    ):
        preparation = BenchPreparation(bench, callbacks.wait_for, orders)
        for part in parts:
            state = part.state
            preparation.prepare(part, state)
            if state is PartState.COMPLETE:
                continue
            callbacks.part(part.task, part.plan)
            results.append(RunResult(_measured_part(part, state, sample, bench, callbacks, orders)))
            if results[-1].status is not RunState.COMPLETE or results[-1].unconfirmed:
                break
    return CampaignResult(folder, tuple(results))


def _measured_part(
    part: PlannedPart,
    state: PartState,
    sample: Sample,
    bench: Bench,
    callbacks: Callbacks,
    orders: Orders,
) -> RunSummary:
    """Measure one part, or its missing steps."""
    labels = replace(sample.labels, part=part.task.part.name, clamping=part.task.clamping)
    with locked(part.path, orders):
        if state is PartState.BEGUN:
            clear_dead(part.path, callbacks)
            summary = measure_rest(part.plan, bench, part.path, callbacks, orders)
        else:
            prepare_new(part.plan, part.path, callbacks)
            summary = measure_new(part.plan, bench, part.path, labels, callbacks, orders)
        # With the bench open: the reed stays as it is between the parts of a campaign.
        return pack_complete(summary, part.plan, callbacks, orders)
