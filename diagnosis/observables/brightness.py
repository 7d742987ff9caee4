"""Brightness of fringes during a campaign, and what light changes by."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from diagnosis.observable_groups import (
    BANDS,
    DISORDER,
    Coordinates,
    Errors,
    GroupNuisances,
    Observable,
    ObservableGroup,
    band_of,
    observable_group,
)
from diagnosis.observable_source import GroupSource
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.reed_at_rest import RestHolograms
from diagnosis.readings.sweeps import SweepReading, at_highest_level
from holography.arrays import Array
from physics.mechanics import ReedSolver
from physics.optics import log_laser_power
from physics.parameters.disorder import BY_NAME
from physics.parameters.optics import Interference
from physics.parameters.tree import BenchParameters

_CHANGES = BY_NAME["field_change"].ordinary.source
# Time of an acquisition where there are none: four frames at the paper's 12.4 Hz, and settling.
_USUAL_S = 0.4
# Pieces of a sweep's time. Chosen: of 184 steps, each has more than 20.
PIECES = 8
# Sweeps end together if they do within two steps of 25 cents.
_ENDS = 0.03
# Weights of interpolation that are rounding errors of equal frequencies.
_ROUNDING = 1e-6
# Chance brightness is correlated over this many acquisitions. Chosen: more than 1, as
# it would be if nothing lasted.
_ALIKE = 3.0
# Log brightness that is anyone's: from one speckle to another, and between order 0 and the others.
_SPECKLE, _ORDER = 10.0, 10.0
# Relative change of the light of an ordinary bench from one acquisition to the next, which adds up
# as a random walk does.
FIELD_CHANGE = BY_NAME["field_change"].ordinary.root_mean_square
# Mean distance of neighbouring modes, in log frequency: Table 1 of the paper has 13 of series A,
# from 1996 to 18 497 Hz. Shapes, and so what they see of local light, change over this distance.
_MODE_DISTANCE = 0.19
# Light and vibration of a sweep are confounded as finely as modes are (decision 0047): log
# brightness of each sweep; and in each band of a sweep of another clamping. Chosen.
_SWEEP, _BAND = 0.01, 0.03
# Least error of the log brightness of a piece. Chosen: a tenth of a per cent of brightness.
_LEAST = 1e-3
# Variance of a median around the mean of the same numbers, over that of the mean, of normal ones.
_OF_MEDIAN = 0.5 * np.pi - 1


def log_light(time_s: Array, beams: Interference) -> Array:
    """Return the log of the fringes' amplitude at times (any shape) since the campaign began."""
    after = time_s > 3600 * beams.hop_after_h
    hop: Array = np.log1p(-min(beams.hop, 0.95)) * after
    # Both beams are of the laser's power, and fringes are the product of both amplitudes.
    return log_laser_power(beams, time_s) + hop


def brightness_group(
    sweeps: Sequence[SweepReading], stills: Sequence[RestHolograms]
) -> ObservableGroup:
    """Compare the brightness of fringes over time, of all sweeps and at rest.

    What holograms of one drive show is vibration times light: sweeps that repeat others tell how
    the light differs, whatever the vibration is. Sweeps at another level depend on the drive.
    """
    acquired_s = acquisition_times_s(sweeps)
    sweeps = at_highest_level(sweeps)
    table = _Brightness.of(sweeps)
    values, variance, places, columns = [], [], [], []
    pieces: list[tuple[int, NDArray[np.intp]]] = []
    spreads: list[float] = []
    for row, sweep in enumerate(sweeps):
        order = np.argsort(sweep.time_s)
        own = table.relative[row][order]
        spread = scatter_of(own[table.within(row)[order]])
        spreads.append(spread)
        for number, every in enumerate(np.array_split(order, PIECES)):
            piece = every[table.within(row)[every]]
            if not piece.size:
                continue
            values.append(float(np.median(table.relative[row][piece])))
            variance.append(_ALIKE * _OF_MEDIAN * spread**2 / len(piece) + _LEAST**2)
            pieces.append((row, piece))
            places.append(Coordinates("fringes", time=f"{sweep.name} {number + 1}"))
            columns.append(table.shared(row, piece))
    still_s: list[float] = []
    for still in stills:
        # A few acquisitions may agree by chance; the light is that of the sweeps.
        own_spread = max(scatter_of(still.brightness), float(np.median(spreads)), 5e-3)
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

    errors = _errors(
        table, pieces, variance, columns, spreads, np.array(still_s), acquired_s,
    )  # fmt: skip
    return observable_group(
        "brightness", Observable.FIELD, values, errors, places, ("optics",), predict
    )


def _errors(
    table: "_Brightness",
    pieces: Sequence[tuple[int, NDArray[np.intp]]],
    variance: Sequence[float],
    columns: Sequence[dict[str, float]],
    spreads: Sequence[float],
    still_s: Array,
    acquired_s: Array,
) -> Errors:
    """Return the errors of n numbers: of pieces of sweeps, then of runs at rest.

    Parameters
    ----------
    table : _Brightness
    pieces : sequence of (int, (p,) int)
        Number of a sweep and its holograms.
    variance : (n,) sequence of float
        What each number scatters by itself.
    columns : (n,) sequence of dict
        What numbers share, by name.
    spreads : (s,) sequence of float
        See `_of_holograms`.
    still_s : (r,) float
        Times at rest.
    acquired_s : (k,) float
        Times of all acquisitions.
    """
    usual = {name for column in columns for name in column if _is_open(name)}
    seen, own = _as_pieces(table, pieces), np.zeros((len(variance), len(table.sweeps)))
    noise = np.diag(variance) + _shared([_chosen(column, usual) for column in columns])
    noise[: len(pieces), : len(pieces)] += _of_holograms(table, seen, spreads)
    own[: len(pieces)] = _SWEEP * seen @ _of_sweeps(table)
    others = columns_of([_chosen(column, {*column} - usual) for column in columns])
    light = GroupNuisances("light of sweeps", np.hstack([own, others]), DISORDER, "decision 0047")
    return Errors(noise, (light, *_changes(table, seen, still_s, acquired_s)))


def _is_open(name: str) -> bool:
    """Whether brightness is anyone's in such a comparison: of other speckle, of another order."""
    return name.startswith(("speckle", "order"))


def _chosen(column: dict[str, float], names: set[str]) -> dict[str, float]:
    return {name: size for name, size in column.items() if name in names}


def _of_sweeps(table: "_Brightness") -> Array:
    """Return of which sweep (k, s) each hologram of all sweeps is."""
    counts = [len(sweep.time_s) for sweep in table.sweeps]
    return np.repeat(np.eye(len(counts)), counts, axis=0)


def _of_holograms(table: "_Brightness", seen: Array, spreads: Sequence[float]) -> Array:
    """Return the covariance (n, n) of pieces by what single holograms scatter.

    Parameters
    ----------
    table : _Brightness
    seen : (n, k) float
        See `_as_pieces`.
    spreads : (s,) sequence of float
        By which holograms of each sweep scatter around the mean of sweeps, which takes along a
        share of it.
    """
    like = max(int(np.count_nonzero(table.like)), 1)
    own = np.square(spreads) * (like / max(like - 1, 1))
    return np.asarray(_ALIKE * (seen * (_of_sweeps(table) @ own)) @ seen.T)


def _changes(
    table: "_Brightness",
    seen: Array,
    still_s: Array,
    acquired_s: Array,
) -> tuple[GroupNuisances, GroupNuisances]:
    """Return what light changes by as a random walk, on all of the reed, and here and there.

    Where the reed moves, light counts, and that changes from mode to mode: what one frequency sees
    of a local change, another one does not. The mean over a reed at rest shows nothing of it.

    Parameters
    ----------
    table : _Brightness
    seen : (n, k) float
        See `_as_pieces`.
    still_s : (r,) float
        Times at rest.
    acquired_s : (k,) float
        Times of all acquisitions.
    """
    at_s, rest = acquisition_times_s(table.sweeps), np.eye(len(still_s))
    steps = acquired_until(np.concatenate([at_s, still_s]), acquired_s)
    walk = np.minimum.outer(steps, steps)
    log_hz = np.log(np.concatenate([sweep.drive_hz for sweep in table.sweeps]))
    near = np.exp(-0.5 * (np.subtract.outer(log_hz, log_hz) / _MODE_DISTANCE) ** 2)
    of_all, local = block_diag(seen, rest), block_diag(seen, 0 * rest)
    columns = (
        FIELD_CHANGE * _root(of_all @ walk @ of_all.T),
        FIELD_CHANGE * _root(local @ (walk * block_diag(near, rest)) @ local.T),
    )
    names = "changing field", "locally changing field"
    everywhere, here = (
        GroupNuisances(name, own, DISORDER, _CHANGES)
        for name, own in zip(names, columns, strict=True)
    )
    return everywhere, here


def _as_pieces(table: "_Brightness", pieces: Sequence[tuple[int, NDArray[np.intp]]]) -> Array:
    """Return the weights (n, k) of the holograms of all sweeps in the relative light of pieces."""
    ends = np.cumsum([0, *(len(sweep.time_s) for sweep in table.sweeps)])
    weights = np.zeros((len(pieces), ends[-1]))
    for hologram, one in enumerate(np.eye(ends[-1])):
        relative = table.less_mean(np.split(one, ends[1:-1]))
        weights[:, hologram] = [np.mean(relative[row][at]) for row, at in pieces]
    return weights


def acquired_until(at_s: Array, acquired_s: Array) -> Array:
    """Return how many acquisitions (n,) there are between the first of some times and each.

    Light changes with time: a pause counts as many acquisitions as there would be in it.

    Parameters
    ----------
    at_s : (n,) float
    acquired_s : (k,) float
        Times of all acquisitions.
    """
    begun_s = np.unique(acquired_s)
    usual_s = float(np.median(np.diff(begun_s))) if len(begun_s) > 1 else _USUAL_S
    count = np.concatenate([[0.0], np.cumsum(np.maximum(np.diff(begun_s) / usual_s, 1.0))])
    if not len(begun_s):
        begun_s = at_s[:1]
    inside = np.interp(at_s, begun_s, count[: len(begun_s)])
    outside = np.minimum(at_s - begun_s[0], 0.0) + np.maximum(at_s - begun_s[-1], 0.0)
    steps = inside + outside / usual_s
    return np.asarray(steps - steps.min(initial=np.inf))


def _root(covariance: Array) -> Array:
    """Return columns (n, n) whose independent amounts have a covariance (n, n)."""
    values, vectors = np.linalg.eigh(covariance)
    columns: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return columns


def walk_columns(steps: Array) -> Array:
    """Return columns (n, n) whose amounts make a random walk with unit steps.

    Parameters
    ----------
    steps : (n,) float
        Number of steps before each of the numbers.
    """
    after = steps - steps.min()
    return _root(np.minimum.outer(after, after))


def acquisition_times_s(sweeps: Sequence[SweepReading]) -> Array:
    """Return the times (k,) of all acquisitions of some sweeps."""
    return np.concatenate([sweep.time_s for sweep in sweeps])


def field_changing(
    times_s: Sequence[tuple[Array, Array]], compared: Sequence[SweepReading], acquired_s: Array
) -> GroupNuisances:
    """Return what light changes by along and between two sweeps, for numbers that compare them.

    Parameters
    ----------
    times_s : sequence of ((k,) float, (k,) float)
        Times of the holograms of each number in either sweep.
    compared : sequence of SweepReading
        Sweeps that are compared.
    acquired_s : (k,) float
        Times of all acquisitions, also of other sweeps.
    """
    ends = np.array([[np.mean(each) for each in pair] for pair in times_s])
    columns = FIELD_CHANGE * walk_columns(acquired_until(ends.T.ravel(), acquired_s))
    # From the light at one time to that at the other.
    walk = columns[: len(ends)] - columns[len(ends) :]
    whole = FIELD_CHANGE * np.sqrt(len(acquisition_times_s(compared)) / 2)
    between = whole * np.ones((len(times_s), 1))
    return GroupNuisances("changing field", np.hstack([walk, between]), DISORDER, "as light")


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
        compared = [
            np.interp(grid, np.log(sweep.drive_hz), own)
            for sweep, own, counts in zip(self.sweeps, series, self.like, strict=True)
            if counts
        ]
        mean = np.mean(compared, axis=0)
        return tuple(
            own - np.interp(np.log(sweep.drive_hz), grid, mean)
            for sweep, own in zip(self.sweeps, series, strict=True)
        )

    def within(self, row: int) -> NDArray[np.bool_]:
        """Return which holograms (k,) of a sweep are compared: all others have its frequency.

        A hologram in a wrong fringe says nothing of the light. Where one sweep has one, the mean
        of sweeps is wrong too.
        """
        compared = [s for s, counts in zip(self.sweeps, self.like, strict=True) if counts]
        ends = [np.log(sweep.drive_hz) for sweep in compared]
        low, high = max(log.min() for log in ends), min(log.max() for log in ends)
        own, grid = np.log(self.sweeps[row].drive_hz), np.log(self.sweeps[0].drive_hz)
        wrong = [_interpolated(grid, np.log(sweep.drive_hz), sweep.off) for sweep in compared]
        of_mean = _interpolated(own, grid, np.any(wrong, axis=0))
        inside: NDArray[np.bool_] = (own > low - _ENDS) & (own < high + _ENDS)
        return np.asarray(inside & ~of_mean & ~self.sweeps[row].off)

    def of_light(self, light: Callable[[Array], Array]) -> tuple[Array, ...]:
        """Return the light expected relative to the mean, for a given light at each time."""
        return self.less_mean([light(sweep.time_s) for sweep in self.sweeps])

    def shared(self, row: int, piece: NDArray[np.intp]) -> dict[str, float]:
        """What a piece of a sweep shares with others, by name, with deviations."""
        sweep = self.sweeps[row]
        if self.like[row]:
            return {}
        columns = {f"speckle between {sweep.clamping}": _SPECKLE}
        bands = np.array([band_of(hz) for hz in sweep.drive_hz[piece]])
        for band in BANDS:
            columns[f"{band} of {sweep.name}"] = _BAND * float(np.mean(bands == band))
        return columns


def _interpolated(at: Array, places: Array, marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which places (n,) take a part of what is marked (k,) at others, if interpolated."""
    return np.asarray(np.interp(at, places, marked.astype(float)) > _ROUNDING)


def _shared(columns: Sequence[dict[str, float]]) -> Array:
    """Covariance (n, n) of what is shared by numbers, each a name with a deviation."""
    table = columns_of(columns)
    shared: Array = table @ table.T
    return shared


def columns_of(columns: Sequence[dict[str, float]]) -> Array:
    """Return the columns (n, k) of what is shared by numbers."""
    names = sorted({name for column in columns for name in column})
    rows = [[column.get(name, 0.0) for name in names] for column in columns]
    return np.array(rows, dtype=float).reshape(len(columns), len(names))


def scatter_of(series: Array) -> float:
    """Scatter from one number to the next, as of numbers without memory; 0 of fewer than two."""
    steps = np.diff(series)
    if not steps.size:
        return 0.0
    return float(1.4826 * np.median(np.abs(steps)) / np.sqrt(2))


def _brightness(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    if not readings.sweeps:
        return None
    group = brightness_group(readings.sweeps, readings.stills)
    # Sweeps may have wrong fringes at all frequencies.
    return group if len(group.values) else None


SOURCES: Final = (GroupSource(10, _brightness),)
