"""What one acquisition is worth: a verdict and a sentence, from numbers alone.

Of all that is wrong with a step the most severe is its verdict. `SEVERITY` orders them such that
each makes those after it meaningless: frames that are not consecutive, not in order or not whole
have no phase steps; frames from before the setting measure another setting; without a lock no
sideband is seen; saturated frames distort it; and only light that could have been there can be
missed.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from acquire.lock import lock_residual_hz, phase_error_rad
from drivers.roles import Frame
from holography.phase import PhaseAdvance


class Verdict(StrEnum):
    """What became of a step.

    Attributes
    ----------
    OK : the step can be used.
    DROPPED : frames are missing between the first and the last.
    DISORDERED : frames came twice or in another order, or their time stamps jump.
    PARTIAL : a frame is not filled to its end.
    STALE : an exposure began before the setting had settled, or was seen before.
    LOCK : what was played, or the real frame rate, misses the sideband.
    SATURATED : too many pixels are at their limit.
    NO_SIGNAL : the reed's region holds no more light than an empty one.
    PENDING : the step was not measured yet.
    INTERRUPTED : the step was begun and given up; it holds no data.
    SKIPPED : an instrument failed at this step and the run went on without it; it holds no data.
    """

    OK = "ok"
    DROPPED = "dropped"
    DISORDERED = "disordered"
    PARTIAL = "partial"
    STALE = "stale"
    LOCK = "lock"
    SATURATED = "saturated"
    NO_SIGNAL = "no_signal"
    PENDING = "pending"
    INTERRUPTED = "interrupted"
    SKIPPED = "skipped"

    @property
    def measured(self) -> bool:
        """Whether a step of this verdict holds data, good or bad."""
        return self not in (Verdict.PENDING, Verdict.INTERRUPTED, Verdict.SKIPPED)


SEVERITY: Final = (
    Verdict.DROPPED,
    Verdict.DISORDERED,
    Verdict.PARTIAL,
    Verdict.STALE,
    Verdict.LOCK,
    Verdict.SATURATED,
    Verdict.NO_SIGNAL,
    Verdict.OK,
)

# Hot pixels of a good CCD are some ten in a million.
SATURATED_SHARE_MAX: Final = 1e-4
# Of a frame period, and of the time between two frames, by which time stamps may be off.
_PERIOD_SHARE: Final = 0.5
_CLOCK_DRIFT: Final = 1e-4
_PHASE_DEVIATIONS: Final = 5.0
# Over four frames other sidebands turn the light by up to 0.02 rad on the simulated bench.
_PHASE_LEAK_RAD: Final = 0.03
# All light of the object over the noise: what the carrier has where the reed hardly moves. A good
# image; on a worse one less is leaked than is allowed for.
_CARRIER_TO_NOISE: Final = 1000.0
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
    """`DROPPED` unless there are as many frames as expected, and none is missing between them.

    In which order they came, and whether one came twice, `judge_order` tells.
    """
    ids = [frame.id for frame in frames]
    if len(ids) != expected:
        return Judgement(
            Verdict.DROPPED, f"{len(ids)} frames came instead of {expected}; check the camera's bus"
        )
    if max(ids) - min(ids) >= len(set(ids)):
        listed = ", ".join(str(id) for id in ids)
        return Judgement(
            Verdict.DROPPED,
            f"the frames are numbers {listed}, which are not consecutive; check the camera's bus "
            "and the load of the computer",
        )
    return None


def judge_order(
    frames: Sequence[Frame], period_s: float, previous: Frame | None = None
) -> Judgement | None:
    """`DISORDERED` unless time stamps follow the numbers of the frames.

    From each frame to the next, and from the last one of the acquisition before, so many periods
    have to pass as numbers. Of an interval, half a period and a ten-thousandth (clocks drift) may
    be missing or too much.

    Parameters
    ----------
    frames : sequence of Frame
        In the order in which they came.
    period_s : float
        Of the frames, as asked for.
    previous : Frame, optional
        Last one of the acquisition before, since when the camera did not stop.
    """
    chain = [frame for frame in (previous, *frames) if frame is not None]
    for before, after in pairwise(chain):
        if after.id <= before.id:
            # A number that was seen before is not new, see `judge_fresh`.
            if before is previous:
                continue
            return Judgement(
                Verdict.DISORDERED,
                f"frame {after.id} came after frame {before.id}; check the camera's bus and driver",
            )
        expected_s = (after.id - before.id) * period_s
        off_s = after.timestamp_s - before.timestamp_s - expected_s
        if abs(off_s) > _PERIOD_SHARE * period_s + _CLOCK_DRIFT * expected_s:
            return Judgement(
                Verdict.DISORDERED,
                f"from frame {before.id} to {after.id} the camera's clock went "
                f"{1e3 * (expected_s + off_s):.4g} ms instead of {1e3 * expected_s:.4g} ms; check "
                "its trigger and clock",
            )
    return None


def judge_whole(frames: Sequence[Frame], saturation_dn: int) -> Judgement | None:
    """`PARTIAL` if rows of a frame are empty, or those of the frame before.

    Light has noise: no row of it comes twice. A buffer that was not filled to its end holds zeros
    or what it held before. (Saturated rows are all alike, and judged as such.)
    """
    for frame in frames:
        empty = ~np.any(frame.image, axis=1)
        if empty.any() and not empty.all():
            return _partial(frame, empty, "empty")
    for before, after in pairwise(frames):
        same = np.all(before.image == after.image, axis=1)
        same &= np.any(after.image < saturation_dn, axis=1) & np.any(after.image, axis=1)
        if same.any():
            return _partial(after, same, f"those of frame {before.id}")
    return None


def _partial(frame: Frame, rows: npt.NDArray[np.bool_], what: str) -> Judgement:
    return Judgement(
        Verdict.PARTIAL,
        f"{np.count_nonzero(rows)} of {len(rows)} rows of frame {frame.id} are {what}; check the "
        "camera's bus and the load of the computer",
    )


def judge_fresh(
    frames: Sequence[Frame], ready_s: float, previous: Frame | None = None
) -> Judgement | None:
    """`STALE` if an exposure began before the last setting had settled, or is no new one.

    Parameters
    ----------
    frames : sequence of Frame
    ready_s : float
        When it had settled, on the camera's clock.
    previous : Frame, optional
        Last one of the acquisition before, since when the camera did not stop.
    """
    if previous is not None and min(frame.id for frame in frames) <= previous.id:
        return Judgement(
            Verdict.STALE,
            f"frame {min(frame.id for frame in frames)} is not later than frame {previous.id} of "
            "the step before; empty the camera's buffer",
        )
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


def judge_phase(
    phase: PhaseAdvance,
    condition: LockCondition,
    count: int,
    carrier_leak: float,
    signal_to_noise: float,
) -> Judgement | None:
    """`LOCK` if the frames themselves turn by more than the tolerance over the acquisition.

    What the light shows counts whatever instruments say, as far as it shows it: on top of the
    tolerance, `_PHASE_DEVIATIONS` standard errors are allowed, and what other sidebands may leak:
    where the reed hardly moves the carrier is many times as strong as the sideband. Light of fewer
    deviations than that above the noise shows nothing.

    Parameters
    ----------
    phase : PhaseAdvance
        Measured from the frames.
    condition : LockCondition
    count : int
        Frames of the acquisition.
    carrier_leak : float
        Amplitude of the carrier in the hologram per unit of the sideband's, were they equal.
    signal_to_noise : float
        Mean ``|H|²`` in the reed's region over that of an empty pixel; NaN without any noise.
    """
    # Where there is hardly any light, its deviations are the inverse of this error.
    if not phase.standard_error_rad < 1 / _PHASE_DEVIATIONS:
        return None
    turn_rad = count * abs(phase.error_rad)
    beyond_noise = math.inf if math.isnan(signal_to_noise) else max(signal_to_noise - 1, 1e-3)
    carrier = math.sqrt(_CARRIER_TO_NOISE / beyond_noise)
    # It may turn either of the two differences by as much as it has of the sideband's amplitude.
    leaked_rad = _PHASE_LEAK_RAD + 2 * count * carrier_leak * carrier
    uncertain_rad = count * _PHASE_DEVIATIONS * phase.standard_error_rad + leaked_rad
    allowed_rad = condition.tolerance_rad + uncertain_rad
    if turn_rad <= allowed_rad:
        return None
    error_hz = phase.error_rad / (2 * math.pi) * float(condition.frame_rate_hz)
    return Judgement(
        Verdict.LOCK,
        f"the light turns by {turn_rad:.3g} rad over {count} frames, {error_hz:+.3g} Hz off the "
        f"lock, at most {allowed_rad:.3g} rad can be; check that synthesizers, generator and "
        "camera share one clock",
    )


def judge_saturation(share: float) -> Judgement | None:
    """`SATURATED` if more than `SATURATED_SHARE_MAX` of all pixels are at their limit."""
    if share <= SATURATED_SHARE_MAX:
        return None
    return Judgement(
        Verdict.SATURATED,
        f"{100 * share:.3g} % of the pixels are saturated; weaken the local oscillator or shorten "
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
