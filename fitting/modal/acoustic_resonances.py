"""Find excitation peaks: narrow peaks of the fitted drive, such as acoustic resonances of the air.

The joint fit has a free drive for every hologram, so that an acoustic resonance moves no mode but
shows in the drive. In one sweep a peak of the drive may still belong to the reed, if no mode
explains it. A peak at the same frequency in several reeds does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import find_peaks

from holography.arrays import Array

# Width of the median filter that gives the drive without peaks, in steps.
_AROUND = 31
# Least prominence of a peak, in nepers, and largest width at half height, in steps.
_PROMINENCE, _WIDEST = 0.3, 8.0
# Peaks of several reeds are one if they are this close; a common peak needs this fraction of the
# reeds, and this many.
_SAME_CENTS, _MOST, _LEAST_REEDS = 40.0, 0.6, 3
_DB_PER_NEPER = 20 / np.log(10)


@dataclass(frozen=True)
class ExcitationPeak:
    """A peak of the drive.

    Attributes
    ----------
    hz : float
    height_db : float
        Height above the median of the drive around it.
    reeds : int
        Number of reeds that show it.
    """

    hz: float
    height_db: float
    reeds: int = 1


def find_excitation_peaks(drive_hz: Array, log_magnitude: Array) -> list[ExcitationPeak]:
    """Find peaks in the drive of one sweep.

    Parameters
    ----------
    drive_hz : (k,) float
        Drive frequencies, ascending, in equal intervals.
    log_magnitude : (k,) float
        Log magnitude of the drive per volt, in nepers.
    """
    rest = log_magnitude - median_filter(log_magnitude, _AROUND, mode="nearest")
    tops, _ = find_peaks(rest, prominence=_PROMINENCE, width=(None, _WIDEST))
    peaks = []
    for k in tops:
        bend = rest[k - 1] - 2 * rest[k] + rest[k + 1]
        shift = 0.5 * (rest[k - 1] - rest[k + 1]) / bend if bend else 0.0
        hz = float(np.exp(np.interp(k + shift, np.arange(len(drive_hz)), np.log(drive_hz))))
        top = rest[k] - 0.25 * (rest[k - 1] - rest[k + 1]) * shift
        peaks.append(ExcitationPeak(hz, float(_DB_PER_NEPER * top)))
    return peaks


def common_excitation_peaks(reeds: Sequence[Sequence[ExcitationPeak]]) -> list[ExcitationPeak]:
    """Find the peaks that most of several reeds show at the same frequency.

    Parameters
    ----------
    reeds : sequence of sequences of ExcitationPeak
        Peaks of each reed, of all its series.

    Returns
    -------
    list of ExcitationPeak
        In order of frequency, each shown by at least three reeds.
    """
    every = sorted(
        ((peak, number) for number, peaks in enumerate(reeds) for peak in peaks),
        key=lambda each: each[0].hz,
    )
    least, common = max(_LEAST_REEDS, _MOST * len(reeds)), []
    while every:
        # Windows of a fixed width: peaks in a row do not merge to one.
        windows = [_within(every, first) for first in range(len(every))]
        fullest = max(windows, key=lambda window: len({number for _, number in window}))
        count = len({number for _, number in fullest})
        if count < least:
            break
        hz = float(np.exp(np.median([np.log(peak.hz) for peak, _ in fullest])))
        height_db = float(np.median([peak.height_db for peak, _ in fullest]))
        common.append(ExcitationPeak(hz, height_db, count))
        every = [each for each in every if abs(_cents(each[0].hz, hz)) > _SAME_CENTS]
    return sorted(common, key=lambda peak: peak.hz)


def _within(
    every: list[tuple[ExcitationPeak, int]], first: int
) -> list[tuple[ExcitationPeak, int]]:
    """Return the peaks from number `first` on that are within 40 cents of it."""
    last = first
    while last < len(every) and _cents(every[last][0].hz, every[first][0].hz) < _SAME_CENTS:
        last += 1
    return every[first:last]


def _cents(hz: float, reference_hz: float) -> float:
    return 1200 * float(np.log2(hz / reference_hz))
