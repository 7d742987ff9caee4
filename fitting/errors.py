"""Errors of reading resonances and parameters out of a run."""

from holography.errors import BenchError


class FitError(BenchError):
    """A run from which nothing can be concluded; says what is missing."""


class FitInputError(FitError):
    """Something that cannot be fitted as asked: runs that do not belong together, no such model."""

    exit_status = 2
