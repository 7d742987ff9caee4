"""Errors of the application: options and arguments that do not fit together."""

from holography.errors import BenchError


class UsageError(BenchError):
    """Arguments that cannot be used as given; names the argument and the remedy."""

    exit_status = 2
