"""Lost frames and lock errors of all steps of all sweeps."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from diagnosis.campaign import CampaignRun
from holography.arrays import Array
from runs.verdict import Verdict

# What steps are worth of which frames were missing, twice the same, or in another order.
_LOST = (Verdict.PARTIAL, Verdict.DROPPED, Verdict.DISORDERED)


@dataclass(frozen=True)
class StepLog:
    """All steps of all sweeps.

    Attributes
    ----------
    steps, lost : int
        Acquisitions, and those of them in which a frame was missing or twice the same. Those that
        were measured again count, too: most steps that lose a frame are good at the second attempt.
    lock_hz, error_hz : (k,) float
        By which the lock was missed, and standard errors; of steps with light enough.
    drive_hz, time_s : (k,) float
    acquired_s : (n,) float
        Times of all acquisitions, also of those without light enough.
    sweep : (k,) int
    names : tuple of str
        Of the sweeps.
    """

    steps: int
    lost: int
    lock_hz: Array
    error_hz: Array
    drive_hz: Array
    time_s: Array
    sweep: NDArray[np.intp]
    names: tuple[str, ...]
    acquired_s: Array = field(default_factory=lambda: np.zeros(0))


def read_step_log(parts: Sequence[CampaignRun]) -> StepLog:
    """Read the steps of sweeps."""
    rows, acquired_s, lost, count = [], [], 0, 0
    for number, part in enumerate(parts):
        for attempt in (*part.run.steps, *part.run.earlier_attempts):
            if not attempt.verdict.measured:
                continue
            acquired_s.append(float(np.mean(attempt.timestamps_s)) - part.clock_s)
            if attempt.order == part.run.sideband_order:
                count += 1
                lost += attempt.verdict in _LOST
        for step in part.run.steps:
            if step.order != part.run.sideband_order:
                continue
            if step.verdict is Verdict.OK and np.isfinite(step.lock_error_se_hz):
                hz = float(step.read_drive_hz or step.drive_hz)
                time_s = float(np.mean(step.timestamps_s)) - part.clock_s
                rows.append((step.lock_error_hz, step.lock_error_se_hz, hz, time_s, number))
    lock, error, hz, time_s, number_ = np.reshape(np.array(rows, dtype=float), (-1, 5)).T
    names = tuple(part.name for part in parts)
    acquired = np.sort(np.array(acquired_s))
    return StepLog(count, lost, lock, error, hz, time_s, number_.astype(int), names, acquired)
