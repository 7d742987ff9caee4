"""Modes of a few canes of the box by finite elements, and the few shapes that span them."""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray
from scipy import sparse

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
    shape_1d,
    stiffness,
)
from physics.reed.elements.mesh import HalfReedMesh, MeshLevel, ReedMesh, build_least_mesh
from physics.reed.geometry import ReedGeometry, half_width_m
from physics.reed.modes import HIGHEST_HZ
from physics.reed.reduced.reed import CONSTANTS, BasisSettings

# Modes of a plate are evenly spaced in frequency, and the softest cane of the usual box has a third
# more of them below 20 kHz than the one in the middle; this many more are taken.
_TAKEN_BEYOND = Fraction(1, 3)
# Coordinates per mode taken. Chosen: with 7 and 8 the farthest mode below 20 kHz is 1.5 and 1.1
# cents off for 24 canes, half of them at corners of the box; 3 are allowed
# (`studies.reduced_basis`).
_SIZE_PER_MODE = 7.0
# Modes of one part sought at first, and beyond which a search ends; a clarinet's reed has nine
# symmetric ones below 20 kHz.
_FIRST_COUNT, _MOST_MODES = 12, 100
# Modes of the middle from which those of other canes are found, and modes kept of each cane, as
# multiples of the modes taken.
_START, _KEPT = 2, Fraction(4, 3)
# Steps of inverse iteration; steps that add less than this share of energy are noise.
_STEPS, _LEAST_STEP = 2, 1e-10
# Modes above this frequency weigh less in the choice of coordinates. Chosen: of 1, 0.3, 0.1 and
# 0.03, the weight with the least errors below 20 kHz.
_WANTED_HZ, _HIGH_WEIGHT = 1.05 * HIGHEST_HZ, 0.1
# Shapes at rest weigh more. Chosen: of 1, 2, 3 and 5, the least with which a whole reed at rest is
# that of its finite elements to 1e-4.
_STATIC_WEIGHT = 2.0
# Scrambled Sobol sequence; inner third of each range stretched to all of it, because a box of nine
# dimensions is mostly edges.
_SEED, _STRETCH = 5, 3.0
# Orders along half a reed, or a whole one, and across it of the trial pressures.
_TRIAL_ORDERS = {1: (4, 4), 2: (4, 8)}
# Two factorisations at once; each is itself not threaded.
_THREADS = 2

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Motions:
    """Finite elements of the motions of one part of a reed.

    Attributes
    ----------
    symmetries : tuple of Symmetry
        That they may have: one of half a reed, both of a whole one.
    free : (f,) int
        Degrees of freedom left by clamp and symmetry.
    mass : (f, f) sparse
        Per unit density.
    """

    symmetries: tuple[Symmetry, ...]
    free: NDArray[np.intp]
    mass: sparse.csc_array


@dataclass(frozen=True)
class Elements:
    """Finite elements of a reed, of half of it where that says all.

    Attributes
    ----------
    mesh : ReedMesh
    matrices : ReedMatrices
    motions : tuple of Motions
    load_points_m, faces
        See `flat_side`.
    """

    mesh: ReedMesh
    matrices: ReedMatrices
    motions: tuple[Motions, ...]
    load_points_m: Array
    faces: sparse.csr_array

    def stiffness(self, cane: Cane) -> sparse.csc_array:
        """Stiffness (3n, 3n) of all degrees of freedom."""
        return stiffness(self.matrices, stiffness_terms_pa(cane))


@dataclass(frozen=True)
class _Factored:
    """Motions of a part of a reed of the cane in the middle of the box.

    Attributes
    ----------
    motions : Motions
    stiffness : (f, f) sparse
    solve : callable
        Takes forces (f, ...) to displacements at rest.
    """

    motions: Motions
    stiffness: sparse.csc_array
    solve: Callable[[Array], Array]


@dataclass(frozen=True)
class _Middle:
    """The cane in the middle of the box.

    Attributes
    ----------
    stiffness : (f, f) sparse
    start : (f, c) float
        Its modes, ascending.
    statics : (f, t) float
        Shapes under trial pressures.
    """

    stiffness: sparse.csc_array
    start: Array
    statics: Array


def elements_of(geometry: ReedGeometry, level: MeshLevel) -> Elements:
    """Mesh a reed and integrate its matrices.

    Raises
    ------
    ImpossibleReedError
        For an impossible geometry (see `build_whole_mesh`).
    """
    mesh = build_least_mesh(geometry, level)
    matrices = assemble(mesh)
    everything = mass(matrices, 1.0)

    def motions(symmetries: tuple[Symmetry, ...], free: NDArray[np.intp]) -> Motions:
        return Motions(symmetries, free, everything[free][:, free])

    if isinstance(mesh, HalfReedMesh):
        parts = tuple(motions((symmetry,), free_dofs(mesh, symmetry)) for symmetry in Symmetry)
    else:
        parts = (motions(tuple(Symmetry), np.flatnonzero(~np.repeat(mesh.clamped, 3))),)
    return Elements(mesh, matrices, parts, *flat_side(mesh))


def spanning_shapes(
    geometry: ReedGeometry,
    elements: Elements,
    settings: BasisSettings,
    progress: Progress = lambda _: None,
) -> list[Array]:
    """Shapes (f, r) per part that span the modes of all canes of a box, on two threads.

    Modes of a network of canes, and shapes at rest under smooth pressures, by proper orthogonal
    decomposition in the energy of the cane in the middle.

    Parameters
    ----------
    geometry : ReedGeometry
    elements : Elements
    settings : BasisSettings
    progress : callable, optional
        Called, in this thread, with the fraction of the work that is done.

    Raises
    ------
    ImpossibleReedError
        For impossible cane, and a reed that has over 100 modes of a symmetry below 20 kHz.
    """
    box, (*corners, middle_cane) = settings.box, network(settings)
    loads = _trial_loads(geometry, elements)
    with ThreadPoolExecutor(_THREADS) as pool:
        modes, middles = _middles(elements, middle_cane, loads, settings.modes, pool)

        def shapes(cane: Cane) -> list[Array]:
            own = elements.stiffness(cane)
            return [
                _weighted_modes(part, own, middle, box.cane.density_kg_m3, math.ceil(_KEPT * modes))
                for part, middle in zip(elements.motions, middles, strict=True)
            ]

        found = []
        for number, each in enumerate(pool.map(shapes, (middle_cane, *corners)), 1):
            found.append(each)
            progress(number / (len(corners) + 1))
    size = settings.size or round(_SIZE_PER_MODE * modes)
    return [
        pod(
            [*own, _STATIC_WEIGHT * _of_unit_energy(middle.statics, middle.stiffness)],
            middle.stiffness,
            size,
        )
        for middle, own in zip(middles, zip(*found, strict=True), strict=True)
    ]


def network(settings: BasisSettings) -> Iterator[Cane]:
    """Yield the corners of E_L and G_LT, canes spread over the box, and the one in its middle."""
    # Slow to import, and only who builds a basis needs it.
    from scipy.stats import qmc

    box = settings.box
    for E in box.E_L_pa:
        for G in box.G_LT_pa:
            yield replace(box.cane, E_L_pa=E, G_LT_pa=G)
    if settings.snapshots:
        power = math.ceil(math.log2(settings.snapshots))
        places = qmc.Sobol(len(CONSTANTS), seed=_SEED).random_base2(power)
        yield from box.at(_stretched(places[: settings.snapshots]))
    yield box.middle


def _stretched(places: Array) -> Array:
    return np.asarray(np.clip(_STRETCH * (places - 0.5) + 0.5, 0, 1))


def _middles(
    elements: Elements, cane: Cane, loads: Array, modes: int | None, pool: ThreadPoolExecutor
) -> tuple[int, list[_Middle]]:
    """Return how many modes are taken of each part, if that is not given, and the middle cane's."""
    stiff = elements.stiffness(cane)
    parts = list(pool.map(lambda part: _factored(part, stiff), elements.motions))
    if modes is None:
        counts = pool.map(lambda part: _modes_below(part, cane), parts)
        modes = max(count + math.ceil(_TAKEN_BEYOND * count) for count in counts)
    return modes, list(pool.map(lambda part: _middle(part, loads, _START * modes), parts))


def _factored(motions: Motions, stiff: sparse.csc_array) -> _Factored:
    K = stiff[motions.free][:, motions.free]
    return _Factored(motions, K, factor(K))


def _modes_below(part: _Factored, cane: Cane) -> int:
    """How many modes a part has below 20 kHz; at least one.

    Raises
    ------
    ImpossibleReedError
        If it has over 100.
    """
    motions = part.motions
    count, most = (n * len(motions.symmetries) for n in (_FIRST_COUNT, _MOST_MODES))
    while True:
        # The sparse solver finds a part of all modes only.
        count = min(count, len(motions.free) // 2)
        unit_hz = lowest_modes(part.stiffness, motions.mass, count, part.solve)[0]
        below = int(np.count_nonzero(unit_hz < HIGHEST_HZ * math.sqrt(cane.density_kg_m3)))
        if below < count or count == len(motions.free) // 2:
            return max(below, 1)
        if count > most:
            raise ImpossibleReedError(
                f"the reed has over {most} modes below {HIGHEST_HZ:.0f} Hz, more than cane can "
                "have; check moduli, density and thickness"
            )
        count *= 2


def _middle(part: _Factored, loads: Array, count: int) -> _Middle:
    free, count = part.motions.free, min(count, len(part.motions.free) // 2)
    hz, shapes = lowest_modes(part.stiffness, part.motions.mass, count, part.solve)
    return _Middle(part.stiffness, shapes[:, np.argsort(hz)], part.solve(loads[free]))


def _weighted_modes(
    part: Motions, stiff: sparse.csc_array, middle: _Middle, density_kg_m3: float, count: int
) -> Array:
    """Modes (f, c) of a cane, of unit energy in the middle one or of less if they are high.

    By Rayleigh's and Ritz's method in the span of a few steps of inverse iteration, all shapes at
    once: that takes a third of the time of a sparse eigensolver, which knows no start.
    """
    solve = factor(stiff[part.free][:, part.free])
    forces, steps = [part.mass @ middle.start], []
    for _ in range(_STEPS):
        steps.append(solve(forces[-1]))
        forces.append(part.mass @ steps[-1])
    trial, elastic, inertial = np.hstack(steps), np.hstack(forces[:-1]), np.hstack(forces[1:])
    energies = trial.T @ elastic
    scale = 1 / np.sqrt(np.diag(energies))
    values, vectors = np.linalg.eigh(scale[:, None] * energies * scale)
    kept = values > _LEAST_STEP * values[-1]
    mixing = scale[:, None] * vectors[:, kept] / np.sqrt(values[kept])
    # The greater the mass per energy, the lower the mode.
    per_energy, lowest = np.linalg.eigh(mixing.T @ (trial.T @ inertial) @ mixing)
    hz = 1 / (2 * np.pi * np.sqrt(density_kg_m3 * per_energy[::-1][:count]))
    shapes = trial @ (mixing @ lowest[:, ::-1][:, :count])
    weight = np.where(hz < _WANTED_HZ, 1.0, _HIGH_WEIGHT)
    return np.asarray(weight * _of_unit_energy(shapes, middle.stiffness))


def _of_unit_energy(shapes: Array, reference: sparse.csc_array) -> Array:
    energies = np.einsum("fs,fs->s", shapes, reference @ shapes)
    return np.asarray(shapes / np.sqrt(energies))


def pod(parts: Sequence[Array], reference: sparse.csc_array, size: int) -> Array:
    """Proper orthogonal decomposition in the energy inner product.

    Parameters
    ----------
    parts : sequence of (f, s) float
        Snapshots; their energies are their weights.
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
    snapshots = np.hstack(parts)
    values, vectors = np.linalg.eigh(snapshots.T @ (reference @ snapshots))
    kept = slice(-size, None)
    if size > len(values) or values[kept][0] <= _LEAST_STEP**1.5 * values[-1]:
        raise ValueError(f"a basis of {size} coordinates needs more snapshots; lower its size")
    basis: Array = snapshots @ (vectors[:, kept] / np.sqrt(values[kept]))
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


def _trial_loads(geometry: ReedGeometry, elements: Elements) -> Array:
    """Loads (3n, t) of smooth trial pressures, whose static shapes enrich the basis."""
    x_m, y_m = elements.load_points_m.T
    orders = _TRIAL_ORDERS[max(len(part.symmetries) for part in elements.motions)]
    along = 2 * x_m / geometry.outline.length_m - 1
    across = y_m / np.maximum(half_width_m(geometry.outline, x_m), 1e-6)
    trial: Array = np.einsum(
        "qm,qn->qmn", legvander(along, orders[0] - 1), legvander(across, orders[1] - 1)
    ).reshape(len(x_m), -1)
    loads = np.zeros((3 * len(elements.mesh.nodes_m), trial.shape[1]))
    loads[2::3] = elements.faces.T @ trial
    return loads
