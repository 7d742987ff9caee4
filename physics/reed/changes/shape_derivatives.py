"""A reed laid open: its bark side, where layers may come and go, and its clamp, which may yield.

First-order changes of a boundary need only what happens there (Hadamard's formula): a layer of
thickness δh on the free bark side adds ``∫ δh ε·C·ε dA`` to the stiffness and ``ρ ∫ δh u·u dA`` to
the mass. Coordinates in which the strip moves, with the reed following at rest, are added to those
of the clamped reed; a clamp that yields holds them by springs.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from holography.arrays import Array
from physics.reed.cane.material import stiffness_terms_pa
from physics.reed.elements.fem import (
    Symmetry,
    factor,
    free_dofs,
    shape_1d,
    stiffness,
)
from physics.reed.elements.mesh import HalfReedMesh, MeshLevel
from physics.reed.geometry import Clamp, ReedGeometry
from physics.reed.reduction.basis import (
    BasisSettings,
    HalfShapes,
    ReducedReed,
    half_shapes,
    reduced,
)

# The strip's reactions fall over this distance behind its front edge.
_DECAY_M = 3e-3
# Powers of this decay in which the strip moves, per component, and of the distance from its middle
# line across.
_DECAYS = {"x": 3, "y": 3, "z": 4}
_ACROSS = {"x": 1, "y": 1, "z": 2}
_GAUSS = 8


@dataclass(frozen=True)
class ShapeDerivatives:
    """What tells how changes of a reed change its vibrations.

    Attributes
    ----------
    reed : ReducedReed
        Its first coordinates, `clamped` of either symmetry, leave the strip at rest; in the m
        others the strip moves.
    clamped : dict of int
        Per symmetry.
    bark_m : (q, 2) float
        Gauss points (x, y ≥ 0) of the bark side.
    area_m2 : (q,) float
        Of the plan that each stands for.
    strain : dict of (6, q, r) float
        Engineering strains there in Voigt order, per symmetry.
    motion : dict of (3, q, r) float
        Displacements there.
    strip_m2 : (m, m) float
        Integrals over the strip of y > 0 of products of what it does in its coordinates, the same
        for both symmetries.
    """

    reed: ReducedReed
    clamped: dict[Symmetry, int]
    bark_m: Array
    area_m2: Array
    strain: dict[Symmetry, Array]
    motion: dict[Symmetry, Array]
    strip_m2: Array

    @cached_property
    def stiffness_terms(self) -> Array:
        """Per unit of each independent stiffness (9, s, s), in coordinates of both symmetries."""
        each = [half.stiffness_terms for half in self.reed.halves.values()]
        return np.stack([linalg.block_diag(*terms) for terms in zip(*each, strict=True)])

    @cached_property
    def mass(self) -> Array:
        """Per unit density (s, s), in the same coordinates."""
        whole: Array = linalg.block_diag(*[half.mass for half in self.reed.halves.values()])
        return whole


def build_shape_derivatives(
    geometry: ReedGeometry, level: MeshLevel, settings: BasisSettings
) -> ShapeDerivatives:
    """Compute what changes of a reed need, by finite elements.

    Raises
    ------
    ImpossibleReedError
        As `basis.half_shapes`.
    """
    held = half_shapes(geometry, level, settings)
    shapes = {
        symmetry: np.concatenate([motion, _lifts(held, geometry.clamp, symmetry)], axis=2)
        for symmetry, motion in held.shapes.items()
    }
    loose = HalfShapes(held.mesh, held.matrices, held.middle, shapes)
    bark_m, area_m2, values, gradients, elements = _bark_side(held.mesh)
    return ShapeDerivatives(
        reed=reduced(geometry, settings, loose),
        clamped={symmetry: motion.shape[2] for symmetry, motion in held.shapes.items()},
        bark_m=bark_m,
        area_m2=area_m2,
        strain={s: _strain(gradients, motion[elements]) for s, motion in shapes.items()},
        motion={s: _motion(values, motion[elements]) for s, motion in shapes.items()},
        strip_m2=_strip_m2(geometry.clamp),
    )


def _strip_functions(clamp: Clamp, x_m: Array, y_m: Array) -> Array:
    """What the strip of y > 0 does in each of its m coordinates, at points (n,): (n, 3, m)."""
    (front, back), middle = clamp.x_m, np.mean(clamp.y_m)
    decay = np.exp(-(x_m - front) / _DECAY_M)
    tilt = (x_m - 0.5 * (front + back)) / (0.5 * (back - front))
    across = (y_m - middle) / (0.5 * (clamp.y_m[1] - clamp.y_m[0]))
    columns = []
    for number, axis in enumerate("xyz"):
        along = [np.ones_like(x_m), *(decay**power for power in range(1, _DECAYS[axis]))]
        if axis == "z":
            along.append(tilt)
        for function in along:
            for power in range(_ACROSS[axis]):
                column = np.zeros((len(x_m), 3))
                column[:, number] = function * across**power
                columns.append(column)
    return np.stack(columns, axis=2)


def _strip_m2(clamp: Clamp) -> Array:
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


def _lifts(held: HalfShapes, clamp: Clamp, symmetry: Symmetry) -> Array:
    """Shapes (n, 3, m) at rest of a reed whose strip is moved."""
    mesh = held.mesh
    x, y = mesh.nodes_m[mesh.clamped, :2].T
    functions = _strip_functions(clamp, x, y)
    lifts = np.zeros((len(mesh.nodes_m), 3, functions.shape[2]))
    lifts[mesh.clamped] = functions
    flat = lifts.reshape(-1, functions.shape[2])
    free = free_dofs(mesh, symmetry)
    K = stiffness(held.matrices, stiffness_terms_pa(held.middle))[free]
    flat[free] = -factor(K[:, free].tocsc())(K @ flat)
    return lifts


def _bark_side(mesh: HalfReedMesh) -> tuple[Array, Array, Array, Array, NDArray[np.intp]]:
    """Quadrature of the bark side.

    Returns
    -------
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
    return points_m, area.ravel(), values, gradients, elements


def _strain(gradients: Array, motion: Array) -> Array:
    """Engineering strains (6, e·g, r) of displacements (e, m, 3, r) of the elements' nodes."""
    slope = np.einsum("ieqm,emcr->iceqr", gradients, motion, optimize=True)
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
    return strain.reshape(6, -1, motion.shape[-1])


def _motion(values: Array, motion: Array) -> Array:
    """Displacements (3, e·g, r)."""
    moved: Array = np.einsum("qm,emcr->ceqr", values, motion, optimize=True)
    return moved.reshape(3, -1, motion.shape[-1])
