"""Judge the frames of one acquisition as the camera delivered them: number, order, content."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from drivers.roles import Frame
from runs.verdict import Judgement, Verdict

# Largest allowed fraction of saturated pixels. Chosen: a good CCD has about ten hot pixels in a
# million; ten times that are allowed.
SATURATED_SHARE_MAX: Final = 1e-4

# Largest error of a time stamp, as a fraction of a frame period. Chosen: a missing or repeated
# frame changes the time by a whole period.
_STAMP_TOLERANCE: Final = 0.5

# Largest drift of the camera's clock, per unit of time. Chosen: quartz clocks drift by less than
# 1e-4.
_CLOCK_DRIFT: Final = 1e-4


def judge_consecutive(frames: Sequence[Frame], expected: int) -> Judgement | None:
    """Return `DROPPED` if the number of frames is wrong, or a frame is missing between others.

    `judge_order` finds frames in the wrong order and frames that came twice.

    Parameters
    ----------
    frames : sequence of Frame
    expected : int
        Number of frames that were requested.

    Returns
    -------
    Judgement or None
        None if no frame is missing.
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
    """Return `DISORDERED` unless the time stamps of frames agree with their numbers.

    If the number of a frame is k above that of the frame before, its time stamp must be k periods
    later, within half a period and 1e-4 of the interval (drift of the clock). This includes the
    interval from the last frame of the acquisition before.

    Parameters
    ----------
    frames : sequence of Frame
        In the order in which they came.
    period_s : float
        Requested frame period, in s.
    previous : Frame, optional
        Last frame of the acquisition before, if the camera was not restarted since.

    Returns
    -------
    Judgement or None
        None if the order is right.
    """
    chain = [frame for frame in (previous, *frames) if frame is not None]
    for before, after in pairwise(chain):
        if after.id <= before.id:
            # `judge_fresh` judges frames that were returned in the acquisition before.
            if before is previous:
                continue
            return Judgement(
                Verdict.DISORDERED,
                f"frame {after.id} came after frame {before.id}; check the camera's bus and driver",
            )
        expected_s = (after.id - before.id) * period_s
        off_s = after.timestamp_s - before.timestamp_s - expected_s
        if abs(off_s) > _STAMP_TOLERANCE * period_s + _CLOCK_DRIFT * expected_s:
            return Judgement(
                Verdict.DISORDERED,
                f"from frame {before.id} to {after.id} the camera's clock advanced by "
                f"{1e3 * (expected_s + off_s):.4g} ms instead of {1e3 * expected_s:.4g} ms; check "
                "its trigger and clock",
            )
    return None


def judge_whole(frames: Sequence[Frame], saturation_dn: int) -> Judgement | None:
    """Return `PARTIAL` if rows of a frame are empty, or equal to those of the frame before.

    Light has noise, so no row of light repeats exactly. A buffer that was not filled to its end
    holds zeros or its old content. Saturated rows are also equal; `judge_saturation` judges them.

    Parameters
    ----------
    frames : sequence of Frame
    saturation_dn : int
        Value of a saturated pixel.

    Returns
    -------
    Judgement or None
        None if all frames are complete.
    """
    for frame in frames:
        empty = ~np.any(frame.image, axis=1)
        if empty.any() and not empty.all():
            return _partial(frame, empty, "empty")
    for before, after in pairwise(frames):
        same = np.all(before.image == after.image, axis=1)
        same &= np.any(after.image < saturation_dn, axis=1) & np.any(after.image, axis=1)
        if same.any():
            return _partial(after, same, f"equal to those of frame {before.id}")
    return None


def _partial(frame: Frame, rows: npt.NDArray[np.bool_], state: str) -> Judgement:
    return Judgement(
        Verdict.PARTIAL,
        f"{np.count_nonzero(rows)} of {len(rows)} rows of frame {frame.id} are {state}; check the "
        "camera's bus and the load of the computer",
    )


def judge_fresh(
    frames: Sequence[Frame], ready_s: float, previous: Frame | None = None
) -> Judgement | None:
    """Return `STALE` if an exposure began before the setting had settled, or a frame is old.

    Parameters
    ----------
    frames : sequence of Frame
    ready_s : float
        Time at which the setting had settled, on the camera's clock, in s.
    previous : Frame, optional
        Last frame of the acquisition before, if the camera was not restarted since.

    Returns
    -------
    Judgement or None
        None if all frames are new and began in time.
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


def judge_saturation(share: float) -> Judgement | None:
    """Return `SATURATED` if more than `SATURATED_SHARE_MAX` of all pixels are saturated."""
    if share <= SATURATED_SHARE_MAX:
        return None
    return Judgement(
        Verdict.SATURATED,
        f"{100 * share:.3g} % of the pixels are saturated; weaken the local oscillator or shorten "
        "the exposure",
    )


def frame_rate_hz(frames: Sequence[Frame]) -> float | None:
    """Return the frame rate from numbers and time stamps; None for fewer than two frames."""
    first, last = frames[0], frames[-1]
    duration_s = last.timestamp_s - first.timestamp_s
    if last.id == first.id or duration_s <= 0:
        return None
    return (last.id - first.id) / duration_s


def saturated_share(frames: Sequence[Frame], saturation_dn: int) -> float:
    """Return the fraction of all pixels of all frames that are at `saturation_dn` or above."""
    return float(np.mean([np.mean(frame.image >= saturation_dn) for frame in frames]))
