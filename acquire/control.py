"""Lets other processes pause a run, go on with it, or end it.

While a run is measured its process holds a lock on a small file beside the run file, in which its
number stands. The lock goes with the process, however that ends.
"""

import contextlib
import fcntl
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal

from acquire.errors import RunFileError

Order = Literal["pause", "continue", "stop"]

_SIGNALS: Final[dict[Order, signal.Signals]] = {
    "pause": signal.SIGUSR1,
    "continue": signal.SIGUSR2,
    "stop": signal.SIGTERM,
}


def control_path(run_path: Path) -> Path:
    """Return where the number of a run's process stands: ``R07.h5`` → ``R07.process``."""
    return run_path.with_suffix(".process")


@contextmanager
def controllable(run_path: Path) -> Iterator[None]:
    """Hold the lock of a run while it is measured.

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
                f"{run_path}: is being measured by process {_number(path)}; wait for its end"
            ) from None
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(descriptor)


def order(run_path: Path, what: Order) -> int:
    """Tell the process that measures a run to pause, go on, or end; return its number.

    It obeys at the next step.

    Raises
    ------
    RunFileError
        If no process is measuring that run, or it belongs to somebody else.
    """
    path = control_path(run_path)
    process = _number(path) if _held(path) else None
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


def _number(path: Path) -> int | None:
    with contextlib.suppress(OSError, ValueError):
        return int(path.read_text())
    return None
