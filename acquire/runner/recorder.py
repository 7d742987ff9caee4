"""What happens to frames once the camera has given them: seen, judged and kept, on a thread.

The thread lags behind the camera by at most two steps, so memory stays small; if it cannot keep up
the next step waits, with the instruments idle.
"""

import contextlib
import os
import shutil
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np

from acquire.runner.history import History
from acquire.runner.quality import (
    LockCondition,
    Usual,
    brightness_dn,
    common_turn,
    judge_consecutive,
    judge_fresh,
    judge_light,
    judge_lock,
    judge_order,
    judge_saturation,
    judge_settings,
    judge_shown,
    judge_signal,
    judge_steady,
    judge_turn,
    judge_whole,
    most_severe,
    saturated_share,
)
from drivers.roles import Bench, Frame
from holography.fresnel import FresnelTransform
from holography.phase import NO_TURN, SteadyTurn
from holography.reconstruction import Reconstruction, mean_power
from protocols.plan import Plan, Step
from runs.disk import error_class
from runs.documents import (
    DocumentLog,
    documents_path,
    event_data,
    recorded_data,
)
from runs.errors import DiskError, RunFileError
from runs.layout import (
    RunLabels,
    Seam,
    Status,
)
from runs.reader import Run, StepRecord
from runs.verdict import (
    Judgement,
    ReadBack,
    Verdict,
)
from runs.writer import (
    MeasuredStep,
    RunWriter,
    now,
)

_WAITING_STEPS: Final = 2
_NOT_OF_THE_STEP: Final = (
    Verdict.DROPPED,
    Verdict.DISORDERED,
    Verdict.PARTIAL,
    Verdict.STALE,
    Verdict.SETTINGS,
)
_WITHOUT_LIGHT: Final = (Verdict.NO_SIGNAL, Verdict.SATURATED)


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """What the instruments gave for one step.

    Attributes
    ----------
    position : int
        Place of the step in the plan, from 0.
    step : Step
    before, after : ReadBack
        Of before the frames and after them.
    changed_s : float
        When the last setting was changed, on the camera's clock.
    frames : tuple of Frame
    camera_start : int
        How often the camera had been started: frames are numbered from there.
    """

    position: int
    step: Step
    before: ReadBack
    after: ReadBack
    changed_s: float
    frames: tuple[Frame, ...]
    camera_start: int


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
        turn = common_turn(self._history.usual(), _condition(step, self._plan), step.frames)
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

    def add_seam(self, seam: Seam) -> None:
        """Note where the run was not carried on at once."""
        self._waiting.append(self._thread.submit(self._writer.add_seam, seam))

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
        with _noted(error):
            self._documents.finish("failed", str(error))
        with _noted(error):
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
        self._writer.reopen(Seam(first, "resumed", ended, now(), reason))

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


@contextlib.contextmanager
def _noted(first: BaseException) -> Iterator[None]:
    """Add what fails besides to an error; a disk that refuses is one cause, and one line."""
    try:
        yield
    except RunFileError as second:
        if not isinstance(first, DiskError):
            first.add_note(str(second))


def measure(
    acquisition: Acquisition,
    plan: Plan,
    reconstruction: Reconstruction,
    saturation_dn: int,
    previous: Frame | None = None,
    usual: Usual | None = None,
    *,
    echoes: bool = False,
) -> MeasuredStep:
    """Reconstruct and judge one step.

    Parameters
    ----------
    acquisition : Acquisition
    plan : Plan
        Supplies what was asked for.
    reconstruction : Reconstruction
    saturation_dn : int
        See `drivers.roles.Camera`.
    previous : Frame, optional
        Last frame of the acquisition before, since when the camera did not stop.
    usual : Usual, optional
        What the steps before were like.
    echoes : bool
        Whether the synthesizers' read-back only repeats what they were told.

    Returns
    -------
    MeasuredStep
        A step of fewer frames than planned has a field of zeros.
    """
    step, frames, usual = acquisition.step, acquisition.frames, usual or Usual()
    region, kind = reconstruction.region, _kind(plan)
    field = np.zeros((region.height, region.width), dtype=np.complex64)
    ratio, noise, turn, level_dn, share = np.nan, np.nan, NO_TURN, np.nan, 0.0
    judgements = [judge_consecutive(frames, step.frames)]
    if frames:
        share = saturated_share(frames, saturation_dn)
        judgements += [judge_saturation(share)]
        judgements += _judge_frames(acquisition, plan, saturation_dn, previous)
        # Without light rows may well be empty, all of them alike.
        if kind != "dark":
            level_dn = float(np.median(brightness_dn(frames, _dark_dn(plan))))
            light = judge_light(frames, _dark_dn(plan), usual)
            judgements += [light, judge_whole(frames, saturation_dn)]
    if len(frames) == step.frames and kind in ("sweep", "order0"):
        images = np.stack([frame.image for frame in frames])
        halves = reconstruction.quadratures(images)
        field, noise = halves.field, halves.noise
        turn = reconstruction.steady_turn(images, halves)
        ratio = mean_power(field) / noise if noise > 0 else np.nan
        # Frames of different brightness say nothing of how their image turns.
        if light is None:
            judgements += _judge_turn(turn, step, plan, usual, echoes)
        judgements.append(_judge_signal(ratio, step, plan, reconstruction))
    turn_hz = float(plan.protocol.camera.frame_rate_hz) / (2 * np.pi)
    return MeasuredStep(
        read_back=acquisition.after,
        changed_s=acquisition.changed_s,
        frames=frames,
        field=field,
        signal_to_noise=ratio,
        noise_level=noise,
        saturated_share=share,
        brightness_dn=level_dn,
        lock_error_hz=turn.error_rad * turn_hz,
        lock_error_se_hz=turn.standard_error_rad * turn_hz,
        unexplained=turn.unexplained,
        judgement=most_severe(judgements),
    )


def _kind(plan: Plan) -> str:
    calibration = plan.protocol.calibration
    return "sweep" if calibration is None else calibration.kind


def _judge_turn(
    turn: SteadyTurn, step: Step, plan: Plan, usual: Usual, echoes: bool
) -> list[Judgement | None]:
    """Judge how the image turns from frame to frame."""
    leak = step.carrier_leak
    unsteady = judge_steady(turn, leak, usual)
    # What does not turn steadily has no frequency.
    wrong = None if unsteady else judge_turn(turn, _condition(step, plan), leak, usual)
    return [unsteady, wrong, judge_shown(turn, leak) if echoes else None]


def _judge_signal(
    ratio: float, step: Step, plan: Plan, reconstruction: Reconstruction
) -> Judgement | None:
    # Beyond the first order all may be dark: it is the lower ones that tell of a fault.
    if step.order > 1 and len(plan.protocol.sideband.selected) > 1:
        return None
    region, empty = reconstruction.region, reconstruction.empty
    return judge_signal(ratio, region.height * region.width, empty.height * empty.width)


def _judge_frames(
    acquisition: Acquisition, plan: Plan, saturation_dn: int, previous: Frame | None
) -> list[Judgement | None]:
    """Judge numbers, times and settings."""
    step, frames, condition = (
        acquisition.step,
        acquisition.frames,
        _condition(acquisition.step, plan),
    )
    period_s = float(plan.protocol.camera.period_s)
    return [
        judge_fresh(frames, acquisition.changed_s + float(step.settle_s), previous),
        judge_order(frames, period_s, previous),
        judge_settings(step.drive_hz, step.volts, acquisition.before, acquisition.after),
        judge_lock(acquisition.before, frames, condition),
        judge_lock(acquisition.after, frames, condition),
    ]


def _condition(step: Step, plan: Plan) -> LockCondition:
    tolerance_rad = float(plan.protocol.tolerance.lock_phase_rad)
    return LockCondition(step.order, plan.protocol.camera.frame_rate_hz, tolerance_rad)


def _dark_dn(plan: Plan) -> float:
    sheet = plan.bench.instruments.camera.data_sheet
    return sheet.offset_dn if sheet else 0.0


def make_folder(path: Path) -> None:
    """Make the folder of a run file, if it is not there.

    Raises
    ------
    RunFileError
        If it cannot be made, or if the run file's name is unusable: then nothing is made.
    """
    _require_usable_name(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise error_class(error)(
            f"{path}: its folder cannot be made ({error.strerror}); choose another place"
        ) from error


def require_writable(plan: Plan, path: Path) -> None:
    """Check, before anything is switched on, that a run can be kept at `path`.

    Raises
    ------
    RunFileError
        If the folder is missing, the name unusable, the disk too small, or one of the files
        exists already.
    """
    _require_usable_name(path)
    _require_free_name(path)
    if not path.parent.is_dir():
        raise RunFileError(f"{path}: there is no folder {path.parent}; make it first")
    free, needed = shutil.disk_usage(path.parent).free, plan.largest_size_bytes
    if free < needed:
        raise RunFileError(
            f"{path}: the run needs {needed / 1e6:.0f} MB, but its disk has {free / 1e6:.0f} MB "
            "left; make room or choose another folder"
        )


def _require_usable_name(path: Path) -> None:
    if path.suffix != ".h5":
        raise RunFileError(f"{path}: the name of a run file ends in .h5; write {path.stem}.h5")
    try:
        path.exists()
    except OSError as error:
        raise RunFileError(f"{path}: {error.strerror}; choose another name") from error


def _require_free_name(path: Path) -> None:
    for file in (path, documents_path(path)):
        # A link that leads nowhere is there, too.
        if os.path.lexists(file):
            raise RunFileError(
                f"{file}: exists already and is never overwritten; choose another name or move it"
            )


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
