"""One run from its lock to its packed frames: what is shared by new and resumed runs."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from acquire.runner.callbacks import Callbacks
from acquire.runner.control import control_path, controllable
from acquire.runner.orders import Orders
from acquire.runner.run_folder import require_writable
from acquire.runner.runner import run as measure
from acquire.runner.summary import RunState, RunSummary
from drivers.registry import open_bench
from drivers.roles import Arrangement, Bench
from protocols.plan import Plan
from runs.disk import error_class
from runs.errors import RunFileError
from runs.layout import RunLabels, short_reason
from runs.leftovers import clear_leftovers
from runs.packing import pack


@dataclass(frozen=True)
class Sample:
    """What is measured.

    Attributes
    ----------
    reed : str
        Name of the reed, unique in the laboratory. On a simulated bench it also selects the reed.
    labels : RunLabels
        Strength, note, operator and, in a campaign, the campaign's name.
    seed : int
        Seed of the random numbers of a simulated bench.
    """

    reed: str
    labels: RunLabels
    seed: int


@contextmanager
def locked(path: Path, orders: Orders | None = None) -> Iterator[Orders]:
    """Hold the lock of a run or a campaign's folder; yield the orders that reach it.

    Raises
    ------
    RunFileError
        If another process holds the lock, or the disk has no space for the lock's file.
    """
    with ExitStack() as lock:
        try:
            mine = lock.enter_context(controllable(path, orders))
        except OSError as error:
            raise error_class(error)(
                f"{control_path(path)}: cannot be written ({short_reason(error)}); free space on "
                "the disk"
            ) from error
        yield mine


@contextmanager
def opened_bench(
    plan: Plan, sample: Sample, place: Path, callbacks: Callbacks, orders: Orders
) -> Iterator[Bench]:
    """Open the bench of a plan, unless an order to stop arrives first; close it at the end.

    Parameters
    ----------
    plan : Plan
    sample : Sample
    place : Path
        Run file or folder, named in the message to others who want the same bench.
    callbacks : Callbacks
    orders : Orders

    Raises
    ------
    InstrumentError
        If an instrument cannot be opened, or the bench is in use.
    """
    # The first order to stop waits for the instrument that is being opened, the second does not.
    with orders.given_up_at(2):
        bench = open_bench(
            plan.bench,
            plan.preparation(sample.reed),
            sample.seed,
            callbacks.announce,
            does=f"measures {place}",
            stopped=lambda: orders.stopped,
        )
    with bench:
        yield bench


def arrange_light(plan: Plan, bench: Bench, orders: Orders) -> None:
    """Bring shutters and lamp into the state that a run needs, on a bench that can do so.

    Raises
    ------
    KeyboardInterrupt
        At the second order to stop: shutters may never report that they have moved.
    """
    if bench.surroundings is None:
        return
    calibration, arrangement = plan.protocol.calibration, Arrangement.HOLOGRAMS
    if calibration is not None and calibration.kind != "order0":
        arrangement = Arrangement(calibration.kind)
    with orders.given_up_at(2):
        bench.surroundings.arrange(arrangement)


def prepare_new(plan: Plan, path: Path, callbacks: Callbacks) -> None:
    """Check, before anything is switched on, that a new run can be written; the lock is held.

    Raises
    ------
    RunFileError
        See `acquire.runner.run_folder.require_writable`.
    """
    clear_dead(path, callbacks)
    require_writable(plan, path)


def measure_new(
    plan: Plan, bench: Bench, path: Path, labels: RunLabels, callbacks: Callbacks, orders: Orders
) -> RunSummary:
    """Measure a new run on an open bench.

    The caller holds the lock of the run file, and has checked it by `prepare_new`.
    """
    return measure(
        plan, bench, path, labels, callbacks.step, announce=callbacks.announce, orders=orders
    )


def measure_rest(
    plan: Plan, bench: Bench, path: Path, callbacks: Callbacks, orders: Orders
) -> RunSummary:
    """Measure the missing steps of a run on an open bench.

    The caller holds the lock of the run file, and has called `clear_dead`.
    """
    return measure(
        plan,
        bench,
        path,
        progress=callbacks.step,
        announce=callbacks.announce,
        resume=True,
        orders=orders,
    )


def clear_dead(path: Path, callbacks: Callbacks) -> None:
    """Remove the temporary files that a dead process left of a run, and announce each."""
    for removed in clear_leftovers(path):
        callbacks.announce(f"{removed}: was left by a process that has ended; removed")


def pack_complete(
    summary: RunSummary, plan: Plan, callbacks: Callbacks, orders: Orders
) -> RunSummary:
    """Pack the frames of a complete run. A full disk or a stop leaves the run as it was.

    The caller holds the lock of the run file. The bench need not be open: to pack a large run takes
    a minute, in which another run can use it.
    """
    if summary.status is not RunState.COMPLETE or plan.protocol.keep != "frames":
        return summary
    if summary.unconfirmed:
        callbacks.announce(
            f"{summary.path}: is not packed yet, because an output may be on; pack it later with: "
            "acquire pack"
        )
        return summary
    try:
        with orders.given_up_at(1):
            pack(summary.path, callbacks.packing)
    except RunFileError as error:
        callbacks.announce(str(error))
    except KeyboardInterrupt:
        callbacks.announce(
            f"{summary.path}: is complete but not packed; pack it with: acquire pack"
        )
        return replace(summary, ended_by="person")
    return summary
