"""Common part of the generators that drive a loudspeaker through an amplifier.

Commands to a generator state volts peak to peak of its open socket; roles and limits state peak
volts at the loudspeaker. Every setting is read back: only what a generator reports counts.

Switching off comes first: a ramp to 0 V and `output_off` send their commands before they ask
anything, so that they take effect although answers are slow or missing.
"""

import math
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from decimal import ROUND_DOWN, Context, Decimal
from fractions import Fraction
from typing import ClassVar, Final, TypeVar

from drivers.context import BenchContext
from drivers.errors import InstrumentError, LimitError
from drivers.generators.options import (
    OPTIONS_KEY,
    GeneratorOptions,
    require_within_range,
    required_output,
)
from drivers.generators.replies import Played, SineRange, agrees, matching
from drivers.transport.visa import (
    LateError,
    VisaLine,
    open_visa,
)
from protocols.bench import Generator

T = TypeVar("T")

# Chosen: a frequency that every generator can play, for its least amplitude after a reset.
STANDBY_HZ: Final = Fraction(1000)
_REFERENCES: Final = {"internal": "INT", "external": "EXT"}

# Twenty steps take a generator some 0.2 s; the runner asks for ramps of 0.1 s.
_RAMP_STEPS: Final = 20
# Chosen: a ramp to 0 V over less is heard as a click.
_SHORTEST_RAMP_S: Final = 0.05
# Chosen, since switching off must not take seconds, and a sound generator answers within 20 ms:
# by how much slow writes may prolong a ramp to 0 V before it is cut short, how long its end is
# waited for, and how long closing may wait.
_RAMP_LATE_S: Final = 0.3
_RAMP_END_S: Final = 0.4
_CLOSING_S: Final = 1.0
# No generator shows more digits of an amplitude. Never more is played than was asked for.
_AMPLITUDE: Final = Context(prec=6, rounding=ROUND_DOWN)


class TweeterGenerator(ABC):
    """The role `SignalGenerator` for a generator that can be asked what it plays.

    The socket has to feed an input of high impedance: a loudspeaker of 8 ohm directly at a source
    of 50 ohm gets a seventh of what is asked for. 0 V are played as the least amplitude of the
    generator, because its relay would click; `read` says that amplitude.

    An output that was switched on here and is found off has tripped: that is an error, and
    `set_sine` does not switch it on again before `output_off` was called. A setting that is not
    confirmed is never sent again blindly, except for switching off.

    Opening it switches all outputs off and resets it.

    Parameters
    ----------
    entry : Generator
    context : BenchContext
    options : GeneratorOptions

    Raises
    ------
    BenchSetupError
        If the bench file lacks `output`, or asks for what the generator cannot play.
    InstrumentError
        If the generator is not there, is another one, or does not confirm a setting.
    """

    # Role and model, for messages.
    _DEVICE: ClassVar[str]
    # Identities that understand the commands, and those that are driven here.
    _LANGUAGE: ClassVar[re.Pattern[str]]
    _MODEL: ClassVar[re.Pattern[str]]
    _CAN_PLAY: ClassVar[SineRange]
    # Commands that switch all outputs off, in whatever state the generator is.
    _OFF: ClassVar[tuple[str, ...]]
    # Commands of the relay of the output and of the 10 MHz reference, and the answer to the latter.
    _OUTPUT: ClassVar[str]
    _REFERENCE: ClassVar[str]
    _REFERENCE_ANSWER: ClassVar[str] = "(INT|EXT)"

    _line: VisaLine

    def __init__(self, entry: Generator, context: BenchContext, options: GeneratorOptions) -> None:
        description = context.description
        output = required_output(description, entry)
        self._name, self._resource = f"{self._DEVICE} at {options.resource}", options.resource
        self._context, self._can_play = context, self._CAN_PLAY
        self._gain = Fraction(str(output.amplifier_gain))
        self._limits, self._step_hz = description.limits, entry.step_hz
        self._last_set_hz: Fraction | None = None
        # The amplitude that was sent or read last.
        self._level_vpp: Decimal | None = None
        self._is_on = False
        require_within_range(self._CAN_PLAY, description, entry)
        self._connect(options.timeout_s)
        try:
            self._reset()
            self._set_up()
            self._choose_reference(options.reference)
        except BaseException:
            self._abandon()
            raise

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
        grid_hz = round(frequency_hz / self._step_hz) * self._step_hz
        if self._is_on:
            self._require_not_tripped(self._reports_on())
        self._level_vpp = amplitude_vpp
        for command in self._sine_commands(grid_hz, amplitude_vpp):
            self._command(command)
        self._confirm(grid_hz, amplitude_vpp, on=self._is_on)
        if not self._is_on:
            self._is_on = True
            self._command(self._output_command(True))
            self._confirm(grid_hz, amplitude_vpp, on=True)

    def ramp_to(self, volts: float, duration_s: float) -> None:
        """Change the volts in small steps; see `SignalGenerator.ramp_to`.

        It takes longer than `duration_s` if the generator does. Every step is read back, except on
        the way to 0 V: this takes at least 50 ms and starts at once, from the last amplitude that
        was sent or read, and only its end is read back. Because the next call may have to switch
        off, that waits no longer than 0.4 s. An end that is not confirmed by then is no error here;
        whatever is called next reads it back.

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
        if volts == 0:
            self._ramp_to_zero(end_vpp, max(duration_s, _SHORTEST_RAMP_S))
            return
        is_on = self._reports_on()
        if self._is_on:
            self._require_not_tripped(is_on)
        elif not is_on:
            raise InstrumentError(
                f"{self._name}: its output is off, but was asked to ramp to {volts:g} V; call "
                "set_sine first"
            )
        self._is_on = True
        played = self._played()
        for step_vpp in self._ramp_steps(played.amplitude_vpp, end_vpp, duration_s):
            self._set_amplitude(step_vpp)
            self._confirm(self._exactly(played.frequency_hz), step_vpp, on=True)

    def output_off(self) -> None:
        """Disconnect the output; see `SignalGenerator.output_off`.

        Raises
        ------
        InstrumentError
        """
        reason, cause = "it says that it is on", None
        for _ in range(2):
            # Unlike an amplitude, this may be sent twice. What the output itself says counts,
            # not how the command fared.
            with suppress(InstrumentError):
                self._line.send(self._output_command(False))
            try:
                is_on = self._reports_on()
            except InstrumentError as error:
                reason, cause = str(error).removeprefix(f"{self._name}: "), error
                continue
            if not is_on:
                self._is_on = False
                return
            reason, cause = "it says that it is on", None
        raise InstrumentError(
            f"{self._name}: was asked twice to switch its output off, which is not confirmed, "
            f"because {reason}; pull the loudspeaker's cable"
        ) from cause

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
        """Switch off what is on, as far as that is possible within 1 s, and close the line."""
        self._leave_off()
        self._line.close()

    @abstractmethod
    def _sine_commands(self, frequency_hz: Fraction, amplitude_vpp: Decimal) -> tuple[str, ...]:
        """Return the commands that set a frequency on the grid and volts peak to peak."""

    @abstractmethod
    def _amplitude_command(self, amplitude_vpp: Decimal) -> str:
        """Return the command that sets volts peak to peak."""

    @abstractmethod
    def _set_up(self) -> None:
        """Set the least amplitude after a reset, with the output off."""

    @abstractmethod
    def _reports_on(self) -> bool:
        """Ask whether the output is on."""

    @abstractmethod
    def _ask_played(self) -> Played:
        """Read what is played; raise if it is no sine, or for another load."""

    @abstractmethod
    def _read_errors(self) -> list[str]:
        """Empty the error queue and return its entries; none if there is no queue."""

    def _require_no_errors(self, after: str) -> None:
        errors = self._read_errors()
        if errors:
            raise InstrumentError(
                f"{self._name}: was sent {after!r} and reports {' and '.join(errors)}; look at "
                "its front panel"
            )

    def _output_command(self, on: bool) -> str:
        return f"{self._OUTPUT} {'ON' if on else 'OFF'}"

    def _connect(self, timeout_s: float) -> None:
        """Open the line, switch the outputs off, and require the right model.

        Nothing else is sent to an instrument that takes other commands.
        """
        self._line = open_visa(self._resource, timeout_s, self._DEVICE, make_safe=self._OFF)
        if self._LANGUAGE.match(self.identity):
            self._send_off()
        if not self._MODEL.fullmatch(self.identity):
            self._line.close()
            raise InstrumentError(
                f"{self._name}: says that it is {self.identity!r}, which this driver does not "
                f"know; correct {OPTIONS_KEY}.resource or instruments.generator.driver"
            )

    def _reset(self) -> None:
        """Leave nothing of earlier settings, with the output off."""
        self.output_off()
        self._read_errors()
        self._command("*RST")
        self._ask("*OPC?", matching("1"))
        self.output_off()

    def _choose_reference(self, reference: str) -> None:
        source = _REFERENCES[reference]
        self._command(f"{self._REFERENCE} {source}")
        if self._ask(f"{self._REFERENCE}?", matching(self._REFERENCE_ANSWER))[1] != source:
            raise InstrumentError(
                f"{self._name}: was set to use its {reference} reference and does not; check the "
                f"10 MHz at its rear, or correct {OPTIONS_KEY}.reference"
            )

    def _leave_off(self) -> None:
        """Switch off what was switched on here; raises nothing."""
        if self._is_on:
            with suppress(InstrumentError), self._line.within(_CLOSING_S):
                self.output_off()

    def _abandon(self) -> None:
        """Switch off and close the line, without reading back."""
        self._send_off()
        self._line.close()

    def _send_off(self) -> None:
        for command in self._OFF:
            with suppress(InstrumentError):
                self._line.send(command)

    def _ramp_to_zero(self, end_vpp: Decimal, duration_s: float) -> None:
        """Send one amplitude after another, and read only the last one back."""
        start_vpp = self._level_of_output()
        if start_vpp is None:
            return
        for step_vpp in self._ramp_steps(start_vpp, end_vpp, duration_s, _RAMP_LATE_S):
            self._level_vpp = step_vpp
            self._line.send(self._amplitude_command(step_vpp))
        if not self._line.is_in_step:
            # Something has just gone wrong or was interrupted: what comes next must not wait.
            return
        try:
            with self._line.within(_RAMP_END_S):
                self._require_no_errors(f"a ramp to {end_vpp:f} Vpp")
                played = self._played()
        except LateError:
            return
        if played.is_on:
            self._confirm_played(self._exactly(played.frequency_hz), end_vpp, played)

    def _level_of_output(self) -> Decimal | None:
        """Return the amplitude of an output that is on, None if it is off or does not answer."""
        if self._is_on:
            return self._level_vpp
        if not self._line.is_in_step:
            return None
        # It was not switched on here, but perhaps at the front panel.
        try:
            with self._line.within(_RAMP_END_S):
                if not self._reports_on():
                    return None
                self._is_on = True
                return self._played().amplitude_vpp
        except LateError:
            return None

    def _ramp_steps(
        self, start_vpp: Decimal, end_vpp: Decimal, duration_s: float, late_s: float = math.inf
    ) -> Iterator[Decimal]:
        """Yield amplitudes when they are due; only the last if the ramp gets late by `late_s`."""
        clock = self._context.clock
        start_s, cut_s = clock.now_s(), time.monotonic() + duration_s + late_s
        for part in range(1, _RAMP_STEPS + 1):
            clock.wait(start_s + duration_s * part / _RAMP_STEPS - clock.now_s())
            if part < _RAMP_STEPS and time.monotonic() > cut_s:
                continue
            yield _AMPLITUDE.plus(start_vpp + (end_vpp - start_vpp) * part / _RAMP_STEPS)

    def _played(self) -> Played:
        """Read what is played, and remember the amplitude."""
        played = self._ask_played()
        self._level_vpp = played.amplitude_vpp
        return played

    def _command(self, command: str) -> None:
        """Send a command. Reading back shows whether it arrived.

        Raises
        ------
        InstrumentError
            If the generator reports an error.
        """
        try:
            self._line.send(command)
        except InstrumentError:
            self._line.drain()
        self._require_no_errors(command)

    def _set_amplitude(self, amplitude_vpp: Decimal) -> None:
        self._level_vpp = amplitude_vpp
        self._command(self._amplitude_command(amplitude_vpp))

    def _ask(self, question: str, understand: Callable[[str], T]) -> T:
        """Return the parsed answer; ask again if it cannot be parsed (`ValueError`)."""
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
        """Require that the settings are played, and remember the exact frequency."""
        played = self._played()
        self._confirm_played(frequency_hz, amplitude_vpp, played)
        self._last_set_hz = frequency_hz
        if on:
            self._require_not_tripped(played.is_on)

    def _confirm_played(
        self, frequency_hz: Fraction, amplitude_vpp: Decimal, played: Played
    ) -> None:
        """Require that what was set is played."""
        can_play = self._can_play
        if not (
            agrees(frequency_hz, played.frequency_hz, can_play.frequency_digits)
            and agrees(amplitude_vpp, played.amplitude_vpp, can_play.amplitude_digits)
        ):
            raise InstrumentError(
                f"{self._name}: was set to play {float(frequency_hz):.11g} Hz at "
                f"{amplitude_vpp:f} Vpp, but says {float(played.frequency_hz):.11g} Hz at "
                f"{played.amplitude_vpp:g} Vpp; it may have missed that or limit itself, or "
                "its front panel is in use"
            )

    def _exactly(self, read_hz: Fraction) -> Fraction:
        """Return the exact frequency that was set if the reading agrees, else the reading."""
        grid_hz, digits = self._last_set_hz, self._can_play.frequency_digits
        return grid_hz if grid_hz is not None and agrees(grid_hz, read_hz, digits) else read_hz

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
        """Volts peak to peak of the open socket, with the digits of a command."""
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
        raise InstrumentError(
            f"{self._name}: its output is off, but was switched on; look for an overload or a "
            "short circuit, and whether its front panel is in use"
        )
