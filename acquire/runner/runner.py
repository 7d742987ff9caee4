"""Measure one sweep on one bench, with a state machine that controls all instruments."""

import functools
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Final

from acquire.runner.measuring import StepAcquisition
from acquire.runner.orders import Orders, signals_obeyed
from acquire.runner.received_frames import received
from acquire.runner.recorder import Recorder, StepReport
from acquire.runner.summary import RunState, RunSummary
from drivers.errors import InstrumentError, note_unconfirmed, unconfirmed_in
from drivers.roles import Bench
from drivers.safe_off import RAMP_S, safe_off
from protocols.plan import Plan
from protocols.step import Step
from runs.errors import SilentDiskError
from runs.layout import Interruption, RunLabels
from runs.verdict import ReadBack, Verdict
from runs.writer import stamp

__all__ = [
    "RAMP_S",
    "RunLabels",
    "RunState",
    "RunSummary",
    "Runner",
    "StepReport",
    "run",
    "safe_off",
]

# Largest ratio of volts that are changed without a ramp. Chosen: the volts of a shipped protocol
# change by less from step to step.
_MAX_JUMP: Final = 1.25
# Reason of a run that an order has stopped.
_ON_REQUEST: Final = "stopped on request"
# What to check first if many steps one after another have the same verdict.
_CABLES: Final[Mapping[Verdict, str]] = {
    Verdict.NO_SIGNAL: (
        "the tweeter's cable and amplifier, then laser, shutters, and the cables from the "
        "synthesizers to the modulators"
    ),
    Verdict.LOCK: "the 10 MHz cables, and those from the synthesizers to the modulators",
    Verdict.SETTINGS: "the front panels of synthesizers and generator",
    Verdict.DROPPED: "the camera's bus cable and its trigger cable",
    Verdict.DISORDERED: "the camera's bus cable and its trigger cable",
    Verdict.PARTIAL: "the camera's bus cable",
    Verdict.STALE: "the camera's trigger cable",
    Verdict.LIGHT: "the laser, the lamp and the shutters",
    Verdict.UNSTEADY: "vibrations of the table, and the tweeter's amplifier",
    Verdict.SATURATED: "the shutters and the power of the laser",
    Verdict.SKIPPED: "the cable of the instrument that failed",
}

# States that may follow each state; `Runner` draws them.
_NEXT: Final = {
    RunState.IDLE: {RunState.OPENING},
    RunState.OPENING: {RunState.STEPPING, RunState.CLOSING, RunState.FAILED},
    RunState.STEPPING: {RunState.PAUSED, RunState.CLOSING},
    RunState.PAUSED: {RunState.STEPPING, RunState.CLOSING},
    RunState.CLOSING: {RunState.COMPLETE, RunState.INTERRUPTED, RunState.FAILED},
}


def run(
    plan: Plan,
    bench: Bench,
    path: str | Path,
    labels: RunLabels | None = None,
    progress: Callable[[StepReport], None] | None = None,
    *,
    announce: Callable[[str], None] | None = None,
    resume: bool = False,
    orders: Orders | None = None,
) -> RunSummary:
    """Measure a whole plan on an open bench.

    On the main thread, Ctrl-C and every other signal that would end the process stop the run after
    the present step; a second one gives up that step. SIGUSR1 and Ctrl-Z pause the run, SIGUSR2
    continues it. However the run ends, the tweeter is ramped down, and its output and the RF are
    switched off before this function returns.

    Parameters
    ----------
    plan : Plan
    bench : Bench
        Open bench; it stays open.
    path : str or Path
        Path of the run file, which must not exist. The documents are written next to it.
    labels : RunLabels, optional
        Labels that the operator gives the run.
    progress : callable, optional
        Called with a `StepReport` of every recorded step, on another thread. An exception that it
        raises stops the run.
    announce : callable, optional
        Called with a text about pauses, and about instruments that failed and work again.
    resume : bool
        True if `path` is a run to continue, see `acquire.runner.resuming`.
    orders : Orders, optional
        Orders to the run. If given, the caller must convert signals to orders.

    Raises
    ------
    ProtocolError
        If the bench cannot carry out the plan; no instrument was used.
    RunFileError
        If the run cannot be written to `path`.
    InstrumentError, LimitError
        If an instrument failed. Steps before are in the file. Outputs that are not confirmed off
        are in the notes of the exception, and in its `unconfirmed`.
    """
    report, place = progress or (lambda _: None), Path(path)
    if resume:
        recorder = functools.partial(Recorder.resume, plan, bench, place, report)
    else:
        recorder = functools.partial(
            Recorder.create, plan, bench, place, labels or RunLabels(), report
        )
    with ExitStack() as obeying:
        if orders is None:
            orders = Orders()
            obeying.enter_context(signals_obeyed(orders))
        return Runner(plan, bench, place, recorder, announce or (lambda _: None), orders).execute()


class Runner:
    """Measure one plan, once.

    ::

        idle ─→ opening ─→ stepping ←──→ paused        closing ─┬→ complete
                   │        │   ↑ one step:   │           ↑     ├→ interrupted
                   │        ├───┘ set pair,   └───────────┤     └→ failed
                   │        │     set generator, settle,  │
                   │        │     grab, submit            │
                   │        └─────────────────────────────┤
                   ├──────────────────────────────────────┘
                   └→ failed (before anything was switched on)

    Orders are obeyed before each step only. While the run is paused, all outputs are off. Every way
    out of `opening`, `stepping` and `paused` leads through `closing`, which switches the bench off
    and then closes the files.

    Parameters
    ----------
    plan : Plan
    bench : Bench
        Open bench.
    path : Path
        Path of the run file.
    recorder : callable
        Function that opens the run file, a new one or one to continue.
    announce : callable
        See `run`.
    orders : Orders, optional

    Attributes
    ----------
    orders : Orders
        Orders to the run.
    """

    def __init__(
        self,
        plan: Plan,
        bench: Bench,
        path: Path,
        recorder: Callable[[], Recorder],
        announce: Callable[[str], None],
        orders: Orders | None = None,
    ) -> None:
        self._plan, self._bench, self._path = plan, bench, path
        self._open_recorder, self._announce = recorder, announce
        self.orders = orders or Orders()
        self._state = RunState.IDLE
        self._camera_starts = 0
        self._exposure_s: Fraction | None = None
        # None means that the output is off.
        self._volts: float | None = None
        self._unconfirmed: tuple[str, ...] = ()

    @property
    def state(self) -> RunState:
        """Return the present state."""
        return self._state

    def execute(self) -> RunSummary:
        """Measure the plan; see `run` for results and errors.

        Raises
        ------
        RuntimeError
            If it is called a second time.
        """
        started_s = time.monotonic()
        self._enter(RunState.OPENING)
        try:
            self._plan.require_possible()
            recorder, reason = self._record()
        except BaseException as error:
            note_unconfirmed(error, self._unconfirmed)
            self._enter(RunState.FAILED)
            raise
        outcome = RunState.INTERRUPTED if reason else RunState.COMPLETE
        self._enter(outcome)
        return RunSummary(
            path=self._path,
            status=outcome,
            reason=reason,
            ended_by="" if not reason else "person" if reason == _ON_REQUEST else "policy",
            counts=recorder.counts,
            steps=len(self._plan.steps),
            repeated=sum(max(takes - 1, 0) for takes in recorder.attempts),
            duration_s=time.monotonic() - started_s,
            unconfirmed=self._unconfirmed,
            remarks=recorder.remarks,
        )

    def _record(self) -> tuple[Recorder, str]:
        """Open the run file and measure; return its recorder, and why the run was interrupted."""
        recorder = self._open_recorder()
        with recorder:
            try:
                reason = self._measure(recorder)
            except KeyboardInterrupt:
                reason = _ON_REQUEST
            except SilentDiskError as error:
                # To leave the recorder is to wait for the disk.
                self._announce(str(error))
                raise
            recorder.finish("interrupted" if reason else "complete", reason)
        return recorder, reason

    def _measure(self, recorder: Recorder) -> str:
        """Measure all steps and switch the bench off; return why the run ends early, or empty."""
        try:
            with self.orders.given_up_at(2):
                # If the run was stopped already, no instrument is switched on.
                if self.orders.stopped:
                    return _ON_REQUEST
                self._open_instruments()
                self._enter(RunState.STEPPING)
                return self._measure_all(recorder)
        finally:
            self._enter(RunState.CLOSING)
            self._switch_off()

    def _switch_off(self) -> None:
        """Switch the bench off, and say at once what is not confirmed."""
        try:
            self._unconfirmed = safe_off(self._bench)
        except KeyboardInterrupt as stop:
            self._unconfirmed = unconfirmed_in(stop)
            raise
        finally:
            for what in self._unconfirmed:
                self._announce(f"NOT CONFIRMED OFF, check the instrument: {what}")

    def _open_instruments(self) -> None:
        bench = self._bench
        bench.generator.output_off()
        self._configure(self._exposure_s or self._plan.steps[self._plan.sequence[0]].exposure_s)
        bench.synthesizers.rf_on()
        bench.camera.start()
        self._camera_starts += 1
        self._volts = None

    def _configure(self, exposure_s: Fraction) -> None:
        rate_hz = self._plan.protocol.camera.frame_rate_hz
        self._bench.camera.configure(rate_hz, exposure_s, self._plan.frame_shape)
        self._exposure_s = exposure_s

    def _measure_all(self, recorder: Recorder) -> str:
        """Measure pending steps, then bad steps again; return why the run ends early, or empty."""
        policy = self._plan.protocol.policy.bad_step
        # If a bad step had stopped the run, measure it again if there is space for an attempt.
        again = policy.then == "stop" and recorder.spare > 0
        verdicts = recorder.verdicts
        todo = [
            k
            for k in self._plan.sequence
            if not verdicts[k].measured or (again and _bad(verdicts[k]))
        ]
        for number, position in enumerate(todo, 1):
            if not self._take(recorder, position):
                return _ON_REQUEST
            if policy.then == "stop" and not self._is_good(recorder, position):
                return _ON_REQUEST if self.orders.stopped else self._bad_step(recorder, position)
            if number == len(todo):
                recorder.settle()
            if reason := self._given_up(recorder.verdicts, todo[:number]):
                return reason
        for _ in range(policy.retries if policy.then == "skip" else 0):
            recorder.settle()
            bad = [k for k, verdict in enumerate(recorder.verdicts) if _bad(verdict)]
            # Too many bad steps have a common cause, so measuring them again does not help. Before
            # a run is continued, the operator may have removed that cause.
            most = recorder.spare if recorder.resumed else self._plan.max_retries
            if len(bad) > min(most, recorder.spare):
                break
            for position in bad:
                if not self._take(recorder, position):
                    return _ON_REQUEST
        return ""

    def _given_up(self, verdicts: Sequence[Verdict], taken: Sequence[int]) -> str:
        """Return why to stop if all of the last steps are bad; empty if they are not."""
        limit = self._plan.protocol.policy.give_up_after
        # The newest steps may not be judged yet.
        judged = [verdicts[k] for k in taken if verdicts[k] is not Verdict.PENDING]
        last = judged[-limit:]
        if len(last) < limit or not all(_lost(verdict) for verdict in last):
            return ""
        counts = Counter(last)
        listed = ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
        return (
            f"{limit} steps one after another are bad ({listed}); check "
            f"{_CABLES[counts.most_common(1)[0][0]]}; then continue with --resume"
        )

    def _bad_step(self, recorder: Recorder, position: int) -> str:
        step, verdict = self._plan.steps[position], recorder.verdicts[position]
        return (
            f"step {step.index} is {verdict} after {recorder.attempts[position]} attempts, and the "
            "policy of the protocol (bad_step) is to stop; see the sentence of this step"
        )

    def _is_good(self, recorder: Recorder, position: int) -> bool:
        """Return whether a step is good, after measuring it again as often as the policy allows."""
        for _ in range(self._plan.protocol.policy.bad_step.retries):
            recorder.settle()
            if not _bad(recorder.verdicts[position]) or not recorder.spare:
                break
            if not self._take(recorder, position):
                return False
        recorder.settle()
        return not _bad(recorder.verdicts[position])

    def _take(self, recorder: Recorder, position: int) -> bool:
        """Measure one step, with pauses and retries; return False if the run has to stop."""
        policy = self._plan.protocol.policy.instrument_error
        attempts = 0
        while True:
            self._hold(recorder, position)
            if self.orders.stopped:
                return False
            try:
                recorder.submit(self._acquire(position))
                return True
            except InstrumentError as error:
                attempts += 1
                if attempts > policy.retries and policy.then == "stop":
                    recorder.mark(position, Verdict.INTERRUPTED, str(error))
                    raise
                self._recover(recorder, position, error)
                if attempts > policy.retries:
                    recorder.mark(position, Verdict.SKIPPED, str(error))
                    return True
            except BaseException as error:
                reason = str(error) or "given up after a second Ctrl-C"
                recorder.mark(position, Verdict.INTERRUPTED, reason)
                raise

    def _hold(self, recorder: Recorder, position: int) -> None:
        """If a pause is ordered, switch all outputs off, wait, and open the instruments again."""
        if not self.orders.paused:
            return
        began = self._now()
        self._enter(RunState.PAUSED)
        self._require_off("to pause")
        self._announce(f"paused, all outputs are off; continue with: acquire continue {self._path}")
        self.orders.wait()
        if self.orders.stopped:
            return
        self._open_instruments()
        self._enter(RunState.STEPPING)
        recorder.add_interruption(
            Interruption(position, "paused", began, self._now(), "a pause was requested")
        )
        self._announce("continuing")

    def _recover(self, recorder: Recorder, position: int, error: InstrumentError) -> None:
        """Switch all outputs off and on again after an instrument failed.

        Raises
        ------
        InstrumentError
            The first error, if the bench cannot be switched off or on.
        """
        began = self._now()
        try:
            self._require_off("after an instrument failed")
            self._open_instruments()
        except InstrumentError as second:
            recorder.mark(position, Verdict.INTERRUPTED, str(error))
            error.add_note(str(second))
            raise error from second
        recorder.add_interruption(
            Interruption(position, "recovered", began, self._now(), str(error))
        )
        self._announce(f"all outputs were switched off and on again, because of: {error}")

    def _now(self) -> str:
        """Return the bench's date and time."""
        return stamp(self._bench.clock.date())

    def _require_off(self, when: str) -> None:
        """Switch all outputs off; raise an error if one of them is not confirmed off."""
        unconfirmed = safe_off(self._bench)
        self._volts = None
        if unconfirmed:
            raise InstrumentError(
                f"the bench was switched off {when}, but not all outputs are confirmed off: "
                f"{'; '.join(unconfirmed)}; check them before you continue"
            )

    def _acquire(self, position: int) -> StepAcquisition:
        """Set one step, wait until it has settled, and take its frames."""
        bench, step = self._bench, self._plan.steps[position]
        settle_s = float(step.settle_s)
        if step.exposure_s != self._exposure_s:
            bench.camera.stop()
            self._configure(step.exposure_s)
            bench.camera.start()
            self._camera_starts += 1
        bench.synthesizers.set_pair(step.aom1_hz, step.aom2_hz)
        self._drive(step)
        changed_s = bench.camera.now_s()
        # Read while the reed settles, so that it costs no time; and again after the frames, to know
        # that the settings were the same while they were exposed.
        before = self._read_back(step)
        bench.clock.wait(changed_s + settle_s - bench.camera.now_s())
        grabbed = bench.camera.grab(step.frames, changed_s + settle_s)
        after = self._read_back(step)
        frames = received(grabbed, changed_s, self._plan.frame_shape)
        return StepAcquisition(
            position, step, before, after, changed_s, frames, self._camera_starts
        )

    def _drive(self, step: Step) -> None:
        """Set the generator, with a ramp if the volts change by more than `_MAX_JUMP`."""
        generator, volts = self._bench.generator, self._volts
        if not step.volts:
            # For a reed at rest, the output stays off, as it is since the instruments were opened.
            return
        if volts is not None:
            # If the output has tripped, a driver might switch it on again. That must not happen.
            self._require_on(step)
        if volts is not None and max(volts, step.volts) <= _MAX_JUMP * min(volts, step.volts):
            generator.set_sine(step.drive_hz, step.volts)
        else:
            if volts is not None:
                generator.ramp_to(0.0, RAMP_S)
            generator.set_sine(step.drive_hz, 0.0)
            generator.ramp_to(step.volts, RAMP_S)
        self._volts = step.volts

    def _read_back(self, step: Step) -> ReadBack:
        if not step.volts:
            return ReadBack(*self._bench.synthesizers.read_pair(), Fraction(0), 0.0)
        drive_hz, volts = self._require_on(step)
        return ReadBack(*self._bench.synthesizers.read_pair(), drive_hz, volts)

    def _require_on(self, step: Step) -> tuple[Fraction, float]:
        """Return the generator's frequency and volts; raise an error if its output is off."""
        drive_hz, volts, on = self._bench.generator.read()
        if not on:
            raise InstrumentError(
                f"generator: its output is off at step {step.index}, but this run had switched it "
                "on; look for an overload, a short circuit or a tripped limit"
            )
        return drive_hz, volts

    def _enter(self, state: RunState) -> None:
        if state not in _NEXT.get(self._state, ()):
            raise RuntimeError(f"a run that is {self._state} cannot become {state}")
        self._state = state


def _bad(verdict: Verdict) -> bool:
    """Return whether measuring a step again can help; it cannot if there is too little light."""
    return verdict.measured and verdict not in (Verdict.OK, Verdict.UNPROVEN)


def _lost(verdict: Verdict) -> bool:
    """Return whether a step gave no usable data, for example because a cable is off."""
    return verdict is Verdict.SKIPPED or _bad(verdict)
