"""The boundary of a reed where changes act: its bark side, and the strips that clamp it.

First-order changes of a boundary need only what happens there (Hadamard's formula): a layer of
thickness δh on the free bark side adds ``∫ δh ε·C·ε dA`` to the stiffness and ``ρ ∫ δh u·u dA`` to
the mass. Coordinates in which the strips move, with the reed following at rest, are added to those
of the clamped reed; a clamp that yields holds them by springs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array
from physics.reed.elements.fem import Symmetry, shape_1d
from physics.reed.elements.mesh import ReedMesh
from physics.reed.geometry import Clamp, ReedGeometry, half_width_m, kink_x_m, thickness_m

# The strip's reactions fall over this distance behind its front edge.
_DECAY_M = 3e-3
# Powers of this decay in which the strip moves, per component, and of the distance from its middle
# line across. Chosen: with one power across, and without turns of the strip in its plane, modes in
# which the reed moves sideways are up to 85 cents above those of finite elements on springs
# (decision 0096).
_DECAYS = {"x": 3, "y": 3, "z": 4}
_ACROSS = {"x": 2, "y": 2, "z": 3}
# Axis along which the strip moves in each of its coordinates: 0 along the reed, 1 across it, 2
# away from it.
STRIP_AXES = np.repeat(range(3), [(_DECAYS[axis] + 1) * _ACROSS[axis] for axis in "xyz"])
_GAUSS = 8


@dataclass(frozen=True)
class BarkSide:
    """Quadrature of the bark side, in e elements with g points each.

    Attributes
    ----------
    points_m : (e·g, 2) float
    area_m2 : (e·g,) float
        Of the plan.
    values : (g, m) float
        Shape functions.
    gradients : (3, e, g, m) float
        Their derivatives by x, y and z.
    elements : (e, m) int
        Those that have a face on this side.
    """

    points_m: Array
    area_m2: Array
    values: Array
    gradients: Array
    elements: NDArray[np.intp]


def bark_side(mesh: ReedMesh) -> BarkSide:
    """Quadrature of the bark side of a mesh."""
    px, py, pz = mesh.orders
    tables, weights = [], []
    for order in (px, py):
        points, weight = np.polynomial.legendre.leggauss(order + 1)
        tables.append(shape_1d(order, 0.5 * (1 + points)))
        weights.append(0.5 * weight)
    tables.append(shape_1d(pz, np.ones(1)))
    (x, dx), (y, dy), (z, dz) = tables
    values = np.kron(x, np.kron(y, z))
    reference = np.stack(
        [np.kron(dx, np.kron(y, z)), np.kron(x, np.kron(dy, z)), np.kron(x, np.kron(y, dz))]
    )
    elements = mesh.elements[mesh.elements[:, -1] % mesh.block[2] == mesh.block[2] - 1]
    nodes = mesh.nodes_m[elements]
    jacobian = np.einsum("iqm,emj->eqij", reference, nodes, optimize=True)
    gradients = np.einsum("eqij,jqm->ieqm", np.linalg.inv(jacobian), reference, optimize=True)
    area = np.linalg.det(jacobian[..., :2, :2]) * np.kron(*weights)
    points_m = np.einsum("qm,emj->eqj", values, nodes[..., :2]).reshape(-1, 2)
    return BarkSide(points_m, area.ravel(), values, gradients, elements)


def bark_fields(mesh: ReedMesh, shapes: Array) -> tuple[Array, Array]:
    """Engineering strains (6, b, s) and displacements (3, b, s) there of shapes (n, 3, s)."""
    bark = bark_side(mesh)
    at_nodes = shapes[bark.elements]
    slope = np.einsum("ieqm,emcr->iceqr", bark.gradients, at_nodes, optimize=True)
    strain = np.stack(
        [
            slope[0, 0],
            slope[1, 1],
            slope[2, 2],
            slope[1, 2] + slope[2, 1],
            slope[0, 2] + slope[2, 0],
            slope[0, 1] + slope[1, 0],
        ]
    )
    motion = np.einsum("qm,emcr->ceqr", bark.values, at_nodes, optimize=True)
    size = shapes.shape[2]
    return strain.reshape(6, -1, size), motion.reshape(3, -1, size)


def strip_displacements(clamp: Clamp, x_m: Array, y_m: Array, symmetry: Symmetry) -> Array:
    """Displacements (n, 3, m) of strips at points (n,) in the m coordinates of a symmetry."""
    functions = _strip_functions(clamp, x_m, np.abs(y_m))
    sign = 1.0 if symmetry is Symmetry.SYMMETRIC else -1.0
    mirrored = sign * np.array([1.0, -1.0, 1.0])[:, None] * functions
    return np.where((y_m < 0)[:, None, None], mirrored, functions)


def _strip_functions(clamp: Clamp, x_m: Array, y_m: Array) -> Array:
    (front, back), middle = clamp.x_m, np.mean(clamp.y_m)
    decay = np.exp(-(x_m - front) / _DECAY_M)
    tilt = (x_m - 0.5 * (front + back)) / (0.5 * (back - front))
    across = (y_m - middle) / (0.5 * (clamp.y_m[1] - clamp.y_m[0]))
    columns = []
    for number, axis in enumerate("xyz"):
        along = [np.ones_like(x_m), *(decay**power for power in range(1, _DECAYS[axis])), tilt]
        for function in along:
            for power in range(_ACROSS[axis]):
                column = np.zeros((len(x_m), 3))
                column[:, number] = function * across**power
                columns.append(column)
    return np.stack(columns, axis=2)


def strip_products_m2(clamp: Clamp) -> Array:
    """Integrals (m, m) over the strip of y > 0 of products of what it does in its coordinates."""
    points, weights = np.polynomial.legendre.leggauss(_GAUSS)
    # The decay is steep: pieces of its own length.
    edges = np.linspace(*clamp.x_m, 1 + round((clamp.x_m[1] - clamp.x_m[0]) / _DECAY_M))
    x = (0.5 * (edges[1:] + edges[:-1])[:, None] + 0.5 * np.diff(edges)[:, None] * points).ravel()
    y = np.mean(clamp.y_m) + 0.5 * np.diff(clamp.y_m) * points
    wx = (0.5 * np.diff(edges)[:, None] * weights).ravel()
    area = np.multiply.outer(wx, 0.5 * np.diff(clamp.y_m) * weights).ravel()
    functions = _strip_functions(clamp, np.repeat(x, _GAUSS), np.tile(y, len(x)))
    product: Array = np.einsum("n,nci,ncj->ij", area, functions, functions, optimize=True)
    return product


def moved_edge(geometry: ReedGeometry, mesh: ReedMesh, step_m: float, *, tilted: bool) -> Array:
    """Nodes (n, 3) that go along with the front edge of the strips when it moves back by a step.

    If tilted, the edge turns: a step back at the middle line of the strip of y > 0, a step forward
    at that of y < 0. Contour, kink and the back of the strips stay where they are, and nodes keep
    their share of the thickness, so that the reed itself is the same.
    """
    clamp, (x, y, _) = geometry.clamp, mesh.nodes_m.T
    (front, back), away = clamp.x_m, np.abs(y)
    kink = float(kink_x_m(geometry, np.array([clamp.y_m[1]]))[0])
    before = kink if kink < front else 0.5 * front
    along = np.interp(x, [before, front, 0.5 * (front + back)], [0.0, 1.0, 0.0])
    width = half_width_m(geometry.outline, x)
    outer = np.clip((width - away) / (width - clamp.y_m[1]), 0.0, 1.0)
    across = np.where(away <= clamp.y_m[1], 1.0, outer)
    if tilted:
        across = across * np.sign(y) * np.minimum(away, clamp.y_m[1]) / np.mean(clamp.y_m)
    moved = mesh.nodes_m.copy()
    moved[:, 0] += step_m * along * across
    moved[:, 2] *= thickness_m(geometry, moved[:, 0], y) / thickness_m(geometry, x, y)
    return moved
