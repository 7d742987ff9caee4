"""Shape of the reed: outline, thickness, and a structured plan mesh that follows its lines.

Lengths are in mm here and in `elements`, as in the paper's appendix on the shape; x runs from the
tip along the grain, y across, z from the flat side to the bark.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RectBivariateSpline
from scipy.optimize import brentq

from studies.second_laboratory.parameters import Clamp, Thickness

Array = NDArray[np.float64]

# Table 8 of the paper, mm.
_STATIONS = np.arange(0.0, 36.0, 5.0)
_TABLE_8 = np.array(
    [
        [0.074, 0.343, 0.648, 1.047, 1.451, 1.926, 2.540, 3.351],
        [0.080, 0.293, 0.542, 0.847, 1.135, 1.527, 2.084, 2.817],
        [0.042, 0.197, 0.377, 0.571, 0.745, 1.078, 1.589, 2.256],
    ]
)
LENGTH = 67.5
"""Contour of the paper: x < 67.5 mm."""
# The strips of the ligature: 23 mm × 1 mm, 38.2 mm from the tip, 5 mm apart (paper, 3.3.1); that
# 5 mm is the gap between them and that they are on the bark side fits Table 3 best (READING.md).
STRIP_FRONT, STRIP_BACK, STRIP_INNER, STRIP_OUTER = 38.2, 61.2, 2.5, 3.5
# Where the arc of the tip meets the arcs of the corners, and these the sides (paper).
_ARC_END, _CORNER_END = 1.13196, 2.94661
# The mesh of the rounded tip ends here; any line behind the corners serves.
_TIP_ZONE = 4.2
# A map of thickness fades out where the heel begins; the drawing's accuracy is stated for the vamp.
_MAP_FADE = (31.0, 34.0)
# Vamp and heel of the drawing meet at 34.72 mm on the axis and 34.77 mm at the side.
_KINK = 34.74
# Rows of the mesh are evenly spaced before, and follow the strips behind these x.
_ROWS_EVEN, _ROWS_STRIPS = 24.0, 34.0


def half_width(x: Array | float) -> Array:
    """Return the contour of the paper, without its rounded tip, in mm."""
    return np.asarray(263 / 40 - 11 / 900 * np.asarray(x, float))


def contour(x: Array | float) -> Array:
    """Return the half width of the reed at x, in mm."""
    x = np.clip(np.asarray(x, float), 0.0, LENGTH)
    arc = np.sqrt(np.maximum((24.4 - x) * x, 0.0))
    corner = 4.08044 + np.sqrt(np.maximum(-5.31 + 6.8 * x - x**2, 0.0))
    return np.where(x < _ARC_END, arc, np.where(x < _CORNER_END, corner, half_width(x)))


class Thicknesses:
    """Thickness of one reed and its slopes: vamp polynomial, heel, and its own deviations."""

    def __init__(self, deviations: Thickness) -> None:
        self._vamp = CubicSpline(_STATIONS, _TABLE_8, axis=1)
        self._deviations = deviations
        self._map = None
        if deviations.map_um is not None:
            table = np.array(deviations.map_um) * 1e-3
            rows = np.linspace(0.0, 36.0, table.shape[0])
            columns = np.linspace(-7.0, 7.0, table.shape[1])
            self._map = RectBivariateSpline(rows, columns, table)

    def vamp(self, x: Array, y: Array, dx: int = 0, dy: int = 0) -> Array:
        """Return the vamp or its first derivative in mm, as the paper's biquadratic polynomial."""
        s0, s1, s2 = self._vamp(x, dx)
        p1 = (-65 * s0 + 81 * s1 - 16 * s2) / 720
        p2 = (5 * s0 - 9 * s1 + 4 * s2) / 2880
        if dy:
            return np.asarray(2 * p1 * y + 4 * p2 * y**3)
        plain = dx == 0
        return np.asarray(s0 + p1 * y**2 + p2 * y**4 + plain * self._deviations.offset_um * 1e-3)

    def kink(self, y: float) -> float:
        """Return x where vamp and heel meet, in mm."""
        heel = -14.1 + np.sqrt(17.4**2 - y**2)
        return float(brentq(lambda x: float(self.vamp(np.array(x), np.array(y))) - heel, 30, 38))

    def __call__(self, x: Array, y: Array, vamp: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Return thickness and its slopes along x and y, given which points lie on the vamp."""
        root = np.sqrt(17.4**2 - y**2)
        thickness = np.where(vamp, self.vamp(x, y), -14.1 + root)
        slope_x = np.where(vamp, self.vamp(x, y, dx=1), 0.0)
        slope_y = np.where(vamp, self.vamp(x, y, dy=1), -y / root)
        if self._map is None and self._deviations.slope_um_per_mm == 0.0:
            return thickness, slope_x, slope_y
        start, end = _MAP_FADE
        part = np.clip((end - x) / (end - start), 0.0, 1.0)
        fade, slope = part**2 * (3 - 2 * part), -6 * part * (1 - part) / (end - start)
        tilt = self._deviations.slope_um_per_mm * 1e-3
        value, by_x, by_y = tilt * y, np.zeros_like(x), np.full_like(x, tilt)
        if self._map is not None:
            value = value + self._map.ev(x, y)
            by_x, by_y = self._map.ev(x, y, dx=1), by_y + self._map.ev(x, y, dy=1)
        # Chosen: nowhere thinner than half the drawing, so that the thinnest corner stays a solid.
        limited = -0.5 * thickness < fade * value
        value, by_x, by_y = (np.where(limited, each, 0.0) for each in (value, by_x, by_y))
        return (
            thickness + fade * value,
            slope_x + fade * by_x + slope * value,
            slope_y + fade * by_y,
        )


@dataclass(frozen=True)
class PlanMesh:
    """A structured mesh of the reed seen from above, each quadrilateral cut into two triangles.

    Attributes
    ----------
    nodes : (2 nx + 1, 2 ny + 1, 2) float64
        Vertices, middles of edges and centres, in mm: triangles are curved quadratically.
    on_vamp, on_strip, layered : (nx, ny) bool
        Whether a quadrilateral lies before the kink, under a strip, and near the clamp.
    rising : (nx, ny) bool
        Whether its diagonal goes from its first to its last vertex. The two quadrilaterals at the
        tip's corners are cut through the corner, where their sides have one tangent.
    """

    nodes: Array
    on_vamp: NDArray[np.bool_]
    on_strip: NDArray[np.bool_]
    layered: NDArray[np.bool_]
    rising: NDArray[np.bool_]


@dataclass(frozen=True)
class Fineness:
    """Sizes of the mesh in mm, and orders of the elements.

    `python -m studies.second_laboratory.convergence` compares the defaults with finer meshes.
    """

    vamp_mm: float = 3.0
    tip_mm: float = 1.1
    edge_mm: float = 0.1
    ratio: float = 3.5
    half_rows: int = 3
    order: int = 3
    layers: tuple[float, ...] = (0.0, 0.75, 0.95, 1.0)
    layer_order: int = 2
    vamp_order: int = 3


def _between(
    start: float, end: float, first: float, last: float, ratio: float, most: float
) -> Array:
    """Return points from start to end, graded from `first` at the start to `last` at the end."""
    left, right = [first], [last]
    while sum(left) + sum(right) < end - start:
        side = left if left[-1] <= right[-1] else right
        side.append(min(side[-1] * ratio, most))
    sizes = np.array([*left, *right[::-1]])
    return np.asarray(
        start + (end - start) * np.concatenate([[0.0], np.cumsum(sizes)]) / sizes.sum()
    )


def _columns(fineness: Fineness) -> tuple[Array, Array]:
    """Return the lines along the reed behind the tip zone, and those inside it as 0 … 1."""
    edge, vamp, ratio = fineness.edge_mm, fineness.vamp_mm, fineness.ratio
    parts = [
        np.linspace(_TIP_ZONE, _KINK, round((_KINK - _TIP_ZONE) / vamp) + 1),
        _between(_KINK, STRIP_FRONT, vamp, edge, ratio, vamp),
        _between(STRIP_FRONT, STRIP_BACK, edge, 2 * edge, ratio, 2 * vamp),
        _between(STRIP_BACK, LENGTH, 4 * edge, 2 * vamp, ratio, 2 * vamp),
    ]
    lines = np.unique(np.round(np.concatenate(parts), 9))
    tip = _between(0.0, _TIP_ZONE, fineness.tip_mm / 2, fineness.tip_mm, 1.5, fineness.tip_mm)
    return np.asarray(lines, float), np.asarray(tip / _TIP_ZONE)


def _rows(fineness: Fineness) -> tuple[Array, Array]:
    """Return the lines across: in mm at the strips, the last for the side, and as fractions."""
    edge, ratio = fineness.edge_mm, fineness.ratio
    parts = [
        _between(
            0.0, STRIP_INNER, STRIP_INNER, edge, ratio, STRIP_INNER / (fineness.half_rows - 1)
        ),
        _between(STRIP_INNER, STRIP_OUTER, edge, edge, ratio, 1.0),
        _between(STRIP_OUTER, float(half_width(STRIP_FRONT)), edge, 2.0, ratio, 2.0),
    ]
    half = np.unique(np.round(np.concatenate(parts), 9))
    lines = np.concatenate([-half[:0:-1], half])
    return lines, np.linspace(-1.0, 1.0, len(lines))


def plan_mesh(thickness: Thicknesses, clamp: Clamp, fineness: Fineness) -> PlanMesh:
    """Build the mesh of a reed under its clamp."""
    columns, tip = _columns(fineness)
    rows, even = _rows(fineness)
    xs, parts = _doubled(columns), _doubled(tip)
    ys, fractions = _doubled(rows), _doubled(even)
    kinks = np.array([thickness.kink(y) for y in ys])
    body = np.empty((len(xs), len(ys), 2))
    for i, x in enumerate(xs):
        part = np.clip((x - _ROWS_EVEN) / (_ROWS_STRIPS - _ROWS_EVEN), 0.0, 1.0)
        strips = part * part * (3 - 2 * part)
        width = float(half_width(x))
        # At the strips the lines keep their y up to the strips, and spread to the side from there.
        inside = np.minimum(np.abs(ys), STRIP_OUTER)
        outside = (np.abs(ys) - inside) / (rows[-1] - STRIP_OUTER) * (width - STRIP_OUTER)
        at_strips = np.sign(ys) * (inside + outside)
        body[i, :, 1] = (1 - strips) * width * fractions + strips * at_strips
        # Lines lean so that one follows the kink, and one the front edge of the strips.
        to_kink = np.clip(1 - abs(x - _KINK) / (STRIP_FRONT - _KINK), 0.0, 1.0)
        to_front = np.interp(x, [_KINK, STRIP_FRONT, STRIP_BACK], [0.0, 1.0, 0.0])
        shift = clamp.front_mm + clamp.tilt_mm_per_mm * body[i, :, 1]
        body[i, :, 0] = x + to_kink * (kinks - _KINK) + to_front * shift
    nodes = np.concatenate([_tip_zone(parts, fractions, body[0])[:-1], body])
    line_i = np.concatenate([np.zeros(len(tip) - 1), columns])
    before_kink = line_i[1:] < _KINK + 1e-6
    strip_rows = (np.abs(ys[1::2]) > STRIP_INNER) & (np.abs(ys[1::2]) < STRIP_OUTER)
    strip_columns = (line_i[:-1] > STRIP_FRONT - 1e-6) & (line_i[1:] < STRIP_BACK + 1e-6)
    rising = np.ones((len(line_i) - 1, len(rows) - 1), bool)
    rising[:, : rising.shape[1] // 2] = False
    rising[0, 0], rising[0, -1] = True, False
    return PlanMesh(
        nodes=nodes,
        on_vamp=np.broadcast_to(before_kink[:, None], rising.shape),
        on_strip=strip_columns[:, None] & strip_rows,
        layered=np.broadcast_to(~before_kink[:, None], rising.shape),
        rising=rising,
    )


def _doubled(lines: Array) -> Array:
    """Return lines with one more in the middle between any two."""
    return np.interp(np.arange(2 * len(lines) - 1) / 2, np.arange(len(lines)), lines)


def _tip_zone(parts: Array, fractions: Array, end: Array) -> Array:
    """Return the nodes between tip and a straight line, by transfinite interpolation."""
    # Lengths along the outline from the middle of the tip; the zone's corners are the middles of
    # the rounded corners.
    x = np.concatenate([np.linspace(0, 1, 4000) ** 2 * _CORNER_END, [end[0, 0]]])
    outline = np.column_stack([x, contour(x)])
    length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(outline, axis=0).T))])
    corner = np.interp(0.5 * (_ARC_END + _CORNER_END), x, length)

    def along(at: Array) -> Array:
        return np.column_stack([np.interp(at, length, outline[:, k]) for k in (0, 1)])

    tip = along(corner * np.abs(fractions)) * np.column_stack(
        [np.ones_like(fractions), np.sign(fractions)]
    )
    side = along(corner + (length[-1] - corner) * parts)
    s, t = parts[:, None, None], fractions[None, :, None]
    linear = (1 - s) * tip[None] + s * end[None]
    right = side - linear[:, -1]
    left = side * [1, -1] - linear[:, 0]
    return np.asarray(linear + 0.5 * (1 + t) * right[:, None] + 0.5 * (1 - t) * left[:, None])
