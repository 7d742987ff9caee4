"""Errors of instruments."""

from collections.abc import Sequence

from holography.errors import BenchError


class InstrumentError(BenchError):
    """An instrument did not do what it was asked; names the device, its state and the remedy."""


class OpeningStoppedError(InstrumentError):
    """A bench was stopped while it was opened."""

    exit_status = 130


class LimitError(BenchError):
    """A setting outside a stated limit, refused before anything is sent."""

    exit_status = 2


class BenchSetupError(InstrumentError):
    """A bench that cannot be put together as its bench file says; names the key and the remedy."""

    exit_status = 2


def note_unconfirmed(error: BaseException, unconfirmed: Sequence[str]) -> None:
    """Add to an exception which outputs are not confirmed off.

    Parameters
    ----------
    error : BaseException
        Gets a note for each; a `BenchError` also remembers them for programs.
    unconfirmed : sequence of str
    """
    for what in unconfirmed:
        error.add_note(f"not confirmed off: {what}")
    if isinstance(error, BenchError):
        error.unconfirmed = (*error.unconfirmed, *unconfirmed)
