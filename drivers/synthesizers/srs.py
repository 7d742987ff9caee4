"""Two Stanford Research SG382, SG384 or SG386 on a common 10 MHz, one for each AOM.

Commands are those that the drivers of QCoDeS and qudi send to an SG384: ``FREQ``, ``AMPR`` (power
of the type-N output in dBm), ``ENBR``, ``MODL``. Nothing here was tried on the instruments. Not
even documented in what could be read are the step of 1 uHz, how many decimals ``FREQ?`` has, and
what ``TIMB?`` answers on these models (that 3 is an external timebase is taken from SRS' own driver
of the DG645).
"""

import re
from contextlib import ExitStack, suppress
from decimal import ROUND_FLOOR, Decimal
from fractions import Fraction
from typing import Annotated, Final, NoReturn, Self

from pydantic import Field, model_validator

from drivers.context import BenchContext
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.options import Options, read_options
from drivers.transport.visa import VisaLine, open_visa
from protocols.bench import Synthesizers

_DEVICE: Final = "synthesizers (SRS SG380)"
_STEP_HZ: Final = Fraction(1, 1_000_000)
# Of the type-N output of the SG382.
_LOWEST_HZ: Final = Fraction(950_000)
_HIGHEST_HZ: Final = Fraction(2_025_000_000)
_MODEL: Final = re.compile(r"SG38[246]\b")
# All RF generators of the maker take these commands.
_LANGUAGE: Final = re.compile(r"Stanford Research Systems,SG3")
_OFF: Final = "ENBR 0"
# Chosen: how long closing may wait until one generator says that it is off.
_CLOSING_S: Final = 0.5
_NUMBER: Final = re.compile(r"[+-]?\d+(\.\d*)?([eE][+-]?\d{1,2})?")
_EXTERNAL: Final = 3


class SRSOptions(Options):
    """Options of two Stanford Research generators."""

    resources: Annotated[list[str], Field(min_length=2, max_length=2)]
    """VISA names of the generators of AOM1 and AOM2."""
    power_dbm: Annotated[float, Field(ge=-110, le=16.5)]
    """Power of both type-N outputs when RF is on, in dBm."""
    power_max_dbm: Annotated[float, Field(ge=-110, le=16.5)]
    """Highest power that the modulators and their amplifiers stand, in dBm."""
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """Longest wait for an answer, in s."""
    baud: Annotated[int, Field(gt=0)] | None = None
    """Baud rate of generators on serial lines."""
    check_timebase: bool = True
    """Whether to refuse two generators that both report that they run on their own clock."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.power_dbm > self.power_max_dbm:
            raise ValueError(
                f"power_dbm {self.power_dbm:g} is above power_max_dbm {self.power_max_dbm:g}, "
                "which would burn the modulators"
            )
        if self.resources[0] == self.resources[1]:
            raise ValueError("resources name the same generator twice")
        return self


class SRSPair:
    """Two generators as AOM1 and AOM2; both play the centre when opened, with RF off.

    They cannot change at the same moment: between the two settings lie some milliseconds, in which
    the difference is that of no step. Everything that is set is read back and compared exactly. If
    a setting is not confirmed, RF is taken off at both; the next pair that is confirmed turns it on
    again, if it was on. RF off is sent to both before anything is asked, and twice.

    Parameters
    ----------
    entry : Synthesizers
    context : BenchContext

    Raises
    ------
    BenchSetupError
        If the options are wrong, `step` is not 1 uHz, or the window leaves the generators' range.
    InstrumentError
        If a generator does not answer or confirm, is no SG380, or both run on their own clocks.
    """

    OPTIONS = SRSOptions

    def __init__(self, entry: Synthesizers, context: BenchContext) -> None:
        bench = context.description.name
        options = read_options(
            self.OPTIONS, entry.options, bench, "instruments.synthesizers.options"
        )
        _require_possible(entry, bench)
        self._centre_hz, self._window_hz = entry.centre_hz, entry.window_hz
        # Rounded down to what AMPR resolves, so that the maximum is not exceeded.
        power = Decimal(str(options.power_dbm)).quantize(Decimal("0.01"), ROUND_FLOOR)
        self._power_dbm = f"{power:.2f}"
        self._is_on = False
        self._confirmed: tuple[int, int] | None = None
        self._boxes: tuple[_Box, ...] = ()
        with ExitStack() as opened:
            opened.callback(self.close)
            for name, resource in zip(("AOM1", "AOM2"), options.resources, strict=True):
                self._boxes += (_Box(name, resource, options),)
            self._set_up(options.check_timebase)
            opened.pop_all()

    @property
    def identity(self) -> str:
        """Identities of both generators."""
        return " and ".join(box.identity for box in self._boxes)

    @property
    def step_hz(self) -> Fraction:
        """1 uHz, exactly."""
        return _STEP_HZ

    @property
    def echoes_registers(self) -> bool:
        """False: a frequency is played as soon as it is set, so ``FREQ?`` is what is played."""
        return False

    def set_pair(self, aom1_hz: Fraction, aom2_hz: Fraction) -> None:
        """Change both generators, one right after the other; see `SynthesizerPair.set_pair`."""
        steps = (self._nearest("AOM1", aom1_hz), self._nearest("AOM2", aom2_hz))
        confirmed, self._confirmed = self._confirmed, None
        try:
            for position, (box, step) in enumerate(zip(self._boxes, steps, strict=True)):
                if confirmed is None or step != confirmed[position]:
                    box.send("FREQ", _decimals(step))
            for box, step in zip(self._boxes, steps, strict=True):
                box.require("FREQ", _decimals(step))
            if confirmed is None and self._is_on:
                self._enable()
        except InstrumentError as error:
            self._raise_off(error)
        self._confirmed = steps

    def read_pair(self) -> tuple[Fraction, Fraction]:
        """Return what both generators say that they play; see `SynthesizerPair.read_pair`."""
        first, second = self._boxes
        return first.read("FREQ"), second.read("FREQ")

    def rf_on(self) -> None:
        """Enable both type-N outputs at their power; see `SynthesizerPair.rf_on`."""
        try:
            self._enable()
        except InstrumentError as error:
            self._confirmed = None
            self._raise_off(error)
        self._is_on = True

    def rf_off(self) -> None:
        """Disable both type-N outputs; see `SynthesizerPair.rf_off`.

        The command goes to both before either is asked, and to both twice, whatever they answer.
        """
        self._is_on = False
        errors = self._disable()
        if errors:
            raise InstrumentError("; ".join(errors))

    def close(self) -> None:
        """Take RF off where it may be on, without waiting for long, and hang up.

        May be called twice; raises nothing.
        """
        for box in self._boxes:
            if box.may_be_on:
                box.send_off()
        for box in self._boxes:
            box.close()

    def _nearest(self, name: str, hz: Fraction) -> int:
        # Written so that NaN is refused too.
        if not abs(hz - self._centre_hz) <= self._window_hz:
            raise LimitError(
                f"{_DEVICE}: {name} was asked for {float(hz):.16g} Hz, more than "
                f"{float(self._window_hz):.16g} Hz from {float(self._centre_hz):.16g} Hz; keep it "
                "inside the window"
            )
        return round(hz / _STEP_HZ)

    def _set_up(self, check_timebase: bool) -> None:
        errors = self._disable()
        if errors:
            raise InstrumentError("; ".join(errors))
        for box in self._boxes:
            box.set("MODL", "0")
        timebases = [int(box.read("TIMB")) for box in self._boxes] if check_timebase else []
        if timebases and _EXTERNAL not in timebases:
            raise InstrumentError(
                f"{_DEVICE}: both run on clocks of their own (TIMB? says {timebases[0]} and "
                f"{timebases[1]}), so their difference would drift; feed both with one 10 MHz, or "
                "one with that of the other, or set options.check_timebase to false"
            )
        self.set_pair(self._centre_hz, self._centre_hz)

    def _enable(self) -> None:
        for command, value in (("AMPR", self._power_dbm), ("ENBR", "1")):
            for box in self._boxes:
                box.set(command, value)

    def _disable(self) -> list[str]:
        """Disable both outputs twice, whatever they answer; return what was not confirmed."""
        errors: list[str] = []
        for _ in range(2):
            for box in self._boxes:
                box.send_off()
            errors = [error for box in self._boxes if (error := box.failure_of_off())]
        return errors

    def _raise_off(self, error: InstrumentError) -> NoReturn:
        left = self._disable()
        outcome = f"RF is not confirmed off ({'; '.join(left)})" if left else "RF is off at both"
        raise InstrumentError(f"{error}; the pair's state is unknown; {outcome}") from error


class _Box:
    """One generator, of which all that is set is read back; off from the first command on.

    Attributes
    ----------
    identity : str
    may_be_on : bool
        Whether the output was not confirmed to be off since it may have been enabled.
    """

    def __init__(self, name: str, resource: str, options: SRSOptions) -> None:
        self._place = f"{_DEVICE}, {name}, at {resource}"
        self.may_be_on = True
        self._line: VisaLine = open_visa(
            resource,
            options.timeout_s,
            f"{_DEVICE}, {name},",
            options.baud,
            make_safe=(_OFF,),
        )
        self.identity = self._line.identity
        if _LANGUAGE.match(self.identity):
            self.send_off()
        if not _MODEL.search(self.identity):
            self._line.close()
            raise InstrumentError(
                f"{self._place}: says that it is {self.identity!r}, no SG382, SG384 or SG386; "
                "check options.resources"
            )

    def send_off(self) -> None:
        """Disable the output, whatever becomes of it."""
        with suppress(InstrumentError):
            self._line.send(_OFF)

    def failure_of_off(self) -> str | None:
        """Return why the output is not confirmed to be off; None if it is."""
        try:
            self.require("ENBR", "0")
        except InstrumentError as error:
            return str(error)
        self.may_be_on = False
        return None

    def send(self, command: str, value: str) -> None:
        """Set without a look at what becomes of it."""
        self._line.send(f"{command} {value}")

    def read(self, command: str) -> Fraction:
        """Ask for a number, a second time if the first answer is none."""
        answer = ""
        for _ in range(2):
            answer = self._line.ask(f"{command}?")
            if _NUMBER.fullmatch(answer):
                return Fraction(answer)
        raise InstrumentError(
            f"{self._place}: answered {answer!r} to '{command}?', which is no number; check that "
            "the cable, and that no other program uses it"
        )

    def require(self, command: str, value: str) -> None:
        """Compare what is set with what should be; a second time if they differ."""
        answers = [self.read(command)]
        if answers[-1] != Fraction(value):
            answers.append(self.read(command))
        if answers[-1] != Fraction(value):
            raise InstrumentError(
                f"{self._place}: was asked for '{command} {value}' and reads "
                f"{float(answers[-1]):.16g}; check that it can do this, and that its front "
                "panel is not in use"
            )

    def set(self, command: str, value: str) -> None:
        """Set, and compare."""
        self.may_be_on |= command == "ENBR"
        self.send(command, value)
        self.require(command, value)

    def close(self) -> None:
        """Disable the output if it may be on, without waiting for long, and hang up."""
        if self.may_be_on:
            self.send_off()
            with suppress(InstrumentError), self._line.within(_CLOSING_S):
                self.failure_of_off()
        self._line.close()


def _decimals(steps: int) -> str:
    return f"{steps // 1_000_000}.{steps % 1_000_000:06d}"


def _require_possible(entry: Synthesizers, bench: str) -> None:
    if entry.step_hz != _STEP_HZ:
        raise BenchSetupError(
            f"bench {bench!r}: instruments.synthesizers.step: is {float(entry.step_hz):g} Hz, but "
            "an SG380 plays multiples of 1 uHz; write step: 1 uHz"
        )
    low_hz, high_hz = entry.centre_hz - entry.window_hz, entry.centre_hz + entry.window_hz
    if low_hz < _LOWEST_HZ or high_hz > _HIGHEST_HZ:
        raise BenchSetupError(
            f"bench {bench!r}: instruments.synthesizers.window: reaches from {float(low_hz):.10g} "
            f"to {float(high_hz):.10g} Hz, but the type-N output of an SG382 gives "
            f"{float(_LOWEST_HZ):.10g} to {float(_HIGHEST_HZ):.10g} Hz; narrow it"
        )
