"""One sweep on one bench: the state machine that owns the instruments while they run."""

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import Final

from acquire.plan import Plan, Step
from acquire.quality import ReadBack, Verdict
from acquire.recorder import Acquisition, Recorder, StepReport
from acquire.run_layout import RunLabels
from drivers.errors import InstrumentError
from drivers.roles import Bench

__all__ = ["RunLabels", "RunState", "RunSummary", "Runner", "StepReport", "run", "safe_off"]

# A tweeter clicks, and may be harmed, if its voltage jumps.
RAMP_S: Final = 0.1


class RunState(StrEnum):
    """Where a run stands."""

    IDLE = "idle"
    OPENING = "opening"
    STEPPING = "stepping"
    CLOSING = "closing"
    COMPLETE = "complete"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


_NEXT: Final = {
    RunState.IDLE: {RunState.OPENING},
    RunState.OPENING: {RunState.STEPPING, RunState.CLOSING, RunState.FAILED},
    RunState.STEPPING: {RunState.CLOSING},
    RunState.CLOSING: {RunState.COMPLETE, RunState.INTERRUPTED, RunState.FAILED},
}


@dataclass(frozen=True, slots=True)
class RunSummary:
    """How a run ended.

    Attributes
    ----------
    path : Path
        Of the run file.
    status : {'complete', 'interrupted'}
        A run that failed raises instead.
    counts : mapping of Verdict to int
        Of the steps that were measured.
    steps : int
        That were planned.
    duration_s : float
        On the wall.
    unconfirmed : tuple of str
        What the bench did not confirm while it was switched off; a person has to look.
    """

    path: Path
    status: RunState
    counts: Mapping[Verdict, int]
    steps: int
    duration_s: float
    unconfirmed: tuple[str, ...]


def run(
    plan: Plan,
    bench: Bench,
    path: str | Path,
    labels: RunLabels | None = None,
    progress: Callable[[StepReport], None] | None = None,
) -> RunSummary:
    """Measure a whole plan on an open bench.

    On the main thread, Ctrl-C (SIGINT) and SIGTERM end the run at the next step boundary; a
    second Ctrl-C gives up the step in work. However the run ends, the tweeter is ramped down and
    its output and the RF are switched off before this returns.

    Parameters
    ----------
    plan : Plan
    bench : Bench
        Stays open.
    path : str or Path
        Of the run file, which must not exist; the documents are written beside it.
    labels : RunLabels, optional
        What a person says about the run.
    progress : callable, optional
        Told of every recorded step, on another thread. What it raises stops the run.

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
        If an instrument failed. Steps recorded before are in the file. What could not be
        confirmed while switching off stands in the exception's notes.
    """
    report = progress or (lambda _: None)
    return Runner(plan, bench, Path(path), labels or RunLabels(), report).execute()


class Runner:
    """Carries out one plan, once.

    ::

        idle ─→ opening ─→ stepping ──────────────→ closing ─┬→ complete
                   │        │   ↑ one step:            ↑     ├→ interrupted
                   │        └───┘ set pair, set        │     └→ failed
                   │              generator, settle,   │
                   │              grab, hand over      │
                   ├───────────────────────────────────┘
                   └→ failed (before anything was switched on)

    `stop` sets a flag that is looked at before each step only. `closing` is entered on every way
    out of `opening` and `stepping`: it makes the bench safe first, and closes the files after.

    Parameters
    ----------
    plan : Plan
    bench : Bench
        Open.
    path : Path
        Of the run file.
    labels : RunLabels
    progress : callable
        Told of every recorded step, on another thread.
    """

    def __init__(
        self,
        plan: Plan,
        bench: Bench,
        path: Path,
        labels: RunLabels,
        progress: Callable[[StepReport], None],
    ) -> None:
        self._plan, self._bench, self._path = plan, bench, path
        self._labels, self._progress = labels, progress
        self._state = RunState.IDLE
        self._stop = threading.Event()
        self._abortable = False
        self._unconfirmed: tuple[str, ...] = ()

    @property
    def state(self) -> RunState:
        """Where the run stands."""
        return self._state

    def stop(self) -> None:
        """End the run at the next step boundary. May be called from any thread."""
        self._stop.set()

    def interrupt(self) -> None:
        """Do what Ctrl-C asks for: the first time `stop`, then give up the step in work.

        To be called on the thread that executes the run.

        Raises
        ------
        KeyboardInterrupt
            Once, while instruments are in use; never while they are being switched off.
        """
        if not self._stop.is_set():
            self._stop.set()
        elif self._abortable:
            self._abortable = False
            raise KeyboardInterrupt

    def execute(self) -> RunSummary:
        """Measure; see `run`.

        Raises
        ------
        RuntimeError
            If called a second time.
        """
        started_s = time.monotonic()
        self._enter(RunState.OPENING)
        with _signals_to(self):
            try:
                self._plan.require_possible()
                counts, outcome = self._record()
            except BaseException as error:
                for message in self._unconfirmed:
                    error.add_note(f"not confirmed while switching off: {message}")
                self._enter(RunState.FAILED)
                raise
            self._enter(outcome)
        return RunSummary(
            path=self._path,
            status=outcome,
            counts=counts,
            steps=len(self._plan.steps),
            duration_s=time.monotonic() - started_s,
            unconfirmed=self._unconfirmed,
        )

    def _record(self) -> tuple[Mapping[Verdict, int], RunState]:
        """Measure into the run file; return counts by verdict, and how the run ended."""
        recorder = Recorder(self._plan, self._bench, self._path, self._labels, self._progress)
        with recorder:
            try:
                complete = self._measure(recorder)
            except KeyboardInterrupt:
                complete = False
            recorder.finish("complete" if complete else "interrupted")
        return recorder.counts, RunState.COMPLETE if complete else RunState.INTERRUPTED

    def _measure(self, recorder: Recorder) -> bool:
        """Use the instruments, and leave them safe; return whether all steps were taken."""
        # Two levels, because a second Ctrl-C may strike inside the inner `finally`.
        try:
            try:
                self._abortable = True
                self._open_instruments()
                self._enter(RunState.STEPPING)
                return self._take_steps(recorder)
            finally:
                self._abortable = False
        finally:
            self._enter(RunState.CLOSING)
            self._unconfirmed = safe_off(self._bench)

    def _open_instruments(self) -> None:
        protocol, bench = self._plan.protocol, self._bench
        bench.generator.output_off()
        bench.camera.configure(
            protocol.camera.frame_rate_hz, protocol.exposure_s, self._plan.frame_shape
        )
        bench.synthesizers.rf_on()
        bench.camera.start()

    def _take_steps(self, recorder: Recorder) -> bool:
        for position, step in enumerate(self._plan.steps):
            if self._stop.is_set():
                return False
            try:
                acquisition = self._acquire(position, step)
            except BaseException as error:
                reason = str(error) or "given up by a second Ctrl-C"
                recorder.mark_interrupted(position, reason)
                raise
            recorder.submit(acquisition)
        return True

    def _acquire(self, position: int, step: Step) -> Acquisition:
        """Set one step, let it settle, and take its frames."""
        bench, settle_s = self._bench, float(step.settle_s)
        bench.synthesizers.set_pair(step.aom1_hz, step.aom2_hz)
        if position == 0:
            bench.generator.set_sine(step.drive_hz, 0.0)
            bench.generator.ramp_to(step.volts, RAMP_S)
        else:
            bench.generator.set_sine(step.drive_hz, step.volts)
        changed_s = bench.camera.now_s()
        # Read while the reed settles, so that it costs no time.
        read_back = self._read_back(step)
        bench.clock.wait(changed_s + settle_s - bench.camera.now_s())
        frames = bench.camera.grab(step.frames, changed_s + settle_s)
        return Acquisition(position, step, read_back, changed_s, tuple(frames))

    def _read_back(self, step: Step) -> ReadBack:
        drive_hz, volts, on = self._bench.generator.read()
        if not on:
            raise InstrumentError(
                f"generator: its output is off at step {step.index}, but was set to "
                f"{step.volts:g} V; look for an overload or a tripped limit"
            )
        return ReadBack(*self._bench.synthesizers.read_pair(), drive_hz, volts)

    def _enter(self, state: RunState) -> None:
        if state not in _NEXT.get(self._state, ()):
            raise RuntimeError(f"a run that is {self._state} cannot become {state}")
        self._state = state


def safe_off(bench: Bench) -> tuple[str, ...]:
    """Switch off what could harm: ramp the tweeter down, output off, RF off, camera stopped.

    Each is tried whatever became of those before.

    Parameters
    ----------
    bench : Bench

    Returns
    -------
    tuple of str
        What was not confirmed, and why. Empty if all is well.
    """
    switches: tuple[tuple[str, Callable[[], None]], ...] = (
        ("tweeter ramp to 0 V", lambda: bench.generator.ramp_to(0.0, RAMP_S)),
        ("tweeter output off", lambda: _output_off(bench)),
        ("RF off", bench.synthesizers.rf_off),
        ("camera stopped", bench.camera.stop),
    )
    unconfirmed = []
    for name, switch in switches:
        try:
            switch()
        except BaseException as error:  # noqa: BLE001  # whatever a driver raises, go on
            unconfirmed.append(f"{name}: {error}")
    return tuple(unconfirmed)


def _output_off(bench: Bench) -> None:
    bench.generator.output_off()
    if bench.generator.read()[2]:
        raise InstrumentError("generator: its output is still on; pull the tweeter's cable")


@contextmanager
def _signals_to(runner: Runner) -> Iterator[None]:
    """Let SIGINT and SIGTERM end the run, if this is the main thread; others get no signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        runner.interrupt()

    def stop(_number: int, _frame: FrameType | None) -> None:
        runner.stop()

    before = {
        number: signal.signal(number, handler)
        for number, handler in ((signal.SIGINT, interrupt), (signal.SIGTERM, stop))
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)
