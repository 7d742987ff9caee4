"""Run files that have no name yet."""

from pathlib import Path

import h5py

from runs.checks import require_run
from runs.disk import (
    error_class,
)
from runs.errors import RunFileError
from runs.layout import (
    short_reason,
)


def unborn_path(path: Path) -> Path:
    """Return where a run file is until it is whole: ``R07.h5`` → ``.R07.h5.part``."""
    return path.with_name(f".{path.name}.part")


def require_readable(path: Path, unborn: Path) -> None:
    """Refuse a new file that holds something which a reader of runs would refuse."""
    try:
        with h5py.File(unborn, "r", locking=False) as file:
            require_run(unborn, file)
    except RunFileError as refused:
        reason = str(refused).removeprefix(f"{unborn}: ")
        raise RunFileError(
            f"{path}: cannot be made, because no reader would take it: {reason}"
        ) from None


def cannot_make(path: Path, error: Exception) -> RunFileError:
    """Return the error that says why a run file cannot be made."""
    return error_class(error)(
        f"{path}: cannot be made ({short_reason(error)}); check folder, permissions and disk space"
    )
