"""New run files: they have a temporary name until they are finished and checked."""

from pathlib import Path

import h5py

from runs.disk import error_class
from runs.errors import RunFileError
from runs.integrity.checks import require_run
from runs.layout import short_reason


def unborn_path(path: Path) -> Path:
    """Return the temporary path of a new run file: ``R07.h5`` → ``.R07.h5.part``."""
    return path.with_name(f".{path.name}.part")


def require_readable(path: Path, unborn: Path) -> None:
    """Raise an error if readers of run files would refuse a new file.

    Parameters
    ----------
    path : Path
        Final path of the file; used in messages.
    unborn : Path
        Temporary path of the file.

    Raises
    ------
    RunFileError
    """
    try:
        with h5py.File(unborn, "r", locking=False) as file:
            require_run(unborn, file)
    except RunFileError as refused:
        reason = str(refused).removeprefix(f"{unborn}: ")
        raise RunFileError(
            f"{path}: cannot be made, because it could not be read again: {reason}"
        ) from None


def cannot_make(path: Path, error: Exception) -> RunFileError:
    """Return the error that says why a run file cannot be made."""
    return error_class(error)(
        f"{path}: cannot be made ({short_reason(error)}); check folder, permissions and disk space"
    )
