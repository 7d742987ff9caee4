"""Novatech 409B: four synthesized channels in one box, of which the AOMs use the first two.

Its system clock of 2^32 x 0.1 Hz makes all frequencies exact multiples of 0.1 Hz; option /R locks
that clock to an external 10 MHz. Commands and answers are lines of ASCII on RS-232; sources are the
409B manual (firmware 2.1), Novatech's AN004 and the public drivers of labscript, ARTIQ and naqslab,
where they agree. Nothing here was tried on the instrument itself yet.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from itertools import takewhile
from typing import Final, NoReturn

from drivers.context import BenchContext
from drivers.errors import (
    InstrumentError,
    LimitError,
)
from drivers.options import read_options
from drivers.synthesizers.novatech_registers import (
    FULL_SCALE,
    STEP_HZ,
    NovatechOptions,
    Registers,
    commands_between,
    failure_of,
    require_possible,
)
from drivers.transport.serial_line import SerialLine
from protocols.bench import Synthesizers

_DEVICE: Final = "synthesizers (Novatech 409B)"
_CHANNELS: Final = 4

_CHANNEL_LINE: Final = re.compile(
    r"([0-9A-F]{8}) [0-9A-F]{4} ([0-9A-F]{4}) [0-9A-F]{4} [0-9A-F]{8} [0-9A-F]{8} [0-9A-F]{6}"
)
_LAST_LINE: Final = re.compile(r"[0-9A-F]{2} [0-9A-F]{6} [0-9A-F]{4} [0-9A-F]{4} ([0-9A-F]{2})")
# Five lines of status, and before them what was still on its way when it was asked for.
_MOST_LINES: Final = 20
# Chosen: how often a mark is sent to a box whose answers are out of step.
_TRIES: Final = 3
_OFF: Final = ("V0 0", "V1 0")
# How long RF off waits for one answer before the next command is sent all the same. Command and
# answer take 10 ms at 9600 baud, and an FTDI adapter keeps characters for 16 ms (its data sheet).
_OFF_PATIENCE_S: Final = 0.1

_REFUSALS: Final = {
    "?0": "unrecognized command",
    "?1": "bad frequency",
    "?2": "bad AM command",
    "?3": "input line too long",
    "?4": "bad phase",
    "?5": "bad time",
    "?6": "bad mode",
    "?7": "bad amplitude",
    "?8": "bad constant",
    "?f": "bad byte",
}
_REMEDY: Final = (
    "check power, cable and port, and that options.baud is the box's own rate (19200 unless it was "
    "changed); if the box or this computer is slow, raise options.timeout_s"
)


class Novatech409B:
    """Channels 0 and 1 of a 409B as AOM1 and AOM2; both play the centre when opened, with RF off.

    The box is kept in manual update (``I m``): commands fill registers, and one ``I p`` makes all
    outputs follow at the same moment. RF is off when both amplitudes are 0; never by a frequency of
    0, which makes the output a constant voltage (AN004). Nothing is ever saved in the box (``S``).

    Whether the status (``QUE``) shows registers or outputs while they differ is not documented, so
    it is found out when the box is opened, see `echoes_registers`. Where it shows registers, a
    status is no proof of an update, and every update is asked for twice: a second ``I p`` from the
    same registers changes nothing if the first was made.

    An update of both frequencies is 56 bytes on the wire, commands and answers, and takes 29.2 ms
    at 19200 baud (30.2 ms from 100 MHz up); of one frequency, 37 bytes and 19.3 ms. Where the
    status shows outputs, it is 47 bytes and 24.5 ms (25.5 ms), or 28 bytes and 14.6 ms. Reading
    back is 229 bytes and takes 119 ms. RF is off after 29 bytes and 15 ms; all that `rf_off` does
    to confirm it is 525 bytes and 0.28 s.

    Every command is answered; a command whose answer is missing or garbled is in doubt. Answers
    belong to commands by their order alone, so before anything else is believed, the box has to
    echo a mark that was never sent before: all earlier answers have come by then. A doubtful update
    counts as made only if the box confirms an ``I p`` and its status afterwards is what was to be.
    After an update that failed, the next one sets the box up again and sends all.

    Parameters
    ----------
    entry : Synthesizers
    context : BenchContext

    Raises
    ------
    BenchSetupError
        If the options are wrong, `step` is not 0.1 Hz, or the window leaves the box's range.
    InstrumentError
        If the box does not answer, or does not confirm RF off at the centre.
    """

    OPTIONS = NovatechOptions

    def __init__(self, entry: Synthesizers, context: BenchContext) -> None:
        bench = context.description.name
        options = read_options(
            self.OPTIONS, entry.options, bench, "instruments.synthesizers.options"
        )
        require_possible(entry, bench)
        self._options = options
        self._centre_hz, self._window_hz = entry.centre_hz, entry.window_hz
        # Rounded down, so that no share is exceeded.
        self._on_word = int(options.amplitude * FULL_SCALE)
        centre = round(entry.centre_hz / STEP_HZ)
        self._intended = Registers((centre, centre), (0, 0))
        self._confirmed: Registers | None = None
        self._in_doubt = self._may_be_lit = True
        self._in_step, self._marks, self._tries = True, 0, _TRIES
        self._is_manual, self._echoes_registers = False, True
        self._firmware = ""
        self._line = SerialLine(options.port, options.baud, options.timeout_s, _DEVICE)
        try:
            # Off first: all that follows can fail. The empty line ends what may lie in its input.
            self._send_all(("", *_OFF, "I p"))
            self._play(self._intended)
            self._echoes_registers = self._finds_registers_echoed()
            self.rf_off()
        except BaseException:
            self.close()
            raise

    @property
    def identity(self) -> str:
        """Model, port, firmware, and what its clock is locked to."""
        reference = "10 MHz reference (/R)" if self._options.external_reference else "own clock"
        return f"Novatech 409B at {self._options.port}, firmware {self._firmware}, {reference}"

    @property
    def step_hz(self) -> Fraction:
        """0.1 Hz, exactly."""
        return STEP_HZ

    @property
    def echoes_registers(self) -> bool:
        """Whether the status shows registers while outputs differ; see `SynthesizerPair`.

        True also if that could not be found out.
        """
        return self._echoes_registers

    def set_pair(self, aom1_hz: Fraction, aom2_hz: Fraction) -> None:
        """Change both channels in one update; see `SynthesizerPair.set_pair`."""
        steps = (self._nearest("AOM1", aom1_hz), self._nearest("AOM2", aom2_hz))
        self._play(replace(self._intended, steps=steps))

    def read_pair(self) -> tuple[Fraction, Fraction]:
        """Return what the box says that both channels play; see `SynthesizerPair.read_pair`.

        If `echoes_registers`, this is what was written, whether or not the outputs followed.

        Raises
        ------
        InstrumentError
            Also after an update that failed, because the status may show then what is not played.
        """
        if self._in_doubt:
            raise InstrumentError(
                f"{self._place}: was asked what it plays after an update that failed, which its "
                "status does not show; set the pair again, and check cable and earth"
            )
        registers = self._read_status()
        if self._confirmed not in (None, registers):
            # Noise can make one digit of another, but hardly the same twice.
            registers = self._read_status()
            if registers != self._confirmed:
                self._confirmed = None
        aom1, aom2 = registers.steps
        return aom1 * STEP_HZ, aom2 * STEP_HZ

    def rf_on(self) -> None:
        """Give both channels their amplitude; see `SynthesizerPair.rf_on`."""
        self._may_be_lit = True
        on = replace(self._intended, amplitudes=(self._on_word, self._on_word))
        self._play(on, read_back=True)

    def rf_off(self) -> None:
        """Take both amplitudes to 0; see `SynthesizerPair.rf_off`.

        It is done in two ways, both in any case: by an update, which is sent before anything is
        asked and whatever state the line is in; then in automatic update (``I a``), where each
        command takes effect at once, so that the status shows what the outputs give.

        Raises
        ------
        InstrumentError
            If the status does not show that both outputs are off.
        """
        self._intended = replace(self._intended, amplitudes=(0, 0))
        confirmed, self._confirmed = self._confirmed, None
        self._in_doubt = True
        # A box that says nothing would be waited for three times in each of the two ways.
        self._tries = 1
        try:
            by_update = failure_of(self._off_by_update)
            at_once = failure_of(self._off_at_once)
        finally:
            self._tries = _TRIES
        if at_once is not None and (by_update is not None or self._echoes_registers):
            causes = dict.fromkeys(
                str(error).removeprefix(f"{self._place}: ")
                for error in (by_update, at_once)
                if error
            )
            raise InstrumentError(
                f"{self._place}: RF off was sent in two ways and is not confirmed; take the power "
                f"off the modulators' amplifiers ({'; then '.join(causes)})"
            ) from at_once
        self._may_be_lit = self._in_doubt = False
        if self._is_manual:
            self._confirmed = confirmed and self._intended

    def close(self) -> None:
        """Take RF off if it may be on, without waiting for long, and close the port.

        Frequencies stay. May be called twice; raises nothing.
        """
        if self._may_be_lit:
            self._may_be_lit = self._in_step = False
            with suppress(InstrumentError):
                self._send_all((*_OFF, "I p", "I a", *_OFF, "I m"))
        self._line.close()

    def _nearest(self, name: str, hz: Fraction) -> int:
        # Written so that NaN is refused too.
        if not abs(hz - self._centre_hz) <= self._window_hz:
            raise LimitError(
                f"{_DEVICE}: {name} was asked for {float(hz):.10g} Hz, more than "
                f"{float(self._window_hz):.10g} Hz from {float(self._centre_hz):.10g} Hz; keep it "
                "inside the window"
            )
        return round(hz / STEP_HZ)

    def _play(self, target: Registers, read_back: bool = False) -> None:
        """Bring the box from what is confirmed, or from anywhere, to a target."""
        confirmed, self._confirmed = self._confirmed, None
        self._in_doubt = True
        if confirmed is None:
            self._set_up()
        commands = commands_between(confirmed, target)
        self._update(commands, target.steps, target.amplitudes, read_back or confirmed is None)
        self._intended = self._confirmed = target
        self._in_doubt = False

    def _set_up(self) -> None:
        """Make the box speak and update as this driver expects."""
        self._obeys("E d")
        self._read_status()
        # Single tone, phase-continuous, manual update.
        for command in ("M 0", "M n", "I m"):
            self._require_obeyed(command)
        self._is_manual = True

    def _finds_registers_echoed(self) -> bool:
        """Return whether the status shows registers that no output follows yet.

        RF is off: the register of a frequency is changed by one step and back, without an update.
        """
        intended, confirmed, self._confirmed = self._intended, self._confirmed, None
        aom1, aom2 = intended.steps
        other = replace(intended, steps=(aom1 + 1, aom2))
        (change,), (restore,) = commands_between(intended, other), commands_between(other, intended)
        is_changed = self._obeys(change)
        # Twice, because noise can make one digit of another, but hardly the same twice.
        shown = {self._read_status().steps[0] for _ in range(2)}
        self._require_obeyed(restore)
        self._confirmed = confirmed
        return not (is_changed and shown == {aom1})

    def _off_by_update(self) -> None:
        self._send_all((*_OFF, "I p"))
        self._require(None, (0, 0), ", ".join((*_OFF, "I p")))

    def _off_at_once(self) -> None:
        commands = ("I a", *_OFF)
        self._is_manual = False
        try:
            if not self._send_all(commands):
                for command in commands:
                    self._require_obeyed(command)
            self._require(None, (0, 0), ", ".join(commands))
        except InstrumentError:
            with suppress(InstrumentError):
                self._send_all(("I m",))
            raise
        # If this fails the next update sets the box up again.
        with suppress(InstrumentError):
            self._is_manual = self._obeys("I m") or self._obeys("I m")

    def _send_all(self, commands: Sequence[str]) -> bool:
        """Send commands whatever becomes of their answers; return whether all are confirmed.

        Each waits for its answer for a moment only. On a line that is out of step no answer is
        believed.
        """
        in_step, self._in_step = self._in_step, False
        answers = []
        for command in commands:
            self._line.write(command, discard=not in_step)
            answer = self._answer(command, commands, _OFF_PATIENCE_S)
            if answer is not None:
                answers.append(answer)
        # Answers that are late come in their order.
        while in_step and len(answers) < len(commands):
            answer = self._answer(commands[-1], commands)
            if answer is None:
                return False
            answers.append(answer)
        self._in_step = in_step and {"OK", *_REFUSALS}.issuperset(answers)
        return self._in_step and set(answers) == {"OK"}

    def _update(
        self,
        commands: Sequence[str],
        steps: tuple[int, int] | None,
        amplitudes: tuple[int, int],
        read_back: bool,
    ) -> None:
        """Fill registers, make the outputs follow at once, and make sure of it.

        Frequencies do not matter if `steps` is None.
        """
        if commands:
            doubts = [command for command in commands if not self._obeys(command)]
            wanted, made = 2 if self._echoes_registers else 1, 0
            for _ in range(wanted + 1):
                made += self._obeys("I p")
                if made == wanted:
                    break
                if not self._in_step:
                    # The outputs may not have followed although the registers are right. Another
                    # update from the same registers changes nothing if the first was made.
                    self._require(steps, amplitudes, "I p")
            else:
                self._raise_unconfirmed("I p")
            read_back = read_back or bool(doubts)
        if read_back:
            self._require(steps, amplitudes, ", ".join(commands) or "QUE")

    def _require(
        self, steps: tuple[int, int] | None, amplitudes: tuple[int, int], after: str
    ) -> None:
        for _ in range(2):
            read = self._read_status()
            target = Registers(read.steps if steps is None else steps, amplitudes)
            if read == target:
                return
        raise InstrumentError(
            f"{self._place}: reads {read} after {after!r}, not {target}; its outputs are unknown, "
            "switch RF off, and check cable and earth"
        )

    def _obeys(self, command: str) -> bool:
        """Send a command; return whether the box confirms it.

        Raises
        ------
        InstrumentError
            If the box refuses the command, or cannot be brought in step.
        """
        self._get_in_step()
        # Until the answer is here: who gives up in between (Ctrl-C) leaves it on its way.
        self._in_step = False
        answer = self._ask(command)
        self._in_step = answer == "OK" or answer in _REFUSALS
        if answer in _REFUSALS:
            raise InstrumentError(
                f"{self._place}: refused {command!r} with {answer!r} ({_REFUSALS[answer]}); its "
                "outputs are unknown, switch RF off, and check that it is a 409B with firmware "
                "2.1 or later"
            )
        return self._in_step

    def _require_obeyed(self, command: str) -> None:
        """Send a command that may be said twice until the box confirms it."""
        if not (self._obeys(command) or self._obeys(command)):
            self._raise_unconfirmed(command)

    def _read_status(self) -> Registers:
        """Ask for the status, a second time if need be."""
        for _ in range(2):
            self._get_in_step()
            self._in_step = False
            status = self._status()
            self._in_step = status is not None
            if status is not None:
                return status
        raise InstrumentError(
            f"{self._place}: was asked 'QUE' twice and gave no status of five lines; {_REMEDY}"
        )

    def _get_in_step(self) -> None:
        """After an answer that did not come as it should, wait until none is on its way."""
        for _ in range(self._tries):
            if self._in_step:
                return
            self._marks += 1
            mark = f"#{self._marks}"
            self._ask("E e")
            self._line.write(mark)
            # A mark is no command. Without its refusal, a loop in the cable would echo it too.
            self._in_step = (
                self._hears(mark) and self._answer(mark) == "?0" and self._ask("E d") == "OK"
            )
        if not self._in_step:
            raise InstrumentError(f"{self._place}: was asked to echo a mark and did not; {_REMEDY}")

    def _hears(self, mark: str) -> bool:
        lines = (self._line.read(mark) for _ in range(_MOST_LINES))
        return mark in takewhile(lambda line: line is not None, lines)

    def _ask(self, command: str) -> str | None:
        """Send a line and return the first of its answer; None if there is none in time."""
        self._line.write(command)
        return self._answer(command)

    def _answer(
        self, command: str, sent: Sequence[str] = (), patience_s: float | None = None
    ) -> str | None:
        for _ in range(_MOST_LINES):
            answer = self._line.read(command, patience_s)
            # With echo on, the command itself comes first.
            if answer is None or answer not in ("", command, *sent):
                return answer
        return None

    def _status(self) -> Registers | None:
        self._line.write("QUE")
        channels: list[tuple[int, int]] = []
        for _ in range(_MOST_LINES):
            line = self._line.read("QUE")
            if line is None:
                return None
            if found := _CHANNEL_LINE.fullmatch(line):
                channels.append((int(found[1], 16), int(found[2], 16)))
            elif found := _LAST_LINE.fullmatch(line):
                if len(channels) != _CHANNELS:
                    return None
                self._firmware = ".".join(found[1])
                (aom1, amplitude1), (aom2, amplitude2) = channels[:2]
                return Registers((aom1, aom2), (amplitude1, amplitude2))
        return None

    @property
    def _place(self) -> str:
        return f"{_DEVICE} at {self._options.port}"

    def _raise_unconfirmed(self, command: str) -> NoReturn:
        raise InstrumentError(
            f"{self._place}: did not confirm {command!r}, sent twice; its outputs are unknown, "
            f"switch RF off; {_REMEDY}"
        )
