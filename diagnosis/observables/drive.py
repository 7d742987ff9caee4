"""Drive and response: excitation peaks, amplitude against drive level, forces on modes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter1d

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
from diagnosis.observables.brightness import acquisition_times_s, field_changing, log_light
from diagnosis.observables.carrier import Leaks
from diagnosis.observables.light import leaks_of
from diagnosis.observables.shapes import elastic_reed
from diagnosis.readings.campaign_readings import Readings
from diagnosis.readings.mean_drive import mean_drive, same_hz
from diagnosis.readings.sweeps import SAME_LEVEL, SweepReading, common_modes, loudest
from holography.arrays import Array
from physics.air import pressure_shape
from physics.drive import acoustic_gain, amplifier_gain, kept_by_tweeter, tweeter_pressure_pa
from physics.errors import ImpossibleReedError
from physics.mechanics import Mechanics, ReedMode, ReedSolver
from physics.parameters.chamber import Chamber
from physics.parameters.drive import Drive
from physics.parameters.optics import Interference
from physics.parameters.tree import BenchParameters
from physics.plausible.chambers import log_forces
from physics.reed.elements.fem import Symmetry

# Gains that are kept. Chosen: some hundred kilobytes.
_KEPT = 8192
# Log of the drive: polynomials of this degree may be any speaker's, of any size. Chosen: four
# bends in three octaves.
_DEGREE, _SMOOTH = 5, 1.0
# Waves of what a loudspeaker sends: standard deviation of its log, and correlation length in log
# frequency. Data sheets of tweeters: within 3 dB from 2 to 20 kHz.
_WAVES = 0.3, 0.3
# ... and of resonances in which domes break up, at any frequencies: three of them in an octave, of
# heights of 0.4 and qualities up to 20, have this standard deviation of the log, and the covariance
# 1 / (1 + (Q ln(f/f'))²) (decision 0102).
_BREAK_UP, _QUALITY = 0.2, 20.0
# Nearby in log frequency, for the usual level of a drive. Chosen: an octave, several resonances.
_NEARBY = 0.35
# Directions with less of their variance than these are left out, of waves and of resonances; of
# resonances they are errors. Chosen: a thousandth of a wave, and of resonances 1 %, the error of a
# hologram.
_LEAST_WAVE, _LEAST_RESONANT = 1e-6, 3e-3
# Log frequency over which leaked light at a small-amplitude hologram spreads: the width of a mode
# with a loss factor of 0.05.
_NEAR = 0.05
# Error of the log drive of a weak hologram more. Chosen: light follows what gains scatter by.
_WEAK = 0.02
# Where a mode that is not identified may be, from its frequency, in widths. Chosen: seven places
# within half of a width.
_OFF_BY = np.linspace(-0.5, 0.5, 7)
# Acoustic paths cancel to this gain at most. Chosen: 60 dB, more than walls let through.
_LEAST_GAIN = 1e-3
# Log ratio of amplitudes in two sweeps: a common factor, smoothly in frequency, of every band.
_RATIO, _RATIO_BAND = 0.03, 0.015
# ... and of light that leaks into the hologram.
_SPOILT = 0.25
# Holograms are compared where both have at least this amplitude, rad, and at least this many.
_LEAST_AMPLITUDE_RAD, _FEWEST = 0.3, 3
# Log of what moves a mode: gain, which a tweeter 0.1 to 1 m from the reed decides to a factor of
# three, and what is not the model's in a mode's shape and its place in the window. It pushes, too,
# where pressures cancel.
_GAIN, _FIELD = 1.0, 0.15
# Holograms on either side of a mode in which a drive may jump; from which second difference on, and
# what share of it forces are then uncertain by.
_BESIDE, _BENT, _JUMP = 2, 0.4, 0.5


def excitation_group(
    sweeps: Sequence[SweepReading], nominal: BenchParameters, leaks: Leaks
) -> ObservableGroup | None:
    """Compare peaks above the smooth drive, by hologram, mean of all sweeps.

    None if they hardly have frequencies in common.

    Parameters
    ----------
    sweeps : sequence of SweepReading
    nominal : BenchParameters
    leaks : Leaks
    """
    hz, log, error, fitted = mean_drive(sweeps)
    if len(hz) <= _DEGREE + 1:
        return None
    loud = loudest(sweeps)[0]
    # Of each sweep: the mean drive is that of the middle level.
    volts = np.stack([np.interp(hz, sweep.drive_hz, sweep.volts) for sweep in sweeps])
    pitch = np.log(hz / np.sqrt(hz[0] * hz[-1]))
    powers = np.polynomial.chebyshev.chebvander(pitch / np.abs(pitch).max(), _DEGREE)
    apart = pitch[:, None] - pitch
    near = np.exp(-0.5 * (apart / _NEAR) ** 2)
    spoilt = _of_leaks(loud, leaks, hz, near)
    leaked = np.multiply.outer(spoilt, spoilt) * near
    error = np.hypot(error, _WEAK / _gain(nominal.drive, hz))

    def predict(parameters: BenchParameters) -> Array:
        kept = np.median(np.log(kept_by_tweeter(parameters.drive, volts, hz)), axis=0)
        bent: Array = np.log(_gain(parameters.drive, hz)) + kept
        return bent

    doubtful = _taken_for_drive(sweeps, hz)
    noise = np.diag(error**2) + fitted + leaked + _SMOOTH**2 * powers @ powers.T
    waves, left = _loudspeaker(apart, _in_notches(log, apart))
    noise = noise + doubtful @ doubtful.T + left
    places = [Coordinates("drive", band=band_of(float(f))) for f in hz]
    return observable_group(
        "lines of the drive", Observable.DRIVE, log, Errors(noise, waves), places,
        ("drive",), predict,
    )  # fmt: skip


def _taken_for_drive(sweeps: Sequence[SweepReading], hz: Array) -> Array:
    """Return columns (k, c) of errors of the log drive by modes that are not identified.

    Any share of such a mode may be in the drive, at a frequency within half of its width. Errors
    count in proportion to the sweeps in which it is not identified.
    """
    modes = np.concatenate([sweep.doubtful for sweep in sweeps])
    own_hz = modes[:, 0] * np.exp(np.multiply.outer(_OFF_BY, modes[:, 1]))
    response = 1 + 1j * modes[:, 1] - (hz[:, None, None] / own_hz) ** 2
    weight = 1 / np.sqrt(len(sweeps) * len(_OFF_BY))
    return np.asarray(-weight * np.log(np.abs(response)).reshape(len(hz), own_hz.size))


def _in_notches(log: Array, apart: Array) -> Array:
    """Return by what factor (n,) the drive is below its usual level nearby, at least 1.

    Parameters
    ----------
    log : (n,) float
        Log of the drive.
    apart : (n, n) float
        Differences of log frequency.
    """
    usual = [np.median(log[near]) for near in np.abs(apart) < _NEARBY]
    return np.asarray(np.exp(np.maximum(np.array(usual) - log, 0.0)))


def _loudspeaker(
    apart: Array, notches: Array | float = 1.0
) -> tuple[tuple[GroupNuisances, ...], Array]:
    """Return waves and resonances of a loudspeaker, and what is left of these as errors (n, n).

    A loudspeaker has few resonances: where it has none, and is even, it says nothing about others.

    Parameters
    ----------
    apart : (n, n) float
        Differences of log frequency.
    notches : (n,) float, optional
        See `_in_notches`: what a resonance adds is more of a drive that others nearly cancel.
    """
    waves = _columns(np.exp(-0.5 * (apart / _WAVES[1]) ** 2), _LEAST_WAVE)
    resonant = np.multiply.outer(notches, notches) / (1 + (_QUALITY * apart) ** 2)
    most = _columns(resonant, _LEAST_RESONANT)
    found = tuple(
        GroupNuisances(name, columns, DISORDER, "data sheets of tweeters", rare=True)
        for name, columns in (
            ("response of the loudspeaker", _WAVES[0] * waves),
            ("resonances of the loudspeaker", _BREAK_UP * most),
        )
    )
    return found, _BREAK_UP**2 * (resonant - most @ most.T)


def _columns(covariance: Array, least: float) -> Array:
    """Return columns (n, k) of independent amounts that have a covariance (n, n).

    Directions with less than a share `least` of the greatest are left out.
    """
    values, vectors = np.linalg.eigh(covariance)
    kept = values > least * values[-1]
    columns: Array = vectors[:, kept] * np.sqrt(values[kept])
    return columns


def _of_leaks(sweep: SweepReading, leaks: Leaks, hz: Array, near: Array) -> Array:
    """Return the error of the log drive (k,) by leaked light, largest at small amplitude."""
    usual = np.interp(hz, sweep.drive_hz, np.median(sweep.amplitude_rad) / sweep.amplitude_rad)
    # Half of a small amplitude is what shows of it; a fit's error there is its neighbours' as well.
    square = near @ np.minimum(2 * leaks.carrier.get(sweep.name, 0.0) * usual, 1.0) ** 2
    errors: Array = np.sqrt(square / near.sum(axis=1))
    return errors


def _gain(drive: Drive, hz: Array) -> Array:
    """Return the gain (k,) of acoustic resonances between loudspeaker and reed."""
    gain: Array = np.maximum(np.abs(acoustic_gain(drive, hz)), _LEAST_GAIN)
    return gain


def level_group(sweeps: Sequence[SweepReading], leaks: Leaks) -> ObservableGroup | None:
    """Compare amplitudes of sweeps at another level with those of the loudest.

    None if there are none at the same frequencies.

    Parameters
    ----------
    sweeps : sequence of SweepReading
    leaks : Leaks
    """
    loud = loudest(sweeps)
    quiet = [sweep for sweep in sweeps if sweep.loudness < loud[0].loudness - SAME_LEVEL]
    others = [sweep for sweep in quiet if sweep.clamping == loud[0].clamping]
    if not others:
        return None
    values, errors, places, volts, hz = [], [], [], [], []
    times_s: list[tuple[Array, Array]] = []
    for other in others:
        apart = np.abs(np.log(loud[0].drive_hz[:, None] / other.drive_hz))
        one = np.flatnonzero(apart.min(axis=1) < same_hz((loud[0], other)))
        two = np.argmin(apart[one], axis=1)
        # At small amplitude, leaked light is as large as the signal.
        right = (
            ~loud[0].off[one] & ~other.off[two] & (other.deepest_rad[two] > _LEAST_AMPLITUDE_RAD)
        )
        one, two = one[right], two[right]
        ratio = loud[0].signal[one] - other.signal[two]
        ratio -= np.log(loud[0].volts[one] / other.volts[two])
        for piece in np.array_split(np.arange(len(ratio)), 2 * len(BANDS)):
            if len(piece) < _FEWEST:
                continue
            own = 1.4826 * float(np.median(np.abs(ratio[piece] - np.median(ratio[piece]))))
            values.append(float(np.median(ratio[piece])))
            least = np.hypot(_RATIO_BAND, _SPOILT * leaks.carrier.get(other.name, 0.0))
            errors.append(np.hypot(1.25 * own / np.sqrt(len(piece)), least))
            volts.append((loud[0].volts[one[piece]].mean(), other.volts[two[piece]].mean()))
            hz.append(float(np.mean(loud[0].drive_hz[one[piece]])))
            times_s.append((loud[0].time_s[one[piece]], other.time_s[two[piece]]))
            places.append(
                Coordinates("amplitude over volts", band=band_of(hz[-1]), level=other.name)
            )
    if not values:
        return None

    def predict(parameters: BenchParameters) -> Array:
        one, two = np.array(volts).T
        at = np.array(hz)
        kept = np.log(
            kept_by_tweeter(parameters.drive, one, at) / kept_by_tweeter(parameters.drive, two, at)
        )
        # What is compared is vibration times light, which may have changed between the sweeps.
        changed: Array = kept + _light_between(times_s, parameters.optics.interference)
        return changed

    changing = field_changing(times_s, [loud[0], *others], acquisition_times_s(sweeps))
    noise = np.diag(np.square(errors)) + _RATIO**2
    return observable_group(
        "level", Observable.DRIVE, values, Errors(noise, (changing,)), places, ("drive", "optics"),
        predict,
    )  # fmt: skip


def _light_between(times_s: Sequence[tuple[Array, Array]], beams: Interference) -> Array:
    """Return the log light (n,) at the first times of each pair over that at the second ones."""
    return np.array(
        [np.median(log_light(one, beams) - log_light(two, beams)) for one, two in times_s]
    )


def force_group(
    sweeps: Sequence[SweepReading], reed_solver: ReedSolver, nominal: BenchParameters
) -> ObservableGroup | None:
    """Compare the force on each mode with that of loudspeaker, chamber and reed of the model.

    None if no mode is identified in all loud sweeps.

    Parameters
    ----------
    sweeps : sequence of SweepReading
    reed_solver : ReedSolver
        Of the kind of reed.
    nominal : BenchParameters
    """
    loud = loudest(sweeps)
    known = reed_solver.modes(nominal.reed)
    names = [
        name
        for name in common_modes(sweeps)
        if name in known and all(name in sweep.names for sweep in loud)
    ]
    if not names:
        return None
    at = [[sweep.names.index(name) for name in names] for sweep in loud]
    forces = np.array([np.log(np.abs(s.force_rad[i])) for s, i in zip(loud, at, strict=True)])
    error = np.array([s.force_error[i] for s, i in zip(loud, at, strict=True)]).mean(axis=0)
    hz = loud[0].hz[at[0]]
    volts = np.interp(hz, loud[0].drive_hz, loud[0].volts)
    torn = np.max([_torn(sweep, hz) for sweep in loud], axis=0)
    closed, modes = replace(nominal.chamber, leak=0.0), [known[name] for name in names]
    elastic = reed_solver.modes(elastic_reed(nominal))
    usual = _pushed(_pushes(reed_solver, closed, modes, elastic), 0.0)
    fields = log_forces(reed_solver, closed, modes, usual)
    waves, left = _loudspeaker(np.log(hz)[:, None] - np.log(hz))
    errors = Errors(
        np.diag(error**2 + _FIELD**2 + torn**2) + _GAIN**2 + left,
        (
            *waves,
            GroupNuisances(
                "pressure on the reed", fields.columns, DISORDER, "chambers that a bench may have"
            ),
        ),
    )
    predicted = forces_rad(reed_solver, nominal)

    def predict(parameters: BenchParameters) -> Array:
        drive = parameters.drive
        resounding = _gain(drive, hz) * kept_by_tweeter(drive, volts, hz)
        force: Array = np.log(predicted(parameters, names) * resounding) + fields.mean
        return force

    places = [
        Coordinates("force", mode=n, band=band_of(float(f))) for n, f in zip(names, hz, strict=True)
    ]
    parts = ("reed", "drive", "chamber")
    return observable_group(
        "forces", Observable.RESPONSE, forces.mean(axis=0), errors, places, parts, predict
    )


def _torn(sweep: SweepReading, hz: Array) -> Array:
    """Log (a,) of forces by a drive that jumps where a mode is: one is taken for the other."""
    bends = np.abs(np.diff(sweep.log_drive, 2))
    nearest = np.argmin(np.abs(np.log(sweep.drive_hz[1:-1]) - np.log(hz)[:, None]), axis=1)
    worst = maximum_filter1d(bends, 2 * _BESIDE + 1, mode="nearest")[nearest]
    jumps: Array = _JUMP * np.maximum(worst - _BENT, 0.0)
    return jumps


def forces_rad(
    reed_solver: ReedSolver, nominal: BenchParameters
) -> Callable[[BenchParameters, Sequence[str]], Array]:
    """Return a function for phase amplitudes per volt that forces alone would give modes.

    They are those of a mode that is pushed slowly: what it has of the elastic mode of its name,
    where that moves most, as a fit has them. The function takes the parameters of a bench and names
    of modes.

    Parameters
    ----------
    reed_solver : ReedSolver
    nominal : BenchParameters
        With the cane of the series, and the laser.
    """
    elastic = reed_solver.modes(elastic_reed(nominal))
    wavelength_m = nominal.optics.layout.wavelength_m

    @lru_cache(maxsize=_KEPT)
    def pushes(reed: Mechanics, chamber: Chamber, names: tuple[str, ...]) -> _Pushes:
        modes = reed_solver.modes(reed)
        return _pushes(reed_solver, chamber, [modes[name] for name in names], elastic)

    def forces(parameters: BenchParameters, names: Sequence[str]) -> Array:
        reed, drive, leak = parameters.reed, parameters.drive, parameters.chamber.leak
        closed = replace(parameters.chamber, leak=0.0)
        modes = reed_solver.modes(reed)
        missing = [name for name in names if name not in modes]
        if missing:
            raise ImpossibleReedError(f"a reed of this kind has no mode {missing[0]}")
        hz = np.array([modes[name].hz for name in names])
        each = pushes(reed, closed, tuple(names))
        at_tip = np.array([abs(tweeter_pressure_pa(drive.tweeter, float(f), 1.0)) for f in hz])
        at_tip *= np.abs(amplifier_gain(drive, hz))
        pushed = _pushed(each, leak)
        moved = at_tip * pushed / (2 * np.pi * hz) ** 2
        force: Array = 4 * np.pi / wavelength_m * moved * each.deepest
        return force

    return forces


@dataclass(frozen=True)
class _Pushes:
    """Forces of unit pressure at the tip on m modes.

    Attributes
    ----------
    closed, by_leak : (m,) float
        Force with a chamber as it is filled, and what it grows by if it leaks all.
    without_signs : (m,) float
        Force if the pressure of the closed chamber pushed in phase with the mode everywhere.
    deepest : (m,) float
        What the mode has of the elastic mode of its name, where that moves most.
    """

    closed: Array
    by_leak: Array
    without_signs: Array
    deepest: Array


def _pushed(pushes: _Pushes, leak: float) -> Array:
    """Return forces (m,) with a leak; where pressures cancel, what is not the model's in them."""
    pushed: Array = np.hypot(pushes.closed + leak * pushes.by_leak, _FIELD * pushes.without_signs)
    return pushed


def _pushes(
    reed_solver: ReedSolver,
    chamber: Chamber,
    modes: Sequence[ReedMode],
    elastic: Mapping[str, ReedMode],
) -> _Pushes:
    """Compute forces on modes whose shapes are stated in units of `elastic` ones."""
    reed = reed_solver.reed
    x, y = reed.load_points_m.T
    # The standing wave times what walls and clay let through, which is its shape at 0 Hz.
    wavenumbers = 2 * np.pi * np.array([mode.hz for mode in modes]) / chamber.sound_speed_m_s
    wave, both = np.cos(np.multiply.outer(wavenumbers, x)), (chamber, replace(chamber, leak=1.0))
    left, right = (
        np.array([pressure_shape(each, 0.0, x, side * y) for each in both]) for side in (1, -1)
    )
    shapes = np.stack([mode.coordinates for mode in modes], axis=1)
    pushed, moved = np.zeros((len(modes), 2)), np.zeros((2, *wave.shape))
    parts = np.split(shapes, reed.starts[1:])
    for (symmetry, half), own in zip(reed.loose.items(), parts, strict=True):
        sign = 1 if symmetry is Symmetry.SYMMETRIC else -1
        deflection = (half.load_z @ own).T
        pushed += 0.5 * (wave * deflection) @ (left + sign * right).T
        moved += np.multiply.outer([1, sign], deflection)
    sides = zip(moved, (left[0], right[0]), strict=True)
    without_signs = sum(0.5 * np.abs(wave * side) @ np.abs(open_) for side, open_ in sides)
    closed, leaking = pushed.T
    return _Pushes(closed, leaking - closed, without_signs, _deepest(reed_solver, modes, elastic))


def _deepest(
    reed_solver: ReedSolver, modes: Sequence[ReedMode], elastic: Mapping[str, ReedMode]
) -> Array:
    """Return what modes (m,) have of the elastic modes of their names, where those move most.

    A fit states a mode in units of that shape. If the mode is changed, it has other shapes, too:
    their largest deflection is not what its force was measured by.
    """
    reed = reed_solver.reed
    shapes = np.stack([elastic.get(mode.name, mode).coordinates for mode in modes], axis=1)
    moved = np.zeros((2, len(reed.plan_m), len(modes)))
    parts = np.split(shapes, reed.starts[1:])
    for (symmetry, half), own in zip(reed.loose.items(), parts, strict=True):
        sign = 1 if symmetry is Symmetry.SYMMETRIC else -1
        moved += np.multiply.outer([1, sign], half.surface_z @ own)
    along = reed_solver.mass_kg @ shapes
    own = np.stack([mode.coordinates for mode in modes], axis=1)
    share = np.sum(along * own, axis=0) / np.sum(along * shapes, axis=0)
    return np.asarray(np.abs(share) * np.abs(moved).max(axis=(0, 1)))


def _lines(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    if not readings.sweeps:
        return None
    return excitation_group(readings.sweeps, readings.nominal, leaks_of(readings))


def _level(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return level_group(readings.sweeps, leaks_of(readings)) if readings.sweeps else None


def _forces(readings: Readings, reed_solver: ReedSolver) -> ObservableGroup | None:
    sweeps = readings.sweeps
    return force_group(sweeps, reed_solver, readings.nominal) if sweeps else None


SOURCES: Final = (GroupSource(13, _lines), GroupSource(14, _level), GroupSource(15, _forces))
