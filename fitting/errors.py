"""Errors of reading resonances and parameters out of a run."""

from holography.errors import BenchError


class FitError(BenchError):
    """A run from which nothing can be concluded; says what is missing."""
