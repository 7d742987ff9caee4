"""The reed that the paper prints: outline and thickness, by functions of this package's own."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

Array = NDArray[np.floating[Any]]

LENGTH_M = 67.5e-3
CLAMP_X_M, CLAMP_Y_M = (38.2e-3, 61.2e-3), (2.5e-3, 3.5e-3)
VAMP_END_M = 35e-3
# Paper, Table 8: thickness in mm at 0, 4 and 6 mm from the axis, every 5 mm from the tip.
_KNOTS_MM = np.arange(0.0, 36.0, 5.0)
_AXIS_MM = (0.074, 0.343, 0.648, 1.047, 1.451, 1.926, 2.540, 3.351)
_INNER_MM = (0.080, 0.293, 0.542, 0.847, 1.135, 1.527, 2.084, 2.817)
_OUTER_MM = (0.042, 0.197, 0.377, 0.571, 0.745, 1.078, 1.589, 2.256)
_HEEL_RADIUS_MM, _HEEL_SAGITTA_MM = 17.4, 14.1


def side_m(x_m: Array) -> Array:
    """Half width of the straight sides, continued to the tip."""
    sides: Array = 1e-3 * 263 / 40 - x_m * 11 / 900
    return sides


def half_width_m(x_m: Array) -> Array:
    """Half width of the reed (paper, ``contour(x)``)."""
    x = np.maximum(1e3 * np.asarray(x_m, dtype=float), 0.0)
    arc = np.sqrt(np.clip((24.4 - x) * x, 0, None))
    corner = 4.08044 + np.sqrt(np.clip(-5.31 + 6.8 * x - x**2, 0, None))
    rounded = np.where(x < 1.13196, arc, corner)
    return np.where(x < 2.94661, 1e-3 * rounded, side_m(1e-3 * x))


def tip_m(y_m: Array) -> Array:
    """Abscissa at which the reed begins at a distance y from the axis."""
    x = np.linspace(0.0, 2.94661e-3, 4000)
    return np.interp(np.abs(y_m), half_width_m(x), x)


def thickness_m(x_m: Array, y_m: Array) -> Array:
    """Thickness of the drawing: monotone cubics along the reed, an even polynomial across."""
    x, y2 = 1e3 * np.asarray(x_m), (1e3 * np.asarray(y_m)) ** 2
    along = [
        PchipInterpolator(_KNOTS_MM, row, extrapolate=True)(x)
        for row in (_AXIS_MM, _INNER_MM, _OUTER_MM)
    ]
    powers = np.linalg.inv(np.vander(np.square([0.0, 4.0, 6.0]), increasing=True))
    a, b, c = np.tensordot(powers, np.stack(along), axes=1)
    vamp = a + b * y2 + c * y2**2
    heel = np.sqrt(_HEEL_RADIUS_MM**2 - y2) - _HEEL_SAGITTA_MM
    return np.asarray(1e-3 * np.where(x > 1e3 * VAMP_END_M + 1, heel, np.minimum(vamp, heel)))
