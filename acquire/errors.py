"""Errors of describing, planning, running and reading a sweep."""

from holography.errors import BenchError


class ProtocolError(BenchError):
    """A protocol or bench file that cannot be used; names the file and the key path."""

    exit_status = 2


class RunFileError(BenchError):
    """A run file that cannot be read or written."""

    exit_status = 2


class DiskError(RunFileError):
    """A disk that refuses to be written or read: full, gone, or failing."""

    exit_status = 1


class OutputRefusedError(BenchError):
    """A file that must not or cannot be written where it was asked for; nothing was computed."""

    exit_status = 2


class OutputFailedError(BenchError):
    """A disk, or whatever standard output is, that refused what was written to it."""
