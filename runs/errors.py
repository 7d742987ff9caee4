"""Errors of run files and of the disks that hold them."""

from holography.errors import BenchError


class RunFileError(BenchError):
    """A run file that cannot be read or written."""

    exit_status = 2


class DiskError(RunFileError):
    """A disk that refuses to be written or read: full, gone, or failing."""

    exit_status = 1
