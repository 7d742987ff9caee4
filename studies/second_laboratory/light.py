"""Light: scatterers on the reed, their waves on the sensor, and the mean over an exposure.

A scatterer at (x, y) on the reed, at distance z, gives exp(−iπ((u − x)² + (v − y)²)/λz) on the
sensor (time factor exp(+2πiνt), decision 0002). The scatterers lie anywhere; their sum on the
pixels is a transform from uneven to even points, made by spreading on a finer grid with the
"exponential of semicircle" kernel (Barnett, Magland, af Klinteberg 2019), an FFT and a division.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse

from studies.second_laboratory.shape import STRIP_FRONT, contour

ComplexArray = NDArray[np.complex64]
Array = NDArray[np.float64]
# Width w and shape β/w of the kernel, at σ = 1.25 times the points along each axis:
# β = 0.97 πw (1 − 1/2σ) (the paper of Barnett et al., section 4). For w = 10 the relative error is
# 1e-5, and 1e-4 at the sensor's edge, as that of a direct sum shows; for w = 7 it is 5e-4.
_KERNEL_WIDTH, _FINER = 10, 1.25
_KERNEL_SHAPE = 0.97 * np.pi * (1 - 1 / (2 * _FINER))

# Middle of the vamp, at which the camera looks, and half of the vamp's greatest width.
MIDDLE_MM, _WIDEST_MM = 19.0, float(contour(3.0))
# Degree of the polynomials in x and y by which the field drifts.
_DRIFT_DEGREE = 3


@dataclass(frozen=True)
class Geometry:
    """Sensor and distance, in m, as the bench file states them."""

    shape: tuple[int, int]
    pixel_m: float
    wavelength_m: float
    distance_m: float

    def axis(self, n: int) -> Array:
        """Return the positions of n pixels; pixel n // 2 is on the optical axis."""
        return np.asarray((np.arange(n) - n // 2) * self.pixel_m)


class Propagation:
    """Waves of scatterers on the sensor.

    Parameters
    ----------
    geometry : Geometry
    x_m, y_m : (n,) float64
        Scatterers, from the optical axis.
    width : int
        Of the kernel, in points of the finer grid.
    """

    def __init__(
        self, geometry: Geometry, x_m: Array, y_m: Array, width: int = _KERNEL_WIDTH
    ) -> None:
        self._geometry = geometry
        rate = geometry.wavelength_m * geometry.distance_m
        self._fine = tuple(fft.next_fast_len(math.ceil(_FINER * n)) for n in geometry.shape)
        ny, nx = (
            _spread(geometry.pixel_m * at / rate, n, width)
            for at, n in zip((y_m, x_m), self._fine, strict=True)
        )
        rows = (ny[0][:, :, None] * self._fine[1] + nx[0][:, None, :]).reshape(len(x_m), -1)
        values = (ny[1][:, :, None] * nx[1][:, None, :]).reshape(len(x_m), -1)
        owner = np.repeat(np.arange(len(x_m)), rows.shape[1])
        spreading = sparse.csr_array(
            (values.ravel().astype(np.float32), (rows.ravel(), owner)),
            shape=(self._fine[0] * self._fine[1], len(x_m)),
        )
        # Points of the grid that no scatterer reaches stay zero.
        self._reached = np.flatnonzero(np.diff(spreading.indptr))
        self._spreading = spreading[self._reached]
        phase = np.exp(-1j * np.pi * (x_m**2 + y_m**2) / rate)
        # The wave of a scatterer is averaged over a pixel that is filled by its sensitive area. The
        # pixel's own distance from the axis changes this factor by less than 2 % within 1 mm.
        blur = np.sinc(geometry.pixel_m * x_m / rate) * np.sinc(geometry.pixel_m * y_m / rate)
        self._source = (phase * blur).astype(np.complex64)
        v, u = (geometry.axis(n) for n in geometry.shape)
        flat = [
            _kernel_transform((np.arange(n) - n // 2) / m, width)
            for n, m in zip(geometry.shape, self._fine, strict=True)
        ]
        chirp = np.exp(-1j * np.pi * (v[:, None] ** 2 + u**2) / rate)
        self._target = (chirp / (flat[0][:, None] * flat[1])).astype(np.complex64)

    def __call__(self, amplitudes: ComplexArray) -> ComplexArray:
        """Return the fields (k, ny, nx) on the pixels of k sets of amplitudes (k, n)."""
        sources = np.ascontiguousarray((amplitudes * self._source).T, dtype=np.complex64)
        spread = (self._spreading @ sources.view(np.float32)).view(np.complex64)
        waves = np.empty((len(amplitudes), *self._geometry.shape), np.complex64)
        for wave, values in zip(waves, spread.T, strict=True):
            grid = np.zeros(self._fine, np.complex64)
            grid.flat[self._reached] = values
            along = _cropped(fft.ifft(grid, axis=0, norm="forward", overwrite_x=True), 0, wave)
            whole = _cropped(fft.ifft(along, axis=1, norm="forward", overwrite_x=True), 1, wave)
            np.multiply(whole, self._target, out=wave)
        return waves


def _cropped(grid: ComplexArray, axis: int, wave: ComplexArray) -> ComplexArray:
    """Return the pixels of a wave along an axis of a finer grid, whose first point is the axis."""
    n = wave.shape[axis]
    return np.roll(grid, n // 2, axis)[(slice(None),) * axis + (slice(n),)]


def _kernel(distance: Array, width: int) -> Array:
    inside = np.maximum(1 - (2 * distance / width) ** 2, 0.0)
    return np.asarray(np.exp(_KERNEL_SHAPE * width * (np.sqrt(inside) - 1)))


def _kernel_transform(frequency: Array, width: int) -> Array:
    points, weights = np.polynomial.legendre.leggauss(60)
    at = points * width / 2
    values = _kernel(at, width) * weights * width / 2
    return np.asarray(np.cos(2 * np.pi * np.outer(frequency, at)) @ values)


def _spread(position: Array, n: int, width: int) -> tuple[NDArray[np.int64], Array]:
    """Return grid points near positions (in turns), and the kernel there; each (points, width)."""
    at = position * n
    first = np.ceil(at - width / 2).astype(int)
    points = first[:, None] + np.arange(width)
    return points % n, _kernel(points - at[:, None], width)


def place_scatterers(
    per_cell: float, geometry: Geometry, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return places on the vamp in mm, `per_cell` of them per cell of the image.

    Only the vamp is lit; `MIDDLE_MM` is where the camera looks.
    """
    rate = geometry.wavelength_m * geometry.distance_m / geometry.pixel_m
    cell_mm2 = 1e6 * rate**2 / (geometry.shape[0] * geometry.shape[1])
    count = round(per_cell * STRIP_FRONT * 2 * _WIDEST_MM / cell_mm2)
    x = rng.uniform(0, STRIP_FRONT, count)
    y = rng.uniform(-_WIDEST_MM, _WIDEST_MM, count)
    inside = np.abs(y) < contour(x)
    return x[inside], y[inside]


def drift_shapes(x: Array, y: Array) -> Array:
    """Return the polynomials (n, m) by which the field drifts, at places on the vamp in mm."""
    u, v = x / MIDDLE_MM - 1, y / _WIDEST_MM
    degrees = [(i, j) for i in range(_DRIFT_DEGREE + 1) for j in range(_DRIFT_DEGREE + 1 - i)]
    return np.stack([u**i * v**j for i, j in degrees], 1)


def circular(rng: np.random.Generator, count: int) -> NDArray[np.complex128]:
    """Return circular Gaussian numbers of mean power 1."""
    real, imaginary = rng.standard_normal((2, count))
    return np.asarray((real + 1j * imaginary) / math.sqrt(2))


def vibration_samples(largest_rad: float) -> int:
    """Return the number of phases of a vibration that sample its light without aliasing.

    Light modulated by φ cos θ has no harmonic above about φ + 4 + 2φ^⅓ (J_n(φ) < 1e-3 beyond), and
    the intensity has differences of any two.
    """
    return int(2 * np.ceil(largest_rad + 3 + 2 * np.cbrt(largest_rad)))


def exposure_weights(
    drive_hz: float, beat_hz: float, starts_s: Array, exposure_s: float, samples: int
) -> NDArray[np.complex128]:
    """Return how strongly the light at each phase of the vibration beats with the reference.

    The order n of the light, at n·f from the carrier, beats at n·f − Δ; over an exposure from t to
    t + T it leaves sinc((n f − Δ)T)·exp(2πi (n f − Δ)(t + T/2)). All orders that `samples` resolves
    are kept; the others are below 1e-3·sinc.

    Parameters
    ----------
    drive_hz, beat_hz : float
        f, and Δ = f_AOM1 − f_AOM2.
    starts_s : (m,) float64
        Starts of the exposures.
    exposure_s : float
    samples : int

    Returns
    -------
    (m, samples) complex128
        For light at the phases 2πk/samples of the vibration.
    """
    order = np.arange(-(samples // 2) + 1, samples - samples // 2)
    beat = order * drive_hz - beat_hz
    middle = np.asarray(starts_s)[:, None] + exposure_s / 2
    gain = np.sinc(beat * exposure_s) * np.exp(2j * np.pi * np.mod(beat * middle, 1.0))
    phases = np.exp(-2j * np.pi * np.outer(order, np.arange(samples)) / samples)
    return np.asarray(gain @ phases / samples)
