"""Frames without fringes: camera, vignetting, local oscillator."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np

from diagnosis.observable_groups import (
    DISORDER,
    Coordinates,
    Errors,
    GroupNuisances,
    Observable,
    ObservableGroup,
    observable_group,
)
from diagnosis.observable_source import GroupSource
from diagnosis.readings.camera import (
    DarkFrames,
    FlatFrames,
    LocalOscillatorFrames,
    half_m,
    log_paraboloid,
)
from diagnosis.readings.campaign_readings import Readings
from holography.arrays import Array
from physics.mechanics import ReedSolver
from physics.optics import vignette_profile
from physics.parameters.disorder import BY_NAME
from physics.parameters.optics import Illumination
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters

# Beams that are kept. Chosen: some kilobytes.
_KEPT = 256
# Black levels are set by whoever sets up a camera: the data sheet says where they usually are.
_OFFSET_DN = 10.0
# Data sheets state typical values: of read noise and gain, specimens differ by this in the log.
# EMVA 1288 sheets of one type of camera differ by 10 to 30 %, and by 5 to 10 %.
_READ_NOISE, _GAIN = 0.25, 0.1
# ... and of any cameras: in the log, and of the black level as a share of the range. EMVA 1288
# sheets have full wells of 5 to 50 thousand electrons and read noise of 1.5 to 30. Chosen: black
# levels are 0 to 5 %.
_ANY_READ_NOISE, _ANY_GAIN, _ANY_OFFSET = 1.0, 1.0, 0.02
# Rows and columns of ordinary cameras have up to this share of the read noise in common.
_ROW_NOISE = BY_NAME["row_noise"].ordinary.high / BY_NAME["read_noise"].ordinary.low
# Pixels that are hot though nothing is wrong: data sheets of CCDs admit one in a thousand.
_HOT = 1e-3
# Lamps: from exposure to exposure (lamps that are not regulated: some tenths of a per cent a
# minute), and from the middle to the edge.
_LAMP, _UNEVEN = 3e-3, BY_NAME["lamp"].ordinary.high
# Pattern that every sensor has, and the standard deviation of its log.
_PATTERN = BY_NAME["pixel_pattern"].ordinary.root_mean_square
_PATTERN_SPREAD = 0.5
# Share by which ordinary cameras bend at a full pixel.
_BENDS = BY_NAME["nonlinearity"].ordinary.root_mean_square
# Dust and fringes of a cover glass, a per cent of the light in patches of 2 mm, tilt and bend a
# beam by a third of that on a sensor of any size. Chosen.
_DUST = 3e-3
# How well frames measure what is the camera's own: black levels wander by a tenth of a digital
# number within minutes; noise is neither quite Gaussian nor evenly rounded. Chosen.
_WANDER_DN, _NOISE_LAW = 0.1, 0.01
# Least share of the variance of lit pixels that shot noise is taken to have. Chosen.
_LEAST_SHOT = 0.1
# Most rows and columns in which a smooth beam is computed. Chosen: the paraboloid of its log is
# then the same to a thousandth.
_COARSE = 128


# Numbers of even light but for those of its exposures.
_OF_FLATS = (
    Coordinates("pattern"),
    Coordinates("electrons per number"),
    Coordinates("corners", region="corners"),
    Coordinates("tilt of the light", region="rows"),
    Coordinates("tilt of the light", region="columns"),
)


@dataclass(frozen=True)
class Specimens:
    """Standard deviations by which cameras differ from what is expected of one.

    Attributes
    ----------
    offset_dn : float
    log_gain, log_read_noise : float
    source : str
    """

    offset_dn: float = _OFFSET_DN
    log_gain: float = _GAIN
    log_read_noise: float = _READ_NOISE
    source: str = "EMVA 1288 data sheets"

    @classmethod
    def of(cls, readings: Readings) -> "Specimens":
        """Return those of cameras with a data sheet, or of all."""
        if readings.data_sheet:
            return cls()
        offset_dn = _ANY_OFFSET * 2.0**readings.nominal.sensor.bits
        return cls(offset_dn, _ANY_GAIN, _ANY_READ_NOISE, "data sheets of many cameras")


def dark_group(
    dark: DarkFrames, sensor: Sensor, specimens: Specimens = Specimens()
) -> ObservableGroup:
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
    rows, columns = sensor.shape
    variances = [dark.pixels, rows, columns]
    noise, *lines = (np.hypot(_NOISE_LAW, np.sqrt(2 / (n * (dark.frames - 1)))) for n in variances)
    # The root of a count of pixels, doubled, has a standard deviation of one: Poisson's law.
    measured = np.array([_WANDER_DN, 0.5 * noise, 1.0, *lines])
    # The mean of a row has the noise of its pixels less than what they have in common.
    common = [np.log1p(length * _ROW_NOISE**2) for length in (columns, rows)]
    camera, of_noise = specimens.source, np.hypot(specimens.log_read_noise, specimens.log_gain)
    errors = Errors(
        measured,
        (
            _own("black level", [specimens.offset_dn, 0, 0, 0, 0], "set by hand"),
            _own("noise of the camera", [0, of_noise, 0, 0, 0], camera),
            _own("hot pixels of the camera", [0, 0, np.sqrt(_HOT * dark.pixels), 0, 0], camera),
            _own("noise in common", [0, 0, 0, *common], BY_NAME["row_noise"].ordinary.source),
        ),
    )
    places = [Coordinates(name) for name in names]
    return observable_group(
        "dark frames", Observable.SENSOR, values, errors, places, ("sensor",), predict
    )


def flat_group(
    flat: FlatFrames,
    dark: DarkFrames | None,
    sensor: Sensor,
    specimens: Specimens = Specimens(),
) -> ObservableGroup:
    """Compare frames of even light with a linear camera."""
    order = np.argsort(flat.exposure_s)
    signal = flat.signal_dn[order]
    rate = np.log(signal / flat.exposure_s[order])
    full_dn = sensor.full_well_e / sensor.gain_e_dn
    # Of a camera without dark frames the read noise is known as its sheet says it, and less than
    # all noise that light has.
    noise_dn = dark.noise_dn if dark else sensor.read_noise_e / sensor.gain_e_dn
    shot = np.maximum(flat.variance_dn[order] - noise_dn**2, _LEAST_SHOT * flat.variance_dn[order])
    gain = float(np.log(np.mean(signal / shot)))
    unsure = 0.0 if dark else 2 * specimens.log_read_noise * float(np.max(noise_dn**2 / shot))

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

    values = [
        *(rate[1:] - rate[0]),
        # A sensor better than usual is not a gap.
        np.log(max(flat.pattern, _PATTERN)),
        gain,
        flat.corner,
        *flat.tilt,
    ]
    places = [Coordinates(f"linearity at {share:.0%}") for share in signal[1:] / full_dn]
    places += _OF_FLATS
    errors = _flat_errors(flat, signal, full_dn, specimens)
    if dark is None:
        by_offset = _by_offset(flat, signal, shot)
        columns = np.stack([specimens.offset_dn * by_offset, np.zeros(len(by_offset))], axis=1)
        columns[len(signal), 1] = unsure
        source = "no dark frames: set by hand"
        own = GroupNuisances("black level and read noise", columns, DISORDER, source)
        errors = replace(errors, nuisances=(*errors.nuisances, own))
    return observable_group(
        "even light", Observable.SENSOR, values, errors, places, ("sensor", "optics"), predict
    )


def _by_offset(flat: FlatFrames, signal: Array, shot: Array) -> Array:
    """Return the derivatives (n,) of the numbers of `flat_group` by the offset, 1/dn.

    A black level that is higher than it was taken to be makes all light as much weaker.
    """
    rates = -1 / signal[1:] + 1 / signal[0]
    whole = float(np.mean(signal))
    gain = -float(np.mean(1 / shot) / np.mean(signal / shot))
    return np.array([*rates, 1 / whole, gain, flat.corner / whole, *(flat.tilt / whole)])


def _flat_errors(flat: FlatFrames, signal: Array, full_dn: float, specimens: Specimens) -> Errors:
    """Return errors of the numbers of `flat_group`, from the shortest exposure to the longest."""
    several = len(signal) - 1
    # Within an exposure, the lamp flickers from frame to frame as the means of frames show.
    shown = np.hypot(flat.flicker / np.sqrt(flat.frames), _WANDER_DN / signal)
    noise = np.diag([*shown[1:], _NOISE_LAW, _NOISE_LAW, _DUST, _DUST, _DUST]) ** 2
    noise[:several, :several] += shown[0] ** 2
    drifts = np.zeros((len(noise), several + 1))
    # All rates are compared with that of the shortest exposure.
    drifts[:several] = _LAMP * np.hstack([np.eye(several), -np.ones((several, 1))])
    bends = np.zeros((len(noise), 1))
    bends[:several, 0] = _BENDS * (signal[1:] - signal[0]) / full_dn
    linear = [0.0] * several
    return Errors(
        noise,
        (
            GroupNuisances("drift of the lamp", drifts, DISORDER, "lamps that are not regulated"),
            GroupNuisances("bend", bends, DISORDER, BY_NAME["nonlinearity"].ordinary.source),
            _own("pattern of the camera", [*linear, _PATTERN_SPREAD, 0, 0, 0, 0], "data sheets"),
            _own(
                "gain of the camera",
                [*linear, 0, specimens.log_gain, 0, 0, 0],
                specimens.source,
            ),
            _own(
                "evenness of the lamp",
                [*linear, 0, 0, *[_UNEVEN] * 3],
                BY_NAME["lamp"].ordinary.source,
            ),
        ),
    )


def _own(name: str, deviations: Sequence[float], source: str) -> GroupNuisances:
    """Return an amount for each number of a group whose standard deviation is not zero."""
    columns = np.diag(np.array(deviations, dtype=float))
    return GroupNuisances(name, columns[:, columns.any(axis=0)], DISORDER, source)


def _filled(shown: Array, bends: float) -> Array:
    """Return how full pixels are (e,), as fractions, that show some fraction of a full one.

    The root of ``shown = filled (1 - bends filled)``, see `Sensor.nonlinearity`.
    """
    root = np.sqrt(np.maximum(1 - 4 * bends * shown, 0.0))
    filled: Array = 2 * shown / (1 + root)
    return filled


def local_oscillator_group(
    beam: LocalOscillatorFrames,
    sensor: Sensor,
    *,
    offset_dn: float = 0.0,
) -> ObservableGroup:
    """Compare the log of the local oscillator with that of a Gaussian beam.

    Parameters
    ----------
    beam : LocalOscillatorFrames
    sensor : Sensor
    offset_dn : float, optional
        Standard error of the digital number of a dark pixel.
    """
    halves = half_m(sensor)
    rows, columns = (min(count, _COARSE) for count in sensor.shape)
    coarse = replace(sensor, shape=(rows, columns))

    @lru_cache(maxsize=_KEPT)
    def shown(light: Illumination) -> Array:
        y, x = (
            half * np.linspace(-1, 1, count) - shift
            for half, count, shift in zip(
                halves, (rows, columns), light.local_oscillator_shift_m, strict=True
            )
        )
        image = np.exp(-2 * np.add.outer(y**2, x**2) / light.local_oscillator_waist_m**2)
        vignette = vignette_profile(light, coarse)
        found = log_paraboloid(image if vignette is None else image * vignette)
        return np.array([*found[1:], found[0]])

    def predict(parameters: BenchParameters) -> Array:
        return shown(parameters.optics.illumination)

    values = [*beam.tilt, beam.bend]
    dark = offset_dn / beam.signal_dn * np.array(values)[:, None]
    black = GroupNuisances("black level", dark, DISORDER, "no dark frames: set by hand")
    errors = Errors(np.full(len(values), _DUST), (black,) if offset_dn else ())
    places = [
        Coordinates("middle", region="rows"),
        Coordinates("middle", region="columns"),
        Coordinates("width", region="corners"),
    ]
    return observable_group(
        "local oscillator", Observable.SENSOR, values, errors, places, ("optics",), predict
    )


def _dark(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    if readings.dark is None:
        return None
    return dark_group(readings.dark, readings.nominal.sensor, Specimens.of(readings))


def _flat(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    if readings.flat is None:
        return None
    sensor, specimens = readings.nominal.sensor, Specimens.of(readings)
    return flat_group(readings.flat, readings.dark, sensor, specimens)


def _lo(readings: Readings, _reed_solver: ReedSolver) -> ObservableGroup | None:
    if readings.lo is None:
        return None
    offset_dn = 0.0 if readings.dark else Specimens.of(readings).offset_dn
    return local_oscillator_group(readings.lo, readings.nominal.sensor, offset_dn=offset_dn)


SOURCES: Final = (GroupSource(1, _dark), GroupSource(2, _flat), GroupSource(3, _lo))
