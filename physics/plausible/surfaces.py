"""Functions of the plan in which the random thickness of reeds varies, most important first."""

from dataclasses import dataclass

import numpy as np

from holography.arrays import Array
from physics.reed.geometry import ReedGeometry

# Points at which an eigenfunction is computed. Chosen: variances are then those of 192 points to
# 3e-5, of a sum of 1.
_POINTS = 64
# Fraction of the variance that the functions describe. Chosen: what is left of a map of 6 µm is
# 1.3 µm, below the 10 µm to which thickness is known (paper, section III.A).
_DESCRIBED = 0.95


@dataclass(frozen=True)
class ThicknessFunctions:
    """Functions with independent random amounts that make up a random surface of variance 1.

    By the theorem of Karhunen and Loève; the correlation of the surface is a product of a function
    along the reed and one across it, and so are these.

    Attributes
    ----------
    along, across : _Axis
    pairs : tuple of (int, int)
        Which eigenfunctions along and across each function is the product of.
    """

    along: "_Axis"
    across: "_Axis"
    pairs: tuple[tuple[int, int], ...]

    @classmethod
    def of(
        cls, geometry: ReedGeometry, correlation_x_m: float, correlation_y_m: float
    ) -> "ThicknessFunctions":
        """Return the functions for the vamp of a reed.

        Parameters
        ----------
        geometry : ReedGeometry
        correlation_x_m, correlation_y_m : float
            See `physics.reed.random_surface.random_surface`.
        """
        width_m = geometry.outline.side_half_width_m
        along = _Axis.of(0.0, float(geometry.vamp_x_m[-1]), correlation_x_m)
        across = _Axis.of(-width_m, width_m, correlation_y_m)
        variance = np.multiply.outer(along.variance, across.variance)
        order = np.argsort(variance, axis=None)[::-1]
        described = np.cumsum(variance.ravel()[order])
        kept = order[: int(np.searchsorted(described, _DESCRIBED)) + 1]
        rows, columns = np.unravel_index(kept, variance.shape)
        return cls(along, across, tuple(zip(rows.tolist(), columns.tolist(), strict=True)))

    def at(self, x_m: Array, y_m: Array) -> Array:
        """Return the functions (f, n) at points (n,), each scaled by its standard deviation."""
        along, across = self.along.at(x_m), self.across.at(y_m)
        return np.stack([along[one] * across[other] for one, other in self.pairs])


@dataclass(frozen=True)
class _Axis:
    """Eigenfunctions of the correlation ``exp(-(Δ/length)²)`` on an interval.

    Attributes
    ----------
    points_m : (n,) float
    length_m : float
    variance : (n,) float
        Mean square of each function over the interval, descending; the sum is 1.
    vectors : (n, n) float
        Eigenvectors of the correlation of the points.
    """

    points_m: Array
    length_m: float
    variance: Array
    vectors: Array

    @classmethod
    def of(cls, start_m: float, end_m: float, length_m: float) -> "_Axis":
        points = start_m + (np.arange(_POINTS) + 0.5) * (end_m - start_m) / _POINTS
        correlation = _correlation(points, points, length_m) / _POINTS
        variance, vectors = np.linalg.eigh(correlation)
        return cls(points, length_m, np.maximum(variance[::-1], 0.0), vectors[:, ::-1])

    def at(self, x_m: Array) -> Array:
        """Return the functions (n, p) at points (p,), by Nyström's interpolation."""
        scaled = _correlation(self.points_m, x_m, self.length_m).T @ self.vectors / _POINTS
        safe = np.maximum(self.variance, 1e-12)
        return np.asarray((scaled * np.sqrt(_POINTS / safe)).T)


def _correlation(one_m: Array, other_m: Array, length_m: float) -> Array:
    return np.asarray(np.exp(-((np.subtract.outer(one_m, other_m) / length_m) ** 2)))
