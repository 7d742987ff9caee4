"""Faults of the emulated instruments; those of their connections are `WireFaults`."""

from typing import Annotated

from pydantic import Field

from drivers.options import Options

_Numbers = Annotated[tuple[int, ...], Field(strict=False)]


class SynthesizerFaults(Options):
    """Faults of an emulated pair of synthesizers. Updates (``I p``) count from 1."""

    skips_update_at: _Numbers = ()
    """Updates that are acknowledged and not carried out."""
    skips_updates_from: int | None = None
    """Update from which on none is carried out."""
    shows_registers: bool = True
    """Whether the status shows registers, or outputs, while they differ."""

    def skips(self, update: int) -> bool:
        """Return whether an update, counted from 1, is not carried out."""
        from_ = self.skips_updates_from
        return update in self.skips_update_at or (from_ is not None and update >= from_)


class GeneratorFaults(Options):
    """Faults of an emulated generator. Lines that it receives count from 1."""

    trips_at: _Numbers = ()
    """Lines after which the output trips, as after an overload."""
    relay_sticks_from: int | None = None
    """Line from which on the relay of the output does not move. The generator does not notice: it
    reports its output as it was set."""

    def sticks(self, line: int) -> bool:
        """Return whether the relay sticks at a line."""
        return self.relay_sticks_from is not None and line >= self.relay_sticks_from
