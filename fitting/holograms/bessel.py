"""Interpolate Bessel functions in tables, which is about ten times faster than evaluating them."""

from collections.abc import Sequence

import numpy as np
from scipy.special import j1, jv, jvp

from holography.arrays import Float32Array

# Below this J₂(φ)/φ² and J₃(φ)/φ³ are taken from their series, to 10⁻¹⁰ and 10⁻⁷.
_SERIES_RAD = 0.05


class BesselTable:
    """J₁(φ)/φ, J₂(φ)/φ² and J₃(φ)/φ³ for 0 ≤ φ ≤ `largest`, within 3·10⁻⁶; constant beyond.

    Parameters
    ----------
    largest : float
        Largest φ of the table, rad.
    per_rad : int
        Entries in the table per rad.
    """

    def __init__(self, largest: float = 200.0, per_rad: int = 200) -> None:
        phi = np.arange(int(largest * per_rad) + 2) / per_rad
        self._per_rad = np.float32(per_rad)
        self._last = np.float32(len(phi) - 2)
        ratio = np.divide(j1(phi), phi, out=np.full_like(phi, 0.5), where=phi > 0)
        bend = np.divide(
            jv(2, phi), phi**2, out=1 / 8 - phi**2 / 96 + phi**4 / 3072, where=phi > _SERIES_RAD
        )
        curve = np.divide(jv(3, phi), phi**3, out=1 / 48 - phi**2 / 768, where=phi > _SERIES_RAD)
        self._ratio, self._bend, self._curve = (
            table.astype(np.float32) for table in (ratio, -bend, curve)
        )

    def over_argument(self, phi: Float32Array) -> Float32Array:
        """Return J₁(φ)/φ for φ ≥ 0 (any shape)."""
        (ratio,) = _between(phi, self._per_rad, self._last, (self._ratio,))
        return ratio

    def tensor(self, phi: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return α = J₁(φ)/φ and β = −J₂(φ)/φ² for φ ≥ 0 (any shape).

        For a plane vector u, the function ``F(u) = u J₁(|u|)/|u|`` and its derivative are
        ``F = α u`` and ``dF/du = α 1 + β u uᵀ``.
        """
        ratio, bend = _between(phi, self._per_rad, self._last, (self._ratio, self._bend))
        return ratio, bend

    def curvature(self, phi: Float32Array) -> Float32Array:
        """Return J₃(φ)/φ³ for φ ≥ 0 (any shape): of β, the gradient is this times u."""
        (curve,) = _between(phi, self._per_rad, self._last, (self._curve,))
        return curve


class SidebandTable:
    """J_n(φ) and its derivative for 0 ≤ φ ≤ `largest`, within 3·10⁻⁶; constant beyond.

    Parameters
    ----------
    order : int
        Order n.
    largest : float
        Largest φ of the table, rad.
    per_rad : int
        Entries in the table per rad.
    """

    def __init__(self, order: int, largest: float = 200.0, per_rad: int = 200) -> None:
        phi = np.arange(int(largest * per_rad) + 2) / per_rad
        self._per_rad = np.float32(per_rad)
        self._last = np.float32(len(phi) - 2)
        self._tables = tuple(f(order, phi).astype(np.float32) for f in (jv, jvp))

    def __call__(self, phi: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return J_n(φ) and J_n′(φ) for φ ≥ 0 (any shape)."""
        value, slope = _between(phi, self._per_rad, self._last, self._tables)
        return value, slope


def _between(
    phi: Float32Array, per_rad: np.float32, last: np.float32, tables: Sequence[Float32Array]
) -> list[Float32Array]:
    """Interpolate linearly in tables."""
    position = np.minimum(phi * per_rad, last)
    index = position.astype(np.int32)
    # In single precision: with integers numpy would take doubles.
    part = position - index.astype(np.float32)
    rest = np.float32(1) - part
    after = index + np.int32(1)
    return [table.take(index) * rest + table.take(after) * part for table in tables]
