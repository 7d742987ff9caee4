"""Errors of instruments."""

from holography.errors import BenchError


class InstrumentError(BenchError):
    """An instrument did not do what it was asked; names the device, its state and the remedy."""


class LimitError(BenchError):
    """A setting outside a stated limit, refused before anything is sent."""

    exit_status = 2
