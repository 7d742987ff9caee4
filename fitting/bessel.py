"""Bessel functions from tables: interpolation is an order of magnitude faster than evaluation."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1

Float = NDArray[np.float32]

# Below this the slope at 0, ½, stands for J₁(φ)/φ: to single precision it is the same.
_SMALL_RAD = np.float32(1e-3)


class BesselTable:
    """J₁ and its derivative at phases from 0 to `largest`, to 3·10⁻⁶; constant beyond.

    Parameters
    ----------
    largest : float
        In rad.
    per_rad : int
        Entries.
    """

    def __init__(self, largest: float = 200.0, per_rad: int = 200) -> None:
        phi = np.arange(int(largest * per_rad) + 2) / per_rad
        self._per_rad = np.float32(per_rad)
        self._last = np.float32(len(phi) - 2)
        ratio = np.divide(j1(phi), phi, out=np.full_like(phi, 0.5), where=phi > 0)
        self._value, self._slope = (
            table.astype(np.float32) for table in (j1(phi), j0(phi) - ratio)
        )

    def __call__(self, phi: Float) -> tuple[Float, Float]:
        """J₁ and J₁′ at phases φ ≥ 0 (any shape)."""
        position = np.minimum(phi * self._per_rad, self._last)
        index = position.astype(np.int32)
        # In single precision: with integers numpy would take doubles.
        part = position - index.astype(np.float32)
        return (
            self._value[index] * (1 - part) + self._value[index + 1] * part,
            self._slope[index] * (1 - part) + self._slope[index + 1] * part,
        )

    def over_argument(self, phi: Float) -> tuple[Float, Float]:
        """J₁(φ)/φ and J₁′ at phases φ ≥ 0 (any shape)."""
        value, slope = self(phi)
        whole: Float = np.divide(
            value, phi, out=np.full_like(phi, 0.5), where=np.asarray(phi > _SMALL_RAD)
        )
        return whole, slope
