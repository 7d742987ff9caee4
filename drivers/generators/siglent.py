"""Siglent SDG2000X generators: channel 1 drives the loudspeaker, channel 2 may trigger the camera.

These generators clamp what they cannot do without a word and report no errors, so every setting is
read back. What they answer is known from a recorded session with an SDG2042X (firmware
2.01.01.23R7); the answer about the 10 MHz reference is known from the programming guide alone.
"""

import re
from contextlib import suppress
from decimal import Decimal
from fractions import Fraction
from typing import Annotated, Final

from pydantic import Field

from drivers.cameras.trigger import CameraTrigger
from drivers.context import BenchContext
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.generators.options import OPTIONS_KEY, GeneratorOptions, generator_options
from drivers.generators.replies import Played, SineRange, agrees, in_hertz, matching
from drivers.generators.tweeter import STANDBY_HZ, TweeterGenerator
from drivers.options import Options
from protocols.bench import Generator

# Chosen: how long closing may wait until the camera's pulses are confirmed to have stopped.
_CLOSING_S: Final = 0.5
_NUMBER: Final = re.compile(r"(-?\d+(?:\.\d+)?(?:e[+-]\d+)?)(HZ|S|V|Vrms|dBm)?")
# Modulation, sweep and burst, during which a wave is still said to be a sine.
_MODES: Final = ("MDWV", "SWWV", "BTWV")
# Of the redundant numbers of an answer, each of six digits.
_ROUNDING: Final = Fraction(1, 100_000)


class CameraTriggerOptions(Options):
    """A pulse on channel 2 for each frame, at the frame rate that the camera asks for."""

    width_s: Annotated[float, Field(gt=0, le=1)]
    """Width of the pulse, in s."""
    high_v: Annotated[float, Field(ge=0.1, le=5)]
    """Volts of the pulse into high impedance; between pulses there are 0 V."""


class SiglentOptions(GeneratorOptions):
    """Options of a Siglent generator."""

    camera_trigger: CameraTriggerOptions | None = None
    """Pulses on channel 2 that trigger the camera."""


class SiglentGenerator(TweeterGenerator):
    """An SDG2042X, SDG2082X or SDG2122X as the role `SignalGenerator`.

    With the option `camera_trigger` it offers itself as the source of the bench's `CameraTrigger`;
    see `TweeterGenerator`.
    """

    OPTIONS = SiglentOptions

    _DEVICE = "generator (Siglent SDG2000X)"
    # All generators of the maker take these commands.
    _LANGUAGE = re.compile(r"Siglent Technologies,SDG")
    _MODEL = re.compile(r"Siglent Technologies,SDG2(04|08|12)2X,[^,]+,[^,]+")
    _CAN_PLAY = SineRange(
        least_vpp=Decimal("0.002"),
        most_vpp=Decimal(20),
        most_hz=20_000_000,
        amplitude_digits=6,
        frequency_digits=10,
    )
    _OFF = ("C1:OUTP OFF", "C2:OUTP OFF")
    _OUTPUT = "C1:OUTP"
    _REFERENCE = "ROSC"
    _REFERENCE_ANSWER = "ROSC (INT|EXT)(?:,.*)?"

    def __init__(self, entry: Generator, context: BenchContext) -> None:
        options = generator_options(self.OPTIONS, entry, context)
        self._pulse, self._plays_pulses = options.camera_trigger, False
        super().__init__(entry, context, options)
        if self._pulse is not None:
            context.share(CameraTrigger).offer(self)

    def play_pulses(self, frame_rate_hz: Fraction) -> None:
        """Play the camera's pulses on channel 2; see `PulseSource.play_pulses`.

        Raises
        ------
        LimitError
        BenchSetupError
            If the options have no `camera_trigger`.
        InstrumentError
        """
        pulse = self._pulse
        if pulse is None:
            raise BenchSetupError(
                f"{self._name}: was asked for the camera's pulses; add camera_trigger to "
                f"{OPTIONS_KEY}"
            )
        if frame_rate_hz <= 0 or (frame_rate_hz * 1_000_000).denominator != 1:
            raise LimitError(
                f"{self._name}: was asked for {float(frame_rate_hz):.12g} pulses per second, but "
                "its grid is 1 uHz; choose a frame rate on it"
            )
        if pulse.width_s * frame_rate_hz >= 1:
            raise LimitError(
                f"{self._name}: was asked for {float(frame_rate_hz):g} pulses per second of "
                f"{pulse.width_s:g} s each; shorten {OPTIONS_KEY}.camera_trigger.width_s"
            )
        self.stop_pulses()
        high_v, width_s = Decimal(str(pulse.high_v)), Decimal(str(pulse.width_s))
        self._command("C2:OUTP LOAD,HZ,PLRT,NOR")
        self._command(
            f"C2:BSWV WVTP,PULSE,FRQ,{in_hertz(frame_rate_hz)},OFST,0,AMP,{high_v:f},"
            f"OFST,{high_v / 2:f},WIDTH,{width_s:f},DLY,0"
        )
        self._confirm_pulses(frame_rate_hz, high_v, width_s)
        self._plays_pulses = True
        self._command("C2:OUTP ON")
        if self._output("C2")[0] != "ON":
            raise InstrumentError(
                f"{self._name}: channel 2 is off, but was switched on; look for a short circuit "
                "in the camera's cable"
            )

    def stop_pulses(self) -> None:
        """Switch channel 2 off; see `PulseSource.stop_pulses`.

        Raises
        ------
        InstrumentError
        """
        self._command("C2:OUTP OFF")
        if self._output("C2")[0] != "OFF":
            raise InstrumentError(
                f"{self._name}: channel 2 was switched off, but reports that it is on; pull the "
                "camera's cable"
            )
        self._plays_pulses = False

    def _leave_off(self) -> None:
        super()._leave_off()
        if self._plays_pulses:
            self._plays_pulses = False
            with suppress(InstrumentError), self._line.within(_CLOSING_S):
                self.stop_pulses()

    def _set_up(self) -> None:
        self._command("C1:OUTP LOAD,HZ,PLRT,NOR")
        least_vpp = self._can_play.least_vpp
        self._command(f"C1:BSWV WVTP,SINE,FRQ,{in_hertz(STANDBY_HZ)},OFST,0,AMP,{least_vpp},PHSE,0")
        self._confirm(STANDBY_HZ, least_vpp, on=False)
        for mode in _MODES:
            if self._ask(f"C1:{mode}?", matching(f"C1:{mode} STATE,(ON|OFF).*"))[1] == "ON":
                raise InstrumentError(
                    f"{self._name}: was reset, but still modulates, sweeps or bursts (C1:{mode}); "
                    "switch that off at its front panel"
                )

    def _sine_commands(self, frequency_hz: Fraction, amplitude_vpp: Decimal) -> tuple[str, ...]:
        return (f"C1:BSWV FRQ,{in_hertz(frequency_hz)},AMP,{amplitude_vpp:f}",)

    def _amplitude_command(self, amplitude_vpp: Decimal) -> str:
        return f"C1:BSWV AMP,{amplitude_vpp:f}"

    def _read_errors(self) -> list[str]:
        # Its error queue is empty also after values that it clamped.
        return []

    def _reports_on(self) -> bool:
        return self._output("C1")[0] == "ON"

    def _ask_played(self) -> Played:
        wave = self._wave("C1")
        switch, load = self._output("C1")
        if wave["WVTP"] != "SINE" or load != "HZ" or Fraction(wave["OFST"]) != 0:
            raise InstrumentError(
                f"{self._name}: plays {wave['WVTP']} with an offset of {wave['OFST']} V into a "
                f"load of {load}, instead of a sine without offset into HZ; look whether its "
                "front panel is in use"
            )
        return Played(Fraction(wave["FRQ"]), Decimal(wave["AMP"]), switch == "ON")

    def _output(self, channel: str) -> tuple[str, str]:
        """Return ``ON`` or ``OFF``, and the load that volts refer to."""
        answers = matching(f"{channel}:OUTP (ON|OFF),LOAD,(HZ|\\d+),PLRT,(?:NOR|INVT)")
        found = self._ask(f"{channel}:OUTP?", answers)
        return found[1], found[2]

    def _wave(self, channel: str) -> dict[str, str]:
        return self._ask(f"{channel}:BSWV?", lambda answer: understand_wave(channel, answer))

    def _confirm_pulses(self, frame_rate_hz: Fraction, high_v: Decimal, width_s: Decimal) -> None:
        wave = self._wave("C2")
        if not (
            wave["WVTP"] == "PULSE"
            and agrees(frame_rate_hz, Fraction(wave["FRQ"]), 10)
            and agrees(high_v, Fraction(wave["HLEV"]), 6)
            and Fraction(wave["LLEV"]) == 0
            and agrees(width_s, Fraction(wave.get("WIDTH", "0")), 6)
        ):
            raise InstrumentError(
                f"{self._name}: channel 2 was set to pulses of {width_s} s and {high_v} V at "
                f"{float(frame_rate_hz):.10g} Hz, but says {wave}; correct "
                f"{OPTIONS_KEY}.camera_trigger"
            )


def understand_wave(channel: str, answer: str) -> dict[str, str]:
    """Read an answer to ``C1:BSWV?``, and require that its redundant numbers agree.

    Parameters
    ----------
    channel : {'C1', 'C2'}
    answer : str
        Such as ``C1:BSWV WVTP,SINE,FRQ,1000HZ,PERI,0.001S,AMP,4V,…,PHSE,0``.

    Returns
    -------
    dict of str to str
        Numbers without their units, by key.

    Raises
    ------
    ValueError
        If it is no such answer, or has been garbled on its way.
    """
    head, _, rest = answer.partition(" ")
    words = rest.split(",")
    if head != f"{channel}:BSWV" or len(words) % 2:
        raise ValueError(answer)
    wave = dict(zip(words[::2], words[1::2], strict=True))
    kind = wave.pop("WVTP", "")
    numbers = {key: _number(value) for key, value in wave.items()}
    try:
        frequency_hz, period_s = Fraction(numbers["FRQ"]), Fraction(numbers["PERI"])
        amplitude_v, offset_v = Fraction(numbers["AMP"]), Fraction(numbers["OFST"])
        high_v, low_v = Fraction(numbers["HLEV"]), Fraction(numbers["LLEV"])
    except KeyError as error:
        raise ValueError(answer) from error
    rounding_v = _ROUNDING * max(abs(high_v), abs(low_v))
    if (
        abs(high_v - low_v - amplitude_v) > rounding_v
        or abs(high_v + low_v - 2 * offset_v) > rounding_v
        or abs(frequency_hz * period_s - 1) > _ROUNDING
    ):
        raise ValueError(answer)
    return {"WVTP": kind, **numbers}


def _number(text: str) -> str:
    found = _NUMBER.fullmatch(text)
    if found is None:
        raise ValueError(text)
    return found[1]
