"""Demodulate and judge the four frames of a step."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquire.runner.frame_quality import (
    judge_consecutive,
    judge_fresh,
    judge_order,
    judge_saturation,
    judge_whole,
    saturated_share,
)
from acquire.runner.quality import (
    LockCondition,
    Usual,
    brightness_dn,
    judge_light,
    judge_lock,
    judge_settings,
    judge_shown,
    judge_signal,
    judge_steady,
    judge_turn,
    most_severe,
)
from drivers.roles import Frame
from holography.phase import NO_TURN, SteadyTurn
from holography.reconstruction import Reconstruction, mean_power
from protocols.plan import Plan
from protocols.step import Step
from runs.errors import DiskError, RunFileError
from runs.measured_step import MeasuredStep
from runs.verdict import Judgement, ReadBack


@dataclass(frozen=True, slots=True, eq=False)
class StepAcquisition:
    """Frames of one step, and settings that the instruments reported.

    Attributes
    ----------
    position : int
        Position of the step in the plan, from 0.
    step : Step
    before, after : ReadBack
        Settings that were read before and after the frames.
    changed_s : float
        Time of the last change of a setting on the camera's clock, in s.
    frames : tuple of Frame
    camera_start : int
        How often the camera was started in this run; each start resets the frame numbers.
    """

    position: int
    step: Step
    before: ReadBack
    after: ReadBack
    changed_s: float
    frames: tuple[Frame, ...]
    camera_start: int


@contextlib.contextmanager
def noted(first: BaseException) -> Iterator[None]:
    """Add a second error as a note to a first one.

    If the first is an error of the disk, the second has the same cause and is ignored.
    """
    try:
        yield
    except RunFileError as second:
        if not isinstance(first, DiskError):
            first.add_note(str(second))


def measure(
    acquisition: StepAcquisition,
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
    acquisition : StepAcquisition
    plan : Plan
        Plan of the run, with the requested settings.
    reconstruction : Reconstruction
    saturation_dn : int
        Value of a saturated pixel, see `drivers.roles.Camera`.
    previous : Frame, optional
        Last frame of the acquisition before, if the camera was not restarted since.
    usual : Usual, optional
        Usual values of the steps before.
    echoes : bool
        Whether the synthesizers' read-back only repeats the settings that were sent to them.

    Returns
    -------
    MeasuredStep
        A step with fewer frames than planned has a field of zeros.
    """
    step, frames, usual = acquisition.step, acquisition.frames, usual or Usual()
    level_dn, light = _brightness(frames, plan, usual)
    judgements = [judge_consecutive(frames, step.frames)]
    if frames:
        judgements += _judge_frames(acquisition, plan, saturation_dn, previous)
        judgements += _judge_pixels(frames, plan, saturation_dn, light)
    hologram = _demodulated(acquisition, plan, reconstruction)
    if hologram.is_complete:
        # If the brightness differs between frames, the turn of their image cannot be measured.
        if light is None:
            judgements += _judge_turn(hologram.turn, step, plan, usual, echoes)
        judgements.append(_judge_signal(hologram.signal_to_noise, step, plan, reconstruction))
    return MeasuredStep(
        read_back=acquisition.after,
        changed_s=acquisition.changed_s,
        frames=frames,
        field=hologram.field,
        signal_to_noise=hologram.signal_to_noise,
        noise_level=hologram.noise,
        saturated_share=saturated_share(frames, saturation_dn) if frames else 0.0,
        brightness_dn=level_dn,
        lock_error_hz=hologram.lock_error_hz,
        lock_error_se_hz=hologram.lock_error_se_hz,
        unexplained=hologram.turn.unexplained,
        judgement=most_severe(judgements),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Hologram:
    """Complex image of one step, and how it turns from frame to frame.

    Attributes
    ----------
    is_complete : bool
        Whether all frames were there; if not, the field is zero and the numbers are NaN.
    field : (height, width) complex64
    noise, signal_to_noise : float
        Mean power of the noise, and of the image in units of it.
    turn : SteadyTurn
    frame_rate_hz : float
    """

    is_complete: bool
    field: npt.NDArray[np.complex64]
    noise: float
    signal_to_noise: float
    turn: SteadyTurn
    frame_rate_hz: float

    @property
    def lock_error_hz(self) -> float:
        """Turn of the image per second, in periods."""
        return self.turn.error_rad * (self.frame_rate_hz / (2 * np.pi))

    @property
    def lock_error_se_hz(self) -> float:
        """Standard error of `lock_error_hz`."""
        return self.turn.standard_error_rad * (self.frame_rate_hz / (2 * np.pi))


def _demodulated(
    acquisition: StepAcquisition, plan: Plan, reconstruction: Reconstruction
) -> _Hologram:
    """Demodulate the frames of a step that is measured with a sideband and has all its frames."""
    frames, region = acquisition.frames, reconstruction.region
    rate_hz = float(plan.protocol.camera.frame_rate_hz)
    if len(frames) != acquisition.step.frames or _kind(plan) not in ("sweep", "order0"):
        empty = np.zeros((region.height, region.width), dtype=np.complex64)
        return _Hologram(False, empty, np.nan, np.nan, NO_TURN, rate_hz)
    images = np.stack([frame.image for frame in frames])
    halves = reconstruction.quadratures(images)
    ratio = mean_power(halves.field) / halves.noise if halves.noise > 0 else np.nan
    turn = reconstruction.steady_turn(images, halves)
    return _Hologram(True, halves.field, halves.noise, ratio, turn, rate_hz)


def _judge_pixels(
    frames: Sequence[Frame], plan: Plan, saturation_dn: int, light: Judgement | None
) -> list[Judgement | None]:
    """Judge the values of the pixels."""
    judgements = [judge_saturation(saturated_share(frames, saturation_dn)), light]
    # In a dark run, empty or equal rows are no fault.
    if _kind(plan) != "dark":
        judgements.append(judge_whole(frames, saturation_dn))
    return judgements


def _brightness(
    frames: Sequence[Frame], plan: Plan, usual: Usual
) -> tuple[float, Judgement | None]:
    """Return the median brightness in dn and its judgement; NaN and None in a dark run."""
    if not frames or _kind(plan) == "dark":
        return np.nan, None
    dark_dn = _dark_dn(plan)
    level_dn = float(np.median(brightness_dn(frames, dark_dn)))
    return level_dn, judge_light(frames, dark_dn, usual)


def _kind(plan: Plan) -> str:
    calibration = plan.protocol.calibration
    return "sweep" if calibration is None else calibration.kind


def _judge_turn(
    turn: SteadyTurn, step: Step, plan: Plan, usual: Usual, echoes: bool
) -> list[Judgement | None]:
    """Judge how the phase of the image turns from frame to frame."""
    leak = step.carrier_leak
    unsteady = judge_steady(turn, leak, usual)
    # A frequency error is defined only if the phase turns uniformly.
    wrong = None if unsteady else judge_turn(turn, lock_condition(step, plan), leak, usual)
    return [unsteady, wrong, judge_shown(turn, leak) if echoes else None]


def _judge_signal(
    ratio: float, step: Step, plan: Plan, reconstruction: Reconstruction
) -> Judgement | None:
    # Sidebands above the first may be dark without a fault; the lower orders show faults.
    if step.order > 1 and len(plan.protocol.sideband.selected) > 1:
        return None
    return judge_signal(ratio, reconstruction)


def _judge_frames(
    acquisition: StepAcquisition, plan: Plan, saturation_dn: int, previous: Frame | None
) -> list[Judgement | None]:
    """Judge frame numbers, times and settings."""
    step, frames, condition = (
        acquisition.step,
        acquisition.frames,
        lock_condition(acquisition.step, plan),
    )
    period_s = float(plan.protocol.camera.period_s)
    return [
        judge_fresh(frames, acquisition.changed_s + float(step.settle_s), previous),
        judge_order(frames, period_s, previous),
        judge_settings(step.drive_hz, step.volts, acquisition.before, acquisition.after),
        judge_lock(acquisition.before, frames, condition),
        judge_lock(acquisition.after, frames, condition),
    ]


def lock_condition(step: Step, plan: Plan) -> LockCondition:
    """Return the condition that a step must satisfy to be locked."""
    tolerance_rad = float(plan.protocol.tolerance.lock_phase_rad)
    return LockCondition(step.order, plan.protocol.camera.frame_rate_hz, tolerance_rad)


def _dark_dn(plan: Plan) -> float:
    sheet = plan.bench.instruments.camera.data_sheet
    return sheet.offset_dn if sheet else 0.0
