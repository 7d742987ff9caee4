"""Reduced basis: the finite-element reed in a few dozen coordinates, for any E_L and G_LT.

The basis spans the modes of a network of materials and the static shapes under pressure, so both
eigenfrequencies and forced responses are those of the full model to a fraction of a cent.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from physics.reed.fem import (
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
from physics.reed.geometry import ReedGeometry, half_width_m
from physics.reed.material import Cane, stiffness_terms_pa
from physics.reed.mesh import HalfReedMesh, MeshLevel, build_mesh
from physics.reed.names import width_profiles

Array = NDArray[np.floating[Any]]

# The rounded tip has no straight line across; profiles start behind it.
_TIP_M = 0.5e-3


@dataclass(frozen=True)
class BasisSettings:
    """What a reduced basis is built from.

    Attributes
    ----------
    cane : Cane
        Supplies all constants but E_L and G_LT.
    E_L_pa, G_LT_pa : (float, float)
        Least and greatest values. Modes are computed at the four corners of this box and at its
        centre.
    modes : int
        Modes per symmetry taken from each material; enough to pass 20 kHz.
    size : int
        Coordinates kept per symmetry.
    """

    cane: Cane = Cane()
    E_L_pa: tuple[float, float] = (7e9, 21e9)
    G_LT_pa: tuple[float, float] = (0.45e9, 2.0e9)
    modes: int = 12
    size: int = 56


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
    profiles : (nx, 7, r) float
        Legendre profiles across the width of the vamp's deflection (see `names`).
    load_z : (q, r) float
        Deflection of the flat side at the quadrature points of a pressure, times their area.
    """

    stiffness_terms: Array
    mass: Array
    surface_z: Array
    lateral_mass: Array
    heel_mass: Array
    profiles: Array
    load_z: Array


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


def build_reduced_reed(
    geometry: ReedGeometry, level: MeshLevel, settings: BasisSettings
) -> ReducedReed:
    """Compute a reduced basis from finite-element snapshots.

    Raises
    ------
    ValueError
        For an impossible geometry or material (see `build_mesh`, `stiffness_terms_pa`).
    """
    mesh = build_mesh(geometry, level)
    matrices = assemble(mesh)
    points, faces = _flat_side(mesh)

    def half(symmetry: Symmetry) -> HalfBasis:
        return _half_basis(geometry, mesh, matrices, settings, symmetry, points, faces)

    # SuperLU lets go of the interpreter: the two symmetries take two cores.
    with ThreadPoolExecutor(len(Symmetry)) as pool:
        halves = dict(zip(Symmetry, pool.map(half, Symmetry), strict=True))
    columns = mesh.nodes_m.reshape(*mesh.block, 3)[:, :, -1, :2].reshape(-1, 2)
    return ReducedReed(geometry, settings.cane, columns, points, halves)


def _network(settings: BasisSettings) -> Iterator[Cane]:
    """Materials at the corners of the box, then at its centre."""
    pairs = [(E, G) for E in settings.E_L_pa for G in settings.G_LT_pa]
    centre = (float(np.sqrt(np.prod(moduli))) for moduli in (settings.E_L_pa, settings.G_LT_pa))
    for E, G in (*pairs, tuple(centre)):
        yield replace(settings.cane, E_L_pa=E, G_LT_pa=G)


def _half_basis(
    geometry: ReedGeometry,
    mesh: HalfReedMesh,
    matrices: ReedMatrices,
    settings: BasisSettings,
    symmetry: Symmetry,
    points_m: Array,
    faces: sparse.csr_array,
) -> HalfBasis:
    free = free_dofs(mesh, symmetry)
    unit_mass = mass(matrices, 1.0)[free][:, free]
    snapshots = []
    for cane in _network(settings):
        K = stiffness(matrices, stiffness_terms_pa(cane))[free][:, free]
        solve = factor(K)
        snapshots.append(lowest_modes(K, unit_mass, settings.modes, solve)[1])
    # The last is the centre of the box, and serves as the reference.
    snapshots.append(solve(_trial_loads(geometry, mesh, points_m, faces)[free]))
    basis = _pod(np.hstack(snapshots), K, settings.size)
    full = np.zeros((3 * len(mesh.nodes_m), basis.shape[1]))
    full[free] = basis
    shapes = full.reshape(-1, 3, basis.shape[1])
    lateral, vertical = shapes[:, 1], shapes[:, 2]
    top = vertical.reshape(*mesh.block, -1)[:, :, -1]
    heel = vertical * (mesh.nodes_m[:, :1] > geometry.vamp_x_m[-1])
    return HalfBasis(
        stiffness_terms=projected_stiffness(matrices, shapes),
        mass=basis.T @ (unit_mass @ basis),
        surface_z=top.reshape(-1, basis.shape[1]),
        lateral_mass=lateral.T @ (matrices.mass @ lateral),
        heel_mass=heel.T @ (matrices.mass @ heel),
        profiles=_vamp_profiles(mesh, geometry, top),
        load_z=faces @ vertical,
    )


def _pod(snapshots: Array, reference: sparse.csc_array, size: int) -> Array:
    """Proper orthogonal decomposition in the energy inner product: (f, size) basis."""
    scaled = snapshots / np.sqrt(np.einsum("fs,fs->s", snapshots, reference @ snapshots))
    values, vectors = np.linalg.eigh(scaled.T @ (reference @ scaled))
    kept = slice(-size, None)
    if values[kept][0] <= 0:
        raise ValueError(f"a basis of {size} coordinates needs more snapshots; lower its size")
    basis: Array = scaled @ (vectors[:, kept] / np.sqrt(values[kept]))
    return basis


def _vamp_profiles(mesh: HalfReedMesh, geometry: ReedGeometry, top: Array) -> Array:
    """Legendre profiles (nx, 7, r) of deflections (nx', ny, r) on the lines of the vamp.

    Weighted by the root of the area that each line stands for, so that sums of their squares do
    not depend on how the mesh is graded.
    """
    plan = mesh.nodes_m.reshape(*mesh.block, 3)[:, :, -1, :2]
    vamp = (plan[:, 0, 0] > _TIP_M) & (plan[:, 0, 0] < geometry.vamp_x_m[-1])
    width = plan[vamp, -1:, 1]
    area = np.gradient(plan[vamp, 0, 0]) * width[:, 0]
    profiles = width_profiles(top[vamp], plan[vamp, :, 1] / width)
    weighted: Array = profiles * np.sqrt(area / area.mean())[:, None, None]
    return weighted


def _flat_side(mesh: HalfReedMesh) -> tuple[Array, sparse.csr_array]:
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
    K = np.tensordot(terms_pa, half.stiffness_terms, axes=1)
    eigenvalues, shapes = linalg.eigh(K, density_kg_m3 * half.mass)
    return np.sqrt(np.clip(eigenvalues, 0.0, None)) / (2 * np.pi), shapes
