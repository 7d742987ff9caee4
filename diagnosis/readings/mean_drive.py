"""The drive of all sweeps of a campaign, hologram by hologram."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter

from diagnosis.readings.sweeps import SweepReading
from holography.arrays import Array

# Frequencies of two sweeps that lie no further apart, in log, are one: a generator may not play
# quite what it is asked to. Chosen: a fifteenth of a step of 25 cents; of narrower steps a quarter.
_SAME_HZ, _OF_STEP = 1e-3, 0.25
# Log frequency over which sweeps may differ smoothly: 375 cents, a resonance of quality 5; and the
# fewest holograms. At the ends little tells what is smooth: share of the range, and error of the
# log there. Chosen.
_AROUND, _FEWEST_AROUND, _END_SHARE, _END = 0.217, 5, 0.06, 0.1
# Error of the log drive of one hologram at least. Chosen: gains scatter by half a per cent a step,
# and light follows them.
_LEAST = 0.01
# Beyond this frequency modes are too dense to separate them from the drive.
_HIGHEST_HZ = 16.5e3


def mean_drive(sweeps: Sequence[SweepReading]) -> tuple[Array, Array, Array, Array]:
    """Frequencies, log drive per volt and errors (k,) of all holograms, by all sweeps.

    What sweeps differ by smoothly is anyone's; where they differ from hologram to hologram, some of
    their fits are wrong there. Where a mode lies in a notch, every fit divides it in the same way:
    the errors (k, k) of the fits themselves, which come last, do not decrease with their number.
    """
    every = np.array(sorted({float(f) for s in sweeps for f in s.drive_hz}))
    new = np.diff(np.log(every), prepend=-np.inf) > same_hz(sweeps)
    hz, place = every[new], np.cumsum(new) - 1
    table = np.full((len(sweeps), len(hz)), np.nan)
    pairs = np.zeros((len(hz), len(hz)))
    for row, sweep in zip(table, sweeps, strict=True):
        good = np.flatnonzero(~sweep.off)
        at = place[np.searchsorted(every, sweep.drive_hz[good])]
        row[at] = sweep.log_drive[good]
        pairs[np.ix_(at, at)] += sweep.log_drive_covariance[np.ix_(good, good)]
    count = np.sum(np.isfinite(table), axis=0)
    seen = (count >= min(2, len(sweeps))) & (hz < _HIGHEST_HZ)
    hz, table, count = hz[seen], table[:, seen], count[seen]
    # The mean over sweeps of each covariance, also where they have not the same frequencies: a sum
    # of covariances, which a mean over those that have both frequencies need not be.
    fitted = pairs[np.ix_(seen, seen)] / np.sqrt(np.multiply.outer(count, count))
    if not hz.size:
        return hz, hz, hz, fitted
    middle = np.nanmedian(table, axis=0)
    apart = np.where(np.isfinite(table), table - middle, 0.0)
    around = _AROUND / float(np.median(np.diff(np.log(hz)))) if len(hz) > 1 else 1.0
    apart -= median_filter(apart, (1, max(round(around), _FEWEST_AROUND)), mode="nearest")
    mean = middle + np.sum(apart, axis=0) / count
    error = np.sqrt(np.sum(apart**2, axis=0) / np.maximum(count - 1, 1))
    pitch = np.log(hz / np.sqrt(hz[0] * hz[-1]))
    ends = np.clip((np.abs(pitch) / np.abs(pitch).max() - 1) / _END_SHARE + 1, 0, 1)
    return hz, mean, np.sqrt(_LEAST**2 + error**2 + (_END * ends) ** 2), fitted


def same_hz(sweeps: Sequence[SweepReading]) -> float:
    """Return up to which log distance frequencies of two sweeps are one."""
    steps = [np.diff(np.sort(np.log(sweep.drive_hz))) for sweep in sweeps]
    narrow = min((float(step[step > 0].min(initial=np.inf)) for step in steps), default=np.inf)
    return min(_SAME_HZ, _OF_STEP * narrow)
