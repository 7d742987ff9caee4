"""Light from a vibrating reed with speckle, and its sidebands in one exposure."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1, jv

from holography.arrays import Array, Float32Array
from holography.fresnel import FresnelTransform
from holography.fringes import phase_amplitude
from holography.region import Region, region_from_metres
from physics.parameters.optics import Illumination, Interference, Layout
from physics.parameters.sensor import Sensor

Complex64 = NDArray[np.complex64]

# Sidebands that are always computed. Chosen: the integrals of others over a frame are too small to
# change a pixel.
_KEPT_ORDERS = (-1, 0, 1, 2)


def reed_region(layout: Layout, transform: FresnelTransform) -> Region:
    """Return the region of an object image that holds the visible reed."""
    return region_from_metres(layout.reed_centre_m, layout.reed_size_m, transform)


def reed_axes_m(layout: Layout, region: Region, transform: FresnelTransform) -> tuple[Array, Array]:
    """Return the reed coordinates of a region's pixels in m: y (height,) and x (width,)."""
    pitch_y, pitch_x = transform.object_pitch_m
    ny, nx = transform.shape
    y = (np.arange(region.height) + region.row - ny // 2) * pitch_y - layout.reed_centre_m[0]
    x = (np.arange(region.width) + region.column - nx // 2) * pitch_x - layout.reed_centre_m[1]
    return y, x + 0.5 * layout.reed_size_m[1]


def speckle(shape: tuple[int, int], rng: np.random.Generator) -> Complex64:
    """Draw fully developed speckle of a rough surface: circular Gaussian, mean power 1.

    Each pixel is one resolution cell of the hologram. Roughness within a cell is not resolved, so
    cells are independent.

    Parameters
    ----------
    shape : (int, int)
    rng : numpy.random.Generator

    Returns
    -------
    complex64 array of that shape
    """
    parts = rng.standard_normal((2, *shape), dtype=np.float32)
    rough: Complex64 = ((parts[0] + 1j * parts[1]) / np.sqrt(2)).astype(np.complex64)
    return rough


def sidebands(
    orders: Sequence[int], displacement_m: Complex64, wavelength_m: float
) -> list[Complex64]:
    """Return the complex amplitudes of sidebands of the reflected light, relative to rest.

    A surface that moves by ``Re(w e^{iωt})`` along the beam modulates the phase by
    ``φ cos(ωt + arg w)`` with ``φ = 4π|w|/λ``; sideband n is ``iⁿ J_n(φ) e^{i n arg w}``.
    Backscattering along the line of sight is assumed, as in the paper.

    Parameters
    ----------
    orders : sequence of int
    displacement_m : (n,) complex64
        Complex displacement w.
    wavelength_m : float

    Returns
    -------
    list of (n,) complex64
        Amplitudes, one array for each order.
    """
    size = np.abs(displacement_m).astype(np.float64)
    # Without motion the phase of w is undefined, but J_n is 0 there for n ≠ 0.
    unit = displacement_m / np.maximum(size, np.finfo(np.float64).tiny)
    bessel = _bessel({abs(order) for order in orders}, phase_amplitude(size, wavelength_m))
    answer = []
    for order in orders:
        # With J_{−n} = (−1)ⁿ J_n, sidebands n and −n have the same factor iⁿ.
        direction = unit if order >= 0 else unit.conj()
        factor = 1j ** abs(order) * bessel[abs(order)] * direction ** abs(order)
        answer.append(factor.astype(np.complex64))
    return answer


def _bessel(orders: set[int], phi: Array) -> dict[int, Array]:
    """Return Bessel functions J_n(φ) by order n ≥ 0, each of the shape of φ."""
    values = {0: j0(phi), 1: j1(phi)}
    # J_2 by recurrence, ten times faster than jv; by its series where the recurrence is inaccurate.
    series = phi < 1e-3
    values[2] = np.where(series, phi**2 / 8, 2 * values[1] / np.where(series, 1, phi) - values[0])
    return values | {order: jv(order, phi) for order in orders - values.keys()}


def local_oscillator_profile(light: Illumination, sensor: Sensor) -> Float32Array:
    """Return the amplitude of the local oscillator on the sensor (ny, nx), √(electrons/s)."""
    squares = [
        (sensor.pixel_m * (np.arange(n) - n // 2) - shift_m) ** 2
        for n, shift_m in zip(sensor.shape, light.local_oscillator_shift_m, strict=True)
    ]
    profile = np.exp(-np.add.outer(*squares) / light.local_oscillator_waist_m**2)
    amplitude: Float32Array = (np.sqrt(light.local_oscillator_e_s) * profile).astype(np.float32)
    return amplitude


def vignette_profile(light: Illumination, sensor: Sensor) -> Float32Array | None:
    """Return the part of the light that reaches each pixel (ny, nx); None if all of it does.

    It falls with the square of the distance from the middle, to 1 - `vignette` in the corners.
    """
    if not light.vignette:
        return None
    y, x = (np.linspace(-1, 1, n) for n in sensor.shape)
    lost = 0.5 * light.vignette * np.add.outer(y**2, x**2)
    return np.asarray(1 - lost, dtype=np.float32)


def lamp_profile(light: Illumination, sensor: Sensor) -> Float32Array | None:
    """Return a lamp's light on each pixel (ny, nx) relative to its mean; None if it is even.

    The lamp is off the axis: its light falls from one corner and towards all sides. Four
    terms of equal mean square make the rms `Illumination.lamp_unevenness`.
    """
    if not light.lamp_unevenness:
        return None
    terms = []
    for n in sensor.shape:
        place = np.linspace(-1, 1, n)
        bowl = place**2 - np.mean(place**2)
        terms.append(0.5 * (place / np.std(place) - bowl / np.std(bowl)))
    return np.asarray(1 + light.lamp_unevenness * np.add.outer(*terms), dtype=np.float32)


def decorrelated(interference: Interference, phi_rad: Array) -> Float32Array:
    """Return the contrast that is left where the phase amplitude is φ."""
    kept = 1 - interference.decorrelation_per_rad2 * np.square(phi_rad)
    return np.maximum(kept, 0.0).astype(np.float32)


def log_laser_power(changes: Interference, time_s: Array) -> Array:
    """Return the log of the laser's power over that at the start, at times (any shape) since then.

    Its mean only: what scatters from frame to frame is left out.
    """
    fallen: Array = -changes.fade_per_h * time_s / 3600
    return fallen


def beat_integral(offset_hz: float, start_s: float, end_s: float) -> complex:
    """Return ``∫ exp(2πi·offset·t) dt`` over a part of an exposure, in s."""
    middle, length = 0.5 * (start_s + end_s), end_s - start_s
    return complex(length * np.sinc(offset_hz * length) * np.exp(2j * np.pi * offset_hz * middle))


def kept_orders(difference_hz: Fraction, drive_hz: Fraction) -> tuple[int, ...]:
    """Return the orders of the sidebands that have to be computed for an exposure.

    These are always the carrier and its neighbours, because they leak into a weak first sideband.
    The sideband that the difference frequency selects, and its neighbours, are added.
    """
    selected = round(difference_hz / drive_hz) if drive_hz else 0
    around = (selected - 1, selected, selected + 1)
    return tuple(sorted({*_KEPT_ORDERS, *around}))
