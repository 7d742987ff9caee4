"""Keeps two programs from using one bench at the same time.

A bench is known by the addresses of its instruments, whatever its file is called: serial ports,
VISA resources, serial numbers of cameras. Each address has a lock file in one folder for all users
of the computer.
"""

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from drivers.errors import BenchSetupError
from drivers.exclusive import (
    Holder,
    LockedError,
    exclusive,
    holder_of,
)
from protocols.bench import Instruments

# Keys of `options:` that say which instrument is meant; all others are settings of it.
_ADDRESS_KEYS: Final = (
    "port",
    "resource",
    "resources",
    "serial",
    "device",
    "address",
    "host",
    "ip",
    "url",
)
# With sixteen hexadecimal digits, two of 10^9 addresses are equal with a probability of 3 %.
_NAME_DIGITS: Final = 16
_EVERYBODY: Final = 0o1777


class BenchInUseError(BenchSetupError):
    """Another program uses one of the instruments.

    Attributes
    ----------
    holder : Holder or None
        The process, where that is known.
    """

    def __init__(self, message: str, holder: Holder | None) -> None:
        super().__init__(message)
        self.holder = holder


def addresses(instruments: Instruments) -> tuple[str, ...]:
    """Return what tells the instruments of a bench from all others, each once.

    Simulated instruments have no address: everybody may have some of their own.
    """
    found = (
        address
        for entry in (instruments.synthesizers, instruments.generator, instruments.camera)
        for address in _addresses_in(entry.options)
    )
    return tuple(dict.fromkeys(found))


def _addresses_in(options: Mapping[str, Any]) -> Iterator[str]:
    for key in _ADDRESS_KEYS:
        value = options.get(key)
        several = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
        yield from (_canonical(key, each) for each in several if each not in (None, ""))


def _canonical(key: str, value: object) -> str:
    """Write an address in one way: ports by their device file, whatever link leads there."""
    text = str(value)
    if os.path.exists(text):
        return os.path.realpath(text)
    # VISA and pyserial do not mind capitals. A camera's serial number is no host's name.
    return f"serial number {text}" if key == "serial" else text.upper()


@contextmanager
def bench_locked(instruments: Instruments, does: str) -> Iterator[None]:
    """Hold the lock of every address of a bench.

    Parameters
    ----------
    instruments : Instruments
    does : str
        What this process does, for the messages of others.

    Raises
    ------
    BenchInUseError
        If another program uses an instrument of this bench.
    BenchSetupError
        If the lock files cannot be made.
    """
    with ExitStack() as held:
        # In one order, so that two programs never hold one address each and refuse the other's.
        for address in sorted(addresses(instruments)):
            _hold(held, address, does)
        yield


@contextmanager
def address_locked(address: str, does: str) -> Iterator[None]:
    """Hold the lock of one serial port or VISA resource, whatever bench it belongs to.

    Parameters
    ----------
    address : str
        As a bench file writes it.
    does : str
        As for `bench_locked`, which also says what is raised.
    """
    with ExitStack() as held:
        _hold(held, _canonical("port", address), does)
        yield


def _hold(held: ExitStack, address: str, does: str) -> None:
    """Take the lock of an address until `held` is closed."""
    path = _lock_path(address)
    try:
        held.enter_context(exclusive(path, does))
    except LockedError as locked:
        raise BenchInUseError(
            f"instrument at {address}: is in use by "
            f"{locked.holder or 'another program'}; wait for its end, or switch all off "
            "with: acquire bench off BENCH",
            locked.holder,
        ) from None
    except OSError as error:
        raise BenchSetupError(
            f"instrument at {address}: its lock file {path} cannot be made "
            f"({error.strerror}); name another folder in REEDBENCH_LOCKS"
        ) from error


def holders(instruments: Instruments) -> tuple[Holder, ...]:
    """Return the processes that use instruments of a bench, each once."""
    found = (holder_of(_lock_path(address))[1] for address in addresses(instruments))
    return tuple(dict.fromkeys(holder for holder in found if holder is not None))


def lock_folder() -> Path:
    """Folder of the lock files: ``$REEDBENCH_LOCKS``, else one in the system's temporary folder."""
    named = os.environ.get("REEDBENCH_LOCKS")
    return Path(named) if named else Path(tempfile.gettempdir(), "reedbench-locks")


def _lock_path(address: str) -> Path:
    folder = lock_folder()
    if not folder.is_dir():
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            # For all users of the computer, as its temporary folder is; mkdir obeys the umask.
            folder.chmod(_EVERYBODY)
    name = hashlib.sha256(address.encode("utf-8", "surrogatepass")).hexdigest()[:_NAME_DIGITS]
    return folder / f"{name}.lock"
