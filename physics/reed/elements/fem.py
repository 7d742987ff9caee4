"""Finite elements of a reed, half or whole: energies, and modes of either symmetry.

Stiffness is affine in the nine independent stiffnesses of the cane. It is kept as the nine scalar
matrices ``D_ij = ∫ ∂_i N_a ∂_j N_b dV`` from which every component block is a sum, so a change of
material costs no new quadrature.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.reed.cane.material import STIFFNESS_TERMS
from physics.reed.elements.mesh import (
    HalfReedMesh,
    ReedMesh,
    lobatto_points,
)

IntArray = NDArray[np.intp]


class Symmetry(StrEnum):
    """Behaviour of a motion under reflection in the reed's median plane y = 0."""

    SYMMETRIC = "symmetric"
    ANTISYMMETRIC = "antisymmetric"


@dataclass(frozen=True)
class ReedMatrices:
    """Material-free matrices of a mesh, (n, n) over its nodes.

    Attributes
    ----------
    gradients : dict
        ``gradients["xy"]`` is ``∫ ∂_x N_a ∂_y N_b dV``, for all nine pairs of axes.
    mass : csr_array
        ``∫ N_a N_b dV``, to be multiplied by the density.
    """

    gradients: dict[str, sparse.csr_array]
    mass: sparse.csr_array


def shape_1d(order: int, points: Array) -> tuple[Array, Array]:
    """Lagrange polynomials on Lobatto nodes and their derivatives at points (q,): two (q, m)."""
    nodes = lobatto_points(order)
    values, slopes = [], []
    for node in nodes:
        others = nodes[nodes != node]
        polynomial = np.poly1d(others, r=True) / np.prod(node - others)
        values.append(polynomial(points))
        slopes.append(polynomial.deriv()(points))
    return np.stack(values, axis=1), np.stack(slopes, axis=1)


def _tensor(x: Array, y: Array, z: Array) -> Array:
    """Products of three one-dimensional tables: (qx·qy·qz, mx·my·mz)."""
    return np.kron(x, np.kron(y, z))


@dataclass(frozen=True)
class ReferenceElement:
    """Quadrature on an element of unit size.

    Attributes
    ----------
    weights : (q,) float
    shape : (q, m) float
        Shape functions.
    gradients : (3, q, m) float
        Their derivatives along the element's own axes.
    """

    weights: Array
    shape: Array
    gradients: Array


def hexahedron(orders: tuple[int, int, int]) -> ReferenceElement:
    """Hexahedron of Lobatto nodes, of a degree along each axis, with one Gauss point more."""
    tables, weights = [], []
    for order in orders:
        points, weight = np.polynomial.legendre.leggauss(order + 1)
        tables.append(shape_1d(order, 0.5 * (1 + points)))
        weights.append(0.5 * weight)
    (x, dx), (y, dy), (z, dz) = tables
    return ReferenceElement(
        np.kron(weights[0], np.kron(weights[1], weights[2])),
        _tensor(x, y, z),
        np.stack([_tensor(dx, y, z), _tensor(x, dy, z), _tensor(x, y, dz)]),
    )


def assemble(mesh: ReedMesh) -> ReedMatrices:
    """Integrate all material-free matrices of a mesh.

    Raises
    ------
    ImpossibleReedError
        If an element is turned inside out.
    """
    return integrate(mesh.nodes_m, mesh.elements, hexahedron(mesh.orders))


def integrate(nodes_m: Array, elements: IntArray, reference: ReferenceElement) -> ReedMatrices:
    """Integrate all material-free matrices of elements of one kind.

    Parameters
    ----------
    nodes_m : (n, 3) float
    elements : (e, m) int
        Node numbers, in the order of the shape functions.
    reference : ReferenceElement

    Raises
    ------
    ImpossibleReedError
        If an element is turned inside out.
    """
    jacobian = np.einsum("iqm,emj->eqij", reference.gradients, nodes_m[elements], optimize=True)
    volume = np.linalg.det(jacobian)
    if volume.min() <= 0:
        number = int(volume.min(axis=1).argmin())
        raise ImpossibleReedError(
            f"element {number} of the mesh is turned inside out; change the breaks of its level, "
            "or divide the reed more finely"
        )
    inverse = np.linalg.inv(jacobian)
    scale = np.sqrt(volume * reference.weights)[..., None]
    weighted = scale * np.einsum("eqij,jqm->ieqm", inverse, reference.gradients, optimize=True)
    rows = np.repeat(elements, elements.shape[1], axis=1).ravel()
    columns = np.tile(elements, (1, elements.shape[1])).ravel()
    size = (len(nodes_m),) * 2

    def gather(left: Array, right: Array) -> sparse.csr_array:
        blocks = np.matmul(left.transpose(0, 2, 1), right)
        return sparse.coo_array((blocks.ravel(), (rows, columns)), shape=size).tocsr()

    axes = {"x": weighted[0], "y": weighted[1], "z": weighted[2]}
    gradients = {a + b: gather(axes[a], axes[b]) for a, b in ("xx", "yy", "zz", "xy", "xz", "yz")}
    for pair in ("xy", "xz", "yz"):
        gradients[pair[::-1]] = gradients[pair].T.tocsr()
    shape = scale * reference.shape
    return ReedMatrices(gradients, gather(shape, shape))


def stiffness(matrices: ReedMatrices, terms_pa: Array) -> sparse.csc_array:
    """Stiffness (3n, 3n) in N/m, components u_x, u_y, u_z of a node side by side.

    Parameters
    ----------
    matrices : ReedMatrices
    terms_pa : (9,) float
        Independent stiffnesses in the order of `STIFFNESS_TERMS`.
    """
    # The parts come from the same elements: they share one pattern, and only numbers are added.
    D = {axes: part.data for axes, part in matrices.gradients.items()}
    C = dict(zip(STIFFNESS_TERMS, terms_pa, strict=True))
    pattern = matrices.gradients["xx"]
    blocks = np.empty((len(pattern.data), 3, 3))
    blocks[:, 0, 0] = C["11"] * D["xx"] + C["66"] * D["yy"] + C["55"] * D["zz"]
    blocks[:, 1, 1] = C["66"] * D["xx"] + C["22"] * D["yy"] + C["44"] * D["zz"]
    blocks[:, 2, 2] = C["55"] * D["xx"] + C["44"] * D["yy"] + C["33"] * D["zz"]
    blocks[:, 0, 1] = C["12"] * D["xy"] + C["66"] * D["yx"]
    blocks[:, 1, 0] = C["12"] * D["yx"] + C["66"] * D["xy"]
    blocks[:, 0, 2] = C["13"] * D["xz"] + C["55"] * D["zx"]
    blocks[:, 2, 0] = C["13"] * D["zx"] + C["55"] * D["xz"]
    blocks[:, 1, 2] = C["23"] * D["yz"] + C["44"] * D["zy"]
    blocks[:, 2, 1] = C["23"] * D["zy"] + C["44"] * D["yz"]
    by_rows = sparse.bsr_array((blocks, pattern.indices, pattern.indptr)).tocsr()
    return _symmetric(by_rows)


def mass(matrices: ReedMatrices, density_kg_m3: float) -> sparse.csc_array:
    """Mass (3n, 3n) in kg, same ordering as `stiffness`."""
    return _symmetric(sparse.csr_array(sparse.kron(density_kg_m3 * matrices.mass, np.eye(3))))


def _symmetric(by_rows: sparse.csr_array) -> sparse.csc_array:
    """Read a symmetric matrix by columns instead of by rows: the same numbers."""
    by_rows.eliminate_zeros()
    return sparse.csc_array((by_rows.data, by_rows.indices, by_rows.indptr), shape=by_rows.shape)


# Engineering strains in Voigt order: (component of the displacement, axis it is derived along).
_STRAINS = (
    (("x", "x"),),
    (("y", "y"),),
    (("z", "z"),),
    (("y", "z"), ("z", "y")),
    (("x", "z"), ("z", "x")),
    (("x", "y"), ("y", "x")),
)


def projected_stiffness(matrices: ReedMatrices, shapes: Array) -> Array:
    """Stiffness between shapes, per unit of each independent stiffness.

    Parameters
    ----------
    matrices : ReedMatrices
    shapes : (n, 3, r) float
        Displacements at the nodes.

    Returns
    -------
    (9, r, r) float
        In the order of `STIFFNESS_TERMS`.
    """
    u = {axis: shapes[:, k] for k, axis in enumerate("xyz")}

    def energy(term: str) -> Array:
        left, right = (_STRAINS[int(number) - 1] for number in term)
        total = np.zeros((shapes.shape[2],) * 2)
        for a, i in left:
            for b, j in right:
                total += u[a].T @ (matrices.gradients[i + j] @ u[b])
        return total if left == right else total + total.T

    return np.stack([energy(term) for term in STIFFNESS_TERMS])


def free_dofs(mesh: HalfReedMesh, symmetry: Symmetry) -> IntArray:
    """Degrees of freedom (f,) left by the clamp and by the condition on the median plane."""
    fixed = np.repeat(mesh.clamped[:, None], 3, axis=1)
    if symmetry is Symmetry.SYMMETRIC:
        fixed[:, 1] |= mesh.midplane
    else:
        fixed[:, 0] |= mesh.midplane
        fixed[:, 2] |= mesh.midplane
    return np.flatnonzero(~fixed.ravel())


def factor(matrix: sparse.csc_array) -> Callable[[Array], Array]:
    """Factor a symmetric positive definite sparse matrix once; returns its solver."""
    lu = splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    solve: Callable[[Array], Array] = lu.solve
    return solve


def lowest_modes(
    stiffness_ff: sparse.csc_array,
    mass_ff: sparse.csc_array,
    count: int,
    solve: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array]:
    """Lowest eigenfrequencies (count,) in Hz and mass-normalised shapes (f, count)."""
    operator = LinearOperator(
        stiffness_ff.shape, matvec=solve or factor(stiffness_ff), dtype=np.float64
    )
    # A fixed start vector: the same reed gives the same bits every time. The tolerance is that of
    # the shapes; frequencies, accurate to its square, come out to the last digits.
    start = np.ones(stiffness_ff.shape[0])
    eigenvalues, shapes = eigsh(
        stiffness_ff, k=count, M=mass_ff, sigma=0.0, OPinv=operator, v0=start, tol=1e-7
    )
    return np.sqrt(eigenvalues) / (2 * np.pi), shapes
