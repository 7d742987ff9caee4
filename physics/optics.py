"""Light from a vibrating reed with speckle, and its sidebands in one exposure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1, jv

from holography.arrays import Array
from holography.fresnel import FresnelTransform
from holography.fringes import phase_amplitude
from holography.region import Region, region_from_metres
from physics.reed.geometry import ReedGeometry

Complex64 = NDArray[np.complex64]

# Sidebands that are always computed. Chosen: the integrals of others over a frame are too small to
# change a pixel.
_KEPT_ORDERS = (-1, 0, 1, 2)
# Margins of the image around the vamp of a reed: across the reed in total, and behind the vamp.
# Chosen: a clarinet reed gets the default `Layout.reed_size_m`.
_SIDE_MARGIN_MM, _HEEL_MARGIN_MM = 0.5, 2.5


@dataclass(frozen=True)
class Illumination:
    """Light on the reed and on the sensor, in electrons per pixel and second.

    Attributes
    ----------
    local_oscillator_e_s : float
        Local oscillator at the middle of the sensor.
    local_oscillator_waist_m : float
        1/e² radius of the expanded local oscillator on the sensor.
    object_e_s : float
        Light that the reed scatters, as a mean over the sensor.
    object_waist_m : float
        1/e² radius of the illumination on the reed.
    """

    local_oscillator_e_s: float = 80e3
    local_oscillator_waist_m: float = 15e-3
    object_e_s: float = 250.0
    object_waist_m: float = 35e-3


@dataclass(frozen=True)
class Layout:
    """Position of the reed in front of the sensor.

    Attributes
    ----------
    wavelength_m : float
        Wavelength of the laser.
    distance_m : float
        Distance from reed to sensor.
    reed_centre_m : (float, float)
        Centre (y, x) of the visible reed relative to the optical axis. It is off axis, so that the
        image order is separated from the zero order and from the twin image.
    reed_size_m : (float, float)
        Height and width (y, x) of the rectangle around the visible reed; the tip touches its left
        side.
    """

    wavelength_m: float = 650e-9
    distance_m: float = 1.0
    reed_centre_m: tuple[float, float] = (22e-3, 0.0)
    reed_size_m: tuple[float, float] = (14e-3, 38e-3)


def visible_size_m(geometry: ReedGeometry) -> tuple[float, float]:
    """Return height and width (y, x) of the vamp with a margin, in m, for `Layout.reed_size_m`.

    Both are rounded up to whole millimetres.
    """
    y_mm = 1e3 * 2 * geometry.outline.side_half_width_m + _SIDE_MARGIN_MM
    x_mm = 1e3 * geometry.vamp_x_m[-1] + _HEEL_MARGIN_MM
    return 1e-3 * math.ceil(y_mm), 1e-3 * math.ceil(x_mm)


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


def beat_integral(offset_hz: Fraction, start_s: float, end_s: float) -> complex:
    """Return ``∫ exp(2πi·offset·t) dt`` over a part of an exposure, in s."""
    offset = float(offset_hz)
    if offset == 0.0:
        return complex(end_s - start_s)
    middle, length = 0.5 * (start_s + end_s), end_s - start_s
    return complex(length * np.sinc(offset * length) * np.exp(2j * np.pi * offset * middle))


def kept_orders(difference_hz: Fraction, drive_hz: Fraction) -> tuple[int, ...]:
    """Return the orders of the sidebands that have to be computed for an exposure.

    These are always the carrier and its neighbours, because they leak into a weak first sideband.
    The sideband that the difference frequency selects, and its neighbours, are added.
    """
    selected = round(difference_hz / drive_hz) if drive_hz else 0
    around = (selected - 1, selected, selected + 1)
    return tuple(sorted({*_KEPT_ORDERS, *around}))
