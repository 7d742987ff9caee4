"""Template of a driver for the generator of the loudspeaker's voltage."""

import math
from fractions import Fraction
from typing import Literal

from drivers.context import BenchContext
from drivers.errors import InstrumentError, LimitError
from my_bench.pretended import PretendedLaboratory
from protocols.bench import Generator

# Steps of a ramp. Chosen: each changes the voltage by 5 %, which makes no click.
_RAMP_STEPS = 20


class MyGenerator:
    """A sine with peak volts at the loudspeaker, and an output that can be switched off."""

    def __init__(self, entry: Generator, context: BenchContext) -> None:
        self._entry, self._limits = entry, context.description.limits
        # Kept for its clock, which a driver that is opened later may replace.
        self._context = context
        self._laboratory = context.share(PretendedLaboratory)
        # A program that was killed may have left the output on.
        self.output_off()

    @property
    def identity(self) -> str:
        """Maker, model, serial number and firmware; the same text for as long as it is open."""
        return "pretended generator"

    def set_sine(self, frequency_hz: Fraction, volts: float) -> None:
        """Check both values first, then play, and switch the output on."""
        low_hz, high_hz = self._limits.drive_min_hz, self._limits.drive_max_hz
        if not low_hz <= frequency_hz <= high_hz:
            raise LimitError(
                f"generator: was asked for {float(frequency_hz):.10g} Hz, which is outside "
                "limits.drive_min and limits.drive_max; change the protocol or the limits"
            )
        self._require_allowed(volts)
        step_hz = self._entry.step_hz
        self._laboratory.drive_hz = round(frequency_hz / step_hz) * step_hz
        self._laboratory.drive_v, self._laboratory.drive_on = float(volts), True

    def ramp_to(self, volts: float, duration_s: float) -> None:
        """Change the volts in small steps; with the output off, a ramp to 0 V does nothing."""
        self._require_allowed(volts)
        if not 0 <= duration_s < math.inf:
            raise LimitError(f"generator: cannot ramp for {duration_s} s; give a time from 0 s")
        if not self._laboratory.drive_on:
            if volts == 0:
                return
            raise InstrumentError("generator: its output is off; call set_sine before a ramp")
        start_v = self._laboratory.drive_v
        for step in range(1, _RAMP_STEPS + 1):
            self._context.clock.wait(duration_s / _RAMP_STEPS)
            self._laboratory.drive_v = start_v + (volts - start_v) * step / _RAMP_STEPS

    def output_off(self) -> None:
        """Switch off whatever happened before; called from any thread, and more than once."""
        self._laboratory.drive_on = False

    def read(self) -> tuple[Fraction, float, bool]:
        """Ask the instrument what it plays; do not return what the program remembers."""
        laboratory = self._laboratory
        return laboratory.drive_hz, laboratory.drive_v, laboratory.drive_on

    def reference_clock(self) -> Literal["external", "own", "unknown"]:
        """Say which clock it uses (optional), for `acquire bench check`."""
        return "external"

    def close(self) -> None:
        """Release the connection. A real driver also switches off what it has switched on."""

    def _require_allowed(self, volts: float) -> None:
        low_v, high_v = float(self._limits.volts_min_v), float(self._limits.volts_max_v)
        # NaN fails both comparisons, so it is refused.
        if not (volts == 0 or low_v <= volts <= high_v):
            raise LimitError(
                f"generator: was asked for {volts} V, which is outside limits.volts_min and "
                "limits.volts_max; change the protocol or the limits"
            )
