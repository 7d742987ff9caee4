"""Changes of the object light from one acquisition to the next."""

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array, Float32Array

Complex64 = NDArray[np.complex64]

# Highest degree, along or across the reed, of a smooth change. Chosen: with 3 it varies over a
# third of the reed, as beams that wander and warm air make it, and not from speckle to speckle.
_DEGREE = 3


def renewed(
    light: Complex64, envelope: Float32Array, renewal: float, rng: np.random.Generator
) -> Complex64:
    """Return speckle of which a part is new.

    Mean power stays: ``√(1 − renewal²)·light + renewal·new``.

    Parameters
    ----------
    light : (n,) complex64
    envelope : (n,) float32
        Root mean square of the light at each point, over all speckle.
    renewal : float
        Rms of what is new, relative to that of all light; from 0 to 1.
    rng : numpy.random.Generator
    """
    parts = rng.standard_normal((2, len(light)), dtype=np.float32)
    new = envelope * (parts[0] + 1j * parts[1]) / np.float32(np.sqrt(2))
    mixed: Complex64 = (np.sqrt(1 - renewal**2) * light + renewal * new).astype(np.complex64)
    return mixed


def smooth_shapes(x_m: Array, y_m: Array) -> Float32Array:
    """Return smooth functions (n, 15) at points (n,), orthogonal and of mean square 1.

    They are products of polynomials along and across. A constant is left out: that would be a gain.
    """
    along, across = (
        np.polynomial.legendre.legvander(_scaled(each), _DEGREE) for each in (x_m, y_m)
    )
    products = np.einsum("nl,nm->nlm", along, across).reshape(len(x_m), -1)
    orthogonal = np.linalg.qr(products)[0][:, 1:]
    shapes: Float32Array = (orthogonal * np.sqrt(len(x_m))).astype(np.float32)
    return shapes


def smoothly_changed(
    light: Complex64, shapes: Float32Array, rms: float, rng: np.random.Generator
) -> Complex64:
    """Return light times ``exp(z)``, with z a smooth complex random field of an rms.

    Parameters
    ----------
    light : (n,) complex64
    shapes : (n, k) float32
        See `smooth_shapes`.
    rms : float
        Root mean square of the modulus of z, over draws and points.
    rng : numpy.random.Generator
    """
    count = shapes.shape[1]
    real, imaginary = rng.standard_normal((2, count)) * rms / np.sqrt(2 * count)
    changed: Complex64 = (light * np.exp(shapes @ (real + 1j * imaginary))).astype(np.complex64)
    return changed


def _scaled(places_m: Array) -> Array:
    low, high = float(np.min(places_m)), float(np.max(places_m))
    return 2 * (places_m - low) / (high - low) - 1
