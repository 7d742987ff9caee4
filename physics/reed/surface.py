"""The bark side of the reed as the camera sees it."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator, NearestNDInterpolator

from holography.arrays import Array, Float32Array
from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import Outline, half_width_m
from physics.reed.reduced.reed import ReducedReed


def on_reed(outline: Outline, x_m: Array, y_m: Array) -> NDArray[np.bool_]:
    """Whether points (any shape) lie inside the reed's contour."""
    return (x_m > 0) & (np.abs(y_m) < half_width_m(outline, x_m))


def surface_shapes(
    reed: ReducedReed, x_m: Array, y_m: Array, *, loose: bool = False
) -> dict[Symmetry | None, Float32Array]:
    """Deflection along z of the bark side, per reduced coordinate.

    Parameters
    ----------
    reed : ReducedReed
    x_m, y_m : (n,) float
        Points inside the contour, on either side of the axis.
    loose : bool
        Whether coordinates in which the strips of the clamp move are wanted, too.

    Returns
    -------
    dict of (n, r) float32
        Per part of the reed.
    """
    answer = {}
    for symmetry, part in (reed.loose if loose else reed.parts).items():
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
