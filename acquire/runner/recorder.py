"""Demodulate, judge and write the steps of a run on a thread, while the camera exposes the next.

The thread is at most two steps behind the camera, so memory use stays small. If it cannot keep up,
the next step waits with the instruments idle.
"""

import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np

from acquire.runner.history import History
from acquire.runner.measuring import StepAcquisition, lock_condition, measure, noted
from acquire.runner.quality import common_turn
from acquire.runner.run_folder import require_writable
from drivers.roles import Bench, Frame
from holography.fresnel import FresnelTransform
from holography.reconstruction import Reconstruction
from protocols.plan import Plan
from protocols.step import Step
from runs.documents import DocumentLog, event_data, recorded_data
from runs.errors import SilentDiskError
from runs.layout import Interruption, RunLabels, Status
from runs.measured_step import MeasuredStep
from runs.reader import Run
from runs.records import StepRecord
from runs.verdict import Verdict
from runs.writer import RunWriter, stamp

# Largest number of unfinished steps. Chosen: one waits while one is processed.
_MAX_WAITING_STEPS: Final = 2
# Outputs do not stay on longer than this for a disk. Chosen: one that wakes up, or a network that
# comes back, takes half a minute. In slices: a process that stood still loses one of them only.
_PATIENCE_S: Final = 60
_SLICE_S: Final = 1.0
# Verdicts of steps whose frames do not show the step, or are not all there.
_NOT_OF_THE_STEP: Final = (
    Verdict.DROPPED,
    Verdict.DISORDERED,
    Verdict.PARTIAL,
    Verdict.STALE,
    Verdict.SETTINGS,
)
# Verdicts of steps whose brightness is not usual.
_WITHOUT_LIGHT: Final = (Verdict.NO_SIGNAL, Verdict.SATURATED)


@dataclass(frozen=True, slots=True)
class StepReport:
    """Report of one recorded step, for a progress display.

    Attributes
    ----------
    done, of : int
        Number of recorded steps, including this one, and of planned steps.
    index : int
        Index k of the step in the protocol's sweep.
    attempt : int
        Number of the attempt of this step, from 1.
    drive_hz, volts : float
        Planned drive frequency and peak volts.
    verdict : Verdict
    sentence : str
        Reason of the verdict.
    seconds_left : float
        Remaining time at the mean pace so far.
    """

    done: int
    of: int
    index: int
    attempt: int
    drive_hz: float
    volts: float
    verdict: Verdict
    sentence: str
    seconds_left: float


class Recorder:
    """Run file and documents of one run, written by a thread that reads a queue; a context manager.

    Use `create` or `resume` to open one, and `finish` to end a run. If the context is left because
    of an exception, the run is marked as failed; if it is a new run without a recorded step, its
    files are removed.
    """

    def __init__(
        self,
        plan: Plan,
        bench: Bench,
        writer: RunWriter,
        documents: DocumentLog,
        progress: Callable[[StepReport], None],
    ) -> None:
        self._plan, self._progress = plan, progress
        self._writer, self._documents = writer, documents
        self._saturation_dn = bench.camera.saturation_dn
        self._reconstruction = reconstruction_of(plan)
        self._rate_hz = float(plan.protocol.camera.frame_rate_hz)
        self._verdicts = [Verdict.PENDING] * len(plan.steps)
        self._attempts = [0] * len(plan.steps)
        self._last: tuple[int, Frame] | None = None
        # A driver that makes no statement about its read-back may only return what was sent to it.
        self._echoes = bool(getattr(bench.synthesizers, "echoes_registers", True))
        self._history = History()
        self._resumed = False
        self._started_s = self._first_done_s = time.monotonic()
        self._recorded = 0
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recorder")
        self._waiting: deque[Future[None]] = deque()

    @classmethod
    def create(
        cls,
        plan: Plan,
        bench: Bench,
        path: Path,
        labels: RunLabels,
        progress: Callable[[StepReport], None],
    ) -> Self:
        """Create the files of a new run.

        Parameters
        ----------
        plan : Plan
        bench : Bench
            Open bench.
        path : Path
            Path of the run file.
        labels : RunLabels
        progress : callable
            Called with the report of every recorded step, on the recorder's thread. An exception
            that it raises stops the run.

        Raises
        ------
        RunFileError
            If the files exist already or cannot be created, or the disk has too little space.
        """
        require_writable(plan, path)
        uid = str(uuid.uuid4())
        documents = DocumentLog.create(path, plan, bench, labels, uid)
        try:
            writer = RunWriter.create(path, plan, bench, labels, reconstruction_of(plan), uid)
        except BaseException:
            documents.discard()
            raise
        return cls(plan, bench, writer, documents, progress)

    @classmethod
    def resume(
        cls, plan: Plan, bench: Bench, path: Path, progress: Callable[[StepReport], None]
    ) -> Self:
        """Open the files of a run to continue it; see `create`, and `acquire.runner.resuming`.

        Raises
        ------
        RunFileError
            If another program has the files open, or they cannot be written.
        """
        # The writer first: it fails if another program has the file open.
        writer = RunWriter.resume(path, plan)
        try:
            with Run.open(path) as run:
                steps, earlier_attempts = run.steps, run.earlier_attempts
                ended = "" if run.status == "running" else run.end_time
            documents = DocumentLog.resume(path)
        except BaseException:
            writer.close()
            raise
        recorder = cls(plan, bench, writer, documents, progress)
        try:
            recorder._restore(steps, earlier_attempts, ended)
        except BaseException:
            documents.close()
            writer.close()
            raise
        return recorder

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return remarks about the whole run; complete after `settle`."""
        step = self._plan.steps[0]
        turn = common_turn(self._history.usual(), lock_condition(step, self._plan), step.frames)
        return (turn,) if turn else ()

    @property
    def resumed(self) -> bool:
        """Return whether another process began the run."""
        return self._resumed

    @property
    def counts(self) -> Mapping[Verdict, int]:
        """Return the number of measured steps with each verdict."""
        return dict(Counter(verdict for verdict in self._verdicts if verdict.measured))

    @property
    def verdicts(self) -> Sequence[Verdict]:
        """Return the verdict of every planned step; complete after `settle`."""
        return tuple(self._verdicts)

    @property
    def attempts(self) -> Sequence[int]:
        """Return the number of attempts of every planned step; complete after `settle`."""
        return tuple(self._attempts)

    @property
    def spare(self) -> int:
        """Return how many more attempts can be set aside; call it only after `settle`."""
        return self._writer.spare

    def submit(self, acquisition: StepAcquisition) -> None:
        """Queue a step for recording; wait while `_MAX_WAITING_STEPS` earlier steps are unfinished.

        Raises
        ------
        Exception
            The error of an earlier step, if there was one.
        """
        self.settle(_MAX_WAITING_STEPS - 1)
        self._waiting.append(self._thread.submit(self._record, acquisition))

    def mark(self, position: int, verdict: Verdict, reason: str) -> None:
        """Record that a step was not finished (interrupted) or is left out (skipped)."""
        self._waiting.append(self._thread.submit(self._mark, position, verdict, reason))

    def add_interruption(self, interruption: Interruption) -> None:
        """Record an interruption of the run."""
        self._waiting.append(self._thread.submit(self._writer.add_interruption, interruption))

    def settle(self, waiting: int = 0) -> None:
        """Wait until at most `waiting` steps are unfinished.

        Raises
        ------
        SilentDiskError
            If the next one is not finished within a minute.
        Exception
            The error of a finished step, if there was one.
        """
        while self._waiting and (len(self._waiting) > waiting or self._waiting[0].done()):
            if not any(wait([self._waiting[0]], _SLICE_S).done for _ in range(_PATIENCE_S)):
                raise SilentDiskError(
                    f"{self._writer.path}: a step was not recorded within {_PATIENCE_S} s; check "
                    "the disk, and what watches the steps; then continue with --resume"
                )
            self._waiting.popleft().result()

    def finish(self, status: Status, reason: str = "") -> None:
        """Wait for all steps, write how the run ended, and close both files.

        Raises
        ------
        Exception
            The error of a step or of closing, if there was one.
        """
        # All is off: a disk may take its time.
        self._thread.shutdown()
        self.settle()
        self._documents.finish(status, reason)
        self._writer.finish(status)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # Steps that were measured before the failure are still written.
        self._thread.shutdown()
        if error is None:
            return
        if not (self._resumed or any(verdict.measured for verdict in self._verdicts)):
            self._documents.discard()
            self._writer.discard()
            return
        with noted(error):
            self._documents.finish("failed", str(error))
        with noted(error):
            self._writer.finish("failed")

    def _restore(
        self, steps: Sequence[StepRecord], earlier_attempts: Sequence[StepRecord], ended: str
    ) -> None:
        """Restore verdicts and attempts from a run file, and write events that are missing.

        An event is missing if the process was killed after it wrote the step.
        """
        self._resumed = True
        for earlier in earlier_attempts:
            self._attempts[earlier.position] += 1
        for step in steps:
            self._verdicts[step.position] = step.verdict
            known = self._documents.attempts_of(step.index, step.order)
            if step.verdict.measured:
                self._attempts[step.position] += 1
                attempt = self._attempts[step.position]
                if attempt > known:
                    self._documents.event(recorded_data(step, attempt), time.time())
            # The documents know more attempts than the run file if the disk has damaged one.
            self._attempts[step.position] = max(self._attempts[step.position], known)
        first = next((s for s, v in enumerate(self._verdicts) if not v.measured), len(steps))
        reason = "the process had died" if not ended else "the run had ended early"
        damaged = [str(steps[position].index) for position in self._writer.damaged]
        if damaged:
            reason += f"; damaged on the disk and measured again: step {', '.join(damaged)}"
        now = stamp(datetime.now(UTC))
        self._writer.reopen(Interruption(first, "resumed", ended, now, reason))

    def _record(self, acquisition: StepAcquisition) -> None:
        step, position = acquisition.step, acquisition.position
        measured = self._measured(acquisition)
        if self._verdicts[position].measured:
            self._writer.set_aside(position)
        self._attempts[position] += 1
        self._writer.write(position, measured)
        self._verdicts[position] = measured.judgement.verdict
        self._documents.event(event_data(step, self._attempts[position], measured), time.time())
        self._recorded += 1
        done, of = sum(verdict.measured for verdict in self._verdicts), len(self._plan.steps)
        self._progress(
            StepReport(
                done=done,
                of=of,
                index=step.index,
                attempt=self._attempts[position],
                drive_hz=float(step.drive_hz),
                volts=step.volts,
                verdict=measured.judgement.verdict,
                sentence=measured.judgement.sentence,
                seconds_left=self._seconds_left(of - done),
            )
        )

    def _measured(self, acquisition: StepAcquisition) -> MeasuredStep:
        """Demodulate and judge a step; its frames must follow those of the step before."""
        previous = None
        if self._last is not None and self._last[0] == acquisition.camera_start:
            previous = self._last[1]
        usual = self._history.usual(acquisition.step.exposure_s)
        measured = measure(
            acquisition,
            self._plan,
            self._reconstruction,
            self._saturation_dn,
            previous,
            usual,
            echoes=self._echoes,
        )
        self._remember(acquisition.step, measured)
        if acquisition.frames:
            newest = max(acquisition.frames, key=lambda frame: frame.id)
            if previous is None or newest.id > previous.id:
                # Kept without its pixels, to save memory.
                self._last = (
                    acquisition.camera_start,
                    replace(newest, image=newest.image[:0]),
                )
        return measured

    def _remember(self, step: Step, measured: MeasuredStep) -> None:
        """Add a step to the history, as far as its verdict allows."""
        verdict = measured.judgement.verdict
        if verdict in _NOT_OF_THE_STEP:
            return
        if np.isfinite(measured.brightness_dn) and verdict not in _WITHOUT_LIGHT:
            self._history.add_brightness(step.exposure_s, measured.brightness_dn)
        if verdict is not Verdict.LIGHT:
            turn_rad = 2 * np.pi * measured.lock_error_hz / self._rate_hz
            self._history.add_turn(turn_rad, measured.unexplained)

    def _seconds_left(self, steps: int) -> float:
        """Extrapolate the remaining time.

        The first step includes all preparations, so it is ignored as soon as there is a second.
        """
        now_s = time.monotonic()
        if self._recorded == 1:
            self._first_done_s = now_s
            return (now_s - self._started_s) * steps
        return (now_s - self._first_done_s) / (self._recorded - 1) * steps

    def _mark(self, position: int, verdict: Verdict, reason: str) -> None:
        # The data of an earlier attempt stay valid.
        if not self._verdicts[position].measured:
            self._writer.mark(position, verdict, reason)
            self._verdicts[position] = verdict


def reconstruction_of(plan: Plan) -> Reconstruction:
    """Return the geometry of frames and fields of a plan."""
    optics, camera = plan.bench.optics, plan.bench.instruments.camera
    transform = FresnelTransform(
        shape=plan.frame_shape,
        pixel_m=float(camera.pixel_m),
        wavelength_m=float(optics.wavelength_m),
        distance_m=float(optics.distance_m),
    )
    return Reconstruction(transform, plan.region)
