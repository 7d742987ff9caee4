"""An emulator of the Keysight 33512B, after the drivers of others and the SCPI standard."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from drivers.emulators.faults import GeneratorFaults
from drivers.emulators.generator import Change, Channel, GeneratorEmulator, finite_number
from drivers.roles import Clock

_IDENTITY: Final = "Agilent Technologies,33512B,MY00000001,5.03-3.15-2.00-58-00"
_SHAPES: Final = ("SINusoid", "SQUare", "TRIangle", "RAMP", "PULSe", "PRBS", "NOISe", "ARB", "DC")
_LEAST_VPP: Final = 0.002
_PEAK_V: Final = 10.0
_LEAST_HZ: Final = Fraction(1, 1_000_000)
_MOST_HZ: Final = Fraction(20_000_000)
_SOURCE_OHM: Final = 50.0
_LEAST_OHM: Final = 1.0
_MOST_OHM: Final = 10_000.0
_INFINITE: Final = 9.9e37
_VPP_PER_RMS: Final = 2 * math.sqrt(2)

# Not measured: what such instruments usually take.
_QUERY_S: Final = 0.002
_WRITE_S: Final = 0.005
_RELAY_S: Final = 0.05

_NO_ERROR: Final = 0, "No error"
_NOT_A_NUMBER: Final = -120, "Numeric data error"
_UNDEFINED: Final = -113, "Undefined header"
_CONFLICT: Final = -221, "Settings conflict"
_TOO_HIGH: Final = -222, "Data out of range;value clipped to upper limit"
_TOO_LOW: Final = -222, "Data out of range;value clipped to lower limit"
_INTERRUPTED: Final = -410, "Query INTERRUPTED"
_UNTERMINATED: Final = -420, "Query UNTERMINATED"
_ILLEGAL: Final = -224, "Illegal parameter value"


class _RefusedError(Exception):
    """An entry of the error queue of the instrument.

    Attributes
    ----------
    entry : tuple of int and str
    """

    def __init__(self, entry: tuple[int, str]) -> None:
        super().__init__(*entry)
        self.entry = entry


@dataclass
class _Channel(Channel):
    """Volts are those of the open socket; answers give them for the load."""

    amplitude_vpp: float = 0.2
    shape: str = "SIN"
    unit: str = "VPP"
    load_ohm: float = 50.0
    high_limit_v: float = _PEAK_V
    low_limit_v: float = -_PEAK_V
    is_limited: bool = False

    @property
    def divider(self) -> float:
        """Volts at the load per volt of the open socket."""
        return self.load_ohm / (self.load_ohm + _SOURCE_OHM) if self.load_ohm < _INFINITE else 1.0

    @property
    def reach_v(self) -> tuple[float, float]:
        """Between which volts both peaks have to stay."""
        if self.is_limited:
            return max(self.low_limit_v, -_PEAK_V), min(self.high_limit_v, _PEAK_V)
        return -_PEAK_V, _PEAK_V


@dataclass
class _State:
    channels: tuple[_Channel, _Channel] = field(default_factory=lambda: (_Channel(), _Channel()))
    reference: str = "INT"


class KeysightEmulator(GeneratorEmulator):
    """A Keysight 33512B, which reports errors in a queue.

    It knows shape, frequency, amplitude, offset, levels, limits and load of both channels, and the
    10 MHz reference; of shapes other than a sine only the name.

    Parameters
    ----------
    on_change, clock, identity, faults
        See `GeneratorEmulator`.
    has_reference : bool
        Whether 10 MHz arrive at the rear. Without, it refuses the external reference.
    """

    def __init__(
        self,
        on_change: Change | None = None,
        clock: Clock | None = None,
        identity: str = _IDENTITY,
        *,
        has_reference: bool = True,
        faults: GeneratorFaults | None = None,
    ) -> None:
        self._has_reference = has_reference
        self._state = _State()
        self._errors: list[tuple[int, str]] = []
        super().__init__(on_change, clock, identity, faults)

    def interrupt(self) -> None:
        """Throw away an answer, because bytes arrived before it was read."""
        self._errors.append(_INTERRUPTED)

    def unterminated(self) -> None:
        """Have nothing to shown when asked to talk."""
        self._errors.append(_UNTERMINATED)

    @property
    def _first_channel(self) -> Channel:
        return self._state.channels[0]

    def _obey(self, line: str) -> str | None:
        # The answers to the questions of one line stand on one line.
        answers = [
            answer
            for unit in line.split(";")
            if (answer := self._obey_unit(unit.strip())) is not None
        ]
        return ";".join(answers) if answers else None

    def _obey_unit(self, unit: str) -> str | None:
        head, _, value = unit.partition(" ")
        head, answer = head.upper().removeprefix(":"), None
        was_on = self._state.channels[0].is_on
        try:
            if head.endswith("?"):
                answer = self._answer(head[:-1])
            elif head:
                self._set(head, value.strip().upper())
        except _RefusedError as refused:
            self._errors.append(refused.entry)
        self._take(_QUERY_S if head.endswith("?") else _WRITE_S)
        self._take(_RELAY_S if self._state.channels[0].is_on != was_on else 0.0)
        self._announce()
        return answer

    def _answer(self, head: str) -> str:
        if head == "*IDN":
            return self._identity
        if head in _CONSTANT_ANSWERS:
            return _CONSTANT_ANSWERS[head]
        if _ERROR.fullmatch(head):
            number, text = self._errors.pop(0) if self._errors else _NO_ERROR
            return f'{number:+d},"{text}"'
        if _REFERENCE.fullmatch(head):
            return self._state.reference
        setting, channel = self._found(head)
        return setting.shown(channel)

    def _set(self, head: str, value: str) -> None:
        if head == "*CLS":
            self._errors.clear()
        elif head == "*RST":
            self._state = _State()
        elif _REFERENCE.fullmatch(head):
            source = _chosen(value, ("INTernal", "EXTernal"))
            if source == "EXT" and not self._has_reference:
                raise _RefusedError(_CONFLICT)
            self._state.reference = source
        elif head not in _CONSTANT_ANSWERS:
            setting, channel = self._found(head)
            setting.change(channel, value)

    def _found(self, head: str) -> "tuple[_Setting, _Channel]":
        for setting in _SETTINGS:
            found = setting.head.fullmatch(head)
            if found is not None:
                return setting, self._state.channels[int(found["channel"] or "1") - 1]
        raise _RefusedError(_UNDEFINED)


def _shown(number: float) -> str:
    return f"{number:+.15E}"


def _number(text: str) -> Fraction:
    number = finite_number(text)
    if number is None:
        raise _RefusedError(_NOT_A_NUMBER)
    return number


def _chosen(text: str, words: tuple[str, ...]) -> str:
    """Return the short form of the word that is meant."""
    for word in words:
        short = _short(word)
        if text in (short, word.upper()):
            return short
    raise _RefusedError(_ILLEGAL)


def _switched(text: str) -> bool:
    return _chosen(text, ("ON", "1", "OFF", "0")) in ("ON", "1")


def _clipped(least: float, value: float, most: float) -> tuple[float, tuple[int, str] | None]:
    """Return what is taken for a value, and what goes into the error queue for that."""
    if value > most:
        return most, _TOO_HIGH
    if value < least:
        return least, _TOO_LOW
    return value, None


def _refuse(entry: tuple[int, str] | None) -> None:
    if entry is not None:
        raise _RefusedError(entry)


def _set_shape(channel: _Channel, value: str) -> None:
    channel.shape = _chosen(value, _SHAPES)


def _set_frequency(channel: _Channel, value: str) -> None:
    asked_hz = _number(value)
    channel.frequency_hz = min(max(asked_hz, _LEAST_HZ), _MOST_HZ)
    if asked_hz != channel.frequency_hz:
        raise _RefusedError(_TOO_HIGH if asked_hz > _MOST_HZ else _TOO_LOW)


def _shown_amplitude(channel: _Channel) -> str:
    volts_rms = channel.amplitude_vpp * channel.divider / _VPP_PER_RMS
    if channel.unit == "VRMS":
        return _shown(volts_rms)
    if channel.unit == "DBM":
        return _shown(10 * math.log10(volts_rms**2 / channel.load_ohm / 1e-3))
    return _shown(channel.amplitude_vpp * channel.divider)


def _set_amplitude(channel: _Channel, value: str) -> None:
    asked = float(_number(value))
    if channel.unit == "DBM":
        asked = math.sqrt(10 ** (asked / 10) * 1e-3 * channel.load_ohm)
    if channel.unit != "VPP":
        asked *= _VPP_PER_RMS
    low_v, high_v = channel.reach_v
    most_vpp = 2 * min(high_v - channel.offset_v, channel.offset_v - low_v)
    channel.amplitude_vpp, entry = _clipped(_LEAST_VPP, asked / channel.divider, most_vpp)
    _refuse(entry)


def _set_offset(channel: _Channel, value: str) -> None:
    asked_v, half_v = float(_number(value)) / channel.divider, channel.amplitude_vpp / 2
    low_v, high_v = channel.reach_v
    channel.offset_v, entry = _clipped(low_v + half_v, asked_v, high_v - half_v)
    _refuse(entry)


def _set_high(channel: _Channel, value: str) -> None:
    _set_levels(channel, channel.low_v, float(_number(value)) / channel.divider)


def _set_low(channel: _Channel, value: str) -> None:
    _set_levels(channel, float(_number(value)) / channel.divider, channel.high_v)


def _set_levels(channel: _Channel, low_v: float, high_v: float) -> None:
    least_v, most_v = channel.reach_v
    if not (least_v <= low_v and high_v - low_v >= _LEAST_VPP and high_v <= most_v):
        raise _RefusedError(_CONFLICT)
    channel.amplitude_vpp, channel.offset_v = high_v - low_v, (high_v + low_v) / 2


def _set_unit(channel: _Channel, value: str) -> None:
    unit = _chosen(value, ("VPP", "VRMS", "DBM"))
    if unit == "DBM" and channel.load_ohm >= _INFINITE:
        raise _RefusedError(_CONFLICT)
    channel.unit = unit


def _set_high_limit(channel: _Channel, value: str) -> None:
    channel.high_limit_v = float(_number(value)) / channel.divider
    _drop_limits_in_conflict(channel)


def _set_low_limit(channel: _Channel, value: str) -> None:
    channel.low_limit_v = float(_number(value)) / channel.divider
    _drop_limits_in_conflict(channel)


def _set_limited(channel: _Channel, value: str) -> None:
    channel.is_limited = _switched(value)
    _drop_limits_in_conflict(channel)


def _drop_limits_in_conflict(channel: _Channel) -> None:
    """Switch off limits that the present signal exceeds."""
    low_v, high_v = channel.reach_v
    if channel.low_v < low_v or channel.high_v > high_v:
        channel.is_limited = False
        raise _RefusedError(_CONFLICT)


def _set_output(channel: _Channel, value: str) -> None:
    channel.is_on = _switched(value)


def _set_load(channel: _Channel, value: str) -> None:
    if value in ("INF", "INFINITY"):
        channel.load_ohm = _INFINITE
        return
    channel.load_ohm, entry = _clipped(_LEAST_OHM, float(_number(value)), _MOST_OHM)
    _refuse(entry)


def _short(word: str) -> str:
    return "".join(letter for letter in word if not letter.islower())


def _compiled(notation: str) -> re.Pattern[str]:
    """Compile the notation of SCPI manuals: ``[SOURce<n>:]VOLTage``, long forms in small type."""
    words = re.sub(
        "[A-Z]+[a-z]*", lambda word: f"(?:{_short(word[0])}|{word[0].upper()})", notation
    )
    optional = words.replace("[", "(?:").replace("]", ")?")
    return re.compile(optional.replace("<n>", "(?P<channel>[12])?"))


@dataclass(frozen=True)
class _Setting:
    """A command: its answer as a question, and its effect as a setting."""

    head: re.Pattern[str]
    shown: Callable[[_Channel], str]
    change: Callable[[_Channel, str], None]


_CONSTANT_ANSWERS: Final = {"*OPC": "1", "*OPT": "0"}
_ERROR: Final = _compiled("SYSTem:ERRor[:NEXT]")
_REFERENCE: Final = _compiled("ROSCillator:SOURce")
_VOLTS: Final = "[SOURce<n>:]VOLTage"
_SETTINGS: Final = tuple(
    _Setting(_compiled(notation), shown, change)
    for notation, shown, change in (
        ("[SOURce<n>:]FUNCtion", lambda c: c.shape, _set_shape),
        ("[SOURce<n>:]FREQuency", lambda c: _shown(float(c.frequency_hz)), _set_frequency),
        (_VOLTS, _shown_amplitude, _set_amplitude),
        (f"{_VOLTS}:OFFSet", lambda c: _shown(c.offset_v * c.divider), _set_offset),
        (f"{_VOLTS}:HIGH", lambda c: _shown(c.high_v * c.divider), _set_high),
        (f"{_VOLTS}:LOW", lambda c: _shown(c.low_v * c.divider), _set_low),
        (f"{_VOLTS}:UNIT", lambda c: c.unit, _set_unit),
        (
            f"{_VOLTS}:LIMit:HIGH",
            lambda c: _shown(c.high_limit_v * c.divider),
            _set_high_limit,
        ),
        (f"{_VOLTS}:LIMit:LOW", lambda c: _shown(c.low_limit_v * c.divider), _set_low_limit),
        (f"{_VOLTS}:LIMit:STATe", lambda c: str(int(c.is_limited)), _set_limited),
        ("OUTPut<n>[:STATe]", lambda c: str(int(c.is_on)), _set_output),
        ("OUTPut<n>:LOAD", lambda c: _shown(c.load_ohm), _set_load),
    )
)
