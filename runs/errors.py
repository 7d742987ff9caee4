"""Errors of run files and of the disks on which they are stored."""

from holography.errors import BenchError


class RunFileError(BenchError):
    """A run file that cannot be read or written."""

    exit_status = 2


class DiskError(RunFileError):
    """A disk that cannot be written or read: it is full, removed, or failing."""

    exit_status = 1


class SilentDiskError(DiskError):
    """A disk that neither writes nor fails."""
