"""Mapped high-order hexahedra for half a reed (y ≥ 0).

The mesh is one structured block. Its lines follow the tip's arc, the line where vamp meets heel
and the edges of the clamping strip, so every discontinuity lies on element faces.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial.legendre import Legendre
from numpy.typing import NDArray

from physics.reed.geometry import (
    SIDE_START_M,
    TIP_CORNER_M,
    ReedGeometry,
    half_width_m,
    kink_x_m,
    thickness_m,
    tip_x_m,
)

Array = NDArray[np.floating[Any]]
IntArray = NDArray[np.intp]

# Where the tip patch, which turns from the arc to the sides, ends.
_TIP_PATCH_END_M = 7.0e-3


@dataclass(frozen=True)
class MeshLevel:
    """How finely the reed is divided.

    Attributes
    ----------
    orders : (int, int, int)
        Polynomial degree along x, y and z.
    vamp_elements : int
        Elements along x between the tip patch and the heel.
    clamp_breaks : tuple of float
        Distances (m) from the front edge of the strip at which element faces are added; they
        grade the mesh towards that edge, where stress is singular.
    strip_elements : int
        Elements along x under the strip, behind the graded ones.
    z_breaks : tuple of float
        Element faces through the thickness, from 0 (flat side) to 1 (bark side).
    """

    orders: tuple[int, int, int] = (3, 3, 2)
    vamp_elements: int = 4
    clamp_breaks: tuple[float, ...] = (-0.8e-3, 0.0, 1.0e-3)
    strip_elements: int = 2
    z_breaks: tuple[float, ...] = (0.0, 0.8, 1.0)


@dataclass(frozen=True)
class HalfReedMesh:
    """Nodes and elements of the half reed.

    Attributes
    ----------
    nodes_m : (n, 3) float
        Coordinates; node (i, j, k) of the structured block has index ``(i·ny + j)·nz + k``.
    block : (int, int, int)
        Nodes along x, y and z.
    elements : (e, m) int
        Node numbers of each element, in tensor order.
    orders : (int, int, int)
    clamped, midplane : (n,) bool
        Nodes under the strip; nodes on y = 0.
    """

    nodes_m: Array
    block: tuple[int, int, int]
    elements: IntArray
    orders: tuple[int, int, int]
    clamped: NDArray[np.bool_]
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


def _tip_patch(y_breaks_m: Array, order_x: int, order_y: int) -> tuple[Array, Array]:
    """Plan coordinates (ni, nj) of the patch between the tip's arc and `_TIP_PATCH_END_M`.

    A transfinite (Coons) map: the arc on the left, the axis below, the side above and a straight
    line on the right.
    """
    (corner_x, corner_y), end = TIP_CORNER_M, _TIP_PATCH_END_M
    end_y = float(half_width_m(np.array(end)))
    side_break = (SIDE_START_M - corner_x) / (end - corner_x)
    xi = _fill(np.array([0.0, side_break, 1.0]), order_x)[:, None]
    eta_breaks = np.append(y_breaks_m, end_y) / end_y
    eta = _fill(eta_breaks, order_y)[None, :]
    left_y = np.interp(eta, eta_breaks, np.append(y_breaks_m, corner_y))
    right_y = eta * end_y
    top_x = corner_x + xi * (end - corner_x)
    top_y = half_width_m(top_x)
    # Coons: ruled along xi, plus ruled along eta, less the bilinear map of the four corners.
    x = (1 - xi) * tip_x_m(left_y) + xi * end + (1 - eta) * xi * end + eta * top_x
    x -= (1 - eta) * xi * end + eta * ((1 - xi) * corner_x + xi * end)
    y = (1 - xi) * left_y + xi * right_y + eta * top_y
    y -= eta * ((1 - xi) * corner_y + xi * end_y)
    return x, y


def _plan(geometry: ReedGeometry, level: MeshLevel) -> tuple[Array, Array]:
    """Plan coordinates (nx, ny) of all node columns."""
    px, py, _ = level.orders
    y_breaks = np.array([0.0, *geometry.clamp_y_m])
    tip_x, tip_y = _tip_patch(y_breaks, px, py)
    front, back = geometry.clamp_x_m
    kink = float(kink_x_m(geometry, np.zeros(1))[0])
    vamp = np.linspace(_TIP_PATCH_END_M, kink, level.vamp_elements + 1)
    graded = front + np.asarray(level.clamp_breaks)
    strip = np.linspace(graded[-1], back, level.strip_elements + 1)[1:]
    breaks = np.concatenate((vamp, graded, strip, [geometry.length_m]))
    x = _fill(breaks, px)[1:, None]
    width = half_width_m(x)
    eta_breaks = np.linspace(0, 1, len(y_breaks) + 1)
    eta = _fill(eta_breaks, py)
    lines = np.broadcast_to(y_breaks, (len(x), len(y_breaks)))
    y = np.stack(
        [np.interp(eta, eta_breaks, [*row, w]) for row, w in zip(lines, width[:, 0], strict=True)]
    )
    # The kink line is bent slightly: carry its neighbours with it, fading out to either side.
    bend = kink_x_m(geometry, y[np.argmin(np.abs(x[:, 0] - kink))]) - kink
    fade = np.interp(x[:, 0], [vamp[-2], kink, graded[0]], [0.0, 1.0, 0.0])
    x = x + fade[:, None] * bend
    return np.concatenate((tip_x, x)), np.concatenate((tip_y, y))


def build_mesh(geometry: ReedGeometry, level: MeshLevel) -> HalfReedMesh:
    """Mesh half of the reed.

    Raises
    ------
    ValueError
        If the thickness is not positive everywhere inside the contour.
    """
    x, y = _plan(geometry, level)
    thickness = thickness_m(geometry, x, y)
    if thickness.min() <= 0:
        at = np.unravel_index(thickness.argmin(), thickness.shape)
        raise ValueError(
            f"the reed is {1e6 * thickness.min():.1f} µm thick at x = {1e3 * x[at]:.2f} mm, "
            f"y = {1e3 * y[at]:.2f} mm; thickness must be positive"
        )
    zeta = _fill(np.asarray(level.z_breaks), level.orders[2])
    block = (*x.shape, len(zeta))
    nodes = np.stack(
        np.broadcast_arrays(x[..., None], y[..., None], thickness[..., None] * zeta), axis=-1
    ).reshape(-1, 3)
    tol = 1e-9
    (x0, x1), (y0, y1) = geometry.clamp_x_m, geometry.clamp_y_m
    strip = (x > x0 - tol) & (x < x1 + tol) & (y > y0 - tol) & (y < y1 + tol)
    clamped = (strip[..., None] & (zeta == 1.0)).ravel()
    midplane = np.broadcast_to((y < tol)[..., None], block).ravel()
    return HalfReedMesh(
        nodes, block, _elements(block, level.orders), level.orders, clamped, midplane
    )


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
