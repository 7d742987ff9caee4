"""Check folder, name and disk space for a run file before it is created."""

import os
import shutil
from pathlib import Path

from protocols.plan import Plan
from runs.disk import error_class
from runs.documents import documents_path
from runs.errors import RunFileError


def make_folder(path: Path) -> None:
    """Create the folder of a run file if it does not exist.

    Raises
    ------
    RunFileError
        If the folder cannot be created, or the name of the run file cannot be used.
    """
    _require_usable_name(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise error_class(error)(
            f"{path}: its folder cannot be made ({error.strerror}); choose another folder"
        ) from error


def require_writable(plan: Plan, path: Path) -> None:
    """Check, before an instrument is switched on, that a run can be written to `path`.

    Raises
    ------
    RunFileError
        If the folder is missing, the name cannot be used, the disk has too little space, or one
        of the files exists already.
    """
    _require_usable_name(path)
    _require_free_name(path)
    if not path.parent.is_dir():
        raise RunFileError(f"{path}: there is no folder {path.parent}; make it first")
    free, needed = shutil.disk_usage(path.parent).free, plan.largest_size_bytes
    if free < needed:
        raise RunFileError(
            f"{path}: the run needs {needed / 1e6:.0f} MB, but its disk has {free / 1e6:.0f} MB "
            "left; free space on the disk or choose another folder"
        )


def _require_usable_name(path: Path) -> None:
    if path.suffix != ".h5":
        raise RunFileError(f"{path}: the name of a run file ends in .h5; write {path.stem}.h5")
    try:
        path.exists()
    except OSError as error:
        raise RunFileError(f"{path}: {error.strerror}; choose another name") from error


def _require_free_name(path: Path) -> None:
    for file in (path, documents_path(path)):
        # lexists, because a link without a target also blocks the name.
        if os.path.lexists(file):
            raise RunFileError(
                f"{file}: exists already and is never overwritten; choose another name or move it"
            )
