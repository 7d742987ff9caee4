"""Mapped high-order hexahedra for half a reed (y ≥ 0), or for a whole one.

The mesh is one structured block. Its lines follow the tip's arc, the line where vamp meets heel
and the edges of the clamping strip, so every discontinuity lies on element faces. In the block of
a whole reed each node has a mirror image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.polynomial.legendre import Legendre
from numpy.typing import NDArray

from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.reed.geometry import (
    Clamp,
    ClampSide,
    Outline,
    ReedGeometry,
    half_width_m,
    is_even,
    kink_x_m,
    require_possible,
    thickness_m,
    tip_x_m,
)

IntArray = NDArray[np.intp]

# The patch that turns from the tip's arc to the sides reaches this far behind the corner.
_TIP_PATCH_M = 4.0e-3
# Element faces closer than this are taken for one.
_SAME_M = 1e-9
# Faces along x that must not meet keep this distance.
_LEAST_FACE_M = 0.5e-3


@dataclass(frozen=True)
class MeshLevel:
    """How finely the reed is divided.

    Stress is singular along the edges of the clamping strip; `edge_breaks_m` and `z_breaks` grade
    the mesh towards them.

    Attributes
    ----------
    orders : (int, int, int)
        Polynomial degree along x, y and z.
    vamp_element_m, heel_element_m : float
        Longest element along x in front of the strip and behind its front edge.
    edge_breaks_m : tuple of float
        Distances beyond each edge of the strip, along and across the reed, at which there are
        element faces; negative ones lie under the strip.
    z_breaks : tuple of float
        Element faces through the thickness, from 0 (free face) to 1 (clamped face).
    """

    orders: tuple[int, int, int] = (3, 3, 2)
    vamp_element_m: float = 7.0e-3
    heel_element_m: float = 11.5e-3
    edge_breaks_m: tuple[float, ...] = (0.3e-3,)
    z_breaks: tuple[float, ...] = (0.0, 0.8, 1.0)


# How far each level lies from the limit of ever finer meshes: `python -m studies.convergence`.
# Every mode below 20 kHz within 10 cents, those of the heel included.
FINE = MeshLevel(orders=(4, 4, 4), heel_element_m=4.5e-3, z_breaks=(0.0, 0.94, 1.0))
# Every mode of the vamp within 10 cents; a basis of it is built within seconds and 2 GiB.
STANDARD = MeshLevel(orders=(4, 4, 3), heel_element_m=8e-3, z_breaks=(0.0, 0.9, 1.0))
# Every mode of the vamp within 45 cents, in a fraction of a second.
FAST = MeshLevel(orders=(3, 3, 2), edge_breaks_m=())


@dataclass(frozen=True)
class ReedMesh:
    """Nodes and elements of a reed.

    Attributes
    ----------
    nodes_m : (n, 3) float
        Coordinates; node (i, j, k) of the structured block has index ``(i·ny + j)·nz + k``. The
        mirror image of node (i, j, k) of a whole reed is node (i, ny − 1 − j, k).
    block : (int, int, int)
        Nodes along x, y and z.
    elements : (e, m) int
        Node numbers of each element, in tensor order.
    orders : (int, int, int)
    clamped : (n,) bool
        Nodes under a strip.
    """

    nodes_m: Array
    block: tuple[int, int, int]
    elements: IntArray
    orders: tuple[int, int, int]
    clamped: NDArray[np.bool_]


@dataclass(frozen=True)
class HalfReedMesh(ReedMesh):
    """Nodes and elements of the half reed.

    Attributes
    ----------
    midplane : (n,) bool
        Nodes on y = 0.
    """

    midplane: NDArray[np.bool_]


def lobatto_points(order: int) -> Array:
    """Gauss-Lobatto points (order + 1,) on [0, 1]: the element's nodes along one axis."""
    inner = Legendre.basis(order).deriv().roots().real
    return 0.5 * (1 + np.concatenate(([-1.0], inner, [1.0])))


def _fill(breaks: Array, order: int) -> Array:
    """Node parameters along an axis: Lobatto points within each interval, ends shared."""
    inner = lobatto_points(order)[:-1]
    pieces = breaks[:-1, None] + np.diff(breaks)[:, None] * inner
    return np.append(pieces.ravel(), breaks[-1])


def _graded(
    strip: tuple[float, float], distances: Sequence[float], low: float, high: float
) -> Array:
    """Element faces between low and high: the strip's edges, and faces beyond each of them."""
    graded = [face for d in distances for face in (strip[0] - d, strip[1] + d)]
    faces = np.unique([low, high, *strip, *(face for face in graded if low < face < high)])
    distinct: Array = faces[np.append(True, np.diff(faces) > _SAME_M)]
    return distinct


def _subdivided(faces: Array, longest_m: float) -> Array:
    """Equal elements between faces, none longer than `longest_m`."""
    pieces = [
        np.linspace(a, b, max(1, int(np.ceil((b - a) / longest_m - 1e-6))) + 1)[:-1]
        for a, b in pairwise(faces)
    ]
    return np.append(np.concatenate(pieces), faces[-1])


def _tip_patch(
    outline: Outline, y_breaks_m: Array, end_m: float, order_x: int, order_y: int
) -> tuple[Array, Array]:
    """Plan coordinates (ni, nj) of the patch between the tip's arc and the line x = `end_m`.

    A transfinite (Coons) map: the arc on the left, the axis below, the side above and a straight
    line on the right.
    """
    corner_x, corner_y = outline.turn_m
    end_y = float(half_width_m(outline, np.array(end_m)))
    side_break = (outline.side_start_m - corner_x) / (end_m - corner_x)
    xi = _fill(np.array([0.0, side_break, 1.0]), order_x)[:, None]
    eta_breaks = y_breaks_m / y_breaks_m[-1]
    eta = _fill(eta_breaks, order_y)[None, :]
    left_y = eta * corner_y
    right_y = eta * end_y
    top_x = corner_x + xi * (end_m - corner_x)
    top_y = half_width_m(outline, top_x)
    # Coons: ruled along xi, plus ruled along eta, less the bilinear map of the four corners.
    x = (1 - xi) * tip_x_m(outline, left_y) + xi * end_m + (1 - eta) * xi * end_m + eta * top_x
    x -= (1 - eta) * xi * end_m + eta * ((1 - xi) * corner_x + xi * end_m)
    y = (1 - xi) * left_y + xi * right_y + eta * top_y
    y -= eta * ((1 - xi) * corner_y + xi * end_y)
    return x, y


def _plan(geometry: ReedGeometry, level: MeshLevel, side: Literal[1, -1]) -> tuple[Array, Array]:
    """Plan coordinates (nx, ny) of all node columns on the side of positive or negative y.

    Those of either side begin with the same columns on the axis.

    Raises
    ------
    ImpossibleReedError
        If the strip begins in the tip patch, or too close to the line where vamp meets heel, or if
        they meet outside the reed.
    """
    px, py, _ = level.orders
    outline, clamp = geometry.outline, geometry.clamp
    patch_end = outline.side_start_m + _TIP_PATCH_M
    breaks, kink = _lengthwise(geometry, level, patch_end)
    x = _fill(breaks, px)[1:, None]
    width = half_width_m(outline, x)
    inner = _graded(clamp.y_m, level.edge_breaks_m, 0.0, float(width.min()))[:-1]
    eta_breaks = np.linspace(0, 1, len(inner) + 1)
    eta = _fill(eta_breaks, py)
    y = np.stack([np.interp(eta, eta_breaks, [*inner, w]) for w in width[:, 0]])
    # The kink line is bent slightly: carry its neighbours with it, fading out to either side.
    bend = kink_x_m(geometry, side * y[np.argmin(np.abs(x[:, 0] - kink))]) - kink
    at = int(np.argmin(np.abs(breaks - kink)))
    x = x + np.interp(x, breaks[at - 1 : at + 2], [0.0, 1.0, 0.0]) * bend
    end_y = float(half_width_m(outline, np.array(patch_end)))
    tip_x, tip_y = _tip_patch(outline, np.append(inner, end_y), patch_end, px, py)
    return np.concatenate((tip_x, x)), side * np.concatenate((tip_y, y))


def _lengthwise(
    geometry: ReedGeometry, level: MeshLevel, patch_end_m: float
) -> tuple[Array, float]:
    """Element faces along x from the tip patch to the butt, and the one that follows the kink."""
    (front, back), end = geometry.clamp.x_m, geometry.outline.length_m
    kink = float(kink_x_m(geometry, np.zeros(1))[0])
    if front < patch_end_m + _LEAST_FACE_M:
        raise ImpossibleReedError(
            f"the clamp begins {1e3 * front:g} mm from the tip; it must leave the rounded tip, "
            f"{1e3 * (patch_end_m + _LEAST_FACE_M):.1f} mm, free"
        )
    if not patch_end_m + _LEAST_FACE_M < kink < end - _LEAST_FACE_M:
        raise ImpossibleReedError(
            f"vamp and heel meet {1e3 * kink:.2f} mm from the tip; they must meet between the "
            f"rounded tip, {1e3 * (patch_end_m + _LEAST_FACE_M):.1f} mm, and the butt, "
            f"{1e3 * end:g} mm"
        )
    if min(abs(front - kink), abs(back - kink)) < _LEAST_FACE_M:
        raise ImpossibleReedError(
            f"the clamp, {1e3 * front:g} to {1e3 * back:g} mm from the tip, begins or ends where "
            f"vamp meets heel, at {1e3 * kink:.2f} mm; move it by {1e3 * _LEAST_FACE_M:g} mm"
        )
    graded = _graded((front, back), level.edge_breaks_m, patch_end_m, end)
    # Near the kink, a face of its own that bends, others would turn elements inside out.
    faces = np.append(graded[np.abs(graded - kink) > _LEAST_FACE_M], kink)
    faces.sort()
    split = np.searchsorted(faces, front)
    before = _subdivided(faces[: split + 1], level.vamp_element_m)
    behind = _subdivided(faces[split:], level.heel_element_m)
    return np.append(before, behind[1:]), kink


def build_mesh(geometry: ReedGeometry, level: MeshLevel) -> HalfReedMesh:
    """Mesh half of the reed.

    Raises
    ------
    ImpossibleReedError
        For an impossible geometry (see `geometry.require_possible`), a thickness that is not
        positive everywhere inside the contour, or a reed that is not its own mirror image.
    """
    require_possible(geometry)
    if not is_even(geometry):
        raise ImpossibleReedError(
            "the thickness map is not even in y, and half a reed stands for both sides only if it "
            "is; mesh the whole reed, or give either side the mean of both"
        )
    x, y = _plan(geometry, level, 1)
    mesh = _over(geometry, level, x, y)
    midplane = np.broadcast_to((y < _SAME_M)[..., None], mesh.block).ravel()
    return HalfReedMesh(
        mesh.nodes_m, mesh.block, mesh.elements, mesh.orders, mesh.clamped, midplane
    )


def build_whole_mesh(geometry: ReedGeometry, level: MeshLevel) -> ReedMesh:
    """Mesh both halves of the reed as one, with as many elements on either side.

    Raises
    ------
    ImpossibleReedError
        As `build_mesh`, but for any thickness map.
    """
    require_possible(geometry)
    left, right = (_plan(geometry, level, side) for side in (-1, 1))
    # The columns on the axis belong to both sides.
    x, y = (np.hstack([one[:, :0:-1], other]) for one, other in zip(left, right, strict=True))
    return _over(geometry, level, x, y)


def build_least_mesh(geometry: ReedGeometry, level: MeshLevel) -> ReedMesh:
    """Mesh half of the reed if it is its own mirror image, the whole if not.

    Raises
    ------
    ImpossibleReedError
        As `build_whole_mesh`.
    """
    return build_mesh(geometry, level) if is_even(geometry) else build_whole_mesh(geometry, level)


def _over(geometry: ReedGeometry, level: MeshLevel, x: Array, y: Array) -> ReedMesh:
    """Mesh that stands on a plan (nx, ny).

    Raises
    ------
    ImpossibleReedError
        If the reed has no thickness somewhere.
    """
    thickness = thickness_m(geometry, x, y)
    if not thickness.min() > 0:
        at = np.unravel_index(thickness.argmin(), thickness.shape)
        raise ImpossibleReedError(
            f"the reed is {1e6 * thickness.min():.1f} µm thick at x = {1e3 * x[at]:.2f} mm, "
            f"y = {1e3 * y[at]:.2f} mm; thickness must be positive"
        )
    zeta = _faces_through(geometry.clamp.side, level)
    block = (*x.shape, len(zeta))
    nodes = np.stack(
        np.broadcast_arrays(x[..., None], y[..., None], thickness[..., None] * zeta), axis=-1
    ).reshape(-1, 3)
    clamped = _clamped(geometry.clamp, x, y, zeta)
    return ReedMesh(nodes, block, _elements(block, level.orders), level.orders, clamped)


def _faces_through(side: ClampSide, level: MeshLevel) -> Array:
    """Node parameters through the thickness, 0 at the flat side and 1 at the bark side."""
    breaks = np.asarray(level.z_breaks)
    if side is ClampSide.FLAT:
        breaks = 1 - breaks[::-1]
    elif side is ClampSide.BOTH:
        breaks = np.unique([*(0.5 * (1 - breaks)), *(0.5 * (1 + breaks))])
    return _fill(breaks, level.orders[2])


def _clamped(clamp: Clamp, x: Array, y: Array, zeta: Array) -> NDArray[np.bool_]:
    """Nodes held by a strip (n,)."""
    (x0, x1), (y0, y1) = clamp.x_m, clamp.y_m
    away = np.abs(y)
    strip = (x > x0 - _SAME_M) & (x < x1 + _SAME_M)
    strip &= (away > y0 - _SAME_M) & (away < y1 + _SAME_M)
    faces = {
        ClampSide.BARK: zeta == 1.0,
        ClampSide.FLAT: zeta == 0.0,
        ClampSide.BOTH: (zeta == 0.0) | (zeta == 1.0),
    }
    held: NDArray[np.bool_] = strip[..., None] & faces[clamp.side]
    return held.ravel()


def _elements(block: tuple[int, int, int], orders: tuple[int, int, int]) -> IntArray:
    """Node numbers (e, m) of every element of a structured block."""
    index = np.arange(np.prod(block)).reshape(block)
    starts = [range(0, n - 1, p) for n, p in zip(block, orders, strict=True)]
    px, py, pz = orders
    return np.array(
        [
            index[i : i + px + 1, j : j + py + 1, k : k + pz + 1].ravel()
            for i in starts[0]
            for j in starts[1]
            for k in starts[2]
        ]
    )
