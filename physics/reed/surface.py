"""The bark side of the reed as the camera sees it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator, NearestNDInterpolator

from physics.reed.basis import ReducedReed
from physics.reed.fem import Symmetry
from physics.reed.geometry import Outline, half_width_m

Array = NDArray[np.floating[Any]]


def on_reed(outline: Outline, x_m: Array, y_m: Array) -> NDArray[np.bool_]:
    """Whether points (any shape) lie inside the reed's contour."""
    return (x_m > 0) & (np.abs(y_m) < half_width_m(outline, x_m))


def surface_shapes(reed: ReducedReed, x_m: Array, y_m: Array) -> dict[Symmetry, Array]:
    """Deflection along z of the bark side, per reduced coordinate.

    Parameters
    ----------
    reed : ReducedReed
    x_m, y_m : (n,) float
        Points inside the contour, on either side of the axis.

    Returns
    -------
    dict of (n, r) float32
    """
    points = np.stack([x_m, np.abs(y_m)], axis=-1)
    answer = {}
    for symmetry, half in reed.halves.items():
        shapes = CloughTocher2DInterpolator(reed.plan_m, half.surface_z)(points)
        # Points between the outermost chord of the mesh and the true contour.
        outside = np.isnan(shapes[:, 0])
        if outside.any():
            nearest = NearestNDInterpolator(reed.plan_m, half.surface_z)
            shapes[outside] = nearest(points[outside])
        if symmetry is Symmetry.ANTISYMMETRIC:
            shapes *= np.sign(y_m)[:, None]
        answer[symmetry] = shapes.astype(np.float32)
    return answer
