"""Taps T4 and T5: brightness of fringes in the course of a campaign, and what else is in them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.block import BANDS, Block, Place, band_of, block
from diagnosis.taps.still import Still
from diagnosis.taps.vibration import TEMPLATES, SweepReading
from physics.effects.form import Tap
from physics.twin import Beams, Twin

Array = NDArray[np.floating[Any]]

# Pieces of a sweep's time.
_PIECES = 8
# Light that is brighter by chance is alike from one acquisition to the next: so many count as one.
_ALIKE = 3.0
# Log brightness: from one speckle to another, between order 0 and the others, in sweeps of other
# volts, in each band (fringes too fine blur), in each sweep.
_SPECKLE, _ORDER, _LEVEL, _BAND, _SWEEP = 10.0, 10.0, 0.1, 0.03, 5e-3
# Log of the noise beside the image: its level, and from sweep to sweep.
_NOISE, _NOISE_SWEEP = 0.1, 2e-3
# Share of that noise that is shot noise of the local oscillator.
_SHOT = 0.96
# What templates show where nothing leaks: amplitude and its spread. Fringes that a block of pixels
# averages look a little like either.
_FLOORS = {
    "carrier_leak": (8e-4, 5e-4),
    "order_mixing": (5e-3, 2.5e-3),
    "decorrelation": (1.15e-4, 3e-5),
}


def brightness_block(sweeps: Sequence[SweepReading], stills: Sequence[Still]) -> Block:
    """Brightness of fringes, of all sweeps and at rest."""
    values, variance, places, times = [], [], [], []
    columns: list[dict[str, float]] = []
    loudest = max(float(np.mean(np.log(sweep.volts))) for sweep in sweeps)
    for sweep in sweeps:
        level = float(np.mean(np.log(sweep.volts)))
        order = np.argsort(sweep.time_s)
        bands = np.array([band_of(hz) for hz in sweep.drive_hz])
        spread = _scatter(sweep.brightness[order])
        for number, piece in enumerate(np.array_split(order, _PIECES)):
            values.append(float(np.median(sweep.brightness[piece])))
            variance.append(_ALIKE * 1.57 * spread**2 / len(piece) + 1e-6)
            times.append(float(np.mean(sweep.time_s[piece])))
            places.append(
                Place("fringes", time=f"{sweep.name} {number + 1}", level=_level(level, loudest))
            )
            column = {f"speckle {sweep.clamping}": _SPECKLE, f"sweep {sweep.name}": _SWEEP}
            other = f", level {level:.1f}" if level < loudest - 0.1 else ""
            if other:
                column[other] = _LEVEL
            for band in BANDS:
                column[f"band {band} {sweep.clamping}{other}"] = _BAND * float(
                    np.mean(bands[piece] == band)
                )
            columns.append(column)
    for still in stills:
        own = _scatter(still.brightness)
        for number, at in enumerate(still.run_time_s):
            near = np.argsort(np.abs(still.time_s - at))[
                : len(still.time_s) // len(still.run_time_s)
            ]
            values.append(float(np.mean(still.brightness[near])))
            variance.append(_ALIKE * max(own, 5e-3) ** 2 / len(near))
            times.append(float(at))
            places.append(Place("order 0", time=f"at rest {still.clamping + 1}.{number + 1}"))
            columns.append({f"speckle {still.clamping}": _SPECKLE, "order": _ORDER})
    end_s, hours = max(times), np.array(times) / 3600

    def predict(twin: Twin) -> Array:
        after = np.array(times) > twin.beams.hop_share * end_s
        lost: Array = -twin.beams.fade_per_h * hours + np.log1p(-min(twin.beams.hop, 0.95)) * after
        return lost

    covariance = np.diag(variance) + _shared(columns)
    return block("brightness", Tap.FIELD, values, covariance, places, ("beams",), predict)


def noise_block(sweeps: Sequence[SweepReading]) -> Block:
    """Noise beside the image: shot noise of the local oscillator, in the course of time."""
    values, variance, places, times = [], [], [], []
    columns: list[dict[str, float]] = []
    for sweep in sweeps:
        order = np.argsort(sweep.time_s)
        log = np.log(sweep.noise_dn2)
        spread = _scatter(log[order])
        for number, piece in enumerate(np.array_split(order, _PIECES // 2)):
            values.append(float(np.mean(log[piece])))
            variance.append(1.2 * spread**2 / len(piece))
            times.append(float(np.mean(sweep.time_s[piece])))
            places.append(Place("noise beside the image", time=f"{sweep.name} {number + 1}"))
            columns.append({"level": _NOISE, f"sweep {sweep.name}": _NOISE_SWEEP})
    usual, hours = float(np.mean(values)), np.array(times) / 3600

    def predict(twin: Twin) -> Array:
        faded: Array = usual - _SHOT * twin.beams.fade_per_h * hours
        return faded

    covariance = np.diag(variance) + _shared(columns)
    return block("noise", Tap.SENSOR, values, covariance, places, ("beams",), predict)


def fringe_block(sweeps: Sequence[SweepReading]) -> Block:
    """What is in fringes beside the first sideband, by templates, of all loud sweeps together."""
    loudest = max(float(np.mean(np.log(sweep.volts))) for sweep in sweeps)
    loud = [s for s in sweeps if float(np.mean(np.log(s.volts))) > loudest - 0.1]
    values = []
    for t, name in enumerate(TEMPLATES):
        found = np.array([_amplitude(sweep, t, name) for sweep in loud])
        values.append(float(np.median(found)))
    floors = np.array([_FLOORS[name] for name in TEMPLATES])

    def predict(twin: Twin) -> Array:
        beams: Beams = twin.beams
        leak, mixing, blur = beams.leak, beams.mixing, beams.blur
        return np.array(
            [np.hypot(leak, floors[0, 0]), np.hypot(mixing, floors[1, 0]), blur + floors[2, 0]]
        )

    places = [Place(name.replace("_", " ")) for name in TEMPLATES]
    return block("fringes", Tap.MAPS, values, floors[:, 1], places, ("beams",), predict)


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
    """Scatter from one number to the next, as of numbers without memory."""
    steps = np.diff(series)
    return float(1.4826 * np.median(np.abs(steps)) / np.sqrt(2))


def _level(level: float, loudest: float) -> str:
    return "loud" if level > loudest - 0.1 else f"{np.exp(level - loudest):.0%} of the volts"
