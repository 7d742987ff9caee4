"""What happens to frames once the camera has given them: seen, judged and kept, on a thread.

The thread lags behind the camera by at most two steps, so memory stays small; if it cannot keep up
the next step waits, with the instruments idle.
"""

import shutil
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np

from acquire.documents import DocumentLog, documents_path
from acquire.errors import RunFileError
from acquire.plan import Plan, Step
from acquire.quality import (
    LockCondition,
    ReadBack,
    Verdict,
    judge_consecutive,
    judge_fresh,
    judge_lock,
    judge_saturation,
    judge_signal,
    most_severe,
    saturated_share,
    signal_and_noise,
)
from acquire.reconstruction import Reconstruction
from acquire.run_layout import RunLabels, Status
from acquire.run_writer import MeasuredStep, RunWriter
from drivers.roles import Bench, Frame
from holography.fresnel import FresnelTransform

_WAITING_STEPS: Final = 2


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """What the instruments gave for one step.

    Attributes
    ----------
    position : int
        Place of the step in the plan, from 0.
    step : Step
    read_back : ReadBack
    changed_s : float
        When the last setting was changed, on the camera's clock.
    frames : tuple of Frame
    """

    position: int
    step: Step
    read_back: ReadBack
    changed_s: float
    frames: tuple[Frame, ...]


@dataclass(frozen=True, slots=True)
class StepReport:
    """What a progress display is told after each step.

    Attributes
    ----------
    done, of : int
        Steps recorded, this one included, and steps planned.
    index : int
        k of the protocol's sweep.
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
    drive_hz: float
    volts: float
    verdict: Verdict
    sentence: str
    seconds_left: float


class Recorder:
    """The run file and its documents, fed through a queue; a context manager.

    Leaving the context because of an exception marks the run as failed, and leaves no file if no
    step was recorded. Otherwise `finish` says how the run ended.

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

    def __init__(
        self,
        plan: Plan,
        bench: Bench,
        path: Path,
        labels: RunLabels,
        progress: Callable[[StepReport], None],
    ) -> None:
        require_writable(plan, path)
        self._plan, self._progress = plan, progress
        self._saturation_dn = bench.camera.saturation_dn
        self._reconstruction = _reconstruction(plan)
        self._counts: Counter[Verdict] = Counter()
        self._started_s = self._first_done_s = time.monotonic()
        uid = str(uuid.uuid4())
        self._documents = DocumentLog(path, plan, bench, labels, uid)
        try:
            self._writer = RunWriter.create(path, plan, bench, labels, self._reconstruction, uid)
        except BaseException:
            self._documents.discard()
            raise
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recorder")
        self._waiting: deque[Future[None]] = deque()

    @property
    def counts(self) -> Mapping[Verdict, int]:
        """How many recorded steps have each verdict."""
        return dict(self._counts)

    def submit(self, acquisition: Acquisition) -> None:
        """Hand over a step; waits while `_WAITING_STEPS` others are in work.

        Raises
        ------
        Exception
            Whatever went wrong with an earlier step.
        """
        self.settle(_WAITING_STEPS - 1)
        self._waiting.append(self._thread.submit(self._record, acquisition))

    def mark_interrupted(self, position: int, reason: str) -> None:
        """Note that the instruments gave up a step."""
        self._waiting.append(self._thread.submit(self._record_interruption, position, reason))

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
        if not self._counts:
            self._documents.discard()
            self._writer.discard()
            return
        try:
            self._documents.finish("failed", str(error))
            self._writer.finish("failed")
        except RunFileError as second:
            error.add_note(str(second))

    def _record(self, acquisition: Acquisition) -> None:
        step = acquisition.step
        measured = measure(acquisition, self._plan, self._reconstruction, self._saturation_dn)
        self._writer.write(acquisition.position, measured)
        self._documents.event(step, measured, time.time())
        self._counts[measured.judgement.verdict] += 1
        done, of = self._counts.total(), len(self._plan.steps)
        seconds_left = self._seconds_left(done, of)
        self._progress(
            StepReport(
                done=done,
                of=of,
                index=step.index,
                drive_hz=float(step.drive_hz),
                volts=step.volts,
                verdict=measured.judgement.verdict,
                sentence=measured.judgement.sentence,
                seconds_left=seconds_left,
            )
        )

    def _seconds_left(self, done: int, of: int) -> float:
        """Extrapolate; the first step, which includes all preparations, only for itself."""
        now_s = time.monotonic()
        if done == 1:
            self._first_done_s = now_s
            return (now_s - self._started_s) * (of - 1)
        return (now_s - self._first_done_s) / (done - 1) * (of - done)

    def _record_interruption(self, position: int, reason: str) -> None:
        self._writer.mark_interrupted(position, reason)


def measure(
    acquisition: Acquisition, plan: Plan, reconstruction: Reconstruction, saturation_dn: int
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

    Returns
    -------
    MeasuredStep
        A step of fewer frames than planned has a field of zeros.
    """
    step, frames, protocol = acquisition.step, acquisition.frames, plan.protocol
    region, empty = reconstruction.region, reconstruction.empty
    field = np.zeros((region.height, region.width), dtype=np.complex64)
    ratio, noise, signal = np.nan, np.nan, None
    if len(frames) == step.frames:
        image = reconstruction.image(np.stack([frame.image for frame in frames]))
        field = region.crop(image).copy()
        ratio, noise = signal_and_noise(image, region, empty)
        signal = judge_signal(ratio, region.height * region.width, empty.height * empty.width)
    share = saturated_share(frames, saturation_dn) if frames else 0.0
    condition = LockCondition(
        protocol.sideband.order,
        protocol.camera.frame_rate_hz,
        float(protocol.tolerance.lock_phase_rad),
    )
    judgements = [judge_consecutive(frames, step.frames), judge_saturation(share), signal]
    if frames:
        judgements.append(judge_fresh(frames, acquisition.changed_s + float(step.settle_s)))
        judgements.append(judge_lock(acquisition.read_back, frames, condition))
    return MeasuredStep(
        read_back=acquisition.read_back,
        changed_s=acquisition.changed_s,
        frames=frames,
        field=field,
        signal_to_noise=ratio,
        noise_level=noise,
        saturated_share=share,
        judgement=most_severe(judgements),
    )


def make_folder(path: Path) -> None:
    """Make the folder of a run file, if it is not there.

    Raises
    ------
    RunFileError
        If it cannot be made, or if the run file's name is unusable or taken: then nothing is made.
    """
    _require_free_name(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFileError(
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
    _require_free_name(path)
    if not path.parent.is_dir():
        raise RunFileError(f"{path}: there is no folder {path.parent}; make it first")
    free, needed = shutil.disk_usage(path.parent).free, plan.file_size_bytes
    if free < needed:
        raise RunFileError(
            f"{path}: the run needs {needed / 1e6:.0f} MB, but its disk has {free / 1e6:.0f} MB "
            "left; make room or choose another folder"
        )


def _require_free_name(path: Path) -> None:
    if path.suffix != ".h5":
        raise RunFileError(f"{path}: the name of a run file ends in .h5; write {path.stem}.h5")
    try:
        path.exists()
    except OSError as error:
        raise RunFileError(f"{path}: {error.strerror}; choose another name") from error
    for file in (path, documents_path(path)):
        if file.exists():
            raise RunFileError(
                f"{file}: exists already and is never overwritten; choose another name or move it"
            )


def _reconstruction(plan: Plan) -> Reconstruction:
    optics, camera = plan.bench.optics, plan.bench.instruments.camera
    transform = FresnelTransform(
        shape=plan.frame_shape,
        pixel_m=float(camera.pixel_m),
        wavelength_m=float(optics.wavelength_m),
        distance_m=float(optics.distance_m),
    )
    return Reconstruction(transform, plan.region)
