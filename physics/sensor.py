"""The camera's sensor: converts electrons to digital numbers."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from holography.arrays import Float32Array
from physics.parameters.sensor import Sensor

Counts = NDArray[np.uint16]

# Dark signal of hot pixels in a frame, as a fraction of the full well: least and most, evenly
# spread in the logarithm. Chosen: from what stands out of the read noise to half a full pixel.
_HOT_FRACTION = (0.02, 0.5)
# Rows that are read out at a time. Chosen: of the paper's camera they fit into a processor's cache.
_BAND_ROWS = 32


@dataclass(frozen=True, eq=False)
class PixelMaps:
    """What the pixels of one sensor always have.

    Attributes
    ----------
    sensitivity : (ny, nx) float32 or None
        Relative; None if all pixels are equal.
    dark_e : (ny, nx) float32 or None
        Electrons that hot pixels add to every frame; None if there are none.
    """

    sensitivity: Float32Array | None = None
    dark_e: Float32Array | None = None


def pixel_maps(sensor: Sensor, rng: np.random.Generator) -> PixelMaps:
    """Draw the maps of one sensor; a sensor without a pattern or hot pixels draws nothing."""
    sensitivity = dark_e = None
    if sensor.pattern:
        sensitivity = rng.standard_normal(sensor.shape, dtype=np.float32)
        sensitivity = np.float32(1) + np.float32(sensor.pattern) * sensitivity
    if sensor.hot:
        low, high = np.log(_HOT_FRACTION)
        strength = sensor.full_well_e * np.exp(rng.uniform(low, high, sensor.shape))
        hot = rng.random(sensor.shape) < sensor.hot
        dark_e = np.where(hot, strength, 0.0).astype(np.float32)
    return PixelMaps(sensitivity, dark_e)


def read_out(
    sensor: Sensor,
    mean_e: Float32Array,
    rng: np.random.Generator,
    maps: PixelMaps = PixelMaps(),
) -> Counts:
    """Draw noise and digitise one exposure.

    Shot noise is drawn from a normal distribution with the variance of a Poisson distribution. For
    the thousands of electrons of a local oscillator, only the skewness of about 1 % is neglected.
    It takes 65 536 values, all of the same probability, which is five times as fast: of its tails,
    what lies beyond 4.3 standard deviations is missing, which is 0.3 ‰ of the fourth moment.

    Parameters
    ----------
    sensor : Sensor
    mean_e : (ny, nx) float32
        Expected number of electrons in a pixel of the mean sensitivity; overwritten.
    rng : numpy.random.Generator
    maps : PixelMaps, optional
        Of this sensor.

    Returns
    -------
    (ny, nx) uint16
        Frame in dn.
    """
    counts = np.empty(mean_e.shape, dtype=np.uint16)
    for start in range(0, len(mean_e), _BAND_ROWS):
        rows = slice(start, start + _BAND_ROWS)
        band = PixelMaps(*(None if a is None else a[rows] for a in (maps.sensitivity, maps.dark_e)))
        counts[rows] = _read_out_rows(sensor, mean_e[rows], rng, band)
    return counts


def _read_out_rows(
    sensor: Sensor, mean_e: Float32Array, rng: np.random.Generator, maps: PixelMaps
) -> Float32Array:
    """Return numbers (rows, nx) that truncation makes those of the pixels; see `read_out`."""
    quantiles = _normal_quantiles()
    if maps.sensitivity is not None:
        mean_e *= maps.sensitivity
    if maps.dark_e is not None:
        mean_e += maps.dark_e
    np.maximum(mean_e, 0.0, out=mean_e)
    noise = np.take(quantiles, rng.integers(0, len(quantiles), mean_e.shape, dtype=np.uint16))
    noise *= np.sqrt(mean_e + np.float32(sensor.read_noise_e**2))
    mean_e += noise
    if sensor.row_noise_e:
        rows = rng.standard_normal((len(mean_e), 1), dtype=np.float32)
        mean_e += np.float32(sensor.row_noise_e) * rows
    np.minimum(mean_e, np.float32(sensor.full_well_e), out=mean_e)
    if sensor.nonlinearity:
        mean_e *= 1 - np.float32(sensor.nonlinearity / sensor.full_well_e) * mean_e
    mean_e *= np.float32(1 / sensor.gain_e_dn)
    # The additional 0.5 dn turns the truncation to whole numbers into rounding.
    mean_e += np.float32(sensor.offset_dn + 0.5)
    return np.clip(mean_e, 0, 2**sensor.bits - 1, out=mean_e)


@cache
def _normal_quantiles() -> Float32Array:
    """Return values of equal probability of a normal distribution, of unit variance."""
    count = 2**16
    quantiles = ndtri((np.arange(count) + 0.5) / count)
    scaled: Float32Array = (quantiles / np.std(quantiles)).astype(np.float32)
    return scaled


def saturation_dn(sensor: Sensor) -> int:
    """Return the digital number of a saturated pixel: the limit of full well or ADC."""
    well = sensor.full_well_e / sensor.gain_e_dn + sensor.offset_dn
    return int(min(well, 2**sensor.bits - 1))
