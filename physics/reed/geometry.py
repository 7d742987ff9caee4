"""Shape of a reed and of its clamp.

Axes as in the paper: x from the tip along the grain, y across, z through the thickness, origin at
the middle of the tip in the flat (bottom) plane. All lengths in m.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from scipy.interpolate import CubicSpline, RegularGridInterpolator
from scipy.optimize import brentq

from holography.arrays import Array
from physics.errors import ImpossibleReedError

# Paper, appendix "Defining the shape of the reed": network of points of the vamp, in mm.
_VAMP_X_MM = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0)
_VAMP_Z_MM = (
    (0.074, 0.343, 0.648, 1.047, 1.451, 1.926, 2.540, 3.351),
    (0.080, 0.293, 0.542, 0.847, 1.135, 1.527, 2.084, 2.817),
    (0.042, 0.197, 0.377, 0.571, 0.745, 1.078, 1.589, 2.256),
)
# Vamp and heel meet within this share of the end of the vamp's network of points.
_KINK_RANGE = (0.8, 1.2)


def _metres(values_mm: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(1e-3 * value for value in values_mm)


@dataclass(frozen=True)
class Outline:
    """The reed seen from above: arc of the tip, rounded corners, straight tapering sides.

    The defaults are the paper's (``contour(x)`` of its appendix).

    Attributes
    ----------
    tip_radius_m : float
        Of the arc of the tip, centred on the axis.
    corner_radius_m, corner_x_m : float
        Of the arc that touches the tip's from within, and the abscissa of its centre.
    side_half_width_m, side_taper : float
        A side is ``y = side_half_width_m − side_taper · x``.
    length_m : float
        Tip to butt.
    """

    tip_radius_m: float = 12.2e-3
    corner_radius_m: float = 2.5e-3
    corner_x_m: float = 3.4e-3
    side_half_width_m: float = 6.575e-3
    side_taper: float = 11 / 900
    length_m: float = 67.5e-3

    @property
    def corner_centre_m(self) -> tuple[float, float]:
        """Centre of the corner's arc."""
        reach = self.tip_radius_m - self.corner_radius_m
        return self.corner_x_m, float(
            np.sqrt(reach**2 - (self.tip_radius_m - self.corner_x_m) ** 2)
        )

    @property
    def tip_arc_end_m(self) -> float:
        """Abscissa at which the tip's arc runs into the corner's."""
        share = self.tip_radius_m / (self.tip_radius_m - self.corner_radius_m)
        return self.tip_radius_m - share * (self.tip_radius_m - self.corner_x_m)

    @property
    def side_start_m(self) -> float:
        """Abscissa at which the corner's arc runs into the side; NaN if they do not meet."""
        x, y = self.corner_centre_m
        slope = 1 + self.side_taper**2
        height = self.side_half_width_m - self.side_taper * x - y
        root = slope * self.corner_radius_m**2 - height**2
        if root < 0:
            return float("nan")
        return float(x + (self.side_taper * height - np.sqrt(root)) / slope)

    @property
    def turn_m(self) -> tuple[float, float]:
        """Point of the corner where the boundary has a slope of 45 degrees."""
        (x, y), step = self.corner_centre_m, self.corner_radius_m / np.sqrt(2)
        return float(x - step), float(y + step)


class ClampSide(StrEnum):
    """Which face of the reed the strips hold."""

    BARK = "bark"
    FLAT = "flat"
    BOTH = "both"


@dataclass(frozen=True)
class Clamp:
    """Two strips along the reed, mirror images in its median plane, on which nothing moves.

    The text gives "23 × 1 mm, spaced laterally by 5 mm, 38.2 mm from the tip".

    Attributes
    ----------
    x_m, y_m : (float, float)
        Extent of the strip at y > 0.
    side : ClampSide
    """

    x_m: tuple[float, float] = (38.2e-3, 61.2e-3)
    y_m: tuple[float, float] = (2.5e-3, 3.5e-3)
    side: ClampSide = ClampSide.BARK


@dataclass(frozen=True)
class ThicknessMap:
    """Measured deviations of the vamp's thickness, linear between the points and constant beyond.

    Attributes
    ----------
    x_m, y_m : tuple of float
        Abscissae (n,) and ordinates (m,), ascending; y of either sign.
    deviation_m : tuple of tuple of float
        Thickness less that of the drawing, (n, m).
    """

    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    deviation_m: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class ReedGeometry:
    """A reed with a straight grain, held by two strips.

    The defaults are the paper's reed (Vandoren V12). The vamp is given by cubic splines along x at
    three distances from the axis, joined by an even polynomial of degree 4 in y; beyond the line
    where it meets the heel, the heel (a cylinder section) takes over.

    Attributes
    ----------
    outline : Outline
    vamp_x_m, vamp_y_m, vamp_z_m : tuple
        Abscissae (n,), distances from the axis (3,) and thicknesses (3, n) of the vamp's network
        of points (paper, Table 8).
    heel_radius_m, heel_sagitta_m : float
        ``heel(y) = sqrt(heel_radius² − y²) − heel_sagitta``.
    clamp : Clamp
    thickness_offset_m : float
        Added everywhere to the vamp (the paper states ±10 µm).
    thickness_map : ThicknessMap, optional
        Added to the vamp point by point.
    """

    outline: Outline = field(default_factory=Outline)
    vamp_x_m: tuple[float, ...] = _metres(_VAMP_X_MM)
    vamp_y_m: tuple[float, float, float] = (0.0, 4e-3, 6e-3)
    vamp_z_m: tuple[tuple[float, ...], ...] = tuple(_metres(row) for row in _VAMP_Z_MM)
    heel_radius_m: float = 17.4e-3
    heel_sagitta_m: float = 14.1e-3
    clamp: Clamp = field(default_factory=Clamp)
    thickness_offset_m: float = 0.0
    thickness_map: ThicknessMap | None = None


def half_width_m(outline: Outline, x_m: Array) -> Array:
    """Half width of the reed at distance x from the tip (paper, ``contour(x)``)."""
    x = np.asarray(x_m, dtype=float)
    x0, y0 = outline.corner_centre_m
    tip = np.sqrt(np.clip((2 * outline.tip_radius_m - x) * x, 0.0, None))
    corner = y0 + np.sqrt(np.clip(outline.corner_radius_m**2 - (x - x0) ** 2, 0.0, None))
    side = outline.side_half_width_m - outline.side_taper * x
    return np.select([x < outline.tip_arc_end_m, x < outline.side_start_m], [tip, corner], side)


def tip_x_m(outline: Outline, y_m: Array) -> Array:
    """Abscissa of the tip's boundary at y, from the axis to `Outline.turn_m`."""
    y = np.asarray(y_m, dtype=float)
    x0, y0 = outline.corner_centre_m
    radius = outline.tip_radius_m
    arc = radius - np.sqrt(radius**2 - y**2)
    corner = x0 - np.sqrt(np.clip(outline.corner_radius_m**2 - (y - y0) ** 2, 0.0, None))
    return np.where(arc < outline.tip_arc_end_m, arc, corner)


def vamp_m(geometry: ReedGeometry, x_m: Array, y_m: Array) -> Array:
    """Thickness of the vamp at (x, y), splines continued beyond the last point."""
    return _vamp(geometry)(np.asarray(x_m, dtype=float), np.asarray(y_m, dtype=float))


def _vamp(geometry: ReedGeometry) -> Callable[[Array, Array], Array]:
    spline = CubicSpline(geometry.vamp_x_m, np.asarray(geometry.vamp_z_m).T)
    # Even in y: the polynomial of degree 2 in y² through three distances from the axis.
    powers = np.vander(np.square(geometry.vamp_y_m), increasing=True)
    coefficients = np.linalg.inv(powers)
    deviation = _deviation(geometry.thickness_map)

    def thickness(x: Array, y: Array) -> Array:
        across = np.stack([np.ones_like(y), y**2, y**4], axis=-1) @ coefficients
        drawn: Array = np.sum(spline(x) * across, axis=-1)
        return drawn + geometry.thickness_offset_m + deviation(x, y)

    return thickness


def _deviation(measured: ThicknessMap | None) -> Callable[[Array, Array], Array]:
    if measured is None:
        return lambda x, y: np.zeros(np.broadcast(x, y).shape)
    axes = np.asarray(measured.x_m), np.asarray(measured.y_m)
    linear = RegularGridInterpolator(axes, np.asarray(measured.deviation_m))

    def deviation(x: Array, y: Array) -> Array:
        # Beyond the outermost points nothing is known: constant, never extrapolated.
        inside = [np.clip(v, axis[0], axis[-1]) for v, axis in zip((x, y), axes, strict=True)]
        points = np.stack(np.broadcast_arrays(*inside), axis=-1)
        return np.asarray(linear(points)).reshape(points.shape[:-1])

    return deviation


def heel_m(geometry: ReedGeometry, y_m: Array) -> Array:
    """Thickness of the heel at y."""
    height: Array = np.sqrt(geometry.heel_radius_m**2 - np.asarray(y_m) ** 2)
    return height - geometry.heel_sagitta_m


def kink_x_m(geometry: ReedGeometry, y_m: Array) -> Array:
    """Abscissa where the vamp meets the heel, for each y (n,).

    Raises
    ------
    ImpossibleReedError
        If they do not meet near the end of the vamp's network of points.
    """
    vamp = _vamp(geometry)

    def difference(x: float, y: float) -> float:
        return float(vamp(np.array(x), np.array(y)) - heel_m(geometry, np.array(y)))

    low, high = (share * geometry.vamp_x_m[-1] for share in _KINK_RANGE)
    for y in np.ravel(y_m):
        if difference(low, float(y)) >= 0 or difference(high, float(y)) <= 0:
            raise ImpossibleReedError(
                f"vamp and heel do not meet between x = {1e3 * low:.1f} and {1e3 * high:.1f} mm; "
                "thickness offset, vamp and heel must belong to one reed"
            )
    return np.array([brentq(difference, low, high, args=(float(y),)) for y in np.ravel(y_m)])


def thickness_m(geometry: ReedGeometry, x_m: Array, y_m: Array) -> Array:
    """Thickness at points inside the contour: the lesser of vamp and heel."""
    return np.minimum(vamp_m(geometry, x_m, y_m), heel_m(geometry, y_m))


def is_even(geometry: ReedGeometry) -> bool:
    """Whether the reed is its own mirror image in the median plane."""
    measured = geometry.thickness_map
    if measured is None:
        return True
    y, deviation = np.asarray(measured.y_m), np.asarray(measured.deviation_m)
    return np.array_equal(y, -y[::-1]) and np.array_equal(deviation, deviation[:, ::-1])


def require_possible(geometry: ReedGeometry) -> None:
    """Refuse what no reed can be; thickness is for `mesh.build_mesh` to check.

    Raises
    ------
    ImpossibleReedError
        Names the first thing wrong, its value and what it must be.
    """
    outline, clamp = geometry.outline, geometry.clamp
    _require_outline(outline)
    _require_ascending("the abscissae of the vamp's network", geometry.vamp_x_m)
    _require_ascending("the distances of the vamp's network from the axis", geometry.vamp_y_m)
    shape = (len(geometry.vamp_y_m), len(geometry.vamp_x_m))
    if np.shape(geometry.vamp_z_m) != shape:
        raise ImpossibleReedError(
            f"the vamp's network has {shape[0]} rows of {shape[1]} thicknesses"
        )
    widest = float(half_width_m(outline, np.linspace(0, outline.length_m, 201)).max())
    if geometry.heel_radius_m <= widest:
        raise ImpossibleReedError(
            f"the heel's radius, {1e3 * geometry.heel_radius_m:g} mm, must exceed the reed's half "
            f"width of {1e3 * widest:.2f} mm"
        )
    _require_ascending("the ends of the clamp along the reed", clamp.x_m)
    _require_ascending("the edges of the clamp across the reed", clamp.y_m)
    narrowest = float(half_width_m(outline, np.asarray(clamp.x_m)).min())
    if clamp.x_m[0] <= 0 or clamp.x_m[1] > outline.length_m:
        raise ImpossibleReedError(
            f"the clamp, from {1e3 * clamp.x_m[0]:g} to {1e3 * clamp.x_m[1]:g} mm, lies outside "
            f"the reed, which is {1e3 * outline.length_m:g} mm long"
        )
    if clamp.y_m[0] < 0 or clamp.y_m[1] > narrowest:
        raise ImpossibleReedError(
            f"the clamp, {1e3 * clamp.y_m[0]:g} to {1e3 * clamp.y_m[1]:g} mm from the axis, lies "
            f"outside the reed, whose half width there is {1e3 * narrowest:.2f} mm"
        )
    if geometry.thickness_map is not None:
        _require_map(geometry.thickness_map)


def _require_outline(outline: Outline) -> None:
    tip, corner, x = outline.tip_radius_m, outline.corner_radius_m, outline.corner_x_m
    if min(tip, corner, x, outline.side_half_width_m, outline.length_m) <= 0:
        raise ImpossibleReedError(
            f"all lengths of a reed's outline must be positive, got {outline}"
        )
    if not corner < x < tip:
        raise ImpossibleReedError(
            f"a corner of radius {1e3 * corner:g} mm centred {1e3 * x:g} mm from the tip does not "
            f"touch a tip of radius {1e3 * tip:g} mm from within; its centre must lie between"
        )
    if not np.isfinite(outline.side_start_m):
        raise ImpossibleReedError(
            f"the side, {1e3 * outline.side_half_width_m:g} mm from the axis at the tip, does not "
            f"meet the corner, which reaches {1e3 * (outline.corner_centre_m[1] + corner):.3f} mm"
        )


def _require_ascending(what: str, values: tuple[float, ...]) -> None:
    if not np.all(np.isfinite(values)) or not np.all(np.diff(values) > 0):
        shown = ", ".join(f"{1e3 * value:g}" for value in values)
        raise ImpossibleReedError(f"{what} must be finite and ascend, but are {shown} mm")


def _require_map(measured: ThicknessMap) -> None:
    _require_ascending("the abscissae of the thickness map", measured.x_m)
    _require_ascending("the ordinates of the thickness map", measured.y_m)
    shape = len(measured.x_m), len(measured.y_m)
    if np.shape(measured.deviation_m) != shape or min(shape) < 2:
        raise ImpossibleReedError(
            f"a thickness map has a row of deviations for each of its {shape[0]} abscissae, one "
            f"for each of its {shape[1]} ordinates, and at least two of either"
        )
