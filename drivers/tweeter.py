"""What generators of all makers share that drive a loudspeaker through an amplifier.

A generator is told volts peak to peak of its open socket; roles and limits speak of peak volts at
the loudspeaker. Whatever is told is read back: only what a generator says that it plays counts.
"""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from decimal import ROUND_DOWN, Context, Decimal
from fractions import Fraction
from typing import Final, TypeVar

from drivers.context import BenchContext
from drivers.description import BenchDescription, GeneratorDescription, OutputDescription
from drivers.errors import BenchSetupError, InstrumentError, LimitError
from drivers.visa import VisaLine

T = TypeVar("T")

# Twenty steps take a generator some 0.2 s; the runner asks for ramps of 0.1 s.
_RAMP_STEPS: Final = 20
_MICROHERTZ: Final = Fraction(1, 1_000_000)
# No generator shows more digits of an amplitude. Never more is played than was asked for.
_AMPLITUDE: Final = Context(prec=6, rounding=ROUND_DOWN)


@dataclass(frozen=True, slots=True)
class SineRange:
    """What sines a generator can play into high impedance, and how exactly it says so.

    Attributes
    ----------
    least_vpp, most_vpp : Decimal
        Volts peak to peak.
    most_hz : int
        Up to which `most_vpp` holds.
    amplitude_digits, frequency_digits : int
        Significant digits of what it says.
    """

    least_vpp: Decimal
    most_vpp: Decimal
    most_hz: int
    amplitude_digits: int
    frequency_digits: int


@dataclass(frozen=True, slots=True)
class Played:
    """What a generator says that it plays.

    Attributes
    ----------
    frequency_hz : Fraction
    amplitude_vpp : Decimal
        Of the open socket.
    is_on : bool
        Whether the output is on.
    """

    frequency_hz: Fraction
    amplitude_vpp: Decimal
    is_on: bool


class TweeterGenerator(ABC):
    """The role `SignalGenerator` for a generator that can be asked what it plays.

    The socket has to feed an input of high impedance: a loudspeaker of 8 ohm directly at a source
    of 50 ohm gets a seventh of what is asked for. 0 V are played as the least amplitude of the
    generator, because its relay would click; `read` says that amplitude.

    An output that was switched on here and is found off has tripped: that is an error, and only
    then may `set_sine` switch it on again. What was told and is not read back is never told again
    blindly, but for switching off.

    Parameters
    ----------
    entry : GeneratorDescription
    context : BenchContext
    device, resource : str
        For messages: role and model, and VISA's name.
    can_play : SineRange

    Raises
    ------
    BenchSetupError
        If the bench file lacks `output`, or asks for what the generator cannot play.
    """

    _line: VisaLine

    def __init__(
        self,
        entry: GeneratorDescription,
        context: BenchContext,
        device: str,
        resource: str,
        can_play: SineRange,
    ) -> None:
        description = context.description
        output = _required_output(description, entry)
        self._name, self._context, self._can_play = f"{device} at {resource}", context, can_play
        self._gain = Fraction(str(output.amplifier_gain))
        self._limits, self._step_hz = description.limits, entry.step_hz
        self._told_hz: Fraction | None = None
        self._is_on = False
        self._require_within_range(description)

    @property
    def identity(self) -> str:
        """Maker, model, serial number and firmware."""
        return self._line.identity

    def set_sine(self, frequency_hz: Fraction, volts: float) -> None:
        """Play a sine; see `SignalGenerator.set_sine`.

        The frequency is the nearest on the grid of the bench file; the volts are the next that
        the generator can say, towards 0.

        Raises
        ------
        LimitError
        InstrumentError
            Also if the output has tripped since it was switched on.
        """
        self._require_frequency(frequency_hz)
        amplitude_vpp = self._amplitude_vpp(volts)
        told_hz = round(frequency_hz / self._step_hz) * self._step_hz
        if self._is_on:
            self._require_not_tripped(self._says_on())
        self._tell_sine(told_hz, amplitude_vpp)
        self._confirm(told_hz, amplitude_vpp, on=self._is_on)
        if not self._is_on:
            self._is_on = True
            self._tell_output(True)
            self._confirm(told_hz, amplitude_vpp, on=True)

    def ramp_to(self, volts: float, duration_s: float) -> None:
        """Change the volts in small steps; see `SignalGenerator.ramp_to`.

        It takes longer than `duration_s` if the generator does.

        Raises
        ------
        LimitError
        InstrumentError
        """
        end_vpp = self._amplitude_vpp(volts)
        if not 0 <= duration_s < math.inf:
            raise LimitError(
                f"{self._name}: was asked to ramp over {duration_s} s; give a time of 0 s or more"
            )
        if not self._says_on():
            self._is_on = False
            if volts == 0:
                return
            raise InstrumentError(
                f"{self._name}: its output is off, but was asked to ramp to {volts:g} V; call "
                "set_sine first"
            )
        self._is_on = True
        played = self._played()
        clock, start_vpp = self._context.clock, played.amplitude_vpp
        start_s = clock.now_s()
        for part in range(1, _RAMP_STEPS + 1):
            clock.wait(start_s + duration_s * part / _RAMP_STEPS - clock.now_s())
            step_vpp = start_vpp + (end_vpp - start_vpp) * part / _RAMP_STEPS
            self._tell_amplitude(_AMPLITUDE.plus(step_vpp))
            self._confirm(self._exactly(played.frequency_hz), _AMPLITUDE.plus(step_vpp), on=True)

    def output_off(self) -> None:
        """Disconnect the output; see `SignalGenerator.output_off`.

        Raises
        ------
        InstrumentError
        """
        # Other than an amplitude, this may be told twice.
        for _ in range(2):
            # What the output itself says counts, not how the command fared.
            with suppress(InstrumentError):
                self._tell_output(False)
            if not self._says_on():
                self._is_on = False
                return
        raise InstrumentError(
            f"{self._name}: was told to switch its output off, but says that it is on; pull the "
            "loudspeaker's cable"
        )

    def read(self) -> tuple[Fraction, float, bool]:
        """Return what is played; see `SignalGenerator.read`.

        The frequency is exactly the one that was set as long as all digits that the generator
        says are those of it.

        Raises
        ------
        InstrumentError
            Also if it says that it plays something other than a sine into high impedance.
        """
        played = self._played()
        volts = float(self._volts(played.amplitude_vpp))
        return self._exactly(played.frequency_hz), volts, played.is_on

    def close(self) -> None:
        """Switch off what is on, as far as that is possible, and hang up."""
        if self._is_on:
            with suppress(InstrumentError):
                self.output_off()
        self._line.close()

    @abstractmethod
    def _tell_sine(self, frequency_hz: Fraction, amplitude_vpp: Decimal) -> None:
        """Send a frequency on the grid and volts peak to peak, and nothing else."""

    @abstractmethod
    def _tell_amplitude(self, amplitude_vpp: Decimal) -> None:
        """Send volts peak to peak, and nothing else."""

    @abstractmethod
    def _tell_output(self, on: bool) -> None:
        """Throw the output's relay."""

    @abstractmethod
    def _says_on(self) -> bool:
        """Ask whether the output is on."""

    @abstractmethod
    def _played(self) -> Played:
        """Ask what is played; an error if it is no sine, or volts into another load."""

    def _tell(self, command: str) -> None:
        """Send a command. If it is not known to have arrived, reading back will tell."""
        try:
            self._line.send(command)
        except InstrumentError:
            self._line.drain()

    def _ask(self, question: str, understand: Callable[[str], T]) -> T:
        """Return what is understood of an answer; ask again if nothing is (`ValueError`)."""
        for _ in range(2):
            answer = self._line.ask(question)
            try:
                return understand(answer)
            except ValueError:
                self._line.drain()
        raise InstrumentError(
            f"{self._name}: was asked {question!r} and answered {answer!r}, which makes no sense; "
            "check its cable and its firmware"
        )

    def _confirm(self, frequency_hz: Fraction, amplitude_vpp: Decimal, on: bool) -> None:
        """Require that what was told is played, and remember the exact frequency."""
        played, can_play = self._played(), self._can_play
        if not (
            agrees(frequency_hz, played.frequency_hz, can_play.frequency_digits)
            and agrees(amplitude_vpp, played.amplitude_vpp, can_play.amplitude_digits)
        ):
            raise InstrumentError(
                f"{self._name}: was told to play {float(frequency_hz):.11g} Hz at "
                f"{amplitude_vpp:f} Vpp, but says {float(played.frequency_hz):.11g} Hz at "
                f"{played.amplitude_vpp:g} Vpp; it may have missed that or limit itself, or "
                "somebody uses its front panel"
            )
        self._told_hz = frequency_hz
        if on:
            self._require_not_tripped(played.is_on)

    def _exactly(self, said_hz: Fraction) -> Fraction:
        """Return the frequency that was told if that is what is said, else what is said."""
        told_hz, digits = self._told_hz, self._can_play.frequency_digits
        return told_hz if told_hz is not None and agrees(told_hz, said_hz, digits) else said_hz

    def _amplitude_vpp(self, volts: float) -> Decimal:
        """Volts peak to peak of the open socket for peak volts at the load, if allowed."""
        limits = self._limits
        least_v, most_v = float(limits.volts_min_v), float(limits.volts_max_v)
        if not (volts == 0 or least_v <= volts <= most_v):
            raise LimitError(
                f"{self._name}: was asked for {volts} V, outside {least_v:g} to {most_v:g} V; "
                "change the protocol's drive or the limits of the bench file"
            )
        least_vpp = self._can_play.least_vpp
        amplitude_vpp = self._shown_vpp(Fraction(str(float(volts))))
        if volts != 0 and amplitude_vpp < least_vpp:
            raise LimitError(
                f"{self._name}: was asked for {volts} V, but can play 0 V, or "
                f"{float(self._volts(least_vpp)):g} V and more; change the protocol's drive or "
                "lower the amplifier's gain"
            )
        return max(amplitude_vpp, least_vpp)

    def _shown_vpp(self, volts: Fraction) -> Decimal:
        """Volts peak to peak of the open socket, as a generator can be told and says them."""
        exact_vpp = 2 * volts / self._gain
        return _AMPLITUDE.divide(Decimal(exact_vpp.numerator), exact_vpp.denominator)

    def _volts(self, amplitude_vpp: Decimal) -> Fraction:
        """Peak volts at the load."""
        return Fraction(amplitude_vpp) / 2 * self._gain

    def _require_frequency(self, frequency_hz: Fraction) -> None:
        low_hz, high_hz = self._limits.drive_min_hz, self._limits.drive_max_hz
        if not low_hz <= frequency_hz <= high_hz:
            raise LimitError(
                f"{self._name}: was asked for {float(frequency_hz):.10g} Hz, outside "
                f"{float(low_hz):.10g} to {float(high_hz):.10g} Hz; change the sweep or the limits"
            )

    def _require_not_tripped(self, is_on: bool) -> None:
        if is_on:
            return
        self._is_on = False
        raise InstrumentError(
            f"{self._name}: its output is off, but was switched on; look for an overload or a "
            "short circuit, and whether somebody uses its front panel"
        )

    def _require_within_range(self, description: BenchDescription) -> None:
        """Refuse a bench file that allows what the generator cannot play, or not exactly."""
        can_play, limits = self._can_play, self._limits
        most_v = self._volts(can_play.most_vpp)
        if self._step_hz % _MICROHERTZ:
            key, complaint = (
                "instruments.generator.step",
                f"is {float(self._step_hz):g} Hz, but the generator's grid is 1 uHz; write a "
                "multiple of that",
            )
        elif limits.volts_max_v > most_v:
            key, complaint = (
                "limits.volts_max",
                f"allows {float(limits.volts_max_v):g} V peak, but the generator and its amplifier "
                f"give {float(most_v):g} V; lower it, or correct "
                "instruments.generator.output.amplifier_gain",
            )
        elif limits.drive_max_hz > can_play.most_hz:
            key, complaint = (
                "limits.drive_max",
                f"is above the {can_play.most_hz} Hz that the generator plays at full volts; "
                "lower it",
            )
        else:
            return
        raise BenchSetupError(f"bench {description.name!r}: {key}: {complaint}")


def agrees(told: Fraction | Decimal, said: Fraction | Decimal, digits: int) -> bool:
    """Whether a number is what another looks like with so many significant digits.

    Parameters
    ----------
    told : Fraction or Decimal
        Not 0.
    said : Fraction or Decimal
    digits : int

    Returns
    -------
    bool
    """
    exact = Fraction(told)
    leading = (Decimal(exact.numerator) / exact.denominator).adjusted()
    return abs(exact - Fraction(said)) <= Fraction(10) ** (leading - digits + 1) / 2


def matching(pattern: str) -> Callable[[str], re.Match[str]]:
    """Return what understands only answers that match a regular expression as a whole.

    Parameters
    ----------
    pattern : str

    Returns
    -------
    callable
        Raises `ValueError` for other answers.
    """

    def understand(answer: str) -> re.Match[str]:
        found = re.fullmatch(pattern, answer)
        if found is None:
            raise ValueError(answer)
        return found

    return understand


def in_hertz(frequency_hz: Fraction) -> str:
    """Write a frequency of a whole number of microhertz, all digits of it.

    Parameters
    ----------
    frequency_hz : Fraction

    Returns
    -------
    str
        Such as ``2033.075000``.
    """
    whole, micro = divmod(round(frequency_hz / _MICROHERTZ), 1_000_000)
    return f"{whole}.{micro:06d}"


def _required_output(
    description: BenchDescription, entry: GeneratorDescription
) -> OutputDescription:
    if entry.output is None:
        raise BenchSetupError(
            f"bench {description.name!r}: instruments.generator.output: is missing; say what lies "
            "between the socket and the loudspeaker, such as output: {amplifier_gain: 2, load: 8 "
            "ohm}"
        )
    return entry.output
