"""Shape of a clarinet reed and of its clamp.

Axes as in the paper: x from the tip along the grain, y across, z through the thickness, origin at
the middle of the tip in the flat (bottom) plane. All lengths in m.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

Array = NDArray[np.floating[Any]]

# Paper, appendix "Defining the shape of the reed": network of points of the vamp, in mm.
_VAMP_X_MM = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0)
_VAMP_Z_MM = (
    (0.074, 0.343, 0.648, 1.047, 1.451, 1.926, 2.540, 3.351),
    (0.080, 0.293, 0.542, 0.847, 1.135, 1.527, 2.084, 2.817),
    (0.042, 0.197, 0.377, 0.571, 0.745, 1.078, 1.589, 2.256),
)


def _metres(values_mm: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(1e-3 * value for value in values_mm)


@dataclass(frozen=True)
class ReedGeometry:
    """A clarinet reed held by two one-sided strips on its bark (upper) side.

    The defaults are the paper's reed (Vandoren V12). The vamp is given by three cubic splines
    along x at y = 0, 4 and 6 mm, joined by an even polynomial of degree 4 in y; beyond the line
    where it meets the heel, the heel (a cylinder section) takes over.

    Attributes
    ----------
    vamp_x_m, vamp_z_m : tuple
        Abscissae (n,) and thicknesses (3, n) of the vamp network (paper, Table 8).
    heel_radius_m, heel_sagitta_m : float
        ``heel(y) = sqrt(heel_radius² − y²) − heel_sagitta``.
    length_m : float
        Length of the reed, tip to butt.
    clamp_x_m, clamp_y_m : (float, float)
        Extent of one clamping strip; its mirror image at −y is clamped too. The text gives
        "23 × 1 mm, spaced laterally by 5 mm, 38.2 mm from the tip".
    thickness_offset_m : float
        Added everywhere to the vamp (the paper states ±10 µm).
    """

    vamp_x_m: tuple[float, ...] = _metres(_VAMP_X_MM)
    vamp_z_m: tuple[tuple[float, ...], ...] = tuple(_metres(row) for row in _VAMP_Z_MM)
    heel_radius_m: float = 17.4e-3
    heel_sagitta_m: float = 14.1e-3
    length_m: float = 67.5e-3
    clamp_x_m: tuple[float, float] = (38.2e-3, 61.2e-3)
    clamp_y_m: tuple[float, float] = (2.5e-3, 3.5e-3)
    thickness_offset_m: float = 0.0


# Contour of the paper's appendix: tip arc, corner arc, straight side (mm).
_TIP_ARC_END_MM = 1.13196
_CORNER_END_MM = 2.94661
_CORNER_CENTRE_MM = (3.4, 4.08044)
_CORNER_RADIUS_MM = 2.5
# Where the boundary of the corner has a slope of 45 degrees: the mesh turns from tip to side.
TIP_CORNER_M = (
    1e-3 * (_CORNER_CENTRE_MM[0] - _CORNER_RADIUS_MM / np.sqrt(2)),
    1e-3 * (_CORNER_CENTRE_MM[1] + _CORNER_RADIUS_MM / np.sqrt(2)),
)
SIDE_START_M = 1e-3 * _CORNER_END_MM


def half_width_m(x_m: Array) -> Array:
    """Half width of the reed at distance x from the tip (paper, ``contour(x)``)."""
    x = np.asarray(x_m, dtype=float) * 1e3
    x0, y0 = _CORNER_CENTRE_MM
    tip = np.sqrt(np.clip((24.4 - x) * x, 0.0, None))
    corner = y0 + np.sqrt(np.clip(_CORNER_RADIUS_MM**2 - (x - x0) ** 2, 0.0, None))
    side = 263 / 40 - 11 / 900 * x
    return 1e-3 * np.select([x < _TIP_ARC_END_MM, x < _CORNER_END_MM], [tip, corner], side)


def tip_x_m(y_m: Array) -> Array:
    """Abscissa of the tip's boundary at y, from the axis to the 45-degree corner point."""
    y = np.asarray(y_m, dtype=float) * 1e3
    x0, y0 = _CORNER_CENTRE_MM
    arc = 12.2 - np.sqrt(12.2**2 - y**2)
    corner = x0 - np.sqrt(np.clip(_CORNER_RADIUS_MM**2 - (y - y0) ** 2, 0.0, None))
    return 1e-3 * np.where(arc < _TIP_ARC_END_MM, arc, corner)


def vamp_m(geometry: ReedGeometry, x_m: Array, y_m: Array) -> Array:
    """Thickness of the vamp at (x, y), splines continued beyond the last point."""
    spline = CubicSpline(geometry.vamp_x_m, np.asarray(geometry.vamp_z_m).T)
    s0, s1, s2 = np.moveaxis(spline(x_m), -1, 0)
    y2 = (np.asarray(y_m) * 1e3) ** 2
    p1 = (-65 * s0 + 81 * s1 - 16 * s2) / 720
    p2 = (5 * s0 - 9 * s1 + 4 * s2) / 2880
    thickness: Array = s0 + p1 * y2 + p2 * y2**2 + geometry.thickness_offset_m
    return thickness


def heel_m(geometry: ReedGeometry, y_m: Array) -> Array:
    """Thickness of the heel at y."""
    height: Array = np.sqrt(geometry.heel_radius_m**2 - np.asarray(y_m) ** 2)
    return height - geometry.heel_sagitta_m


def kink_x_m(geometry: ReedGeometry, y_m: Array) -> Array:
    """Abscissa where the vamp meets the heel, for each y (n,).

    Raises
    ------
    ValueError
        If they do not meet near the end of the vamp's network of points.
    """

    def difference(x: float, y: float) -> float:
        at = np.array(x), np.array(y)
        return float(vamp_m(geometry, *at) - heel_m(geometry, at[1]))

    low, high = 0.8 * geometry.vamp_x_m[-1], 1.2 * geometry.vamp_x_m[-1]
    for y in np.ravel(y_m):
        if difference(low, float(y)) >= 0 or difference(high, float(y)) <= 0:
            raise ValueError(
                f"vamp and heel do not meet between x = {1e3 * low:.1f} and {1e3 * high:.1f} mm; "
                "thickness offset, vamp and heel must belong to one reed"
            )
    return np.array([brentq(difference, low, high, args=(float(y),)) for y in np.ravel(y_m)])


def thickness_m(geometry: ReedGeometry, x_m: Array, y_m: Array) -> Array:
    """Thickness at points inside the contour: the lesser of vamp and heel."""
    return np.minimum(vamp_m(geometry, x_m, y_m), heel_m(geometry, y_m))
