"""What happens to frames once the camera has given them: seen, judged and kept, on a thread.

The thread lags behind the camera by at most two steps, so memory stays small; if it cannot keep up
the next step waits, with the instruments idle.
"""

import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np

from acquire.runner.history import History
from acquire.runner.measuring import Acquisition, lock_condition, measure, noted
from acquire.runner.quality import common_turn
from acquire.runner.run_folder import require_writable
from drivers.roles import Bench, Frame
from holography.fresnel import FresnelTransform
from holography.reconstruction import Reconstruction
from protocols.plan import Plan
from protocols.step import Step
from runs.documents import (
    DocumentLog,
    event_data,
    recorded_data,
)
from runs.layout import (
    Interruption,
    RunLabels,
    Status,
)
from runs.measured_step import MeasuredStep
from runs.reader import Run
from runs.records import StepRecord
from runs.verdict import (
    Verdict,
)
from runs.writer import RunWriter, now

_WAITING_STEPS: Final = 2
_NOT_OF_THE_STEP: Final = (
    Verdict.DROPPED,
    Verdict.DISORDERED,
    Verdict.PARTIAL,
    Verdict.STALE,
    Verdict.SETTINGS,
)
_WITHOUT_LIGHT: Final = (Verdict.NO_SIGNAL, Verdict.SATURATED)


@dataclass(frozen=True, slots=True)
class StepReport:
    """What a progress display is told after each step.

    Attributes
    ----------
    done, of : int
        Steps recorded, this one included, and steps planned.
    index : int
        k of the protocol's sweep.
    take : int
        From 1: how often this step was taken.
    drive_hz, volts : float
        As planned.
    verdict : Verdict
    sentence : str
    seconds_left : float
        At the mean pace so far.
    """

    done: int
    of: int
    index: int
    take: int
    drive_hz: float
    volts: float
    verdict: Verdict
    sentence: str
    seconds_left: float


class Recorder:
    """The run file and its documents, fed through a queue; a context manager.

    Leaving the context because of an exception marks the run as failed; of a new run in which no
    step was recorded it leaves no file. Otherwise `finish` says how the run ended. Made by `create`
    and `resume`.
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
        self._takes = [0] * len(plan.steps)
        self._last: tuple[int, Frame] | None = None
        # Of drivers that do not say what their read-back is worth, the least is presumed.
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
        """Begin a new run.

        Parameters
        ----------
        plan : Plan
        bench : Bench
            Open.
        path : Path
            Of the run file.
        labels : RunLabels
        progress : callable
            Told of every recorded step, on the recorder's thread. What it raises stops the run.

        Raises
        ------
        RunFileError
            If the files exist already or cannot be made, or the disk is too small.
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
        """Go on with a run that is not complete. See `create`, and `acquire.runner.resuming`.

        Raises
        ------
        RunFileError
            If another program has the files open, or they cannot be written.
        """
        # First, because it is refused where another program has the file open.
        writer = RunWriter.resume(path, plan)
        try:
            with Run.open(path) as run:
                steps, retakes = run.steps, run.retakes
                ended = "" if run.status == "running" else run.end_time
            documents = DocumentLog.resume(path)
        except BaseException:
            writer.close()
            raise
        recorder = cls(plan, bench, writer, documents, progress)
        try:
            recorder._take_over(steps, retakes, ended)
        except BaseException:
            documents.close()
            writer.close()
            raise
        return recorder

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is worth knowing of the whole run; to be relied on after `settle`."""
        step = self._plan.steps[0]
        turn = common_turn(self._history.usual(), lock_condition(step, self._plan), step.frames)
        return (turn,) if turn else ()

    @property
    def resumed(self) -> bool:
        """Whether another process began the run."""
        return self._resumed

    @property
    def counts(self) -> Mapping[Verdict, int]:
        """How many steps that hold data have each verdict."""
        return dict(Counter(verdict for verdict in self._verdicts if verdict.measured))

    @property
    def verdicts(self) -> Sequence[Verdict]:
        """What is known of every planned step; to be relied on after `settle`."""
        return tuple(self._verdicts)

    @property
    def takes(self) -> Sequence[int]:
        """How often each planned step was taken; to be relied on after `settle`."""
        return tuple(self._takes)

    @property
    def spare(self) -> int:
        """How many takes may still be set aside; to be asked for after `settle`."""
        return self._writer.spare

    def submit(self, acquisition: Acquisition) -> None:
        """Hand over a step; waits while `_WAITING_STEPS` others are in work.

        Raises
        ------
        Exception
            Whatever went wrong with an earlier step.
        """
        self.settle(_WAITING_STEPS - 1)
        self._waiting.append(self._thread.submit(self._record, acquisition))

    def mark(self, position: int, verdict: Verdict, reason: str) -> None:
        """Note that a step was given up (interrupted) or is done without (skipped)."""
        self._waiting.append(self._thread.submit(self._mark, position, verdict, reason))

    def add_interruption(self, interruption: Interruption) -> None:
        """Note where the run was not carried on at once."""
        self._waiting.append(self._thread.submit(self._writer.add_interruption, interruption))

    def settle(self, waiting: int = 0) -> None:
        """Wait until at most `waiting` steps are still in work.

        Raises
        ------
        Exception
            Whatever went wrong with one of the finished steps.
        """
        while self._waiting and (len(self._waiting) > waiting or self._waiting[0].done()):
            self._waiting.popleft().result()

    def finish(self, status: Status, reason: str = "") -> None:
        """Wait for all steps, and close both files.

        Raises
        ------
        Exception
            Whatever went wrong with a step, or with closing.
        """
        self.settle()
        self._thread.shutdown()
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
        # What was measured before the failure is still worth keeping.
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

    def _take_over(
        self, steps: Sequence[StepRecord], retakes: Sequence[StepRecord], ended: str
    ) -> None:
        """Know what a run file holds, and tell of steps whose event was lost with the process."""
        self._resumed = True
        for earlier in retakes:
            self._takes[earlier.position] += 1
        for step in steps:
            self._verdicts[step.position] = step.verdict
            known = self._documents.takes_of(step.index, step.order)
            if step.verdict.measured:
                self._takes[step.position] += 1
                take = self._takes[step.position]
                if take > known:
                    self._documents.event(recorded_data(step, take), time.time())
            # More than the run file holds, if the disk has damaged one.
            self._takes[step.position] = max(self._takes[step.position], known)
        first = next((s for s, v in enumerate(self._verdicts) if not v.measured), len(steps))
        reason = "the process was gone" if not ended else "the run had been ended"
        damaged = [str(steps[position].index) for position in self._writer.damaged]
        if damaged:
            reason += f"; damaged on the disk and taken again: step {', '.join(damaged)}"
        self._writer.reopen(Interruption(first, "resumed", ended, now(), reason))

    def _record(self, acquisition: Acquisition) -> None:
        step, position = acquisition.step, acquisition.position
        measured = self._measured(acquisition)
        if self._verdicts[position].measured:
            self._writer.set_aside(position)
        self._takes[position] += 1
        self._writer.write(position, measured)
        self._verdicts[position] = measured.judgement.verdict
        self._documents.event(event_data(step, self._takes[position], measured), time.time())
        self._recorded += 1
        done, of = sum(verdict.measured for verdict in self._verdicts), len(self._plan.steps)
        self._progress(
            StepReport(
                done=done,
                of=of,
                index=step.index,
                take=self._takes[position],
                drive_hz=float(step.drive_hz),
                volts=step.volts,
                verdict=measured.judgement.verdict,
                sentence=measured.judgement.sentence,
                seconds_left=self._seconds_left(of - done),
            )
        )

    def _measured(self, acquisition: Acquisition) -> MeasuredStep:
        """Judge a step beside the frames of the one before, which this one's must follow."""
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
                # Without its picture, which is large.
                self._last = (
                    acquisition.camera_start,
                    replace(newest, image=newest.image[:0]),
                )
        return measured

    def _remember(self, step: Step, measured: MeasuredStep) -> None:
        """Let a step count for what is usual, as far as its frames show the step."""
        verdict = measured.judgement.verdict
        if verdict in _NOT_OF_THE_STEP:
            return
        # Steps without light say nothing of how bright the next ones should be.
        if np.isfinite(measured.brightness_dn) and verdict not in _WITHOUT_LIGHT:
            self._history.add_brightness(step.exposure_s, measured.brightness_dn)
        if verdict is not Verdict.LIGHT:
            turn_rad = 2 * np.pi * measured.lock_error_hz / self._rate_hz
            self._history.add_turn(turn_rad, measured.unexplained)

    def _seconds_left(self, steps: int) -> float:
        """Extrapolate; the first step, which includes all preparations, only for itself."""
        now_s = time.monotonic()
        if self._recorded == 1:
            self._first_done_s = now_s
            return (now_s - self._started_s) * steps
        return (now_s - self._first_done_s) / (self._recorded - 1) * steps

    def _mark(self, position: int, verdict: Verdict, reason: str) -> None:
        # A take that was measured before stays what it is.
        if not self._verdicts[position].measured:
            self._writer.mark(position, verdict, reason)
            self._verdicts[position] = verdict


def reconstruction_of(plan: Plan) -> Reconstruction:
    """Geometry of frames and fields of a plan."""
    optics, camera = plan.bench.optics, plan.bench.instruments.camera
    transform = FresnelTransform(
        shape=plan.frame_shape,
        pixel_m=float(camera.pixel_m),
        wavelength_m=float(optics.wavelength_m),
        distance_m=float(optics.distance_m),
    )
    return Reconstruction(transform, plan.region)
