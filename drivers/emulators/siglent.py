"""An emulator of the Siglent SDG2042X, after recorded answers (firmware 2.01.01.23R7)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from drivers.emulators.faults import GeneratorFaults
from drivers.emulators.generator import (
    Change,
    Channel,
    GeneratorEmulator,
    Socket,
    finite_number,
)
from drivers.roles import Clock

_IDENTITY: Final = "Siglent Technologies,SDG2042X,SDG2XSIM000001,2.01.01.23R7"
_LEAST_VPP: Final = 0.002
_PEAK_V: Final = 10.0
# Above this frequency only half of the volts.
_FULL_VOLTS_HZ: Final = 20_000_000
_MOST_HZ: Final = {"SINE": 40_000_000, "SQUARE": 25_000_000, "PULSE": 25_000_000}
_RMS_PER_VPP: Final = {"SINE": 0.3535, "SQUARE": 0.5, "PULSE": 0.5}
_SOURCE_OHM: Final = 50
_MOST_OHM: Final = 100_000
_SHORTEST_PULSE_S: Final = 16.3e-9
_SHORTEST_EDGE_S: Final = 8.4e-9
# Commands that turn a sine into something else while it is still said to be one.
_MODES: Final = ("MDWV", "SWWV", "BTWV")

# As measured on the instrument.
_QUERY_S: Final = 0.004
_WRITE_S: Final = 0.006
_WAVE_S: Final = 0.02
_RELAY_S: Final = 0.15
_RESET_S: Final = 0.12


@dataclass
class _Channel(Channel):
    amplitude_vpp: float = 4.0
    wave: str = "SINE"
    phase_deg: float = 0.0
    duty_percent: float = 50.0
    width_s: float = 2e-4
    rise_s: float = _SHORTEST_EDGE_S
    fall_s: float = _SHORTEST_EDGE_S
    delay_s: float = 0.0
    # None is high impedance.
    load_ohm: int | None = None
    polarity: str = "NOR"
    mode: str | None = None
    is_combined: bool = False

    @property
    def divider(self) -> float:
        """Volts that are said to be at the load, per volt of the open socket."""
        return 1.0 if self.load_ohm is None else self.load_ohm / (self.load_ohm + _SOURCE_OHM)


@dataclass
class _Reference:
    source: str = "INT"
    output: str = "OFF"
    is_connected: bool = True


@dataclass
class _State:
    channels: dict[str, _Channel] = field(
        default_factory=lambda: {"C1": _Channel(), "C2": _Channel()}
    )
    reference: _Reference = field(default_factory=_Reference)


class SiglentEmulator(GeneratorEmulator):
    """A Siglent SDG2042X, which clamps what it cannot do and reports no errors.

    It knows sines, squares and pulses on both channels, loads, the 10 MHz reference, and that the
    sum of both channels, or a modulation, sweep or burst, is on or off. A command that it does not
    know is ignored, and a question that it does not know is not answered. There is no error queue.

    Parameters
    ----------
    on_change, clock, identity, faults
        See `GeneratorEmulator`.
    has_reference : bool
        Whether 10 MHz arrive at the rear. Without, it stays on its own reference.
    most_vpp : float
        Volts peak to peak into high impedance beyond which it clamps.
    """

    def __init__(
        self,
        on_change: Change | None = None,
        clock: Clock | None = None,
        identity: str = _IDENTITY,
        *,
        has_reference: bool = True,
        most_vpp: float = 2 * _PEAK_V,
        faults: GeneratorFaults | None = None,
    ) -> None:
        self._peak_v = most_vpp / 2
        self._state = _State()
        self._state.reference.is_connected = has_reference
        super().__init__(on_change, clock, identity, faults)

    @property
    def trigger(self) -> Socket:
        """Frequency, peak volts and switch of channel 2, which plays the camera's trigger."""
        return self._socket_of("C2")

    def clamp_at(self, most_vpp: float) -> None:
        """Clamp at `most_vpp` volts peak to peak from now on, as another firmware might."""
        self._peak_v = most_vpp / 2

    @property
    def _first_channel(self) -> Channel:
        return self._state.channels["C1"]

    def _played(self) -> Socket:
        return self._socket_of("C1")

    def _obey(self, line: str) -> str | None:
        head, _, rest = line.upper().partition(" ")
        if head.endswith("?"):
            self._take(_QUERY_S)
            return self._answer(head[:-1])
        if head == "*RST":
            self._take(_RESET_S)
            connected = self._state.reference.is_connected
            self._state = _State(reference=_Reference(is_connected=connected))
        elif head == "ROSC":
            self._set_reference(rest.strip().split(","))
        elif ":" in head:
            name, _, command = head.partition(":")
            self._set_channel(name, command, rest)
        self._announce()
        return None

    def _answer(self, head: str) -> str | None:
        if head == "*IDN":
            return self._identity
        if head == "*OPC":
            return "1"
        if head == "SYST:ERR":
            return "+0, No error"
        if head == "ROSC":
            reference = self._state.reference
            return f"ROSC {reference.source},10MOUT,{reference.output}"
        name, _, command = head.partition(":")
        channel = self._state.channels.get(name)
        if channel is None:
            return None
        if command == "OUTP":
            load = "HZ" if channel.load_ohm is None else str(channel.load_ohm)
            switch = "ON" if channel.is_on else "OFF"
            return f"{head} {switch},LOAD,{load},PLRT,{channel.polarity}"
        if command == "BSWV":
            return f"{head} {','.join(_wave_fields(channel))}"
        if command == "CMBN":
            return f"{head} {'ON' if channel.is_combined else 'OFF'}"
        if command in _MODES:
            return f"{head} STATE,{'ON' if channel.mode == command else 'OFF'}"
        return None

    def _set_reference(self, words: list[str]) -> None:
        reference = self._state.reference
        if words == ["INT"] or (words == ["EXT"] and reference.is_connected):
            reference.source = words[0]
        elif words[0] == "10MOUT" and words[1:] in (["ON"], ["OFF"]):
            reference.output = words[1]

    def _set_channel(self, name: str, command: str, rest: str) -> None:
        channel = self._state.channels.get(name)
        if channel is None:
            return
        words = [word.strip() for word in rest.split(",")]
        if command == "OUTP":
            if words[0] in ("ON", "OFF"):
                self._switch(channel, words.pop(0) == "ON")
            for key, value in _pairs(words):
                _set_output(channel, key, value)
        elif command == "BSWV":
            for key, value in _pairs(words):
                self._set_wave(channel, key, value)
        elif command == "CMBN" and words[0] in ("ON", "OFF"):
            channel.is_combined = words[0] == "ON"
        elif command in _MODES:
            for key, value in _pairs(words):
                if key == "STATE":
                    channel.mode = command if value == "ON" else None

    def _switch(self, channel: _Channel, on: bool) -> None:
        self._take(_WRITE_S if on == channel.is_on else _RELAY_S)
        channel.is_on = on

    def _set_wave(self, channel: _Channel, key: str, value: str) -> None:
        if key == "WVTP":
            if value in _MOST_HZ:
                self._take(_WAVE_S)
                channel.wave, channel.mode = value, None
                self._clamp_frequency(channel)
            return
        self._take(_WRITE_S)
        number = finite_number(value)
        if number is None:
            return
        if key == "FRQ" and number > 0:
            channel.frequency_hz = number
            self._clamp_frequency(channel)
        elif key in ("AMP", "OFST", "HLEV", "LLEV"):
            self._set_level(channel, key, float(number))
        elif key == "PHSE" and channel.wave != "PULSE":
            channel.phase_deg = (
                math.fmod(float(number), 360) if abs(number) > 360 else float(number)
            )
        elif channel.wave == "PULSE":
            _set_pulse(channel, key, float(number))
        elif key == "DUTY" and channel.wave == "SQUARE":
            least = 100 * _SHORTEST_PULSE_S * float(channel.frequency_hz)
            channel.duty_percent = _between(least, float(number), 100 - least)

    def _clamp_frequency(self, channel: _Channel) -> None:
        channel.frequency_hz = min(channel.frequency_hz, Fraction(_MOST_HZ[channel.wave]))
        if channel.wave == "PULSE":
            _set_pulse(channel, "WIDTH", channel.width_s)
        self._set_level(channel, "AMP", channel.amplitude_vpp)

    def _set_level(self, channel: _Channel, key: str, volts: float) -> None:
        """Set one level, changed such that all stay within what the instrument can give."""
        halved = channel.frequency_hz > _FULL_VOLTS_HZ
        peak_v = self._peak_v * channel.divider / (2 if halved else 1)
        high_v, low_v = channel.high_v, channel.low_v
        if key == "AMP":
            most_vpp = 2 * (peak_v - abs(channel.offset_v))
            channel.amplitude_vpp = max(min(volts, most_vpp), _LEAST_VPP)
        elif key == "OFST":
            most_v = peak_v - channel.amplitude_vpp / 2
            channel.offset_v = _between(-most_v, volts, most_v)
        else:
            if key == "HLEV":
                high_v = _between(low_v + _LEAST_VPP, volts, peak_v)
            else:
                low_v = _between(-peak_v, volts, high_v - _LEAST_VPP)
            channel.amplitude_vpp, channel.offset_v = high_v - low_v, (high_v + low_v) / 2

    def _socket_of(self, name: str) -> Socket:
        channel, channels = self._state.channels[name], self._state.channels.values()
        played = channels if channel.is_combined else (channel,)
        volts = sum(each.amplitude_vpp / 2 / each.divider for each in played)
        return channel.frequency_hz, volts, channel.is_on


def _set_output(channel: _Channel, key: str, value: str) -> None:
    if key == "PLRT" and value in ("NOR", "INVT"):
        channel.polarity = value
    elif key == "LOAD":
        before, number = channel.divider, finite_number(value)
        if value == "HZ":
            channel.load_ohm = None
        elif number is not None:
            channel.load_ohm = min(max(int(number), _SOURCE_OHM), _MOST_OHM)
        # The socket's voltage stays; what is said of it is for the load that is said to be there.
        channel.amplitude_vpp *= channel.divider / before
        channel.offset_v *= channel.divider / before


def _set_pulse(channel: _Channel, key: str, value: float) -> None:
    period_s = float(1 / channel.frequency_hz)
    if key == "DUTY":
        key, value = "WIDTH", value / 100 * period_s
    if key == "WIDTH":
        channel.width_s = _between(_SHORTEST_PULSE_S, value, period_s - _SHORTEST_PULSE_S)
    elif key == "RISE":
        channel.rise_s = max(value, _SHORTEST_EDGE_S)
    elif key == "FALL":
        channel.fall_s = max(value, _SHORTEST_EDGE_S)
    elif key == "DLY":
        channel.delay_s = _between(-period_s, value, period_s)


def _wave_fields(channel: _Channel) -> Iterator[str]:
    """Yield what is said of a wave: six digits of all numbers, ten of the frequency."""
    frequency_hz, amplitude_vpp = float(channel.frequency_hz), channel.amplitude_vpp
    volts_rms = amplitude_vpp * _RMS_PER_VPP[channel.wave]
    yield f"WVTP,{channel.wave},FRQ,{frequency_hz:.10g}HZ,PERI,{1 / frequency_hz:.6g}S"
    yield f"AMP,{amplitude_vpp:.6g}V,AMPVRMS,{volts_rms:.6g}Vrms"
    if channel.load_ohm is not None:
        yield f"AMPDBM,{10 * math.log10(volts_rms**2 / channel.load_ohm / 1e-3):.6g}dBm"
    yield f"OFST,{channel.offset_v:.6g}V,HLEV,{channel.high_v:.6g}V,LLEV,{channel.low_v:.6g}V"
    if channel.wave == "PULSE":
        yield f"DUTY,{100 * channel.width_s * frequency_hz:.6g},WIDTH,{channel.width_s:.6g}"
        yield f"RISE,{channel.rise_s:.6g}S,FALL,{channel.fall_s:.6g}S,DLY,{channel.delay_s:.6g}"
        return
    yield f"PHSE,{channel.phase_deg:.6g}"
    if channel.wave == "SQUARE":
        yield f"DUTY,{channel.duty_percent:.6g}"


def _pairs(words: list[str]) -> Iterator[tuple[str, str]]:
    return zip(words[::2], words[1::2], strict=False)


def _between(least: float, value: float, most: float) -> float:
    return max(min(value, most), least)
