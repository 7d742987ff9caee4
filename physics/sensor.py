"""The camera's sensor: converts electrons to digital numbers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Float32Array

Counts = NDArray[np.uint16]


@dataclass(frozen=True)
class Sensor:
    """A CCD with shot noise, read noise, a full well and an ADC.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns.
    pixel_m : float
        Pixel pitch.
    full_well_e : float
        Electrons at which a pixel stops filling.
    gain_e_dn : float
        Electrons per digital number.
    read_noise_e : float
        Standard deviation of the read noise per pixel and frame, in electrons.
    offset_dn : float
        Digital number of a dark pixel.
    bits : int
        Resolution of the ADC.
    """

    shape: tuple[int, int] = (1024, 1280)
    pixel_m: float = 6.7e-6
    full_well_e: float = 16000.0
    gain_e_dn: float = 4.0
    read_noise_e: float = 12.0
    offset_dn: float = 50.0
    bits: int = 12


def read_out(sensor: Sensor, mean_e: Float32Array, rng: np.random.Generator) -> Counts:
    """Draw noise and digitise one exposure.

    Shot noise is drawn from a normal distribution with the variance of a Poisson distribution. For
    the thousands of electrons of a local oscillator, only the skewness of about 1 % is neglected.

    Parameters
    ----------
    sensor : Sensor
    mean_e : (ny, nx) float32
        Expected number of electrons; overwritten.
    rng : numpy.random.Generator

    Returns
    -------
    (ny, nx) uint16
        Frame in dn.
    """
    noise = rng.standard_normal(mean_e.shape, dtype=np.float32)
    np.maximum(mean_e, 0.0, out=mean_e)
    noise *= np.sqrt(mean_e + np.float32(sensor.read_noise_e**2))
    mean_e += noise
    np.minimum(mean_e, np.float32(sensor.full_well_e), out=mean_e)
    mean_e *= np.float32(1 / sensor.gain_e_dn)
    # The additional 0.5 dn turns the truncation of astype into rounding.
    mean_e += np.float32(sensor.offset_dn + 0.5)
    np.clip(mean_e, 0, 2**sensor.bits - 1, out=mean_e)
    return mean_e.astype(np.uint16)


def saturation_dn(sensor: Sensor) -> int:
    """Return the digital number of a saturated pixel: the limit of full well or ADC."""
    well = sensor.full_well_e / sensor.gain_e_dn + sensor.offset_dn
    return int(min(well, 2**sensor.bits - 1))
