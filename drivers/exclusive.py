"""Lock files: what one process uses, no other may use at the same time.

The operating system holds the lock (``flock``) and frees it when the process ends, however it ends.
What the file says of its holder only serves messages and orders, and counts only while the lock is
held by a process that the file describes truly: host, start of the computer, number and start of
the process.
"""

import contextlib
import fcntl
import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

# A description of a holder has some 300 bytes; more is no such description.
_LONGEST_DESCRIPTION: Final = 4096
# Chosen: a holder writes its description within a millisecond; on a machine with much else to do it
# may have to wait for its turn.
_DESCRIBED_WITHIN_S: Final = 0.5
_LOOK_EVERY_S: Final = 0.01
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
# Place of the start time among the words that follow the name in /proc/PID/stat (proc(5): the
# start time is field 22, the state, which follows the name, is field 3).
_START_FIELD: Final = 22 - 3


@dataclass(frozen=True, slots=True)
class Holder:
    """A process that holds a lock.

    Attributes
    ----------
    host : str
        Name of the computer.
    boot : str
        Tells one start of that computer from the next; empty where the system has no such mark.
    pid : int
        Number of the process.
    started : str
        Start of the process, in clock ticks since the start of the computer; empty if unknown.
    since : str
        When the lock was taken, ISO 8601 and UTC.
    does : str
        What the process does, for messages.
    takes_orders : bool
        Whether signals reach the work that the process does.
    """

    host: str
    boot: str
    pid: int
    started: str
    since: str
    does: str
    takes_orders: bool = True

    @classmethod
    def this_process(cls, does: str, takes_orders: bool = True) -> "Holder":
        """Describe the process that asks."""
        pid = os.getpid()
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return cls(socket.gethostname(), _boot(), pid, _start_of(pid), now, does, takes_orders)

    @property
    def is_here(self) -> bool:
        """Whether this very process still runs on this computer."""
        return (
            self.host == socket.gethostname()
            and self.boot == _boot()
            and self.started == _start_of(self.pid)
        )

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host} ({self.does}, since {self.since})"


class LockedError(Exception):
    """Another process holds a lock.

    Attributes
    ----------
    holder : Holder or None
        None if the file does not say.
    """

    def __init__(self, holder: Holder | None) -> None:
        super().__init__(f"held by {holder or 'a process that does not say which it is'}")
        self.holder = holder


@contextmanager
def exclusive(path: Path, does: str, takes_orders: bool = True) -> Iterator[None]:
    """Hold the lock of a file; the file goes when the lock is freed.

    Parameters
    ----------
    path : Path
        A symbolic link at this place is refused.
    does : str
        What this process does, for the messages of others.
    takes_orders : bool
        See `Holder`.

    Raises
    ------
    LockedError
        If another process holds it.
    OSError
        If the file cannot be made.
    """
    descriptor = _locked(path)
    try:
        _describe(descriptor, Holder.this_process(does, takes_orders))
        yield
    finally:
        # Removed while the lock is held: whoever opened the file meanwhile finds it gone.
        with contextlib.suppress(OSError):
            path.unlink()
        # Freed by name too, because a child process may have inherited the descriptor.
        fcntl.flock(descriptor, fcntl.LOCK_UN)
        os.close(descriptor)


def _locked(path: Path) -> int:
    """Open a file and lock it; a file that its holder removed meanwhile does not count."""
    while True:
        descriptor = _opened(path)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_still(path, descriptor):
                return descriptor
        except BlockingIOError:
            holder = _described_soon(descriptor)
            os.close(descriptor)
            raise LockedError(holder) from None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _opened(path: Path) -> int:
    flags = os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | flags, 0o644)
    except PermissionError:
        # The file of another user, whose process may be gone: it can be locked all the same.
        return os.open(path, os.O_RDONLY | flags)


def _describe(descriptor: int, holder: Holder) -> None:
    # The file of another user cannot be written; then it describes a process that is gone.
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, json.dumps(asdict(holder)).encode(), 0)


def holder_of(path: Path) -> tuple[bool, Holder | None]:
    """Return whether a lock is held, and the process that holds it if the file says so truly.

    Parameters
    ----------
    path : Path

    Returns
    -------
    (bool, Holder or None)
        None also if the process that the file describes does not run on this computer: it may
        run on another one that shares the folder, or the file may have been changed.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return False, None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = _described_soon(descriptor)
        return True, holder if holder is not None and holder.is_here else None
    else:
        return False, None
    finally:
        os.close(descriptor)


def _is_still(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(path, follow_symlinks=False), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _described_soon(descriptor: int) -> Holder | None:
    """Description of a lock's holder, which writes it just after it has locked the file."""
    until_s = time.monotonic() + _DESCRIBED_WITHIN_S
    while (holder := _described(descriptor)) is None and time.monotonic() < until_s:
        time.sleep(_LOOK_EVERY_S)
    return holder


def _described(descriptor: int) -> Holder | None:
    with contextlib.suppress(OSError, ValueError, TypeError, RecursionError):
        holder = Holder(**json.loads(os.pread(descriptor, _LONGEST_DESCRIPTION, 0)))
        texts = (holder.host, holder.boot, holder.started, holder.since, holder.does)
        if all(isinstance(text, str) for text in texts) and type(holder.pid) is int:
            return holder
    return None


def _boot() -> str:
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _start_of(pid: int) -> str:
    """Start of a process, empty if there is none of that number."""
    if sys.platform != "linux":
        return ""
    try:
        status = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    # The name, in brackets, may itself hold brackets and blanks.
    words = status.rpartition(")")[2].split()
    # A process that ended and was not waited for uses nothing any more (state Z).
    return "" if words[0] == "Z" else words[_START_FIELD]
