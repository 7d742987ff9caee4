"""Template of a driver for the two synthesizers of the modulators."""

from fractions import Fraction
from typing import Literal

from drivers.context import BenchContext
from drivers.errors import InstrumentError, LimitError
from drivers.options import Options, read_options
from my_bench.pretended import PretendedLaboratory
from protocols.bench import Synthesizers


class SynthesizerOptions(Options):
    """Options of `MySynthesizers`: what a bench file may write under ``options:``."""

    port: str
    """Address. While a bench is open, no other program can open a bench with the same address."""


class MySynthesizers:
    """Two channels on one clock. Replace each use of ``self._laboratory`` by your commands."""

    # The names and descriptions of all options, for people and programs that list them.
    OPTIONS = SynthesizerOptions
    # False: `read_pair` returns what the outputs play. True: it repeats what was sent.
    echoes_registers = False

    def __init__(self, entry: Synthesizers, context: BenchContext) -> None:
        key = "instruments.synthesizers.options"
        self._options = read_options(
            SynthesizerOptions, entry.options, context.description.name, key
        )
        self._entry = entry
        self._laboratory = context.share(PretendedLaboratory)
        # A program that was killed may have left the outputs on.
        self.rf_off()

    @property
    def identity(self) -> str:
        """Maker, model, serial number and firmware; the same text for as long as it is open."""
        return f"pretended synthesizer pair at {self._options.port}"

    @property
    def step_hz(self) -> Fraction:
        """Spacing of the frequencies."""
        return self._entry.step_hz

    def set_pair(self, aom1_hz: Fraction, aom2_hz: Fraction) -> None:
        """Check both frequencies first, then change both channels in one update."""
        for name, hz in (("AOM1", aom1_hz), ("AOM2", aom2_hz)):
            if abs(hz - self._entry.centre_hz) > self._entry.window_hz:
                raise LimitError(
                    f"synthesizers at {self._options.port}: {name} was asked for {float(hz):.10g} "
                    "Hz, which is outside the window; change the protocol or the window"
                )
        asked = (self._on_grid(aom1_hz), self._on_grid(aom2_hz))
        self._laboratory.aom_hz = asked
        if self.read_pair() != asked:
            raise InstrumentError(
                f"synthesizers at {self._options.port}: do not play what was set; check the cable"
            )

    def read_pair(self) -> tuple[Fraction, Fraction]:
        """Ask the instrument what it plays; do not return what the program remembers."""
        return self._laboratory.aom_hz

    def rf_on(self) -> None:
        """Let both modulators diffract."""
        self._laboratory.rf_on = True

    def rf_off(self) -> None:
        """Switch off whatever happened before; called from any thread, and more than once."""
        self._laboratory.rf_on = False

    def reference_clock(self) -> Literal["external", "own", "unknown"]:
        """Say which clock it uses (optional), for `acquire bench check`."""
        return "external"

    def close(self) -> None:
        """Release the connection. A real driver also switches off what it has switched on."""

    def _on_grid(self, hz: Fraction) -> Fraction:
        return round(hz / self.step_hz) * self.step_hz
