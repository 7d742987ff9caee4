"""Faults of the simulated instruments themselves; those of their wires are `WireFaults`."""

from typing import Annotated

from pydantic import Field

from drivers.options import Options

_Numbers = Annotated[tuple[int, ...], Field(strict=False)]


class SynthesizerFaults(Options):
    """What is wrong with a simulated pair of synthesizers.

    Attributes
    ----------
    skips_update_at : tuple of int
        Updates (``I p``), counted from 1, that are acknowledged and not carried out.
    skips_updates_from : int or None
        From this update on, none is carried out.
    shows_registers : bool
        Whether the status shows registers, or outputs, while they differ.
    """

    skips_update_at: _Numbers = ()
    skips_updates_from: int | None = None
    shows_registers: bool = True

    def skips(self, update: int) -> bool:
        """Return whether an update, counted from 1, is not carried out."""
        from_ = self.skips_updates_from
        return update in self.skips_update_at or (from_ is not None and update >= from_)


class GeneratorFaults(Options):
    """What is wrong with a simulated generator. Lines that it hears count from 1.

    Attributes
    ----------
    trips_at : tuple of int
        After these lines the output trips, as after an overload.
    relay_sticks_from : int or None
        From this line on the output's relay stays as it is. The generator does not notice: it says
        that its output is as it was set.
    """

    trips_at: _Numbers = ()
    relay_sticks_from: int | None = None

    def sticks(self, line: int) -> bool:
        """Return whether the relay sticks at a line."""
        return self.relay_sticks_from is not None and line >= self.relay_sticks_from
