"""Linearise the block amplitudes of one sideband around a displacement."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array, ComplexArray, IndexArray


@dataclass(frozen=True)
class Local:
    """Block amplitudes of s holograms and their derivatives, relative to object field and gain.

    Attributes
    ----------
    u, v : (s, n) float
        Real and imaginary parts of F.
    uu, vu, uv, vv : (s, n) float
        Derivatives of the real and imaginary part of F (first letter) with respect to the real and
        imaginary part of the displacement (second letter).
    residual_u, residual_v : (s, n) float
        Residuals of the block amplitudes, times the complex conjugate of the object field, over
        the variance of the noise.
    power : (s, n) float
        Squared magnitude of the object field over the variance of the noise.
    gain : (s, 1) float
    misfit : (s,) float
        Sum of squared residuals over the variance of the noise.
    """

    u: Array
    v: Array
    uu: Array
    vu: Array
    uv: Array
    vv: Array
    residual_u: Array
    residual_v: Array
    power: Array
    gain: Array
    misfit: Array


def rows(object_field: ComplexArray, steps: IndexArray) -> ComplexArray:
    """Return the object field of holograms: (s, n), or (1, n) where all have the same."""
    return object_field[None] if object_field.ndim == 1 else object_field[steps]


def gradient(here: Local, functions: Array) -> Array:
    """Return the negative gradient (s, 2j + 1) of half the misfit."""
    pulls = (here.uu * here.residual_u + here.vu * here.residual_v,
             here.uv * here.residual_u + here.vv * here.residual_v)  # fmt: skip
    louder = here.u * here.residual_u + here.v * here.residual_v
    columns = [pull @ functions for pull in pulls] + [louder.sum(axis=1, keepdims=True)]
    found: Array = here.gain * np.concatenate(columns, axis=1)
    return found.astype(float)


def fill_matrix(matrix: Array, here: Local, functions: Array, pairs: Array) -> None:
    """Write the normal matrices (s, 2j + 1, 2j + 1) into `matrix`."""
    size = functions.shape[1]
    square = (here.gain**2).astype(float)
    power = here.power
    weights = (here.uu * here.uu + here.vu * here.vu,
               here.uu * here.uv + here.vu * here.vv,
               here.uv * here.uv + here.vv * here.vv)  # fmt: skip
    # One product: for few holograms its time is that of reading the pairs.
    packed = np.split(np.concatenate([power * each for each in weights]) @ pairs, 3)
    for row, column, products in zip((0, 0, 1), (0, 1, 1), packed, strict=True):
        block = matrix[:, row * size :, column * size :][:, :size, :size]
        write_symmetric(block, square * products)
        if row != column:
            matrix[:, size:-1, :size] = block
    sideband_equations = (here.uu * here.u + here.vu * here.v, here.uv * here.u + here.vv * here.v)
    coupling = square * np.concatenate(
        [(power * part) @ functions for part in sideband_equations], axis=1
    )
    matrix[:, -1, :-1] = matrix[:, :-1, -1] = coupling
    matrix[:, -1, -1] = square[:, 0] * np.sum((here.u * here.u + here.v * here.v) * power, axis=1)


@cache
def triangle(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the row and column indices of an upper triangle."""
    one, other = np.triu_indices(size)
    return one, other


def write_symmetric(matrices: Array, packed: Array) -> None:
    """Write symmetric matrices (s, j, j) from their upper triangles (s, j(j+1)/2)."""
    one, other = triangle(matrices.shape[-1])
    matrices[:, one, other] = packed
    matrices[:, other, one] = packed
