"""The bark side of the reed as the camera sees it."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator, NearestNDInterpolator

from holography.arrays import Array
from physics.reed.elements.fem import Symmetry
from physics.reed.elements.whole import WholeReed, parts_of
from physics.reed.geometry import Outline, half_width_m
from physics.reed.reduction.basis import ReducedReed


def on_reed(outline: Outline, x_m: Array, y_m: Array) -> NDArray[np.bool_]:
    """Whether points (any shape) lie inside the reed's contour."""
    return (x_m > 0) & (np.abs(y_m) < half_width_m(outline, x_m))


def surface_shapes(
    reed: ReducedReed | WholeReed, x_m: Array, y_m: Array
) -> dict[Symmetry | None, Array]:
    """Deflection along z of the bark side, per reduced coordinate.

    Parameters
    ----------
    reed : ReducedReed or WholeReed
    x_m, y_m : (n,) float
        Points inside the contour, on either side of the axis.

    Returns
    -------
    dict of (n, r) float32
        Per part of the reed (see `whole.parts_of`).
    """
    answer = {}
    for symmetry, part in parts_of(reed).items():
        points = np.stack([x_m, y_m if symmetry is None else np.abs(y_m)], axis=-1)
        shapes = CloughTocher2DInterpolator(reed.plan_m, part.surface_z)(points)
        # Points between the outermost chord of the mesh and the true contour.
        outside = np.isnan(shapes[:, 0])
        if outside.any():
            nearest = NearestNDInterpolator(reed.plan_m, part.surface_z)
            shapes[outside] = nearest(points[outside])
        if symmetry is Symmetry.ANTISYMMETRIC:
            shapes *= np.sign(y_m)[:, None]
        answer[symmetry] = shapes.astype(np.float32)
    return answer
