"""Open HDF5 files that another process may be writing, and say why one cannot be read."""

import contextlib
from pathlib import Path
from typing import Any

import h5py

from runs.disk import error_class
from runs.errors import RunFileError
from runs.layout import short_reason
from runs.records import read_text

# Errors that h5py and the interpretation of values raise when bytes differ from what was written.
DAMAGE = OSError, RuntimeError, ValueError, TypeError, ArithmeticError


class DamagedStepError(ValueError):
    """The numbers of an attempt do not match their checksum; the message names the attempt."""


def open_file(path: Path) -> Any:
    """Open an HDF5 file for reading, even if another process is writing it.

    Raises
    ------
    RunFileError
        If it cannot be read as an HDF5 file.
    """
    try:
        try:
            file = h5py.File(path, "r", locking=False)
        except OSError as error:
            # This process already has the file open with a lock, and HDF5 requires the same
            # locking mode for both.
            if "locking" not in str(error):
                raise
            return h5py.File(path, "r")
        return _shareable(path, file)
    except OSError as error:
        # The file may have been removed after `Run.open` found it.
        if not path.exists():
            raise absent(path) from None
        raise error_class(error)(
            f"{path}: cannot be read as an HDF5 file ({short_reason(error)}); name a run file"
        ) from error


def _shareable(path: Path, file: Any) -> Any:
    """Reopen a complete run with a shared lock, the default of other libraries in this process.

    HDF5 opens a file twice in one process only with the same locking mode. A complete run is never
    continued, so the lock does not block a writer.
    """
    if status_of(file) != "complete":
        return file
    file.close()
    try:
        return h5py.File(path, "r")
    except OSError:
        # The file system has no locks, or this process just opened the file without one.
        return h5py.File(path, "r", locking=False)


def absent(path: Path) -> RunFileError:
    """Return the error that says that there is no such file."""
    return RunFileError(f"{path}: there is no such file; check the name")


def status_of(file: Any) -> str:
    """Return the status of a run that may be damaged; empty if the status cannot be read.

    A status in another file is not read: no run file may have another one opened.
    """
    with contextlib.suppress(KeyError, *DAMAGE):
        for name in ("entry", "entry/status"):
            if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                return ""
        made = file["entry/status"].id.get_create_plist()
        if not made.get_external_count() and made.get_layout() != h5py.h5d.VIRTUAL:
            return read_text(file["entry"], "status")
    return ""


def failure(path: Path, error: Exception, status: str) -> RunFileError:
    """Return the error that says why a run file cannot be read, and what to do."""
    if isinstance(error, DamagedStepError):
        instead = "measure again"
        if status not in ("complete", ""):
            instead = "continue the run (acquire run … --resume), which measures the step again"
        return RunFileError(
            f"{path}: the numbers of {error} are damaged: they do not have the checksum that was "
            f"written with them; use another copy of the file, or {instead}"
        )
    if isinstance(error, KeyError):
        return RunFileError(
            f"{path}: is incomplete ({short_reason(error)}); measure again or use another copy"
        )
    return error_class(error)(
        f"{path}: is damaged ({short_reason(error)}); use another copy of the file"
    )
