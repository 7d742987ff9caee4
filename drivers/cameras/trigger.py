"""The cable between an instrument that plays pulses and a camera that exposes at each of them."""

from fractions import Fraction
from typing import Protocol

from drivers.context import BenchContext
from drivers.errors import BenchSetupError


class PulseSource(Protocol):
    """Whoever can play a pulse for each frame, on the clock of the other instruments."""

    def play_pulses(self, frame_rate_hz: Fraction) -> None:
        """Play pulses at a frame rate, from now on.

        Raises
        ------
        LimitError
            If the rate cannot be played exactly; nothing has changed then.
        InstrumentError
            If what is read back is not what was set.
        """
        ...

    def stop_pulses(self) -> None:
        """Play no more pulses; raises `InstrumentError` if that is not confirmed."""
        ...


class CameraTrigger:
    """Connects the source of pulses of a bench to its camera: ``context.share(CameraTrigger)``.

    The frame rate is known only when a run begins, and to the camera alone. So the source offers
    itself when it is opened, and a camera that waits for pulses asks for them when it starts.
    """

    def __init__(self, context: BenchContext) -> None:
        self._bench = context.description.name
        self._source: PulseSource | None = None

    def offer(self, source: PulseSource) -> None:
        """Say who plays the pulses."""
        self._source = source

    def play(self, frame_rate_hz: Fraction) -> None:
        """Play pulses; see `PulseSource.play_pulses`.

        Raises
        ------
        BenchSetupError
            If no instrument of this bench plays pulses.
        """
        self._required().play_pulses(frame_rate_hz)

    def stop(self) -> None:
        """Play no more pulses; see `PulseSource.stop_pulses`. Nobody plays any without a source."""
        if self._source is not None:
            self._source.stop_pulses()

    def _required(self) -> PulseSource:
        if self._source is None:
            raise BenchSetupError(
                f"bench {self._bench!r}: instruments.camera.options: the camera waits for pulses, "
                "but no instrument plays them; add camera_trigger to "
                "instruments.generator.options, or let the camera run freely"
            )
        return self._source
