"""Lets other processes pause a run, go on with it, or end it.

While a run is measured its process holds the lock of a small file next to the run file. Orders are
signals, sent to the process that holds the lock; those that come after its end are lost.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal

from acquire.runner.orders import Orders, signals_obeyed
from drivers.exclusive import (
    Holder,
    LockedError,
    exclusive,
    holder_of,
)
from runs.errors import RunFileError

Order = Literal["pause", "continue", "stop"]

_SIGNALS: Final[dict[Order, signal.Signals]] = {
    "pause": signal.SIGUSR1,
    "continue": signal.SIGUSR2,
    "stop": signal.SIGTERM,
}


def control_path(run_path: Path) -> Path:
    """Return the lock file of a run, ``R07.h5`` → ``R07.process``, or of a campaign's folder."""
    if run_path.suffix == ".h5":
        return run_path.with_suffix(".process")
    return run_path / "campaign.process"


@contextmanager
def controllable(run_path: Path, orders: Orders | None = None) -> Iterator[Orders]:
    """Hold the lock of a run while it is measured, and obey the signals of others.

    Only runs on a process's main thread can be given orders, because only that gets signals.

    Parameters
    ----------
    run_path : Path
    orders : Orders, optional
        Of a campaign, whose signals are obeyed already.

    Yields
    ------
    Orders
        What others ask of the run.

    Raises
    ------
    RunFileError
        If another process is measuring this run, or the file cannot be made.
    """
    takes_orders = threading.current_thread() is threading.main_thread()
    path, mine = control_path(run_path), orders or Orders()
    try:
        with signals_obeyed(mine), exclusive(path, f"measures {run_path}", takes_orders):
            yield mine
    except LockedError as locked:
        raise RunFileError(
            f"{run_path}: is being measured by {locked.holder or 'another program'}; wait for its "
            "end"
        ) from None


def measurer(run_path: Path) -> Holder | None:
    """Return the process that is measuring a run; None if no process on this computer is."""
    return holder_of(control_path(run_path))[1]


def order(run_path: Path, what: Order) -> int:
    """Tell the process that measures a run to pause, go on, or end; return its number.

    It obeys at the next step.

    Raises
    ------
    RunFileError
        If no process of this computer is measuring that run, or it belongs to somebody else, or
        takes no orders.
    """
    held, holder = holder_of(control_path(run_path))
    if not held:
        raise RunFileError(
            f"{run_path}: is not being measured; name the run file of a run in work, on this "
            "computer"
        )
    if holder is None:
        raise RunFileError(
            f"{run_path}: is being measured, but {control_path(run_path).name} does not describe a "
            f"process of this computer; {what} it where it was started"
        )
    if not holder.takes_orders:
        raise RunFileError(
            f"{run_path}: is measured by a script on a thread that gets no orders; let the script "
            f"{what} it"
        )
    try:
        os.kill(holder.pid, _SIGNALS[what])
    except ProcessLookupError:
        raise RunFileError(f"{run_path}: process {holder.pid} has just ended") from None
    except PermissionError:
        raise RunFileError(
            f"{run_path}: process {holder.pid} belongs to another user; ask them to {what} it"
        ) from None
    return holder.pid
