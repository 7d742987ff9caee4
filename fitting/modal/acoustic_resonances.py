"""Lines of the air: where the drive of a sweep stands out of itself, whatever the reed does.

The joint fit leaves the drive of every hologram free, so that no line moves a mode; what the drive
came out as shows the line. In one sweep it may still be something of the reed that no mode tells;
what stays at the same frequency from reed to reed is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.signal import find_peaks

Array = NDArray[np.floating[Any]]

# Steps over which the drive's median is what it would be without lines.
_AROUND = 31
# A line stands out of its flanks by this, in nepers, and is no wider than this many steps at half.
_PROMINENCE, _WIDEST = 0.3, 8.0
# Lines of several reeds are one if they are this close, and stay if so many of them show it.
_SAME_CENTS, _MOST, _LEAST_REEDS = 40.0, 0.6, 3
_DB_PER_NEPER = 20 / np.log(10)


@dataclass(frozen=True)
class Line:
    """A feature of the drive.

    Attributes
    ----------
    hz : float
    height_db : float
        Of its top above the median of the drive around it.
    reeds : int
        How many show it.
    """

    hz: float
    height_db: float
    reeds: int = 1


def drive_lines(drive_hz: Array, log_magnitude: Array) -> list[Line]:
    """Find lines in the drive of one sweep.

    Parameters
    ----------
    drive_hz : (k,) float
        Ascending, in equal intervals.
    log_magnitude : (k,) float
        Of the drive per volt, in nepers.
    """
    rest = log_magnitude - median_filter(log_magnitude, _AROUND, mode="nearest")
    tops, _ = find_peaks(rest, prominence=_PROMINENCE, width=(None, _WIDEST))
    lines = []
    for k in tops:
        bend = rest[k - 1] - 2 * rest[k] + rest[k + 1]
        shift = 0.5 * (rest[k - 1] - rest[k + 1]) / bend if bend else 0.0
        hz = float(np.exp(np.interp(k + shift, np.arange(len(drive_hz)), np.log(drive_hz))))
        top = rest[k] - 0.25 * (rest[k - 1] - rest[k + 1]) * shift
        lines.append(Line(hz, float(_DB_PER_NEPER * top)))
    return lines


def common_lines(reeds: Sequence[Sequence[Line]]) -> list[Line]:
    """Lines that stay at the same frequency in the sweeps of most of several reeds.

    Parameters
    ----------
    reeds : sequence of sequences of Line
        Of each reed, in whatever series; of fewer than three, nothing stays.

    Returns
    -------
    list of Line
        In order of frequency; each with how many reeds show it, at least three.
    """
    every = sorted(
        ((line, number) for number, lines in enumerate(reeds) for line in lines),
        key=lambda each: each[0].hz,
    )
    least, common = max(_LEAST_REEDS, _MOST * len(reeds)), []
    while every:
        # Windows of one width: however many features there are, they do not chain.
        windows = [_within(every, first) for first in range(len(every))]
        fullest = max(windows, key=lambda window: len({number for _, number in window}))
        count = len({number for _, number in fullest})
        if count < least:
            break
        hz = float(np.exp(np.median([np.log(line.hz) for line, _ in fullest])))
        height_db = float(np.median([line.height_db for line, _ in fullest]))
        common.append(Line(hz, height_db, count))
        every = [each for each in every if abs(_cents(each[0].hz, hz)) > _SAME_CENTS]
    return sorted(common, key=lambda line: line.hz)


def _within(every: list[tuple[Line, int]], first: int) -> list[tuple[Line, int]]:
    """Lines from one on that are the same as it."""
    last = first
    while last < len(every) and _cents(every[last][0].hz, every[first][0].hz) < _SAME_CENTS:
        last += 1
    return every[first:last]


def _cents(hz: float, reference_hz: float) -> float:
    return 1200 * float(np.log2(hz / reference_hz))
