"""One sweep on one bench: the state machine that owns the instruments while they run."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Final

from acquire.runner.measuring import Acquisition
from acquire.runner.orders import Orders, signals_obeyed
from acquire.runner.received_frames import received
from acquire.runner.recorder import Recorder, StepReport
from acquire.runner.summary import RunState, RunSummary
from drivers.errors import InstrumentError, note_unconfirmed
from drivers.roles import Bench
from drivers.safe_off import RAMP_S, safe_off
from protocols.plan import Plan
from protocols.step import Step
from runs.layout import Interruption, RunLabels
from runs.verdict import ReadBack, Verdict
from runs.writer import now

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

# From step to step of a sweep volts grow by less than this factor; beyond, they are ramped.
_JUMP: Final = 1.25
_ASKED: Final = "stopped on request"
# Where to look first when step after step has the same verdict.
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
    Verdict.UNSTEADY: "what shakes the table, and the tweeter's amplifier",
    Verdict.SATURATED: "the shutters and the power of the laser",
    Verdict.SKIPPED: "the cable of the instrument that failed",
}


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

    On the main thread, Ctrl-C and every other signal that would end the process end the run at the
    next step boundary; a second one gives up the step in work. SIGUSR1 and Ctrl-Z pause the run,
    SIGUSR2 goes on with it. However the run ends, the tweeter is ramped down and its output and the
    RF are switched off before this returns.

    Parameters
    ----------
    plan : Plan
    bench : Bench
        Stays open.
    path : str or Path
        Of the run file, which must not exist; the documents are written next to it.
    labels : RunLabels, optional
        What a person says about the run.
    progress : callable, optional
        Called with every recorded step, on another thread. What it raises stops the run.
    announce : callable, optional
        Called with words about pauses, and about instruments that failed and came back.
    resume : bool
        Whether `path` is that of a run to go on with, see `acquire.runner.resuming`.
    orders : Orders, optional
        What others ask of the run. If given, whoever gives it takes care of signals.

    Returns
    -------
    RunSummary
        Of a complete or interrupted run.

    Raises
    ------
    ProtocolError
        If the bench cannot carry out the plan; no instrument was touched.
    RunFileError
        If the run cannot be kept at `path`.
    InstrumentError, LimitError
        If an instrument failed. Steps recorded before are in the file. What is not confirmed to be
        off is in the exception's notes, and in its `unconfirmed`.
    """
    report = progress or (lambda _: None)

    def recorder() -> Recorder:
        if resume:
            return Recorder.resume(plan, bench, Path(path), report)
        return Recorder.create(plan, bench, Path(path), labels or RunLabels(), report)

    with ExitStack() as obeying:
        if orders is None:
            orders = Orders()
            obeying.enter_context(signals_obeyed(orders))
        runner = Runner(plan, bench, Path(path), recorder, announce or (lambda _: None), orders)
        return runner.execute()


class Runner:
    """Carries out one plan, once.

    ::

        idle ─→ opening ─→ stepping ←──→ paused        closing ─┬→ complete
                   │        │   ↑ one step:   │           ↑     ├→ interrupted
                   │        ├───┘ set pair,   └───────────┤     └→ failed
                   │        │     set generator, settle,  │
                   │        │     grab, hand over         │
                   │        └─────────────────────────────┤
                   ├──────────────────────────────────────┘
                   └→ failed (before anything was switched on)

    Orders are looked at before each step only. While paused, all is off. `closing` is entered on
    every way out of `opening`, `stepping` and `paused`: it makes the bench safe first, and closes
    the files after.

    Parameters
    ----------
    plan : Plan
    bench : Bench
        Open.
    path : Path
        Of the run file.
    recorder : callable
        Opens the run file, new or to be gone on with.
    announce : callable
        See `run`.
    orders : Orders, optional

    Attributes
    ----------
    orders : Orders
        What others ask of the run.
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
        # None is an output that is off.
        self._volts: float | None = None
        self._unconfirmed: tuple[str, ...] = ()

    @property
    def state(self) -> RunState:
        """Where the run stands."""
        return self._state

    def execute(self) -> RunSummary:
        """Measure; see `run`.

        Raises
        ------
        RuntimeError
            If called a second time.
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
            ended_by="" if not reason else "person" if reason == _ASKED else "policy",
            counts=recorder.counts,
            steps=len(self._plan.steps),
            retaken=sum(max(takes - 1, 0) for takes in recorder.takes),
            duration_s=time.monotonic() - started_s,
            unconfirmed=self._unconfirmed,
            remarks=recorder.remarks,
        )

    def _record(self) -> tuple[Recorder, str]:
        """Measure into the run file; return its recorder, and why the run was interrupted."""
        recorder = self._open_recorder()
        with recorder:
            try:
                reason = self._measure(recorder)
            except KeyboardInterrupt:
                reason = _ASKED
            recorder.finish("interrupted" if reason else "complete", reason)
        return recorder, reason

    def _measure(self, recorder: Recorder) -> str:
        """Use the instruments, and leave them safe; return why steps are left, empty if none is."""
        try:
            with self.orders.given_up_at(2):
                # Nothing is switched on for a run that is to end.
                if self.orders.stopped:
                    return _ASKED
                self._open_instruments()
                self._enter(RunState.STEPPING)
                return self._take_all(recorder)
        finally:
            self._enter(RunState.CLOSING)
            self._unconfirmed = safe_off(self._bench)

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

    def _take_all(self, recorder: Recorder) -> str:
        """Take what is to be taken, then what turned out bad again; return why the run ends early.

        Empty if it does not.
        """
        policy = self._plan.protocol.policy.bad_step
        # A run that was ended by a bad step goes on with it, if there is room for another take.
        again = policy.then == "stop" and recorder.spare > 0
        verdicts = recorder.verdicts
        todo = [
            k
            for k in self._plan.sequence
            if not verdicts[k].measured or (again and _bad(verdicts[k]))
        ]
        for number, position in enumerate(todo, 1):
            if not self._take(recorder, position):
                return _ASKED
            if policy.then == "stop" and not self._good(recorder, position):
                return _ASKED if self.orders.stopped else self._bad_step(recorder, position)
            if number == len(todo):
                recorder.settle()
            if reason := self._given_up(recorder.verdicts, todo[:number]):
                return reason
        for _ in range(policy.retries if policy.then == "skip" else 0):
            recorder.settle()
            bad = [k for k, verdict in enumerate(recorder.verdicts) if _bad(verdict)]
            # If so many are bad the trouble is not theirs; unless it was mended meanwhile.
            most = recorder.spare if recorder.resumed else self._plan.max_retries
            if len(bad) > min(most, recorder.spare):
                break
            for position in bad:
                if not self._take(recorder, position):
                    return _ASKED
        return ""

    def _given_up(self, verdicts: Sequence[Verdict], taken: Sequence[int]) -> str:
        """Return why to stop if the last steps are bad one after another; empty if they are not."""
        limit = self._plan.protocol.policy.give_up_after
        # The last ones may not have been judged yet.
        judged = [verdicts[k] for k in taken if verdicts[k] is not Verdict.PENDING]
        last = judged[-limit:]
        if len(last) < limit or not all(_lost(verdict) for verdict in last):
            return ""
        counts = Counter(last)
        listed = ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
        return (
            f"{limit} steps one after another are bad ({listed}); look at "
            f"{_CABLES[counts.most_common(1)[0][0]]}; then continue with --resume"
        )

    def _bad_step(self, recorder: Recorder, position: int) -> str:
        step, verdict = self._plan.steps[position], recorder.verdicts[position]
        return (
            f"step {step.index} is {verdict} after {recorder.takes[position]} takes, and the "
            "protocol's policy is to stop then"
        )

    def _good(self, recorder: Recorder, position: int) -> bool:
        """Wait for a step's verdict, and take it again while it is bad and policy allows."""
        for _ in range(self._plan.protocol.policy.bad_step.retries):
            recorder.settle()
            if not _bad(recorder.verdicts[position]) or not recorder.spare:
                break
            if not self._take(recorder, position):
                return False
        recorder.settle()
        return not _bad(recorder.verdicts[position])

    def _take(self, recorder: Recorder, position: int) -> bool:
        """Take one step, through pauses and failures; return False if the run is to end."""
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
                reason = str(error) or "given up by a second Ctrl-C"
                recorder.mark(position, Verdict.INTERRUPTED, reason)
                raise

    def _hold(self, recorder: Recorder, position: int) -> None:
        """Switch all off and wait, if a pause is asked for."""
        if not self.orders.paused:
            return
        began = now()
        self._enter(RunState.PAUSED)
        self._require_off("to pause")
        self._announce(f"paused, all outputs are off; continue with: acquire continue {self._path}")
        self.orders.wait()
        if self.orders.stopped:
            return
        self._open_instruments()
        self._enter(RunState.STEPPING)
        recorder.add_interruption(
            Interruption(position, "paused", began, now(), "a pause was requested")
        )
        self._announce("continuing")

    def _recover(self, recorder: Recorder, position: int, error: InstrumentError) -> None:
        """Switch all off and on again after an instrument failed.

        Raises
        ------
        InstrumentError
            The one that made it necessary, if the bench cannot be made safe or does not come back.
        """
        began = now()
        try:
            self._require_off("after an instrument failed")
            self._open_instruments()
        except InstrumentError as second:
            recorder.mark(position, Verdict.INTERRUPTED, str(error))
            error.add_note(str(second))
            raise error from second
        recorder.add_interruption(Interruption(position, "recovered", began, now(), str(error)))
        self._announce(f"all was switched off and on again, because {error}")

    def _require_off(self, why: str) -> None:
        unconfirmed = safe_off(self._bench)
        self._volts = None
        if unconfirmed:
            raise InstrumentError(
                f"the bench was switched off {why}, but not all is confirmed: "
                f"{'; '.join(unconfirmed)}; look at it before going on"
            )

    def _acquire(self, position: int) -> Acquisition:
        """Set one step, let it settle, and take its frames."""
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
        # Read while the reed settles, so that it costs no time; and once more after the frames,
        # because only then is it known what was played while they were exposed.
        before = self._read_back(step)
        bench.clock.wait(changed_s + settle_s - bench.camera.now_s())
        grabbed = bench.camera.grab(step.frames, changed_s + settle_s)
        after = self._read_back(step)
        frames = received(grabbed, changed_s, self._plan.frame_shape)
        return Acquisition(position, step, before, after, changed_s, frames, self._camera_starts)

    def _drive(self, step: Step) -> None:
        """Set the generator; volts that are far from the present ones are ramped."""
        generator, volts = self._bench.generator, self._volts
        if not step.volts:
            # A reed at rest: the output, off when the instruments were opened, stays off.
            return
        if volts is not None:
            # A driver may switch on again what has tripped; the run must not.
            self._require_on(step)
        if volts is not None and max(volts, step.volts) <= _JUMP * min(volts, step.volts):
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
        """Return frequency and volts that the generator plays; an error if its output is off."""
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
    """Whether a step is worth another take. One without light would have no more of it."""
    return verdict.measured and verdict not in (Verdict.OK, Verdict.UNPROVEN)


def _lost(verdict: Verdict) -> bool:
    """Whether a step gave nothing that can be used, as when a cable is off."""
    return verdict is Verdict.SKIPPED or _bad(verdict)
