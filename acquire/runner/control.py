"""Pause, continue or stop a run from another process.

While a run is measured, its process holds the lock of a small file next to the run file. Orders are
signals that are sent to the process that holds the lock. An order after the end of the run is lost.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal

from acquire.runner.orders import Orders, signals_obeyed
from drivers.exclusive import Holder, LockedError, exclusive, holder_of
from runs.errors import RunFileError

Order = Literal["pause", "continue", "stop"]

_SIGNALS: Final[dict[Order, signal.Signals]] = {
    "pause": signal.SIGUSR1,
    "continue": signal.SIGUSR2,
    "stop": signal.SIGTERM,
}


def control_path(run_path: Path) -> Path:
    """Return the path of the lock file of a run (``R07.h5`` → ``R07.process``) or of a campaign.

    Parameters
    ----------
    run_path : Path
        Path of the run file, or folder of the campaign.
    """
    if run_path.suffix == ".h5":
        return run_path.with_suffix(".process")
    return run_path / "campaign.process"


@contextmanager
def controllable(run_path: Path, orders: Orders | None = None) -> Iterator[Orders]:
    """Hold the lock of a run while it is measured, and obey signals of other processes.

    Only a run on the main thread of a process obeys orders, because only that thread gets signals.

    Parameters
    ----------
    run_path : Path
        Path of the run file, or folder of a campaign.
    orders : Orders, optional
        Orders of the campaign to which the run belongs.

    Yields
    ------
    Orders
        Orders to this run.

    Raises
    ------
    RunFileError
        If another process is measuring this run, or the lock file cannot be created.
    """
    takes_orders = threading.current_thread() is threading.main_thread()
    path, own_orders = control_path(run_path), orders or Orders()
    try:
        with signals_obeyed(own_orders), exclusive(path, f"measures {run_path}", takes_orders):
            yield own_orders
    except LockedError as locked:
        raise RunFileError(
            f"{run_path}: is being measured by {locked.holder or 'another program'}; wait until it "
            "ends"
        ) from None


def measurer(run_path: Path) -> Holder | None:
    """Return the process of this computer that is measuring a run; None if there is none."""
    return holder_of(control_path(run_path))[1]


def order(run_path: Path, what: Order) -> int:
    """Order the process that measures a run to pause, continue or stop after its present step.

    Parameters
    ----------
    run_path : Path
        Path of the run file, or folder of a campaign.
    what : {'pause', 'continue', 'stop'}

    Returns
    -------
    int
        Number of the process.

    Raises
    ------
    RunFileError
        If no process of this computer is measuring the run, the process belongs to another user,
        or it does not obey orders.
    """
    held, holder = holder_of(control_path(run_path))
    if not held:
        raise RunFileError(
            f"{run_path}: is not being measured; name a run that this computer is measuring now"
        )
    if holder is None:
        raise RunFileError(
            f"{run_path}: is being measured, but {control_path(run_path).name} does not name a "
            f"process of this computer; {what} it on the computer where it was started"
        )
    if not holder.takes_orders:
        raise RunFileError(
            f"{run_path}: is measured by a script, on a thread that gets no signals; {what} it "
            "from that script"
        )
    try:
        os.kill(holder.pid, _SIGNALS[what])
    except ProcessLookupError:
        raise RunFileError(
            f"{run_path}: process {holder.pid} has just ended; there is nothing to {what}"
        ) from None
    except PermissionError:
        raise RunFileError(
            f"{run_path}: process {holder.pid} belongs to another user; ask them to {what} it"
        ) from None
    return holder.pid
