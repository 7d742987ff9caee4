"""Taps T1 and T6: the drive's lines, how it follows its level, and how it moves each mode."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.block import BANDS, Block, Place, band_of, block
from diagnosis.taps.vibration import SweepReading
from physics.air import CavityLine, Chamber, Filling, pressure_shape
from physics.drive import Tweeter, tweeter_pressure_pa
from physics.effects.form import Tap
from physics.mechanics import Mechanics, ReedMode, Workshop
from physics.reed.fem import Symmetry
from physics.twin import DriveChain, Twin

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

_WAVELENGTH_M = 650e-9
_KEPT = 8192
_FULL_V = 16.0
# Log of the drive: smooth polynomials of this degree are anyone's; noise of one hologram at least.
_DEGREE, _SMOOTH, _LEAST = 9, 0.3, 0.004
# A mode's frequency and the drive around it can be exchanged to this share of its stiffness.
_EXCHANGE = 0.008
# The known line: strength and quality as shares, frequency as a share.
_LINE_STRENGTH, _LINE_QUALITY, _LINE_HZ = 0.08, 0.08, 0.004
# Log ratio of amplitudes in two sweeps: a common factor, smoothly in frequency, of every band.
_RATIO, _RATIO_BAND = 0.01, 0.01
# Log of what moves a mode: gain, by smooth ripple of the loudspeaker, by pressure that is not the
# model's.
_GAIN, _RIPPLE, _FIELD = 0.15, 0.08, 0.15
_RIPPLE_DEGREE = 5


def line_block(sweeps: Sequence[SweepReading], line: CavityLine) -> Block:
    """What stands out of the smooth drive, by hologram, mean of all sweeps at full level."""
    hz, log, error = _mean_drive(sweeps)
    bands = np.log(hz / np.sqrt(hz[0] * hz[-1]))
    powers = np.polynomial.chebyshev.chebvander(bands / np.abs(bands).max(), _DEGREE)
    columns = [_SMOOTH * powers]
    reference = sweeps[0]
    for f, eta in zip(reference.hz, reference.loss_factor, strict=True):
        resonance = 1 / (1 + 1j * eta - (hz / f) ** 2)
        columns.append(_EXCHANGE * np.stack([resonance.real, resonance.imag], axis=1))
    columns.append(_line_columns(hz, line))
    table = np.hstack(columns)

    def predict(twin: Twin) -> Array:
        return _lines(twin.drive, line, hz)

    places = [Place("drive", band=band_of(float(f))) for f in hz]
    covariance = np.diag(error**2) + table @ table.T
    return block("lines of the drive", Tap.DRIVE, log, covariance, places, ("drive",), predict)


def _lines(drive: DriveChain, line: CavityLine, hz: Array) -> Array:
    """Log gain (k,) of what resounds between loudspeaker and reed."""
    own = replace(line, strength=line.strength * (1 + drive.line_excess))
    second = CavityLine(drive.second_hz, drive.second_quality, drive.second_line)
    gain = _gain(own, hz) * _gain(second, hz)
    return np.log(np.abs(gain))


def _gain(line: CavityLine, hz: Array) -> Complex:
    ratio = hz / line.frequency_hz
    gain: Complex = 1 + line.strength / (1 - ratio**2 + 1j * ratio / line.quality)
    return gain


def _line_columns(hz: Array, line: CavityLine) -> Array:
    here = _lines(DriveChain(), line, hz)
    changes = (
        (replace(line, strength=line.strength * 1.01), _LINE_STRENGTH),
        (replace(line, quality=line.quality * 1.01), _LINE_QUALITY),
        (replace(line, frequency_hz=line.frequency_hz * 1.001), 10 * _LINE_HZ),
    )
    return np.stack(
        [(_lines(DriveChain(), other, hz) - here) / 0.01 * by for other, by in changes], axis=1
    )


def _mean_drive(sweeps: Sequence[SweepReading]) -> tuple[Array, Array, Array]:
    """Frequencies, log drive per volt and errors (k,) of all holograms."""
    loud = loudest(sweeps)
    hz = np.array(sorted({float(f) for s in loud for f in s.drive_hz}))
    table = np.full((len(loud), len(hz)), np.nan)
    for row, sweep in zip(table, loud, strict=True):
        good = ~sweep.off
        at = np.searchsorted(hz, sweep.drive_hz[good])
        row[at] = np.log(np.abs(sweep.drive[good]) / sweep.volts[good])
    # Levels of fits are anyone's.
    table = table - np.nanmedian(table - table[:1], axis=1)[:, None]
    told = np.any(np.isfinite(table), axis=0)
    hz, table = hz[told], table[:, told]
    mean, count = np.nanmean(table, axis=0), np.sum(np.isfinite(table), axis=0)
    left = table - mean
    spread = 1.4826 * float(np.nanmedian(np.abs(left))) * np.sqrt(len(loud) / max(len(loud) - 1, 1))
    return hz, mean, np.maximum(max(spread, _LEAST) / np.sqrt(count), _LEAST)


def loudest(sweeps: Sequence[SweepReading]) -> list[SweepReading]:
    """Sweeps of the first clamping at the highest level."""
    first = [s for s in sweeps if s.clamping == sweeps[0].clamping]
    level = [float(np.mean(np.log(s.volts))) for s in first]
    return [s for s, at in zip(first, level, strict=True) if at > max(level) - 0.1]


def level_block(sweeps: Sequence[SweepReading]) -> Block | None:
    """Amplitudes of a sweep at another level beside those of the loudest; None if there is none."""
    loud = loudest(sweeps)
    level = float(np.mean(np.log(loud[0].volts)))
    others = [s for s in sweeps if float(np.mean(np.log(s.volts))) < level - 0.1]
    others = [s for s in others if s.clamping == loud[0].clamping]
    if not others:
        return None
    values, errors, places, volts, hz = [], [], [], [], []
    for other in others:
        by_hz = {float(f): k for k, f in enumerate(other.drive_hz)}
        chosen = [(k, by_hz[float(f)]) for k, f in enumerate(loud[0].drive_hz) if float(f) in by_hz]
        one, two = np.array(chosen).T
        told = ~loud[0].off[one] & ~other.off[two]
        told &= (loud[0].amplitude_rad[one] > 0) & (other.amplitude_rad[two] > 0)
        one, two = one[told], two[told]
        ratio = np.log(loud[0].amplitude_rad[one] / other.amplitude_rad[two])
        ratio -= np.log(loud[0].volts[one] / other.volts[two])
        for piece in np.array_split(np.arange(len(ratio)), 2 * len(BANDS)):
            own = 1.4826 * float(np.median(np.abs(ratio[piece] - np.median(ratio[piece]))))
            values.append(float(np.median(ratio[piece])))
            errors.append(np.hypot(1.25 * own / np.sqrt(len(piece)), _RATIO_BAND))
            volts.append((loud[0].volts[one[piece]].mean(), other.volts[two[piece]].mean()))
            hz.append(float(np.mean(loud[0].drive_hz[one[piece]])))
            places.append(Place("amplitude over volts", band=band_of(hz[-1]), level=other.name))

    def predict(twin: Twin) -> Array:
        drive = twin.drive

        def kept(v: Array) -> Array:
            moves = 1 / (1 + (np.array(hz) / drive.compression_hz) ** 2)
            left: Array = np.log(
                np.maximum(1 - drive.compression * moves * (v / _FULL_V) ** 2, 0.02)
            )
            return left

        one, two = np.array(volts).T
        return kept(one) - kept(two)

    covariance = np.diag(np.square(errors)) + _RATIO**2
    return block("level", Tap.DRIVE, values, covariance, places, ("drive",), predict)


def force_block(
    sweeps: Sequence[SweepReading], workshop: Workshop, chamber: Chamber, tweeter: Tweeter
) -> Block:
    """What moves each mode, beside loudspeaker, chamber and reed of the twin."""
    loud = loudest(sweeps)
    known = workshop.modes(Twin().reed)
    names = [name for name in loud[0].names if name in known and all(name in s.names for s in loud)]
    at = [[sweep.names.index(name) for name in names] for sweep in loud]
    forces = np.array([np.log(np.abs(s.force_rad[i])) for s, i in zip(loud, at, strict=True)])
    error = np.array([s.force_error[i] for s, i in zip(loud, at, strict=True)]).mean(axis=0)
    hz = loud[0].hz[at[0]]
    pitch = np.log(hz / 4e3) / np.log(5)
    powers = np.polynomial.legendre.legvander(np.clip(pitch, -1, 1), _RIPPLE_DEGREE)
    ripple = _RIPPLE * powers[:, 1:] / np.sqrt(np.arange(1, _RIPPLE_DEGREE + 1))
    covariance = np.diag(error**2 + _FIELD**2) + _GAIN**2 + ripple @ ripple.T
    predicted = forces_rad(workshop, chamber, tweeter)

    def predict(twin: Twin) -> Array:
        return np.log(predicted(twin.drive, twin.reed, names))

    places = [
        Place("force", mode=n, band=band_of(float(f))) for n, f in zip(names, hz, strict=True)
    ]
    parts = ("reed", "drive")
    return block("forces", Tap.RESPONSE, forces.mean(axis=0), covariance, places, parts, predict)


def forces_rad(
    workshop: Workshop, chamber: Chamber, tweeter: Tweeter
) -> Callable[[DriveChain, Mechanics, Sequence[str]], Array]:
    """Phase amplitudes per volt that forces have modes move by, at rest, where they move most."""

    @lru_cache(maxsize=_KEPT)
    def pushes(reed: Mechanics, name: str) -> tuple[float, float, float]:
        return _pushes(workshop, chamber, workshop.modes(reed)[name])

    def forces(drive: DriveChain, reed: Mechanics, names: Sequence[str]) -> Array:
        modes = workshop.modes(reed)
        hz = np.array([modes[name].hz for name in names])
        left, right, deepest = np.array([pushes(reed, name) for name in names]).T
        share = drive.open_right if chamber.filling is Filling.ASYMMETRIC else 1.0
        at_tip = np.array([abs(tweeter_pressure_pa(tweeter, float(f), 1.0)) for f in hz])
        at_tip /= np.sqrt(1 + (drive.roll_off * hz / 1e4) ** 4)
        moved = at_tip * np.abs(left + share * right) / (2 * np.pi * hz) ** 2
        force: Array = np.maximum(4 * np.pi / _WAVELENGTH_M * moved * deepest, 1e-12)
        return force

    return forces


def _pushes(workshop: Workshop, chamber: Chamber, mode: ReedMode) -> tuple[float, float, float]:
    """Modal force of unit pressure on either half of the window, and a mode's largest deflection."""
    reed = workshop.anatomy.reed
    x, y = reed.load_points_m.T
    whole = replace(chamber, filling=Filling.SYMMETRIC)
    left = pressure_shape(chamber, mode.hz, x, y)
    right = pressure_shape(whole, mode.hz, x, -y)
    start, pushed, moved = 0, np.zeros(2), np.zeros((2, len(reed.plan_m)))
    for symmetry, half in reed.halves.items():
        own = mode.coordinates[start : start + half.mass.shape[0]]
        start += half.mass.shape[0]
        sign = 1 if symmetry is Symmetry.SYMMETRIC else -1
        deflection = half.load_z @ own
        pushed += 0.5 * np.array([left @ deflection, sign * (right @ deflection)])
        moved += np.multiply.outer([1, sign], half.surface_z @ own)
    return float(pushed[0]), float(pushed[1]), float(np.abs(moved).max())
