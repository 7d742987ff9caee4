"""Lets other processes pause a run, go on with it, or end it.

While a run is measured its process holds a lock on a small file beside the run file, in which its
number stands. The lock goes with the process, however that ends. Orders are signals; they wait
until the run can obey, and those that come after its end are lost.
"""

import contextlib
import fcntl
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Final, Literal

from acquire.errors import RunFileError

Order = Literal["pause", "continue", "stop"]

_SIGNALS: Final[dict[Order, signal.Signals]] = {
    "pause": signal.SIGUSR1,
    "continue": signal.SIGUSR2,
    "stop": signal.SIGTERM,
}
# Would end a process that has not said what it does about them.
_DEADLY: Final = (signal.SIGUSR1, signal.SIGUSR2)


def control_path(run_path: Path) -> Path:
    """Return where the number of a run's process stands: ``R07.h5`` → ``R07.process``."""
    return run_path.with_suffix(".process")


@contextmanager
def controllable(run_path: Path) -> Iterator[None]:
    """Hold the lock of a run while it is measured; hold orders back until the run takes them.

    Only runs on a process's main thread can be told anything, because only that gets signals.

    Raises
    ------
    RunFileError
        If another process is measuring this run, or the file cannot be made.
    """
    path = control_path(run_path)
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise RunFileError(
            f"{path}: cannot be made ({error.strerror}); check the folder"
        ) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise RunFileError(
                f"{run_path}: is being measured by {_measurer(path)}; wait for its end"
            ) from None
        os.ftruncate(descriptor, 0)
        with _orders_wait() as obeys:
            try:
                if obeys:
                    os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
                yield
            finally:
                # First, so that nobody tells the process anything once it would not survive that.
                path.unlink(missing_ok=True)
    finally:
        os.close(descriptor)


class WaitingOrders:
    """Handler of signals that come before a run can obey, or after its end."""

    def __init__(self) -> None:
        self._numbers: list[int] = []

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        """Remember a signal."""
        self._numbers.append(number)

    def take(self) -> list[int]:
        """Return the numbers of signals that came, in their order, and forget them."""
        taken, self._numbers = self._numbers, []
        return taken


@contextmanager
def _orders_wait() -> Iterator[bool]:
    """Let orders wait instead of ending the process; yield whether this thread can get any."""
    if threading.current_thread() is not threading.main_thread():
        yield False
        return
    waiting = WaitingOrders()
    before = {number: signal.signal(number, waiting) for number in _DEADLY}
    try:
        yield True
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)


def order(run_path: Path, what: Order) -> int:
    """Tell the process that measures a run to pause, go on, or end; return its number.

    It obeys at the next step.

    Raises
    ------
    RunFileError
        If no process is measuring that run, or it belongs to somebody else, or cannot be told.
    """
    path = control_path(run_path)
    held = _held(path)
    process = _number(path) if held else None
    if held and process is None:
        raise RunFileError(
            f"{run_path}: is measured by a script on a thread that gets no orders; let the script "
            f"{what} it"
        )
    if process is None:
        raise RunFileError(
            f"{run_path}: is not being measured; name the run file of a run in work, on this "
            "computer"
        )
    try:
        os.kill(process, _SIGNALS[what])
    except PermissionError:
        raise RunFileError(
            f"{run_path}: process {process} belongs to somebody else; ask them to {what} it"
        ) from None
    return process


def _held(path: Path) -> bool:
    """Whether some process holds the lock."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _measurer(path: Path) -> str:
    number = _number(path)
    return "a script" if number is None else f"process {number}"


def _number(path: Path) -> int | None:
    with contextlib.suppress(OSError, ValueError):
        return int(path.read_text())
    return None
