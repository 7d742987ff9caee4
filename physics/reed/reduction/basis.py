"""Reduced basis: the finite-element reed in a few dozen coordinates, for any E_L and G_LT.

The basis spans the modes of a network of materials and the static shapes under pressure, so both
eigenfrequencies and forced responses are those of the full model to a fraction of a cent.
"""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.fem import (
    ReedMatrices,
    Symmetry,
    assemble,
    factor,
    free_dofs,
    lowest_modes,
    mass,
    projected_stiffness,
    shape_1d,
    stiffness,
)
from physics.reed.elements.mesh import (
    HalfReedMesh,
    MeshLevel,
    ReedMesh,
    build_mesh,
)
from physics.reed.geometry import ReedGeometry, half_width_m
from physics.reed.mode_classification import vamp_profiles
from physics.reed.modes import HIGHEST_HZ

# Modes of a plate are evenly spaced in frequency, and the softest material of the usual box has a
# third more of them below 20 kHz than the one in the middle; this many more are taken.
_TAKEN_BEYOND = Fraction(1, 3)
# Modes sought at first, and beyond which a search ends; a clarinet's reed has nine symmetric ones
# below 20 kHz.
_FIRST_COUNT = 12
_MOST_MODES = 100


@dataclass(frozen=True)
class BasisSettings:
    """What a reduced basis is built from.

    Attributes
    ----------
    cane : Cane
        Supplies all constants but E_L and G_LT.
    E_L_pa, G_LT_pa : (float, float)
        Least and greatest values. Modes are computed at the four corners of this box and in its
        middle, the geometric means.
    modes : int, optional
        Modes per symmetry taken from each material. As many as the reed has below 20 kHz in the
        middle of the box, of the symmetry that has more, and a third beyond, if not given.
    size : int, optional
        Coordinates kept per symmetry; 14 for every 3 of these modes if not given.
    """

    cane: Cane = Cane()
    E_L_pa: tuple[float, float] = (7e9, 21e9)
    G_LT_pa: tuple[float, float] = (0.45e9, 2.0e9)
    modes: int | None = None
    size: int | None = None


@dataclass(frozen=True)
class HalfBasis:
    """One symmetry of a reed in reduced coordinates (r of them).

    Attributes
    ----------
    stiffness_terms : (9, r, r) float
        Stiffness per unit of each independent stiffness of the cane.
    mass : (r, r) float
        Mass per unit density.
    surface_z : (p, r) float
        Deflection u_z of the bark side at the nodes of the plan.
    lateral_mass, heel_mass : (r, r) float
        Parts of ``mass`` that move along y, and that lie behind the vamp.
    profiles : (k, 7, r) float
        Legendre profiles across the width of the vamp's deflection (see `names.vamp_profiles`).
    vamp_square : (r, r) float
        Integral over the vamp of the square of its deflection.
    load_z : (q, r) float
        Deflection of the flat side at the quadrature points of a pressure, times their area.
    middle_hz : (r,) float
        Eigenfrequencies of the material in the middle of the box, ascending.
    """

    stiffness_terms: Array
    mass: Array
    surface_z: Array
    lateral_mass: Array
    heel_mass: Array
    profiles: Array
    vamp_square: Array
    load_z: Array
    middle_hz: Array


@dataclass(frozen=True)
class ReducedReed:
    """A reed whose E_L and G_LT may take any value within the network of its basis.

    Attributes
    ----------
    geometry : ReedGeometry
    cane : Cane
        Constants other than E_L and G_LT.
    plan_m : (p, 2) float
        Nodes (x, y ≥ 0) of the plan at which `HalfBasis.surface_z` is given.
    load_points_m : (q, 2) float
        Where a pressure on the flat side is sampled.
    halves : dict
        A `HalfBasis` per `Symmetry`.
    """

    geometry: ReedGeometry
    cane: Cane
    plan_m: Array
    load_points_m: Array
    halves: dict[Symmetry, HalfBasis]


@dataclass(frozen=True)
class _Elements:
    """Finite elements of the motions of one symmetry.

    Attributes
    ----------
    mesh : HalfReedMesh
    matrices : ReedMatrices
    free : (f,) int
        Degrees of freedom left.
    mass : (f, f) sparse
        Per unit density.
    """

    mesh: HalfReedMesh
    matrices: ReedMatrices
    free: NDArray[np.intp]
    mass: sparse.csc_array


@dataclass(frozen=True)
class HalfShapes:
    """Shapes of a basis at all nodes of half a reed.

    Attributes
    ----------
    mesh : HalfReedMesh
    matrices : ReedMatrices
    middle : Cane
        Material in the middle of the box.
    shapes : dict of (n, 3, r) float
        Displacements at the nodes, per `Symmetry`; zero under the strip.
    """

    mesh: HalfReedMesh
    matrices: ReedMatrices
    middle: Cane
    shapes: dict[Symmetry, Array]


@dataclass(frozen=True)
class _Middle:
    """What the material in the middle of the box gives.

    Attributes
    ----------
    stiffness : (f, f) sparse
    hz : (c,) float
    modes : (f, c) float
    statics : (f, t) float
        Shapes under the trial pressures.
    """

    stiffness: sparse.csc_array
    hz: Array
    modes: Array
    statics: Array


def build_reduced_reed(
    geometry: ReedGeometry, level: MeshLevel, settings: BasisSettings
) -> ReducedReed:
    """Compute a reduced basis from finite-element snapshots.

    Raises
    ------
    ImpossibleReedError
        As `half_shapes`.
    """
    return reduced(geometry, settings, half_shapes(geometry, level, settings))


def half_shapes(geometry: ReedGeometry, level: MeshLevel, settings: BasisSettings) -> HalfShapes:
    """Compute the shapes of a basis from finite-element snapshots.

    Raises
    ------
    ImpossibleReedError
        For an impossible geometry or material (see `build_mesh`, `stiffness_terms_pa`), and one
        that has over 100 modes of a symmetry below 20 kHz.
    """
    mesh = build_mesh(geometry, level)
    matrices = assemble(mesh)
    points, faces = flat_side(mesh)
    loads = _trial_loads(geometry, mesh, points, faces)
    *corners, middle_cane = network(settings)
    parts = [_elements(mesh, matrices, symmetry) for symmetry in Symmetry]
    # SuperLU lets go of the interpreter: the two symmetries take two cores.
    with ThreadPoolExecutor(len(Symmetry)) as pool:
        middles = list(
            pool.map(lambda part: _middle(part, middle_cane, loads, settings.modes), parts)
        )
        modes = settings.modes or max(_modes_taken(middle.hz) for middle in middles)
        # Modes of five materials and static shapes are similar: three quarters of them are enough.
        size = settings.size or 14 * modes // 3

        def basis(part: _Elements, middle: _Middle) -> Array:
            return _basis(part, middle, corners, modes, size)

        bases = list(pool.map(basis, parts, middles))
    shapes = {
        symmetry: _at_nodes(part, basis)
        for symmetry, part, basis in zip(Symmetry, parts, bases, strict=True)
    }
    return HalfShapes(mesh, matrices, middle_cane, shapes)


def _at_nodes(part: _Elements, basis: Array) -> Array:
    """Displacements (n, 3, r) at all nodes of a basis (f, r)."""
    full = np.zeros((3 * len(part.mesh.nodes_m), basis.shape[1]))
    full[part.free] = basis
    return full.reshape(-1, 3, basis.shape[1])


def reduced(geometry: ReedGeometry, settings: BasisSettings, whole: HalfShapes) -> ReducedReed:
    """Project everything on the shapes of a basis."""
    mesh = whole.mesh
    points, faces = flat_side(mesh)
    halves = {
        symmetry: _reduced(geometry, whole, shapes, faces)
        for symmetry, shapes in whole.shapes.items()
    }
    columns = mesh.nodes_m.reshape(*mesh.block, 3)[:, :, -1, :2].reshape(-1, 2)
    return ReducedReed(geometry, settings.cane, columns, points, halves)


def network(settings: BasisSettings) -> Iterator[Cane]:
    """Yield the materials at the corners of a basis's box, then the one in its middle."""
    pairs = [(E, G) for E in settings.E_L_pa for G in settings.G_LT_pa]
    means = (float(np.sqrt(np.prod(moduli))) for moduli in (settings.E_L_pa, settings.G_LT_pa))
    for E, G in (*pairs, tuple(means)):
        yield replace(settings.cane, E_L_pa=E, G_LT_pa=G)


def _elements(mesh: HalfReedMesh, matrices: ReedMatrices, symmetry: Symmetry) -> _Elements:
    free = free_dofs(mesh, symmetry)
    return _Elements(mesh, matrices, free, mass(matrices, 1.0)[free][:, free])


def _stiffness(part: _Elements, cane: Cane) -> sparse.csc_array:
    return stiffness(part.matrices, stiffness_terms_pa(cane))[part.free][:, part.free]


def _modes_taken(hz: Array) -> int:
    """How many modes to take where these are the lowest frequencies in the middle of the box."""
    below = max(1, int(np.count_nonzero(hz < HIGHEST_HZ)))
    return below + math.ceil(_TAKEN_BEYOND * below)


def _middle(part: _Elements, cane: Cane, loads: Array, modes: int | None) -> _Middle:
    """Snapshots of the material in the middle: `modes` of them, or as many as are to be taken."""
    K = _stiffness(part, cane)
    solve, count = factor(K), modes or _FIRST_COUNT
    while True:
        unit_hz, shapes = lowest_modes(K, part.mass, count, solve)
        hz = unit_hz / np.sqrt(cane.density_kg_m3)
        if modes or _modes_taken(hz) <= count:
            return _Middle(K, hz, shapes, solve(loads[part.free]))
        if count > _MOST_MODES:
            raise ImpossibleReedError(
                f"the reed has over {_MOST_MODES} modes below {HIGHEST_HZ:.0f} Hz, more than cane "
                "can have; check moduli, density and thickness"
            )
        count = _modes_taken(hz)


def _basis(
    part: _Elements, middle: _Middle, corners: Sequence[Cane], modes: int, size: int
) -> Array:
    """Basis (f, r) that spans what was computed of all materials."""
    snapshots = [lowest_modes(_stiffness(part, cane), part.mass, modes)[1] for cane in corners]
    if len(middle.hz) < modes:
        # The other symmetry has more modes.
        snapshots.append(lowest_modes(middle.stiffness, part.mass, modes)[1])
    else:
        snapshots.append(middle.modes[:, np.argsort(middle.hz)[:modes]])
    # The middle of the box serves as the reference.
    return pod(np.hstack([*snapshots, middle.statics]), middle.stiffness, size)


def _reduced(
    geometry: ReedGeometry, whole: HalfShapes, shapes: Array, faces: sparse.csr_array
) -> HalfBasis:
    """Project everything on shapes (n, 3, r)."""
    mesh, node_mass, size = whole.mesh, whole.matrices.mass, shapes.shape[2]
    lateral, vertical = shapes[:, 1], shapes[:, 2]
    bark = vertical.reshape(*mesh.block, size)[:, :, -1]
    heel = vertical * (mesh.nodes_m[:, :1] > geometry.vamp_x_m[-1])
    plan_m = mesh.nodes_m.reshape(*mesh.block, 3)[:, :, -1, :2]
    profiles, vamp = vamp_profiles(plan_m, bark, geometry.vamp_x_m[-1])
    stiffness_terms = projected_stiffness(whole.matrices, shapes)
    unit_mass = np.sum([u.T @ (node_mass @ u) for u in shapes.transpose(1, 0, 2)], axis=0)
    middle_pa, density_kg_m3 = stiffness_terms_pa(whole.middle), whole.middle.density_kg_m3
    return HalfBasis(
        stiffness_terms=stiffness_terms,
        mass=unit_mass,
        surface_z=bark.reshape(-1, size),
        lateral_mass=lateral.T @ (node_mass @ lateral),
        heel_mass=heel.T @ (node_mass @ heel),
        profiles=profiles,
        vamp_square=vamp.T @ vamp,
        load_z=faces @ vertical,
        middle_hz=_vibrations(stiffness_terms, unit_mass, middle_pa, density_kg_m3)[0],
    )


def pod(snapshots: Array, reference: sparse.csc_array, size: int) -> Array:
    """Proper orthogonal decomposition in the energy inner product.

    Parameters
    ----------
    snapshots : (f, s) float
    reference : (f, f) sparse
        Stiffness, which measures energy.
    size : int

    Returns
    -------
    (f, size) float
        Basis of unit energies.

    Raises
    ------
    ValueError
        If the snapshots span less than that.
    """
    scaled = snapshots / np.sqrt(np.einsum("fs,fs->s", snapshots, reference @ snapshots))
    values, vectors = np.linalg.eigh(scaled.T @ (reference @ scaled))
    kept = slice(-size, None)
    if values[kept][0] <= 0:
        raise ValueError(f"a basis of {size} coordinates needs more snapshots; lower its size")
    basis: Array = scaled @ (vectors[:, kept] / np.sqrt(values[kept]))
    return basis


def flat_side(mesh: ReedMesh) -> tuple[Array, sparse.csr_array]:
    """Quadrature of a pressure on the flat side.

    Returns
    -------
    points_m : (q, 2) float
        Gauss points of the faces.
    faces : (q, n) sparse
        Row q is weight times shape functions at point q (m²), so that ``p @ faces`` are the nodal
        forces of the pressures p and ``faces @ u`` the deflections times their area.
    """
    (px, py, pz), (nx, ny, nz) = mesh.orders, mesh.block
    tables, weights = [], []
    for order in (px, py):
        # Two points more than the shapes need: pressure falls steeply at the chamber's walls.
        points, weight = np.polynomial.legendre.leggauss(order + 3)
        tables.append(shape_1d(order, 0.5 * (1 + points)))
        weights.append(0.5 * weight)
    (x, dx), (y, dy) = tables
    shape = np.kron(x, y)
    bottom = mesh.elements.reshape(-1, (px + 1) * (py + 1), pz + 1)[:, :, 0]
    bottom = bottom[(bottom % nz == 0).all(axis=1)]
    plan = mesh.nodes_m[bottom, :2]
    along, across = np.kron(dx, y) @ plan, np.kron(x, dy) @ plan
    area = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
    values = (np.kron(*weights) * area)[..., None] * shape
    rows = np.repeat(np.arange(area.size), shape.shape[1])
    columns = np.repeat(bottom, len(shape), axis=0).ravel()
    faces = sparse.csr_array((values.ravel(), (rows, columns)), shape=(area.size, nx * ny * nz))
    return (shape @ plan).reshape(-1, 2), faces


def _trial_loads(
    geometry: ReedGeometry, mesh: HalfReedMesh, points_m: Array, faces: sparse.csr_array
) -> Array:
    """Loads (3n, t) of smooth trial pressures, whose static shapes enrich the basis."""
    x = 2 * points_m[:, 0] / mesh.nodes_m[:, 0].max() - 1
    eta = points_m[:, 1] / np.maximum(half_width_m(geometry.outline, points_m[:, 0]), 1e-6)
    trial = [
        np.polynomial.legendre.Legendre.basis(m)(x) * np.polynomial.legendre.Legendre.basis(n)(eta)
        for m in range(4)
        for n in range(4)
    ]
    loads = np.zeros((3 * len(mesh.nodes_m), len(trial)))
    loads[2::3] = faces.T @ np.stack(trial, axis=1)
    return loads


def reduced_modes(half: HalfBasis, terms_pa: Array, density_kg_m3: float) -> tuple[Array, Array]:
    """Eigenfrequencies (r,) in Hz, ascending, and mass-normalised reduced shapes (r, r)."""
    return _vibrations(half.stiffness_terms, half.mass, terms_pa, density_kg_m3)


def _vibrations(
    stiffness_terms: Array, unit_mass: Array, terms_pa: Array, density_kg_m3: float
) -> tuple[Array, Array]:
    K = np.tensordot(terms_pa, stiffness_terms, axes=1)
    eigenvalues, shapes = linalg.eigh(K, density_kg_m3 * unit_mass)
    return np.sqrt(np.clip(eigenvalues, 0.0, None)) / (2 * np.pi), shapes
