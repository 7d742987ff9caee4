"""What the frames of one acquisition are worth as a camera delivered them."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from drivers.roles import Frame
from runs.verdict import Judgement, Verdict

# Hot pixels of a good CCD are some ten in a million.
SATURATED_SHARE_MAX: Final = 1e-4

# Of a frame period, and of the time between two frames, by which time stamps may be off.
_PERIOD_SHARE: Final = 0.5

_CLOCK_DRIFT: Final = 1e-4


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


def judge_saturation(share: float) -> Judgement | None:
    """`SATURATED` if more than `SATURATED_SHARE_MAX` of all pixels are at their limit."""
    if share <= SATURATED_SHARE_MAX:
        return None
    return Judgement(
        Verdict.SATURATED,
        f"{100 * share:.3g} % of the pixels are saturated; weaken the local oscillator or shorten "
        "the exposure",
    )


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
