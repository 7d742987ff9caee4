"""Logs and frequency lock of all steps of all sweeps."""

from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from diagnosis.observable_groups import (
    BANDS,
    Coordinates,
    Observable,
    ObservableGroup,
    band_of,
    observable_group,
    unknown_directions,
)
from diagnosis.observable_source import GroupSource
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.step_log import StepLog
from holography.arrays import Array
from holography.phase import steady_turn
from physics.mechanics import ReedSolver
from physics.parameters.tree import BenchParameters

# Crystals of cameras are right within 100 parts per million: by so much of a quarter turn per frame
# all locks may be off.
_CAMERA_CLOCK = 1e-4
# Fewest steps of a mean. Chosen: from fewer, nothing is known of their scatter.
_LEAST = 4
# Turns that are kept. Chosen: some hundred kilobytes.
_KEPT = 4096


def lost_frames_group(beat: StepLog) -> ObservableGroup:
    """Frames lost."""

    def predict(parameters: BenchParameters) -> Array:
        return np.array([2 * np.sqrt(beat.steps * parameters.clocks.lost_fraction + 3 / 8)])

    values, errors = [2 * np.sqrt(beat.lost + 3 / 8)], np.array([1.0])
    return observable_group(
        "frames", Observable.LOG, values, errors, [Coordinates("frames lost")], ("clocks",), predict
    )


def lock_scatter_hz(beat: StepLog) -> float | None:
    """Scatter of the lock about what depends on frequency and time, without the image's noise.

    None where hardly a lock has been measured.
    """
    if len(beat.lock_hz) < _LEAST:
        return None
    left = beat.lock_hz - _smooth(beat)
    whole = 1.4826 * float(np.median(np.abs(left - np.median(left))))
    noise = float(np.median(beat.error_hz))
    return float(np.sqrt(max(whole**2 - noise**2, (0.1 * whole) ** 2)))


def _smooth(beat: StepLog) -> Array:
    columns = np.stack(
        [np.ones_like(beat.time_s), beat.drive_hz / 1e4 - 1, beat.time_s / 1e3 - 0.5], axis=1
    )
    found: Array = columns @ np.linalg.lstsq(columns, beat.lock_hz, rcond=None)[0]
    return found


def turn_of_unequal_steps(parameters: BenchParameters) -> float:
    """Return what unequal phase steps, every other one, add to the turn that fits four frames best.

    A third of the error, to first order; at 0.15 rad the square adds a twentieth of that.
    """
    return _turn_of_steps(parameters.optics.interference.quarter_error_rad)


@lru_cache(maxsize=_KEPT)
def _turn_of_steps(error_rad: float) -> float:
    """Return the turn in rad that is found in four frames without noise; see `steady_turn`."""
    if not error_rad:
        return 0.0
    frames = np.exp(1j * (np.array([0, error_rad, 0, error_rad]) - 0.5 * np.pi * np.arange(4)))
    U = frames.astype(np.complex64).reshape(4, 1, 1)
    found = steady_turn(U[0] - U[2], U[1] - U[3], U[0] + U[2] - U[1] - U[3], 0.0)
    return -found.error_rad


def _scatter_of_bands(beat: StepLog, bands: NDArray[Any]) -> dict[Any, float]:
    """Standard deviation of the lock in each band, about what depends on frequency and time.

    Of the steps themselves, because their standard errors know the image's noise only: light of
    other sidebands scatters the locks of low frequencies several times as much.
    """
    left = beat.lock_hz - _smooth(beat)
    return {band: float(np.sqrt(np.mean(left[bands == band] ** 2))) for band in set(bands)}


def lock_group(beat: StepLog, rate_hz: float) -> ObservableGroup | None:
    """Lock of every sweep in every band; None if nowhere are enough measured.

    Parameters
    ----------
    beat : StepLog
    rate_hz : float
        Frames per second.
    """
    if not len(beat.lock_hz):
        return None
    bands = np.array([band_of(hz) for hz in beat.drive_hz])
    scatter_hz = _scatter_of_bands(beat, bands)
    values, errors, places, hz, hours = [], [], [], [], []
    for number, name in enumerate(beat.names):
        for band in BANDS:
            chosen = (beat.sweep == number) & (bands == band)
            if np.count_nonzero(chosen) < _LEAST:
                continue
            own = max(scatter_hz[band], float(np.median(beat.error_hz[chosen])))
            values.append(float(np.mean(beat.lock_hz[chosen])))
            errors.append(own / np.sqrt(np.count_nonzero(chosen)))
            places.append(Coordinates("lock", band=band, time=name))
            hz.append(float(np.mean(beat.drive_hz[chosen])))
            hours.append(float(np.mean(beat.time_s[chosen])) / 3600)
    if not values:
        return None
    # Light of other sidebands shifts the lock of a step in every sweep by the same.
    of_band = {band: np.array([place.band == band for place in places]) for band in BANDS}
    repeated = [
        (chosen.astype(float), float(np.max(np.array(errors)[chosen])))
        for chosen in of_band.values()
        if chosen.any()
    ]

    def predict(parameters: BenchParameters) -> Array:
        clocks = parameters.clocks
        lock = clocks.detuning_hz + clocks.detuning_hz_h * np.array(hours)
        lock = lock - 1e-6 * clocks.generator_ppm * np.array(hz)
        return lock - turn_of_unequal_steps(parameters) * rate_hz / (2 * np.pi)

    covariance = np.diag(np.square(errors)) + unknown_directions(
        (np.ones(len(values)), _CAMERA_CLOCK * rate_hz / 4), *repeated
    )
    return observable_group(
        "lock", Observable.HOLOGRAM, values, covariance, places, ("clocks", "optics"), predict
    )


def _lock(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return lock_group(readings.beat, readings.rate_hz)


SOURCES: Final = (
    GroupSource(0, lambda readings, _reed_solver: lost_frames_group(readings.beat)),
    GroupSource(4, _lock),
)
