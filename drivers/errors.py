"""Errors of instruments."""

from holography.errors import BenchError


class InstrumentError(BenchError):
    """An instrument did not do what it was asked; names the device, its state and the remedy."""


class LimitError(BenchError):
    """A setting outside a stated limit, refused before anything is sent."""

    exit_status = 2


class BenchSetupError(InstrumentError):
    """A bench that cannot be put together as its bench file says; names the key and the remedy."""

    exit_status = 2
