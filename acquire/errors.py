"""Errors of the application: options and arguments that do not fit together."""

from typing import Final

from holography.errors import BenchError

# Exit statuses of the command line besides 0, and 2 for bad input (`BenchError.exit_status`).
FAILED: Final = 1
INTERRUPTED: Final = 130


class UsageError(BenchError):
    """Arguments that cannot be used as given; names the argument and the remedy."""

    exit_status = 2
