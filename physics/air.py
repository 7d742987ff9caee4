"""The air that drives the reed: the chamber of the mouthpiece, between tweeter and reed."""

import numpy as np

from holography.arrays import Array, ComplexArray
from physics.parameters.chamber import Chamber, Filling, PressureDistortion

# Degrees of the polynomials of a pressure distortion: along the window, across it, and in ln f.
# Chosen: smooth over the window and over the band.
_DISTORTION_DEGREES = (2, 2, 3)
# Frequency band of a pressure distortion: about that of the paper's sweeps.
_BAND_HZ = (1e3, 20e3)


def pressure_on_reed(chamber: Chamber, frequency_hz: float, x_m: Array, y_m: Array) -> ComplexArray:
    """Return the complex pressure on the reed's flat side, relative to the pressure at its tip.

    It is the standing wave of `pressure_shape` and a wave that travels away from the tip, which
    lags behind it: ``cos(kx) − i·travelling·sin(kx)``. A distortion multiplies both.

    Parameters
    ----------
    chamber, frequency_hz, x_m, y_m
        See `pressure_shape`.

    Returns
    -------
    complex array of the same shape
    """
    pressure: ComplexArray = pressure_shape(chamber, frequency_hz, x_m, y_m).astype(complex)
    if chamber.travelling:
        wavenumber = 2 * np.pi * frequency_hz / chamber.sound_speed_m_s
        behind = _in_window(chamber, x_m, y_m, np.sin(wavenumber * x_m))
        pressure -= 1j * chamber.travelling * behind
    if chamber.distortion.rms:
        pressure *= distortion_factor(chamber.distortion, chamber, frequency_hz, x_m, y_m)
    return pressure


def pressure_shape(chamber: Chamber, frequency_hz: float, x_m: Array, y_m: Array) -> Array:
    """Return the standing wave on the reed's flat side, relative to the pressure at its tip.

    Along the reed it is a standing wave that is closed at the tip. Across the reed it is constant
    over the open part of the window. Positive y is the left side, which stays open if the right
    half is filled; a fraction `Chamber.leak` reaches the filled half, and a fraction
    `Chamber.rail_leak` the edges of the reed beyond the window.

    Parameters
    ----------
    chamber : Chamber
    frequency_hz : float
    x_m, y_m : float arrays of one shape
        Points on the flat side in coordinates of the reed, in m.

    Returns
    -------
    float array of the same shape
    """
    wavenumber = 2 * np.pi * frequency_hz / chamber.sound_speed_m_s
    return _in_window(chamber, x_m, y_m, np.cos(wavenumber * x_m))


def _in_window(chamber: Chamber, x_m: Array, y_m: Array, wave: Array) -> Array:
    """Return what is left of a wave at points that walls or clay may cover."""

    def step(distance_m: Array) -> Array:
        rise: Array = 0.5 * (1 + np.tanh(distance_m / chamber.edge_m))
        return rise

    across = step(chamber.half_width_m - np.abs(y_m))
    if chamber.rail_leak:
        across = across + chamber.rail_leak * (1 - across)
    shape: Array = wave * step(chamber.length_m - x_m)
    shape = shape * across
    if chamber.filling is Filling.ASYMMETRIC:
        shape = shape * (chamber.leak + (1 - chamber.leak) * step(y_m))
    return shape


def distortion_factor(
    distortion: PressureDistortion, chamber: Chamber, frequency_hz: float, x_m: Array, y_m: Array
) -> ComplexArray:
    """Return the factor by which a distortion changes the pressure, at points of the flat side.

    It is 1 plus a sum of products of Legendre polynomials in x, y and ln f with random complex
    weights. Products that are constant over the window are left out, because they would be a gain.
    Outside the window and the band, the values at their edges are used.

    Parameters
    ----------
    distortion : PressureDistortion
    chamber : Chamber
    frequency_hz : float
    x_m, y_m : float arrays of one shape
        Points in coordinates of the reed, in m.

    Returns
    -------
    complex array of the same shape
    """
    rng = np.random.default_rng(distortion.seed)
    shape = [degree + 1 for degree in _DISTORTION_DEGREES]
    real, imaginary = rng.standard_normal((2, *shape))
    weights = real + 1j * imaginary
    weights[0, 0] = 0.0
    weights *= distortion.rms / np.linalg.norm(weights)
    low, high = np.log(_BAND_HZ)
    along, across, in_frequency = (
        _legendre(coordinate, degree)
        for coordinate, degree in zip(
            (
                2 * x_m / chamber.length_m - 1,
                y_m / chamber.half_width_m,
                np.array([2 * (np.log(frequency_hz) - low) / (high - low) - 1]),
            ),
            _DISTORTION_DEGREES,
            strict=True,
        )
    )
    factor: ComplexArray = 1 + np.einsum(
        "lm,...l,...m->...", weights @ in_frequency[0], along, across
    )
    return factor


def _legendre(coordinate: Array, degree: int) -> Array:
    """Return Legendre polynomials (…, degree + 1) of mean square 1 over −1 … 1, constant beyond."""
    table = np.polynomial.legendre.legvander(np.clip(coordinate, -1, 1), degree)
    normalised: Array = table * np.sqrt(2 * np.arange(degree + 1) + 1)
    return normalised
