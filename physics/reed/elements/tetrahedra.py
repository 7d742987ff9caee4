"""Quadratic tetrahedra: the kind of mesh that the paper's frequencies were computed on.

The paper's mesh had "parabolic tetrahedrons", 2 mm long, 5927 points (its section "Modeling the
reed"). Here a block of 27-node hexahedra is split into 10-node tetrahedra on the same nodes, so
that geometry, clamp and material are those of the converged reed and only the elements differ.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linear_sum_assignment
from scipy.special import roots_jacobi

from holography.arrays import Array
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.fem import (
    ReedMatrices,
    ReferenceElement,
    Symmetry,
    free_dofs,
    integrate,
    lowest_modes,
    mass,
    shape_1d,
    stiffness,
)
from physics.reed.elements.mesh import (
    HalfReedMesh,
    MeshLevel,
    build_mesh,
)
from physics.reed.geometry import ReedGeometry, thickness_m
from physics.reed.modes import NamedMode

IntArray = NDArray[np.intp]

# Not graded towards the edges of the strip, and one layer: what a mesh of equal sizes divides.
PLAIN = MeshLevel(orders=(4, 4, 2), edge_breaks_m=(), z_breaks=(0.0, 1.0))
# Elements that begin nearer to the tip than this may be given a size of their own.
_TIP_M = 6e-3
# Modes computed beyond those that give names: stiff elements change their order.
_SPARE_MODES = 4
# A motion less like the mode that it is compared with bears no name.
_LEAST_SIMILARITY = 0.5
# Nodes of an element, vertices first, then the midpoints of these edges.
_EDGES = tuple(combinations(range(4), 2))
# Exact for polynomials of degree 5; products of quadratic shape functions have 4.
_GAUSS_POINTS = 3


@dataclass(frozen=True, eq=False)
class Lattice:
    """A block of nodes and the mesh that it divides.

    Attributes
    ----------
    mesh : HalfReedMesh
        27-node hexahedra, orders (2, 2, 2).
    parent : HalfReedMesh
    along : three of (m, n) float
        Values at the nodes of the parent along x, y and z to those of the mesh.
    """

    mesh: HalfReedMesh
    parent: HalfReedMesh
    along: tuple[Array, Array, Array]

    def carried(self, values: Array) -> Array:
        """Values (n, …) at the parent's nodes, interpolated to the nodes of the mesh."""
        return _interpolated(values.reshape(*self.parent.block, -1), self.along).reshape(
            -1, *values.shape[1:]
        )


@dataclass(frozen=True, eq=False)
class TetrahedralReed:
    """A reed of tetrahedra.

    Attributes
    ----------
    nodes : int
        Of the whole reed, both halves.
    matrices : ReedMatrices
        Of the half reed.
    modes : list of NamedMode
        Ascending in frequency, shapes at the nodes of the half reed. `similarity` is the share of
        the motion that the mode has in common with that of the mesh divided; modes that have
        little in common with any are left out.
    """

    nodes: int
    matrices: ReedMatrices
    modes: list[NamedMode]


def lattice(
    geometry: ReedGeometry,
    size_m: float,
    *,
    tip_size_m: float | None = None,
    level: MeshLevel = PLAIN,
) -> Lattice:
    """Divide a reed into hexahedra of about a given size.

    Parameters
    ----------
    geometry : ReedGeometry
    size_m : float
        Longest edge in the plan. Edges of the clamping strip lie on faces, so that some are
        shorter.
    tip_size_m : float, optional
        Another longest edge in the first 6 mm, and across the reed on all its length.
    level : MeshLevel
        Mesh that is divided, in the plan; its layers are kept.

    Raises
    ------
    ValueError
        For sizes that are not positive, and for an impossible geometry (see `build_mesh`).
    """
    tip_m = size_m if tip_size_m is None else tip_size_m
    if not min(size_m, tip_m) > 0:
        raise ValueError(f"elements of {size_m} m, {tip_m} m at the tip; give positive sizes")
    parent = build_mesh(geometry, level)
    plan = parent.nodes_m.reshape(*parent.block, 3)[:, :, -1, :2]
    (px, py, pz), (_, _, nz) = parent.orders, parent.block
    begins_m = plan[:-1:px, 0, 0]
    sizes_m = np.where(begins_m < _TIP_M, tip_m, size_m)
    along = (
        _divisions(_pieces(plan, px, sizes_m), px),
        _divisions(_pieces(plan.swapaxes(0, 1), py, np.array(tip_m)), py),
        _divisions(np.ones((nz - 1) // pz, dtype=np.intp), pz),
    )
    block, nodes_m = _nodes(geometry, parent, along)
    index = np.arange(len(nodes_m)).reshape(block)
    mesh = HalfReedMesh(
        nodes_m,
        block,
        sliding_window_view(index, (3, 3, 3))[::2, ::2, ::2].reshape(-1, 27),
        (2, 2, 2),
        _marked(parent.clamped, parent, along),
        _marked(parent.midplane, parent, along),
    )
    return Lattice(mesh, parent, along)


def _pieces(plan: Array, order: int, sizes_m: Array) -> IntArray:
    """Into how many pieces each element along the first axis of a plan (n, m, 2) is cut."""
    steps_m = np.linalg.norm(np.diff(plan, axis=0), axis=-1).max(axis=1)
    lengths_m = steps_m.reshape(-1, order).sum(axis=1)
    return np.asarray(np.ceil(lengths_m / sizes_m - 1e-6), dtype=np.intp)


def _divisions(pieces: IntArray, order: int) -> Array:
    """Interpolation from the nodes of elements to three nodes for each of their pieces."""
    parts = []
    for element, count in enumerate(pieces):
        last = element == len(pieces) - 1
        points = np.linspace(0, 1, 2 * count + 1)[: None if last else -1]
        part = np.zeros((len(points), len(pieces) * order + 1))
        part[:, element * order : (element + 1) * order + 1] = shape_1d(order, points)[0]
        parts.append(part)
    return np.vstack(parts)


def _interpolated(values: Array, along: tuple[Array, Array, Array]) -> Array:
    """Values (nx, ny, nz, c) at all nodes of a finer block."""
    return np.asarray(np.einsum("ai,bj,ck,ijkd->abcd", *along, values, optimize=True))


def _nodes(
    geometry: ReedGeometry, parent: HalfReedMesh, along: tuple[Array, Array, Array]
) -> tuple[tuple[int, int, int], Array]:
    """Block and nodes (n, 3): the parent's plan divided, under the exact thickness."""
    fine = _interpolated(parent.nodes_m.reshape(*parent.block, 3), along)
    x, y, z = np.moveaxis(fine, -1, 0)
    share = z / z[..., -1:]
    exact = share * thickness_m(geometry, x[..., 0], y[..., 0])[..., None]
    nx, ny, nz = x.shape
    return (nx, ny, nz), np.stack([x, y, exact], axis=-1).reshape(-1, 3)


def _marked(
    marks: NDArray[np.bool_], parent: HalfReedMesh, along: tuple[Array, Array, Array]
) -> NDArray[np.bool_]:
    """Nodes (n,) on faces of the parent whose nodes are all marked."""
    values = marks.astype(float).reshape(*parent.block, 1)
    return np.asarray(_interpolated(values, along).ravel() > 1 - 1e-9)


def split(hexahedra: IntArray) -> IntArray:
    """Nodes (6e, 10) of tetrahedra that fill 27-node hexahedra (e, 27).

    Each hexahedron is cut into six about one diagonal, the same in all, so that neighbours meet
    face to face (H. Freudenthal's decomposition); midpoints of edges are nodes already.
    """
    local = []
    for order in permutations(range(3)):
        corners = np.zeros((4, 3), dtype=int)
        for step, axis in enumerate(order):
            corners[step + 1 :, axis] = 2
        if np.linalg.det(corners[1:] - corners[0]) < 0:
            corners[[1, 2]] = corners[[2, 1]]
        middles = [(corners[a] + corners[b]) // 2 for a, b in _EDGES]
        local.append([9 * i + 3 * j + k for i, j, k in (*corners, *middles)])
    return np.asarray(hexahedra[:, local].reshape(-1, 10))


def _tetrahedron() -> ReferenceElement:
    """Ten nodes; Gauss-Jacobi rules on a cube, collapsed into the tetrahedron."""
    points, weights = [], []
    for power in (2, 1, 0):
        x, w = roots_jacobi(_GAUSS_POINTS, power, 0)
        points.append(0.5 * (1 + x))
        weights.append(w / 2 ** (power + 1))
    r, s, t = (axis.ravel() for axis in np.meshgrid(*points, indexing="ij"))
    y, z = s * (1 - r), t * (1 - r) * (1 - s)
    L = np.stack([1 - r - y - z, r, y, z])
    slopes = np.vstack([-np.ones(3), np.eye(3)])
    shape = [L[i] * (2 * L[i] - 1) for i in range(4)] + [4 * L[a] * L[b] for a, b in _EDGES]
    local = [np.outer(slopes[i], 4 * L[i] - 1) for i in range(4)]
    local += [4 * (np.outer(slopes[a], L[b]) + np.outer(slopes[b], L[a])) for a, b in _EDGES]
    weight = np.einsum("r,s,t->rst", *weights).ravel()
    return ReferenceElement(weight, np.stack(shape, axis=-1), np.stack(local, axis=-1))


def assemble_tetrahedra(nodes_m: Array, elements: IntArray) -> ReedMatrices:
    """Integrate all material-free matrices of 10-node tetrahedra.

    Parameters
    ----------
    nodes_m : (n, 3) float
    elements : (t, 10) int
        See `split`.

    Raises
    ------
    ValueError
        If an element is turned inside out.
    """
    return integrate(nodes_m, elements, _tetrahedron())


def tetrahedral_reed(
    geometry: ReedGeometry,
    cane: Cane,
    named: Sequence[NamedMode],
    size_m: float,
    *,
    tip_size_m: float | None = None,
    level: MeshLevel = PLAIN,
) -> TetrahedralReed:
    """Modes of a reed of quadratic tetrahedra.

    Parameters
    ----------
    geometry : ReedGeometry
    cane : Cane
    named : sequence of NamedMode
        Modes of the same reed on the mesh that is divided (see `modes.reed_modes`); tetrahedra
        bear their names.
    size_m, tip_size_m, level
        See `lattice`.

    Raises
    ------
    ValueError
        As `lattice` and `stiffness_terms_pa`, and for modes that were computed on another mesh.
    """
    divided = lattice(geometry, size_m, tip_size_m=tip_size_m, level=level)
    if any(mode.shape.shape != divided.parent.nodes_m.shape for mode in named):
        raise ValueError("the named modes lie on another mesh; compute them on the one divided")
    matrices = assemble_tetrahedra(divided.mesh.nodes_m, split(divided.mesh.elements))
    K = stiffness(matrices, stiffness_terms_pa(cane))
    M = mass(matrices, cane.density_kg_m3)

    def half(symmetry: Symmetry) -> list[NamedMode]:
        free = free_dofs(divided.mesh, symmetry)
        within = M[free][:, free]
        like = [mode for mode in named if mode.symmetry is symmetry]
        count = len(like) + _SPARE_MODES
        frequencies, shapes = lowest_modes(K[free][:, free], within, count)
        return _named(divided, like, free, within, frequencies, shapes)

    # SuperLU lets go of the interpreter: the two symmetries take two cores.
    with ThreadPoolExecutor(len(Symmetry)) as pool:
        found = [mode for modes in pool.map(half, Symmetry) for mode in modes]
    whole = 2 * len(divided.mesh.nodes_m) - np.count_nonzero(divided.mesh.midplane)
    return TetrahedralReed(int(whole), matrices, sorted(found, key=lambda m: m.frequency_hz))


def _named(
    divided: Lattice,
    like: Sequence[NamedMode],
    free: IntArray,
    mass_ff: sparse.csc_array,
    frequencies_hz: Array,
    shapes: Array,
) -> list[NamedMode]:
    """Give mass-normalised shapes (f, m) of one symmetry the names of those they are like."""
    trial = np.stack([divided.carried(mode.shape).ravel()[free] for mode in like], axis=1)
    trial = trial / np.sqrt(np.einsum("fr,fr->r", trial, mass_ff @ trial))
    similarity = (trial.T @ (mass_ff @ shapes)) ** 2
    answer = []
    pairs = np.transpose(linear_sum_assignment(similarity, maximize=True)).tolist()
    for r, m in pairs:
        if similarity[r, m] >= _LEAST_SIMILARITY:
            everywhere = np.zeros(divided.mesh.nodes_m.size)
            everywhere[free] = shapes[:, m]
            answer.append(
                replace(
                    like[r],
                    frequency_hz=float(frequencies_hz[m]),
                    similarity=float(similarity[r, m]),
                    shape=everywhere.reshape(-1, 3),
                )
            )
    return answer
