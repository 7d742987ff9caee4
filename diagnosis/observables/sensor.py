"""Frames without fringes: camera, vignetting, local oscillator."""

from typing import Final

import numpy as np

from diagnosis.observable_groups import Coordinates, Observable, ObservableGroup, observable_group
from diagnosis.observable_source import GroupSource
from diagnosis.readings.camera import DarkFrames, FlatFrames, LocalOscillatorFrames, half_m
from diagnosis.readings.campaign_readings import Readings
from holography.arrays import Array
from physics.mechanics import ReedSolver
from physics.parameters.optics import Illumination
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters

# What data sheets leave open: offset in dn, log of noise and of gain.
_OFFSET_DN, _NOISE, _GAIN = 1.0, 0.05, 0.03
# What rows and columns may have in common by chance.
_BANDING = 0.1
# Error of the count of hot pixels, on the square-root scale.
_HOT_COUNT = 3.0
# Lamps: from exposure to exposure, and from the middle to the edge.
_LAMP, _UNEVEN = 7e-4, 4e-3
# Log of the pattern that every sensor has.
_PATTERN, _PATTERN_SPREAD = 3e-3, 0.3
# Local oscillators: per half a sensor, where the mirror stands as it should; share of the width.
_LO_TILT, _LO_WAIST = 1e-3, 0.2


def dark_group(dark: DarkFrames, sensor: Sensor) -> ObservableGroup:
    """Compare dark frames with the data sheet."""

    def predict(parameters: BenchParameters) -> Array:
        read_dn = parameters.sensor.read_noise_e / parameters.sensor.gain_e_dn
        hot = 2 * np.sqrt(parameters.sensor.hot * dark.pixels + 3 / 8)
        return np.array(
            [parameters.sensor.offset_dn, 0.5 * np.log(read_dn**2 + 1 / 12), hot, 0.0, 0.0]
        )

    names = "offset", "read noise", "hot pixels", "noise of rows", "noise of columns"
    values = [
        dark.offset_dn,
        np.log(dark.noise_dn),
        2 * np.sqrt(dark.hot * dark.pixels + 3 / 8),
        dark.row_excess,
        dark.column_excess,
    ]
    errors = np.array([_OFFSET_DN, _NOISE, _HOT_COUNT, _BANDING, _BANDING])
    places = [Coordinates(name) for name in names]
    return observable_group(
        "dark frames", Observable.SENSOR, values, errors, places, ("sensor",), predict
    )


def flat_group(flat: FlatFrames, dark: DarkFrames | None, sensor: Sensor) -> ObservableGroup:
    """Compare frames of even light with a linear camera."""
    order = np.argsort(flat.exposure_s)
    signal = flat.signal_dn[order]
    rate = np.log(signal / flat.exposure_s[order])
    full_dn = sensor.full_well_e / sensor.gain_e_dn
    noise_dn = dark.noise_dn if dark else sensor.read_noise_e / sensor.gain_e_dn
    gain = float(np.log(np.mean(signal / (flat.variance_dn[order] - noise_dn**2))))

    def predict(parameters: BenchParameters) -> Array:
        bends = parameters.sensor.nonlinearity
        filled = _filled(signal / full_dn, bends)
        bent = np.log(np.maximum(1 - bends * filled, 0.05))
        steeper = 2 * np.log(np.maximum(1 - 2 * bends * filled, 0.05))
        pattern = 0.5 * np.log(_PATTERN**2 + parameters.sensor.pattern**2)
        conversion = np.log(parameters.sensor.gain_e_dn) + float(np.mean(bent - steeper))
        return np.array(
            [
                *(bent[1:] - bent[0]),
                pattern,
                conversion,
                -parameters.optics.illumination.vignette,
                0.0,
                0.0,
            ]
        )

    several = len(signal) - 1
    values = [
        *(rate[1:] - rate[0]),
        # A sensor better than usual is not a gap.
        np.log(max(flat.pattern, _PATTERN)),
        gain,
        flat.corner,
        *flat.tilt,
    ]
    errors = np.diag([_LAMP**2] * several + [_PATTERN_SPREAD**2, _GAIN**2] + [_UNEVEN**2] * 3)
    errors[:several, :several] += _LAMP**2
    places = [Coordinates(f"linearity at {share:.0%}") for share in signal[1:] / full_dn]
    places += [
        Coordinates("pattern"),
        Coordinates("electrons per number"),
        Coordinates("corners", region="corners"),
        Coordinates("tilt of the light", region="rows"),
        Coordinates("tilt of the light", region="columns"),
    ]
    return observable_group(
        "even light", Observable.SENSOR, values, errors, places, ("sensor", "optics"), predict
    )


def _filled(shown: Array, bends: float) -> Array:
    """Return how full pixels are (e,), as fractions, that show some fraction of a full one.

    The root of ``shown = filled (1 - bends filled)``, see `Sensor.nonlinearity`.
    """
    root = np.sqrt(np.maximum(1 - 4 * bends * shown, 0.0))
    filled: Array = 2 * shown / (1 + root)
    return filled


def local_oscillator_group(beam: LocalOscillatorFrames, sensor: Sensor) -> ObservableGroup:
    """Compare the local oscillator with a Gaussian beam centred on the sensor."""
    halves, usual = half_m(sensor), Illumination().local_oscillator_waist_m

    def predict(parameters: BenchParameters) -> Array:
        light = parameters.optics.illumination
        waist_m = light.local_oscillator_waist_m
        tilt = [
            4 * shift * half / waist_m**2
            for shift, half in zip(light.local_oscillator_shift_m, halves, strict=True)
        ]
        corner = -2 * sum(half**2 for half in halves) / waist_m**2 - light.vignette
        return np.array([*tilt, corner])

    values = [*beam.tilt, beam.bend]
    corner_error = 4 * _LO_WAIST * sum((half / usual) ** 2 for half in halves)
    errors = np.array([_LO_TILT, _LO_TILT, corner_error])
    places = [
        Coordinates("middle", region="rows"),
        Coordinates("middle", region="columns"),
        Coordinates("width", region="corners"),
    ]
    return observable_group(
        "local oscillator", Observable.SENSOR, values, errors, places, ("optics",), predict
    )


def _dark(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return dark_group(readings.dark, readings.nominal.sensor) if readings.dark else None


def _flat(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    flat = readings.flat
    return flat_group(flat, readings.dark, readings.nominal.sensor) if flat else None


def _lo(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    return local_oscillator_group(readings.lo, readings.nominal.sensor) if readings.lo else None


SOURCES: Final = (GroupSource(1, _dark), GroupSource(2, _flat), GroupSource(3, _lo))
