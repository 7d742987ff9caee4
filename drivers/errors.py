"""Errors of instruments."""

from collections.abc import Sequence
from typing import Final

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


_NOTE: Final = "not confirmed off: "


def unconfirmed_in(error: BaseException) -> tuple[str, ...]:
    """Return which outputs an exception says are not confirmed off."""
    notes = getattr(error, "__notes__", [])
    return tuple(note.removeprefix(_NOTE) for note in notes if note.startswith(_NOTE))


def note_unconfirmed(error: BaseException, unconfirmed: Sequence[str]) -> None:
    """Add to an exception which outputs are not confirmed off.

    Parameters
    ----------
    error : BaseException
        Gets a note for each; a `BenchError` also remembers them for programs.
    unconfirmed : sequence of str
    """
    for what in unconfirmed:
        error.add_note(_NOTE + what)
    if isinstance(error, BenchError):
        error.unconfirmed = (*error.unconfirmed, *unconfirmed)
