"""Errors of describing, planning, running and reading a sweep."""

from holography.errors import BenchError


class ProtocolError(BenchError):
    """A protocol or bench file that cannot be used; names the file and the key path."""

    exit_status = 2


class RunFileError(BenchError):
    """A run file that cannot be read or written."""

    exit_status = 2
