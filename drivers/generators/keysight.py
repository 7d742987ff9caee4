"""Keysight and Agilent 33500 generators: channel 1 drives the loudspeaker.

They have limits of their own for the volts at the socket, which are armed before anything is
played, and an error queue, which is asked after every command. Nothing of this file has met a real
generator: what they answer is known from the drivers of others and from the SCPI standard.
"""

import re
from contextlib import suppress
from dataclasses import dataclass
from decimal import ROUND_UP, Decimal
from fractions import Fraction
from typing import Final

from drivers.context import BenchContext
from drivers.errors import InstrumentError
from drivers.generators.options import GeneratorOptions, generator_options
from drivers.generators.replies import Played, SineRange, in_hertz, matching
from drivers.generators.tweeter import STANDBY_HZ, TweeterGenerator
from protocols.bench import Generator

# SCPI's infinity is 9.9E37, give or take a rounding.
_HIGH_IMPEDANCE_OHM: Final = Decimal("9.8E37")
_ROUNDING_V: Final = Decimal("0.001")
_LONGEST_ERROR_QUEUE: Final = 20
# IEEE 488.2 and SCPI-99 21.8.12: query errors INTERRUPTED and UNTERMINATED.
_QUERY_ERRORS: Final = (-410, -420)
# Chosen: how long `output_off`, which has done its work by then, may take to tidy up.
_TIDYING_S: Final = 0.4
_NUMBER: Final = r"([+-]\d\.\d+E[+-]\d+)"
_WAVE: Final = ";".join(
    (
        ":SOUR1:FUNC?",
        ":SOUR1:FREQ?",
        ":SOUR1:VOLT?",
        ":SOUR1:VOLT:HIGH?",
        ":SOUR1:VOLT:LOW?",
        ":OUTP1:LOAD?",
        ":SOUR1:VOLT:LIM:STAT?",
        ":OUTP1?",
    )
)
_ANSWER: Final = ";".join(
    (
        r"(?P<shape>\w+)",
        *5 * (_NUMBER,),
        "(?P<is_limited>[01])",
        "(?P<is_on>[01])",
    )
)


@dataclass(frozen=True, slots=True)
class _Wave:
    shape: str
    frequency_hz: Decimal
    amplitude_vpp: Decimal
    high_v: Decimal
    low_v: Decimal
    load_ohm: Decimal
    is_limited: bool
    is_on: bool


class KeysightGenerator(TweeterGenerator):
    """A generator of the series 33500A or 33500B as the role `SignalGenerator`.

    Opening it arms its own limits with those of the bench file; see `TweeterGenerator`.
    """

    OPTIONS = GeneratorOptions

    _DEVICE = "generator (Keysight 33500)"
    # All generators of the maker take these commands.
    _LANGUAGE = re.compile(r"(Keysight|Agilent) Technologies,(33|EDU33|81)\d\d")
    _MODEL = re.compile(r"(Keysight|Agilent) Technologies,335\d\d[AB],[^,]+,.+")
    _CAN_PLAY = SineRange(
        least_vpp=Decimal("0.002"),
        most_vpp=Decimal(20),
        most_hz=20_000_000,
        # Its data sheet promises four digits of an amplitude.
        amplitude_digits=4,
        frequency_digits=15,
    )
    _OFF = ("OUTP1 OFF",)
    _OUTPUT = "OUTP1"
    _REFERENCE = "ROSC:SOUR"

    def __init__(self, entry: Generator, context: BenchContext) -> None:
        super().__init__(entry, context, generator_options(self.OPTIONS, entry, context))

    def output_off(self) -> None:
        """Disconnect the output; see `SignalGenerator.output_off`.

        Raises
        ------
        InstrumentError
        """
        super().output_off()
        if self._line.may_have_interrupted:
            # Its display would show errors that only the haste of this driver has caused.
            with suppress(InstrumentError), self._line.within(_TIDYING_S):
                self._read_errors()

    def _set_up(self) -> None:
        # Limits and amplitudes are volts into the load that is set: first the load.
        self._command("OUTP1:LOAD INF")
        self._command("SOUR1:VOLT:UNIT VPP")
        # Limits that the present amplitude exceeds would be refused.
        self._set_amplitude(self._can_play.least_vpp)
        self._command("SOUR1:VOLT:OFFS 0")
        self._arm_limits()
        self._command("SOUR1:FUNC SIN")
        for command in self._sine_commands(STANDBY_HZ, self._can_play.least_vpp):
            self._command(command)
        self._confirm(STANDBY_HZ, self._can_play.least_vpp, on=False)

    def _arm_limits(self) -> None:
        peak_vpp = self._shown_vpp(self._limits.volts_max_v)
        # Rounded up, lest the greatest amplitude that is allowed be refused.
        peak_v = (peak_vpp / 2).quantize(_ROUNDING_V, ROUND_UP)
        for name, volts in (("HIGH", peak_v), ("LOW", -peak_v)):
            self._command(f"SOUR1:VOLT:LIM:{name} {volts:f}")
            read_v = Decimal(self._ask(f"SOUR1:VOLT:LIM:{name}?", matching(_NUMBER))[1])
            if abs(read_v - volts) > _ROUNDING_V:
                raise InstrumentError(
                    f"{self._name}: was set to limit its output to {volts:f} V, but says "
                    f"{read_v:g} V; check that its front panel is not in use"
                )
        self._command("SOUR1:VOLT:LIM:STAT ON")

    def _read_errors(self) -> list[str]:
        """Empty the error queue; return what it held, except what this driver has caused.

        To ask before the last answer was read, which a late answer leads to, is a query error.
        """
        errors = []
        for _ in range(_LONGEST_ERROR_QUEUE + 1):
            found = self._ask("SYST:ERR?", matching(r'([+-]\d+),"(.*)"'))
            number = int(found[1])
            if number == 0:
                self._line.may_have_interrupted = False
                break
            if number not in _QUERY_ERRORS or not self._line.may_have_interrupted:
                errors.append(found[0])
        return errors

    def _sine_commands(self, frequency_hz: Fraction, amplitude_vpp: Decimal) -> tuple[str, ...]:
        return (f"SOUR1:FREQ {in_hertz(frequency_hz)}", self._amplitude_command(amplitude_vpp))

    def _amplitude_command(self, amplitude_vpp: Decimal) -> str:
        return f"SOUR1:VOLT {amplitude_vpp:f}"

    def _reports_on(self) -> bool:
        return self._ask("OUTP1?", matching("([01])"))[1] == "1"

    def _ask_played(self) -> Played:
        wave = self._ask(_WAVE, _understand_wave)
        if (
            wave.shape != "SIN"
            or wave.load_ohm < _HIGH_IMPEDANCE_OHM
            or not wave.is_limited
            or abs(wave.high_v + wave.low_v) > _ROUNDING_V
        ):
            raise InstrumentError(
                f"{self._name}: plays {wave.shape} between {wave.low_v:g} and {wave.high_v:g} V "
                f"into {wave.load_ohm:g} ohm with its limits {'on' if wave.is_limited else 'off'}, "
                "instead of a sine without offset into high impedance with limits on; look "
                "whether its front panel is in use"
            )
        return Played(Fraction(wave.frequency_hz), wave.amplitude_vpp, wave.is_on)


def _understand_wave(answer: str) -> _Wave:
    """Read an answer to all questions of a wave; its levels have to agree with its amplitude."""
    found = matching(_ANSWER)(answer)
    frequency_hz, amplitude_vpp, high_v, low_v, load_ohm = map(Decimal, found.groups()[1:6])
    # They are volts, whatever the unit of the amplitude.
    if abs(high_v - low_v - amplitude_vpp) > _ROUNDING_V:
        raise ValueError(answer)
    return _Wave(
        shape=found["shape"],
        frequency_hz=frequency_hz,
        amplitude_vpp=amplitude_vpp,
        high_v=high_v,
        low_v=low_v,
        load_ohm=load_ohm,
        is_limited=found["is_limited"] == "1",
        is_on=found["is_on"] == "1",
    )
