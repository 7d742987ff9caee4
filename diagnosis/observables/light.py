"""Brightness of fringes during a campaign, noise, and what else is in the fringes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from diagnosis.observable_groups import (
    BANDS,
    Coordinates,
    Observable,
    ObservableGroup,
    band_of,
    observable_group,
)
from diagnosis.observable_source import GroupSource
from diagnosis.observables.carrier import Leaks, leaks_in
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.reed_at_rest import RestHolograms
from diagnosis.readings.sweeps import TEMPLATES, SweepReading, at_highest_level
from holography.arrays import Array
from physics.mechanics import ReedSolver
from physics.parameters.optics import Interference
from physics.parameters.tree import BenchParameters

# Pieces of a sweep's time.
_PIECES = 8
# Sweeps end together if they do within so much of log frequency.
_ENDS = 0.03
# Chance brightness is correlated over this many acquisitions.
_ALIKE = 3.0
# Log brightness: from one speckle to another, between order 0 and the others, in each band of
# sweeps of another clamping, in each sweep.
_SPECKLE, _ORDER, _BAND, _SWEEP = 10.0, 10.0, 0.03, 3e-3
# Log of the noise next to the image: its level, and from sweep to sweep.
_NOISE, _NOISE_SWEEP = 0.1, 2e-3
# ... and of a mean, for programs that record one noise for all.
_LEAST_NOISE = 1e-5
# Share of that noise that is shot noise of the local oscillator.
_SHOT = 0.96
# What templates show where nothing leaks: amplitude and its spread. Fringes that a block of pixels
# averages look a little like crosstalk. Like decorrelation they would look too, but the fit has
# taken their mean into account.
_FLOORS = {"sideband_crosstalk": (5e-3, 2.5e-3), "decorrelation": (0.0, 3e-5)}
# Share of a carrier that looks like the next sideband once it has been taken off, and what doubt
# that leaves of either.
_LEFT_OF_CARRIER, _OF_TAKEN_OFF = 0.2, (0.15, 3e-3)


def log_light(time_s: Array, beams: Interference) -> Array:
    """Return the log of the fringes' amplitude at times (any shape) since the campaign began."""
    after = time_s > 3600 * beams.hop_after_h
    lost: Array = -beams.fade_per_h * time_s / 3600 + np.log1p(-min(beams.hop, 0.95)) * after
    return lost


def brightness_group(
    sweeps: Sequence[SweepReading], stills: Sequence[RestHolograms]
) -> ObservableGroup:
    """Compare the brightness of fringes over time, of all sweeps and at rest.

    What holograms of one drive show is vibration times light: sweeps that repeat others tell how
    the light differs, whatever the vibration is. Sweeps at another level depend on the drive.
    """
    sweeps = at_highest_level(sweeps)
    table = _Brightness.of(sweeps)
    values, variance, places, columns = [], [], [], []
    pieces: list[tuple[int, NDArray[np.intp]]] = []
    spreads: list[float] = []
    for row, sweep in enumerate(sweeps):
        order = np.argsort(sweep.time_s)
        own = table.relative[row][order]
        spread = _scatter(own[table.within(row)[order]])
        spreads.append(spread)
        for number, every in enumerate(np.array_split(order, _PIECES)):
            piece = every[table.within(row)[every]]
            if not piece.size:
                continue
            values.append(float(np.median(table.relative[row][piece])))
            variance.append(_ALIKE * 1.57 * spread**2 / len(piece) + 1e-6)
            pieces.append((row, piece))
            places.append(Coordinates("fringes", time=f"{sweep.name} {number + 1}"))
            columns.append(table.shared(row, piece))
    still_s: list[float] = []
    for still in stills:
        # A few acquisitions may agree by chance; the light is that of the sweeps.
        own_spread = max(_scatter(still.brightness), float(np.median(spreads)), 5e-3)
        for number, at in enumerate(still.run_time_s):
            own_brightness = still.brightness[still.run == number]
            values.append(float(np.mean(own_brightness)))
            variance.append(_ALIKE * own_spread**2 / len(own_brightness))
            still_s.append(float(at))
            places.append(Coordinates("order 0", time=f"at rest {still.clamping + 1}.{number + 1}"))
            columns.append({f"speckle {still.clamping}": _SPECKLE, "order": _ORDER})

    def predict(parameters: BenchParameters) -> Array:
        relative = table.of_light(lambda time_s: log_light(time_s, parameters.optics.interference))
        of_sweeps = [float(np.median(relative[row][at])) for row, at in pieces]
        at_rest = log_light(np.array(still_s), parameters.optics.interference)
        return np.array([*of_sweeps, *at_rest])

    covariance = np.diag(variance) + _shared(columns)
    return observable_group(
        "brightness", Observable.FIELD, values, covariance, places, ("optics",), predict
    )


@dataclass(frozen=True)
class _Brightness:
    """Light of each sweep compared with the mean of sweeps of one clamping, by hologram.

    Attributes
    ----------
    sweeps : sequence of SweepReading
        Of one level.
    like : (s,) bool
        Sweeps of the first clamping.
    relative : tuple of (k,) float
    """

    sweeps: Sequence[SweepReading]
    like: NDArray[np.bool_]
    relative: tuple[Array, ...]

    @classmethod
    def of(cls, sweeps: Sequence[SweepReading]) -> "_Brightness":
        """Compare the sweeps of a campaign."""
        like = np.array([sweep.clamping == sweeps[0].clamping for sweep in sweeps])
        signals = [sweep.signal - np.log(sweep.volts) for sweep in sweeps]
        return cls(sweeps, like, cls(sweeps, like, ()).less_mean(signals))

    def less_mean(self, series: Sequence[Array]) -> tuple[Array, ...]:
        """Return series (k,) of each sweep less the mean over the first clamping's sweeps."""
        grid = np.log(self.sweeps[0].drive_hz)
        alike = [
            np.interp(grid, np.log(sweep.drive_hz), own)
            for sweep, own, counts in zip(self.sweeps, series, self.like, strict=True)
            if counts
        ]
        mean = np.mean(alike, axis=0)
        return tuple(
            own - np.interp(np.log(sweep.drive_hz), grid, mean)
            for sweep, own in zip(self.sweeps, series, strict=True)
        )

    def within(self, row: int) -> NDArray[np.bool_]:
        """Return which holograms (k,) of a sweep are at frequencies that all others have."""
        ends = [
            np.log(s.drive_hz) for s, counts in zip(self.sweeps, self.like, strict=True) if counts
        ]
        low, high = max(log.min() for log in ends), min(log.max() for log in ends)
        own = np.log(self.sweeps[row].drive_hz)
        inside: NDArray[np.bool_] = (own > low - _ENDS) & (own < high + _ENDS)
        return inside

    def of_light(self, light: Callable[[Array], Array]) -> tuple[Array, ...]:
        """Return the light expected relative to the mean, for a given light at each time."""
        return self.less_mean([light(sweep.time_s) for sweep in self.sweeps])

    def shared(self, row: int, piece: NDArray[np.intp]) -> dict[str, float]:
        """What a piece of a sweep shares with others, by name, with deviations."""
        sweep = self.sweeps[row]
        columns = {f"sweep {sweep.name}": _SWEEP}
        if self.like[row]:
            return columns
        columns[f"speckle beside {sweep.clamping}"] = _SPECKLE
        bands = np.array([band_of(hz) for hz in sweep.drive_hz[piece]])
        for band in BANDS:
            columns[f"{band} of {sweep.name}"] = _BAND * float(np.mean(bands == band))
        return columns


def noise_group(sweeps: Sequence[SweepReading]) -> ObservableGroup:
    """Compare noise next to the image, mostly shot noise of the local oscillator, over time.

    Fixed-pattern noise spreads fringes all over the image.
    """
    values, variance, places, times, fringes = [], [], [], [], []
    columns: list[dict[str, float]] = []
    for sweep in sweeps:
        order = np.argsort(sweep.time_s)
        log = np.log(sweep.noise_dn2)
        spread = _scatter(log[order])
        for number, piece in enumerate(np.array_split(order, _PIECES // 2)):
            values.append(float(np.mean(log[piece])))
            variance.append(max(1.2 * spread**2 / len(piece), _LEAST_NOISE**2))
            times.append(float(np.mean(sweep.time_s[piece])))
            fringes.append(float(np.mean(sweep.fringe_dn2[piece])))
            places.append(Coordinates("noise next to the image", time=f"{sweep.name} {number + 1}"))
            columns.append({"level": _NOISE, f"sweep {sweep.name}": _NOISE_SWEEP})
    usual, hours = float(np.mean(values)), np.array(times) / 3600
    beside = np.array(fringes) / np.exp(min(values))

    def predict(parameters: BenchParameters) -> Array:
        shot = usual - _SHOT * parameters.optics.interference.fade_per_h * hours
        noise: Array = shot + np.log1p(parameters.sensor.pattern**2 * beside)
        return noise

    covariance = np.diag(variance) + _shared(columns)
    return observable_group(
        "noise", Observable.SENSOR, values, covariance, places, ("optics", "sensor"), predict
    )


def fringe_group(sweeps: Sequence[SweepReading]) -> ObservableGroup | None:
    """Compare other light in the fringes, by templates, in all loud sweeps together.

    None if no hologram has any.

    Parameters
    ----------
    sweeps : sequence of SweepReading
    """
    loud = _with_fringes(at_highest_level(sweeps))
    if not loud:
        return None
    values = [_amplitudes(loud, name) for name in _FLOORS]
    floors = np.array(list(_FLOORS.values()))
    off = max(sweep.taken_off for sweep in loud)
    # A carrier goes as J0, the next sideband as J2: apart from a constant they are similar.
    alike = _LEFT_OF_CARRIER if off else 1.0

    def predict(parameters: BenchParameters) -> Array:
        beams = parameters.optics.interference
        mixed = np.sqrt(beams.crosstalk**2 + (alike * beams.leak) ** 2 + floors[0, 0] ** 2)
        return np.array([mixed, beams.decorrelation_per_rad2 + floors[1, 0]])

    places = [Coordinates(name.replace("_", " ")) for name in _FLOORS]
    errors = np.hypot(floors[:, 1], off * np.array(_OF_TAKEN_OFF))
    return observable_group(
        "fringes", Observable.MAPS, values, errors, places, ("optics",), predict
    )


def mixing_in(sweeps: Sequence[SweepReading]) -> float:
    """Amplitude of the next sideband in the loud sweeps, beyond what fringes look like anyway."""
    usual, spread = _FLOORS["sideband_crosstalk"]
    loud = _with_fringes(at_highest_level(sweeps))
    if not loud:
        return 0.0
    return max(_amplitudes(loud, "sideband_crosstalk") - usual - 2 * spread, 0.0)


def _with_fringes(sweeps: Sequence[SweepReading]) -> list[SweepReading]:
    """Sweeps of which at least one driven hologram has fringes."""
    told = [np.isfinite(sweep.template_variance).all(axis=0) & ~sweep.off for sweep in sweeps]
    return [sweep for sweep, there in zip(sweeps, told, strict=True) if there.any()]


def _amplitudes(sweeps: Sequence[SweepReading], name: str) -> float:
    t = TEMPLATES.index(name)
    return float(np.median([_amplitude(sweep, t, name) for sweep in sweeps]))


def _amplitude(sweep: SweepReading, t: int, name: str) -> float:
    """Amplitude of a template in a sweep: its mean where it is in phase, else root mean square."""
    told = np.isfinite(sweep.template_variance[t]) & ~sweep.off
    amplitude, variance = sweep.template[t, told], sweep.template_variance[t, told]
    if name == "decorrelation":
        return float(np.sum(amplitude.real / variance) / np.sum(1 / variance))
    square = np.sum((np.abs(amplitude) ** 2 - variance) / variance**2) / np.sum(1 / variance**2)
    return float(np.sqrt(max(square, 0.0)))


def _shared(columns: Sequence[dict[str, float]]) -> Array:
    """Covariance (n, n) of what is shared by numbers, each a name with a deviation."""
    names = sorted({name for column in columns for name in column})
    table = np.array([[column.get(name, 0.0) for name in names] for column in columns])
    shared: Array = table @ table.T
    return shared


def _scatter(series: Array) -> float:
    """Scatter from one number to the next, as of numbers without memory; 0 of fewer than two."""
    steps = np.diff(series)
    if not steps.size:
        return 0.0
    return float(1.4826 * np.median(np.abs(steps)) / np.sqrt(2))


def leaks_of(readings: Readings) -> Leaks:
    """Return what leaks into the sweeps of a campaign."""
    return leaks_in(readings.carriers, readings.sweeps, mixing_in(readings.sweeps))


def _brightness(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return brightness_group(readings.sweeps, readings.stills) if readings.sweeps else None


def _noise(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return noise_group(readings.sweeps) if readings.sweeps else None


def _fringes(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return fringe_group(readings.sweeps) if readings.sweeps else None


SOURCES: Final = (GroupSource(10, _brightness), GroupSource(11, _noise), GroupSource(12, _fringes))
