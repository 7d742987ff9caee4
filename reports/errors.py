"""Errors of outputs: reports, tables, pictures, standard output."""

from holography.errors import BenchError


class OutputRefusedError(BenchError):
    """A file that must not or cannot be written where it was asked for; nothing was computed."""

    exit_status = 2


class OutputFailedError(BenchError):
    """A disk, or whatever standard output is, that refused what was written to it."""
