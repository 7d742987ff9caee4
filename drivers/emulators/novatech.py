"""A simulated Novatech 409B, after its manual (firmware 2.1) and the drivers that others wrote.

What no source says is chosen here and marked as such; nothing was compared with a real box.
"""

import math
import string
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from typing import Final

from drivers.emulators.faults import SynthesizerFaults

# 429.4967296 MHz, so that a tuning word of 32 bits counts tenths of a hertz.
_SYSTEM_CLOCK_HZ: Final = Fraction(2**32, 10)
_MULTIPLIER: Final = 15
_EXTERNAL_CLOCK_HZ: Final = 10_000_000
_MOST_MHZ: Final = Decimal("171.1276031")
_TENTHS_IN_MHZ: Final = Decimal(10_000_000)
_BAUD_DIVIDERS: Final = {0x78: 9600, 0x3C: 19200, 0x1E: 38400, 0x14: 57600, 0x0A: 115200}
# Chosen: the manual's error ?3 says that there is a limit, no source says which.
_LONGEST_LINE: Final = 64


class _RefusedError(Exception):
    """A command that is answered with a question mark and a digit."""


@dataclass(frozen=True)
class OutputState:
    """Output of one socket of the box.

    Attributes
    ----------
    frequency_hz : Fraction
    phase_turns : Fraction
    amplitude : float
        Share of full scale.
    """

    frequency_hz: Fraction
    phase_turns: Fraction
    amplitude: float

    def level(self, time_s: float) -> float:
        """Share of the full-scale voltage at a time; a constant one at 0 Hz (AN004)."""
        turns = float(self.frequency_hz) * time_s + float(self.phase_turns)
        return self.amplitude * math.sin(2 * math.pi * turns)


@dataclass(frozen=True)
class _Channel:
    # Chosen: no source says what a new box plays.
    tenths_hz: int = 100_000_000
    phase: int = 0
    scale: int = 1023
    scaled: bool = True

    def status(self) -> str:
        return f"{self.tenths_hz:08X} {self.phase:04X} {self.scale:04X} 0000 {0:08X} {0:08X} 000301"


@dataclass
class _State:
    channels: list[_Channel] = field(default_factory=lambda: [_Channel()] * 4)
    echoes: bool = True
    updates: str = "a"
    plays_table: bool = False
    external_clock: bool = False
    multiplier: int = _MULTIPLIER
    baud: int = 19200


class NovatechEmulator:
    """The box, as one who types on its serial line finds it after power-up.

    Parameters
    ----------
    on_change : callable
        Called with all four outputs whenever one of them changes.
    faults : SynthesizerFaults, optional
        Which updates are not carried out, and whether the status shows registers or outputs while
        they differ, which no source says.

    Attributes
    ----------
    outputs : tuple of OutputState
        What the four sockets give now.
    saves : int
        How often its settings were saved as those of the next power-up.
    """

    def __init__(
        self,
        on_change: Callable[[tuple[OutputState, ...]], None],
        faults: SynthesizerFaults | None = None,
    ) -> None:
        self._on_change = on_change
        self._faults = faults or SynthesizerFaults()
        self._line, self._updates = b"", 0
        self.saves = 0
        self._saved = _State()
        self._power_up()

    @property
    def baud(self) -> int:
        """Rate of the serial line."""
        return self._state.baud

    def receive(self, data: bytes) -> bytes:
        """Take in bytes and return echo and answers."""
        said = bytearray()
        for byte in data:
            if self._state.echoes:
                said.append(byte)
            if byte == ord("\n"):
                line, self._line = self._line.rstrip(b"\r"), b""
                said += self._answer(line)
            else:
                self._line += bytes([byte])
        return bytes(said)

    def _power_up(self) -> None:
        self._state = replace(self._saved, channels=list(self._saved.channels))
        self._played = list(self._state.channels)
        self.outputs = self._sockets()

    def _answer(self, line: bytes) -> bytes:
        try:
            if len(line) > _LONGEST_LINE:
                raise _RefusedError("3")
            if not line.isascii():
                raise _RefusedError("f")
            return self._obey(line.decode().split())
        except _RefusedError as refusal:
            return f"?{refusal}\r\n".encode()

    def _obey(self, words: list[str]) -> bytes:
        command, arguments = (words[0].lower(), words[1:]) if words else ("", [])
        if command == "r" and not arguments:
            self._power_up()
            self._on_change(self.outputs)
            return b""
        if command == "que" and not arguments:
            return self._status()
        if command == "s" and not arguments:
            self.saves += 1
            self._saved = replace(self._state, channels=list(self._state.channels))
        elif command and len(arguments) == 1:
            self._set(command, arguments[0])
        elif command:
            raise _RefusedError("0")
        if self._state.updates == "a":
            self._update()
        return b"OK\r\n"

    def _set(self, command: str, argument: str) -> None:
        if command[0] in "fpv" and command[1:] in ("0", "1", "2", "3"):
            number = int(command[1:])
            channel = self._state.channels[number]
            setting = {"f": _frequency, "p": _phase, "v": _amplitude}[command[0]]
            self._state.channels[number] = setting(channel, argument)
        elif command in ("kb", "kp"):
            self._set_constant(command, argument)
        elif command in ("e", "i", "m", "c"):
            self._set_mode(command, argument.lower())
        else:
            raise _RefusedError("0")

    def _set_mode(self, command: str, letter: str) -> None:
        state = self._state
        if command == "e" and letter in ("d", "e"):
            state.echoes = letter == "e"
        elif command == "i" and letter in ("a", "m", "e"):
            state.updates = letter
        elif command == "i" and letter == "p":
            self._updates += 1
            if not self._faults.skips(self._updates):
                self._update()
        elif command == "m" and letter in ("0", "t"):
            state.plays_table = letter == "t"
        elif command == "m" and letter in ("a", "n"):
            # Whether an update clears the phase shows in no frequency and no amplitude.
            pass
        elif command == "c" and letter in ("e", "i"):
            state.external_clock = letter == "e"
        else:
            raise _RefusedError("6" if command == "m" else "0")

    def _set_constant(self, command: str, argument: str) -> None:
        if not argument or set(argument) - set(string.hexdigits):
            raise _RefusedError("f")
        number = int(argument, 16)
        if command == "kb":
            if number not in _BAUD_DIVIDERS:
                raise _RefusedError("8")
            self._state.baud = _BAUD_DIVIDERS[number]
            return
        # The two highest bits choose the range of the multiplier.
        multiplier = number & 0x3F
        if multiplier != 1 and not 4 <= multiplier <= 20:
            raise _RefusedError("8")
        self._state.multiplier = multiplier

    def _update(self) -> None:
        """Let the outputs follow the registers, all at the same moment."""
        # Chosen: the table, which is empty here, leaves the two channels that it can play alone.
        own = 2 if self._state.plays_table else 0
        self._played[own:] = self._state.channels[own:]
        before, self.outputs = self.outputs, self._sockets()
        if self.outputs != before:
            self._on_change(self.outputs)

    def _sockets(self) -> tuple[OutputState, ...]:
        return tuple(
            OutputState(
                channel.tenths_hz * self._clock_hz() / 2**32,
                Fraction(channel.phase, 16384),
                channel.scale / 1023 if channel.scaled else 1.0,
            )
            for channel in self._played
        )

    def _clock_hz(self) -> Fraction:
        """Frequency of the system clock (manual 4.8): 10 MHz is assumed at the external input."""
        if self._state.external_clock:
            return Fraction(self._state.multiplier * _EXTERNAL_CLOCK_HZ)
        return _SYSTEM_CLOCK_HZ * self._state.multiplier / _MULTIPLIER

    def _status(self) -> bytes:
        shown = self._state.channels if self._faults.shows_registers else self._played
        lines = [channel.status() for channel in shown] + ["80 BC0000 0000 0102 21"]
        return "".join(f"{line}\r\n" for line in lines).encode()


def _frequency(channel: _Channel, argument: str) -> _Channel:
    try:
        mhz = Decimal(argument)
    except InvalidOperation:
        raise _RefusedError("1") from None
    if not (mhz.is_finite() and 0 <= mhz <= _MOST_MHZ):
        raise _RefusedError("1")
    # Chosen: digits below a tenth of a hertz are rounded.
    return replace(channel, tenths_hz=round(mhz * _TENTHS_IN_MHZ))


def _phase(channel: _Channel, argument: str) -> _Channel:
    if not (argument.isdecimal() and int(argument) < 16384):
        raise _RefusedError("4")
    return replace(channel, phase=int(argument))


def _amplitude(channel: _Channel, argument: str) -> _Channel:
    if not argument.isdecimal():
        raise _RefusedError("7")
    # Above 1023 there is no error (a comment in ARTIQ's driver). Chosen: full scale.
    scale = int(argument)
    return replace(channel, scale=min(scale, 1023), scaled=scale <= 1023)
