"""What one acquisition is worth: a verdict and a sentence, from numbers alone.

Of all that is wrong with a step the most severe is its verdict. `SEVERITY` orders them such that
each makes those after it meaningless: frames that are not consecutive have no phase steps; frames
from before the setting measure another setting; without a lock no sideband is seen; saturated
frames distort it; and only light that could have been there can be missed.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from typing import Final

import numpy as np
import numpy.typing as npt

from acquire.lock import lock_residual_hz, phase_error_rad
from drivers.roles import Frame
from holography.region import Region


class Verdict(StrEnum):
    """What became of a step.

    Attributes
    ----------
    OK : the step can be used.
    DROPPED : frames are missing between the first and the last.
    STALE : an exposure began before the setting had settled.
    LOCK : what was played, or the real frame rate, misses the sideband.
    SATURATED : too many pixels are at their limit.
    NO_SIGNAL : the reed's region holds no more light than an empty one.
    PENDING : the step was not measured yet.
    INTERRUPTED : the step was begun and given up; it holds no data.
    """

    OK = "ok"
    DROPPED = "dropped"
    STALE = "stale"
    LOCK = "lock"
    SATURATED = "saturated"
    NO_SIGNAL = "no_signal"
    PENDING = "pending"
    INTERRUPTED = "interrupted"

    @property
    def measured(self) -> bool:
        """Whether a step of this verdict holds data, good or bad."""
        return self not in (Verdict.PENDING, Verdict.INTERRUPTED)


SEVERITY: Final = (
    Verdict.DROPPED,
    Verdict.STALE,
    Verdict.LOCK,
    Verdict.SATURATED,
    Verdict.NO_SIGNAL,
    Verdict.OK,
)

# Hot pixels of a good CCD are some ten in a million.
SATURATED_SHARE_MAX: Final = 1e-4
# Once in three million empty steps noise alone exceeds this.
_SIGNAL_DEVIATIONS: Final = 5.0


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict, and one sentence that says why and what to do."""

    verdict: Verdict
    sentence: str


@dataclass(frozen=True, slots=True)
class ReadBack:
    """What the instruments said that they were playing during a step.

    Attributes
    ----------
    aom1_hz, aom2_hz, drive_hz : Fraction
    volts : float
        Peak volts at the load.
    """

    aom1_hz: Fraction
    aom2_hz: Fraction
    drive_hz: Fraction
    volts: float


@dataclass(frozen=True, slots=True)
class LockCondition:
    """What a step has to satisfy to be locked.

    Attributes
    ----------
    order : int
        Sideband n.
    frame_rate_hz : Fraction
        f_CCD, as asked for.
    tolerance_rad : float
        By how much the phase may turn over the acquisition.
    """

    order: int
    frame_rate_hz: Fraction
    tolerance_rad: float


def most_severe(judgements: Iterable[Judgement | None]) -> Judgement:
    """Return the judgement that `SEVERITY` has first; that all is well if there is none."""
    found = [judgement for judgement in judgements if judgement is not None]
    if not found:
        return Judgement(Verdict.OK, "all is well")
    return min(found, key=lambda judgement: SEVERITY.index(judgement.verdict))


def judge_consecutive(frames: Sequence[Frame], expected: int) -> Judgement | None:
    """`DROPPED` unless there are as many frames as expected, with ids one after the other."""
    ids = [frame.id for frame in frames]
    if len(ids) != expected:
        return Judgement(
            Verdict.DROPPED, f"{len(ids)} frames came instead of {expected}; check the camera's bus"
        )
    if ids != list(range(ids[0], ids[0] + expected)):
        listed = ", ".join(str(id) for id in ids)
        return Judgement(
            Verdict.DROPPED,
            f"the frames are numbers {listed}, which are not consecutive; check the camera's bus "
            "and the load of the computer",
        )
    return None


def judge_fresh(frames: Sequence[Frame], ready_s: float) -> Judgement | None:
    """`STALE` if an exposure began before `ready_s`, when the last setting had settled.

    Parameters
    ----------
    frames : sequence of Frame
    ready_s : float
        On the camera's clock.
    """
    early_s = ready_s - min(frame.timestamp_s for frame in frames)
    if early_s <= 0:
        return None
    return Judgement(
        Verdict.STALE,
        f"a frame began {1e3 * early_s:.3g} ms before the setting had settled; empty the camera's "
        "buffer or check its clock",
    )


def judge_lock(
    read_back: ReadBack, frames: Sequence[Frame], condition: LockCondition
) -> Judgement | None:
    """`LOCK` if the phase turns by more than the tolerance over the acquisition.

    The residual is that of the frequencies read back and, where two frames or more were taken, of
    the frame rate that their time stamps and ids tell.

    Parameters
    ----------
    read_back : ReadBack
    frames : sequence of Frame
        At least one.
    condition : LockCondition
    """
    asked_hz, count = condition.frame_rate_hz, len(frames)
    difference_hz = read_back.aom1_hz - read_back.aom2_hz
    residual_hz = lock_residual_hz(read_back.drive_hz, condition.order, asked_hz, difference_hz)
    turn_rad = phase_error_rad(residual_hz, count, asked_hz)
    if turn_rad > condition.tolerance_rad:
        return Judgement(
            Verdict.LOCK,
            f"AOM1 and AOM2 differ by {float(difference_hz):.10g} Hz, {float(residual_hz):.3g} Hz "
            f"off the lock: the phase turns by {turn_rad:.3g} rad, tolerance "
            f"{condition.tolerance_rad:g} rad; check both synthesizers",
        )
    measured_hz = frame_rate_hz(frames)
    if measured_hz is None:
        return None
    error_hz = Fraction(measured_hz) - asked_hz
    turn_rad = phase_error_rad(residual_hz - error_hz / 4, count, asked_hz)
    if turn_rad > condition.tolerance_rad:
        return Judgement(
            Verdict.LOCK,
            f"the camera takes {measured_hz:.7g} frames per second instead of "
            f"{float(asked_hz):.7g}: the phase turns by {turn_rad:.3g} rad, tolerance "
            f"{condition.tolerance_rad:g} rad; check its trigger and clock",
        )
    return None


def judge_saturation(share: float) -> Judgement | None:
    """`SATURATED` if more than `SATURATED_SHARE_MAX` of all pixels are at their limit."""
    if share <= SATURATED_SHARE_MAX:
        return None
    return Judgement(
        Verdict.SATURATED,
        f"{100 * share:.2g} % of the pixels are saturated; weaken the local oscillator or shorten "
        "the exposure",
    )


def judge_signal(signal_to_noise: float, reed_pixels: int, empty_pixels: int) -> Judgement | None:
    """`NO_SIGNAL` if the light in the reed's region could be noise, see `signal_threshold`."""
    threshold = signal_threshold(reed_pixels, empty_pixels)
    if signal_to_noise > threshold:
        return None
    return Judgement(
        Verdict.NO_SIGNAL,
        f"the reed shows no motion: signal to noise {signal_to_noise:.4g}, at least "
        f"{threshold:.4g} is needed; check the loudspeaker's cable, amplifier, laser and shutters",
    )


def signal_threshold(reed_pixels: int, empty_pixels: int) -> float:
    """Return the ratio of two means of noise that chance exceeds once in three million.

    Noise is circular Gaussian, so its ``|H|²`` is exponential with a standard deviation of one
    mean. The ratio of means over N and M pixels is then 1 with standard deviation
    ``√(1/N + 1/M)``; five of these are allowed.
    """
    return 1 + _SIGNAL_DEVIATIONS * math.sqrt(1 / reed_pixels + 1 / empty_pixels)


def frame_rate_hz(frames: Sequence[Frame]) -> float | None:
    """Return the frame rate by ids and time stamps; None for fewer than two frames."""
    first, last = frames[0], frames[-1]
    duration_s = last.timestamp_s - first.timestamp_s
    if last.id == first.id or duration_s <= 0:
        return None
    return (last.id - first.id) / duration_s


def saturated_share(frames: Sequence[Frame], saturation_dn: int) -> float:
    """Return the share of all pixels of all frames that are at `saturation_dn` or above."""
    return float(np.mean([np.mean(frame.image >= saturation_dn) for frame in frames]))


def signal_and_noise(
    image: npt.NDArray[np.complex64], reed: Region, empty: Region
) -> tuple[float, float]:
    """Mean ``|H|²`` in the reed's region over that of an empty one, and the latter.

    Parameters
    ----------
    image : (ny, nx) complex64
        Object image.
    reed, empty : Region

    Returns
    -------
    signal_to_noise, noise : float
        NaN and 0 for an image without any noise.
    """
    signal, noise = (_mean_power(region.crop(image)) for region in (reed, empty))
    return (signal / noise if noise > 0 else math.nan), noise


def _mean_power(field: npt.NDArray[np.complex64]) -> float:
    return float(np.mean(np.square(field.real)) + np.mean(np.square(field.imag)))
