"""Common part of the emulated generators: two channels, a relay, and their faults."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, DecimalException
from fractions import Fraction
from typing import Final

from drivers.emulators.faults import GeneratorFaults
from drivers.roles import Clock

# Frequency, peak volts of the open socket, and whether the output is on.
Socket = tuple[Fraction, float, bool]
Change = Callable[[Fraction, float, bool], None]

# Chosen: far beyond every setting of a generator.
_ABSURD: Final = Decimal("1e30")


@dataclass
class Channel:
    """Settings that the channels of all generators have."""

    frequency_hz: Fraction = Fraction(1000)
    amplitude_vpp: float = 0.0
    offset_v: float = 0.0
    is_on: bool = False

    @property
    def high_v(self) -> float:
        """Upper peak."""
        return self.offset_v + self.amplitude_vpp / 2

    @property
    def low_v(self) -> float:
        """Lower peak."""
        return self.offset_v - self.amplitude_vpp / 2


class GeneratorEmulator(ABC):
    """A generator that obeys lines of text.

    Parameters
    ----------
    on_change : callable, optional
        Called with frequency, peak volts of the open socket and whether the relay is closed,
        whenever one of them changes on channel 1. It runs on the thread that calls `receive`.
    clock : Clock, optional
        Clock on which the instrument takes its time; without one it takes none.
    identity : str
        Answer to ``*IDN?``.
    faults : GeneratorFaults, optional
    """

    def __init__(
        self,
        on_change: Change | None,
        clock: Clock | None,
        identity: str,
        faults: GeneratorFaults | None,
    ) -> None:
        self._on_change, self._clock, self._identity = on_change, clock, identity
        self._faults, self._heard, self._relay_is_closed = faults or GeneratorFaults(), 0, False
        self._received = b""
        self._last_change = self.socket

    @property
    def socket(self) -> Socket:
        """Frequency, peak volts and relay of channel 1."""
        frequency_hz, volts, _ = self._played()
        return frequency_hz, volts, self._relay_is_closed

    def receive(self, data: bytes) -> bytes:
        """Obey complete lines and return the answers."""
        *lines, self._received = (self._received + data).split(b"\n")
        answered = b""
        for line in lines:
            self._heard += 1
            answer = self._obey(line.decode("ascii", "replace").strip())
            if answer is not None:
                answered += answer.encode("ascii") + b"\n"
            if self._heard in self._faults.trips_at:
                self.trip()
        return answered

    def trip(self) -> None:
        """Switch the output of channel 1 off without an error, as its overload protection does."""
        self._first_channel.is_on = False
        self._announce()

    def turn_knob(self, command: str) -> None:
        """Change a setting at the front panel, given as a command."""
        self._obey(command)

    @property
    @abstractmethod
    def _first_channel(self) -> Channel:
        """Channel 1, which drives the loudspeaker."""

    @abstractmethod
    def _obey(self, line: str) -> str | None:
        """Obey one line and return its answer, if it has one."""

    def _played(self) -> Socket:
        channel = self._first_channel
        return channel.frequency_hz, channel.amplitude_vpp / 2, channel.is_on

    def _announce(self) -> None:
        if not self._faults.sticks(self._heard):
            self._relay_is_closed = self._first_channel.is_on
        if self._on_change is not None and self.socket != self._last_change:
            self._on_change(*self.socket)
        self._last_change = self.socket

    def _take(self, seconds: float) -> None:
        if self._clock is not None:
            self._clock.wait(seconds)


def finite_number(text: str) -> Fraction | None:
    """Read a finite number of a plausible size; None if the text is something else."""
    try:
        number = Decimal(text)
    except DecimalException:
        return None
    return Fraction(number) if number.is_finite() and abs(number) < _ABSURD else None
