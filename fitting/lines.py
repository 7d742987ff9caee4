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
# Lines of several sweeps are one if they are this close, and stay if so many of them have it.
_SAME_CENTS, _MOST, _LEAST_SWEEPS = 40.0, 0.6, 3
_DB_PER_NEPER = 20 / np.log(10)


@dataclass(frozen=True)
class Line:
    """A feature of the drive.

    Attributes
    ----------
    hz : float
    height_db : float
        Of its top above the median of the drive around it.
    sweeps : int
        How many sweeps, or reeds, show it.
    """

    hz: float
    height_db: float
    sweeps: int = 1


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


def common_lines(sweeps: Sequence[Sequence[Line]]) -> list[Line]:
    """Lines that stay at the same frequency in most of several sweeps of different reeds.

    Parameters
    ----------
    sweeps : sequence of sequences of Line
        Of at least three reeds; of fewer, nothing stays.
    """
    if len(sweeps) < _LEAST_SWEEPS:
        return []
    found = sorted(
        ((line, number) for number, lines in enumerate(sweeps) for line in lines),
        key=lambda each: each[0].hz,
    )
    common, group = [], found[:1]
    for line, number in [*found[1:], (Line(np.inf, 0.0), -1)]:
        if group and 1200 * np.log2(line.hz / group[-1][0].hz) < _SAME_CENTS:
            group.append((line, number))
            continue
        count = len({n for _, n in group})
        if count >= _MOST * len(sweeps):
            hz = float(np.exp(np.median([np.log(each.hz) for each, _ in group])))
            height_db = float(np.median([each.height_db for each, _ in group]))
            common.append(Line(hz, height_db, count))
        group = [(line, number)]
    return common
