"""Measure from Python: load a protocol, change it, plan it, run it."""

import math
from dataclasses import asdict
from pathlib import Path

from acquire.errors import UsageError
from acquire.results.measurement import RunResult, SweepPlan
from acquire.runner.callbacks import Callbacks
from acquire.runner.resuming import unfinished
from acquire.runner.run_folder import make_folder
from acquire.runner.run_session import (
    Sample,
    arrange_light,
    clear_dead,
    locked,
    measure_new,
    measure_rest,
    opened_bench,
    pack_complete,
    prepare_new,
)
from protocols.bench import DEFAULT_BENCH, BenchFile
from protocols.plan import Plan, make_plan
from protocols.protocol import Protocol
from runs.layout import RunLabels
from runs.packing import Packing
from runs.packing import pack as pack_frames
from runs.reader import Run


def load(name_or_path: str | Path) -> Protocol:
    """Read a protocol file, or a shipped protocol by its name.

    Parameters
    ----------
    name_or_path : str or path
        Such as ``"quick"``, ``"seriesA"`` or ``"my-protocol.yaml"``.

    Returns
    -------
    Protocol
        Frozen; `Protocol.replace` returns a changed copy.

    Raises
    ------
    ProtocolError
        If there is no such file or anything in it is wrong.

    Examples
    --------
    >>> import acquire
    >>> acquire.load("quick").series
    'A'
    """
    return Protocol.from_file(name_or_path)


def plan(
    protocol: str | Path | Protocol, bench: str | Path | BenchFile = DEFAULT_BENCH
) -> SweepPlan:
    """Compute every setting of a sweep on a bench. No instrument is opened.

    Parameters
    ----------
    protocol : str, path or Protocol
        A protocol, its file, or the name of a shipped one.
    bench : str, path or BenchFile
        A bench, its file, or the name of a shipped one.

    Returns
    -------
    SweepPlan
        What the bench cannot do is listed in its `violations`.

    Raises
    ------
    ProtocolError
        If the protocol or the bench file is wrong.

    Examples
    --------
    >>> import acquire
    >>> plan = acquire.plan("quick")
    >>> len(plan.steps), round(plan.duration_s)
    (87, 35)
    """
    asked = protocol if isinstance(protocol, Protocol) else load(protocol)
    return SweepPlan(make_plan(asked, bench_file(bench)))


def bench_file(bench: str | Path | BenchFile) -> BenchFile:
    """Return a bench, read from its file unless it is read already."""
    return bench if isinstance(bench, BenchFile) else BenchFile.from_file(bench)


def run(
    plan: Plan | SweepPlan,
    path: str | Path,
    *,
    reed: str = "unnamed",
    labels: RunLabels | None = None,
    seed: int = 0,
    callbacks: Callbacks | None = None,
) -> RunResult:
    """Open the bench of a plan, measure the sweep, close the bench, and pack the frames.

    However the run ends, the tweeter and the RF are switched off before this returns. Ctrl-C stops
    the run after the current step. Call it on the main thread: only there are signals that end a
    process obeyed, and on another one they end it with all outputs on. A bench that can operate its
    shutters and lamp does so first, for example for a run of dark frames; on other benches a person
    does it before.

    Parameters
    ----------
    plan : Plan or SweepPlan
    path : path
        Run file to write, which must not exist. Its folder is created.
    reed : str
        Name of the reed, unique in the laboratory. On a simulated bench it also selects the reed:
        the same name is always the same reed.
    labels : RunLabels, optional
        Strength, note and operator.
    seed : int
        Seed of the random numbers of a simulated bench.
    callbacks : Callbacks, optional
        Functions to call with progress and messages.

    Returns
    -------
    RunResult

    Raises
    ------
    ProtocolError
        If the bench cannot carry out the plan; nothing was opened or written.
    UsageError
        If the run file cannot hold the reed's name or the labels.
    InstrumentError, RunFileError
        See `acquire.runner.runner.run`.
    """
    planned, path, calls = domain_plan(plan), Path(path), callbacks or Callbacks()
    sample = Sample(reed, labels or RunLabels(), seed)
    require_storable(sample)
    planned.require_possible()
    make_folder(path)
    with locked(path) as orders:
        prepare_new(planned, path, calls)
        with opened_bench(planned, sample, path, calls, orders) as bench:
            arrange_light(planned, bench, orders)
            summary = measure_new(planned, bench, path, sample.labels, calls, orders)
        return RunResult(pack_complete(summary, planned, calls, orders))


def resume(
    plan: Plan | SweepPlan, path: str | Path, *, callbacks: Callbacks | None = None
) -> RunResult:
    """Continue a run that was interrupted, that failed, or whose process has ended.

    Reed, labels and seed are those in the run file.

    Parameters
    ----------
    plan : Plan or SweepPlan
        Of the same protocol, bench and kind of reed as the run was started with.
    path : path
        The run file.
    callbacks : Callbacks, optional
        Functions to call with progress and messages.

    Returns
    -------
    RunResult

    Raises
    ------
    RunFileError
        If the run is complete, or was started with another protocol, bench or kind of reed.
    ProtocolError, InstrumentError
        As for `run`.
    """
    planned, calls = domain_plan(plan), callbacks or Callbacks()
    planned.require_possible()
    # Before the lock: its file needs the folder, which exists only if the run exists.
    path = unfinished(path, planned).path
    with locked(path) as orders:
        # Again, because another process may have completed the run before this one had the lock.
        found = unfinished(path, planned)
        clear_dead(path, calls)
        sample = Sample(found.reed, RunLabels(), found.seed)
        with opened_bench(planned, sample, path, calls, orders) as bench:
            arrange_light(planned, bench, orders)
            summary = measure_rest(planned, bench, path, calls, orders)
        return RunResult(pack_complete(summary, planned, calls, orders))


def open_run(path: str | Path) -> Run:
    """Open a run file for reading, also while it is being measured.

    Parameters
    ----------
    path : path

    Returns
    -------
    Run
        A context manager. Close it, or use it in a ``with`` statement.

    Raises
    ------
    RunFileError
        If there is no such file, or it is no run file, or it is damaged.
    """
    return Run.open(path)


def pack(path: str | Path, *, callbacks: Callbacks | None = None) -> Packing:
    """Compress the frames of a complete run without loss; see `runs.packing.pack`.

    Parameters
    ----------
    path : path
        The run file.
    callbacks : Callbacks, optional
        `Callbacks.packing` is called with progress.

    Raises
    ------
    RunFileError
        If the run is being measured, incomplete or damaged, or the disk refuses.
    """
    path, calls = Path(path), callbacks or Callbacks()
    # Before the lock: its file needs the folder, which exists only if the run exists.
    with Run.open(path):
        pass
    with locked(path) as orders, orders.given_up_at(1):
        clear_dead(path, Callbacks())
        return pack_frames(path, calls.packing)


def domain_plan(plan: Plan | SweepPlan) -> Plan:
    """Return the plan within a result of `plan`."""
    return plan.plan if isinstance(plan, SweepPlan) else plan


def require_storable(sample: Sample) -> None:
    """Refuse, before an instrument is opened, what a run file cannot hold.

    Raises
    ------
    UsageError
        Names the argument.
    """
    labels = sample.labels
    if labels.strength is not None and not 0 < labels.strength < math.inf:
        raise UsageError(f"strength: {labels.strength} is not a strength; write one such as 3.5")
    if not sample.reed.strip():
        raise UsageError("reed: is blank; write the name of this reed")
    for name, text in {"reed": sample.reed, **asdict(labels)}.items():
        if not isinstance(text, str):
            continue
        try:
            text.encode("utf-8")
        except UnicodeEncodeError:
            raise UsageError(f"{name}: is not UTF-8 text; type it again") from None
        if "\0" in text:
            raise UsageError(f"{name}: holds a null character; remove it")
