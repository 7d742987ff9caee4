"""What a process that died left beside a run file, and nothing needs any more."""

from pathlib import Path

from runs.disk import error_class
from runs.documents import (
    documents_path,
    holds_no_event,
    rewritten_path,
)
from runs.layout import short_reason
from runs.packing import packed_path
from runs.unborn import unborn_path


def clear_leftovers(run_path: Path) -> list[Path]:
    """Remove what a dead process left of exactly this run; return what was removed.

    Call it while you hold the run's lock (`acquire.runner.control.controllable`): then no living
    process is making these files. Removed are a run file that was not whole yet, a packed copy,
    documents that were being put together, and documents without an event whose run file was never
    made. A link is removed itself; what it leads to stays.

    Documents with events stay, also without their run file: somebody moved it.

    Parameters
    ----------
    run_path : Path

    Raises
    ------
    RunFileError
        If one of them cannot be removed.
    """
    found = [
        path
        for path in (unborn_path(run_path), packed_path(run_path), rewritten_path(run_path))
        if path.is_symlink() or path.exists()
    ]
    if not run_path.exists() and documents_path(run_path).is_file() and holds_no_event(run_path):
        found.append(documents_path(run_path))
    for path in found:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise error_class(error)(
                f"{path}: was left by a process that is gone, and cannot be removed "
                f"({short_reason(error)}); remove it"
            ) from error
    return found
