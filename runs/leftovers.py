"""Remove files that a dead process left next to a run file and that nothing needs any more."""

from pathlib import Path

from runs.disk import error_class
from runs.documents import documents_path, holds_no_event, rewritten_path
from runs.integrity.unborn import unborn_path
from runs.layout import short_reason
from runs.packing import packed_path


def clear_leftovers(run_path: Path) -> list[Path]:
    """Remove unfinished files of one run that a dead process left.

    Call it while you hold the run's lock (`acquire.runner.control.controllable`): then no living
    process is writing these files. Removed are an unfinished run file, a packed copy, unfinished
    documents of a resumed run, and documents without an event if there is no run file. If one of
    these names is a link, only the link is removed.

    Documents with events stay, even without their run file: the user may have moved it.

    Parameters
    ----------
    run_path : Path
        Path of the run file.

    Returns
    -------
    list of Path
        Files that were removed.

    Raises
    ------
    RunFileError
        If a file cannot be removed.
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
                f"{path}: was left by a process that died, and cannot be removed "
                f"({short_reason(error)}); remove it yourself"
            ) from error
    return found
