"""Phasors of one sideband around a displacement: their slopes, and the equations these make."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Local:
    """Phasors (s, n) of some holograms and their slopes, all relative to light and gain.

    Attributes
    ----------
    u, v : (s, n) float
        F, real and imaginary parts.
    uu, vu, uv, vv : (s, n) float
        Derivatives of its real and imaginary parts (first letter) by those of the displacement.
    left_u, left_v : (s, n) float
        What is left of the phasors, times the complex conjugate of the light.
    power : (n,) float
        Of the light.
    gain : (s, 1) float
    misfit : (s,) float
        Squares of what is left.
    """

    u: Array
    v: Array
    uu: Array
    vu: Array
    uv: Array
    vv: Array
    left_u: Array
    left_v: Array
    power: Array
    gain: Array
    misfit: Array


def gradient(here: Local, functions: Array) -> Array:
    """Of half the misfit, downhill: (s, 2j + 1)."""
    pulls = (here.uu * here.left_u + here.vu * here.left_v,
             here.uv * here.left_u + here.vv * here.left_v)  # fmt: skip
    louder = here.u * here.left_u + here.v * here.left_v
    columns = [pull @ functions for pull in pulls] + [louder.sum(axis=1, keepdims=True)]
    found: Array = here.gain * np.concatenate(columns, axis=1)
    return found.astype(float)


def fill_matrix(matrix: Array, here: Local, functions: Array, pairs: Array) -> None:
    """Write normal matrices (s, 2j + 1, 2j + 1)."""
    size = functions.shape[1]
    square = (here.gain**2).astype(float)
    power = here.power
    weights = (here.uu * here.uu + here.vu * here.vu,
               here.uu * here.uv + here.vu * here.vv,
               here.uv * here.uv + here.vv * here.vv)  # fmt: skip
    # All at once: few holograms' products take as long as it takes to read the pairs.
    packed = np.split((power * np.concatenate(weights)) @ pairs, 3)
    for row, column, products in zip((0, 0, 1), (0, 1, 1), packed, strict=True):
        block = matrix[:, row * size :, column * size :][:, :size, :size]
        write_symmetric(block, square * products)
        if row != column:
            matrix[:, size:-1, :size] = block
    beside = (here.uu * here.u + here.vu * here.v, here.uv * here.u + here.vv * here.v)
    coupling = square * np.concatenate([(power * part) @ functions for part in beside], axis=1)
    matrix[:, -1, :-1] = matrix[:, :-1, -1] = coupling
    matrix[:, -1, -1] = square[:, 0] * ((here.u * here.u + here.v * here.v) @ here.power)


@cache
def triangle(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of an upper triangle."""
    one, other = np.triu_indices(size)
    return one, other


def write_symmetric(matrices: Array, packed: Array) -> None:
    """Write symmetric matrices (s, j, j) from their upper triangles (s, j(j+1)/2)."""
    one, other = triangle(matrices.shape[-1])
    matrices[:, one, other] = packed
    matrices[:, other, one] = packed
