"""Reduced basis of a whole reed, even or not: what half a reed cannot stand for.

Of an even reed it says the same as the two halves of `basis.ReducedReed`, at two to three times
the cost. `parts_of` lets those who only solve and look treat both kinds in the same way.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

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
    lowest_modes,
    mass,
    projected_stiffness,
    stiffness,
)
from physics.reed.elements.mesh import (
    MeshLevel,
    ReedMesh,
    build_whole_mesh,
)
from physics.reed.geometry import ReedGeometry, half_width_m
from physics.reed.modes import HIGHEST_HZ
from physics.reed.reduction.basis import (
    BasisSettings,
    ReducedReed,
    flat_side,
    network,
    pod,
)

# As for the halves a third more modes than lie below 20 kHz in the middle of the box, but nine in
# ten of all snapshots: with three quarters, as the halves take, modes are up to 0.2 cent off.
_TAKEN_BEYOND = 4 / 3
_KEPT_SHARE = 0.9
_FIRST_COUNT = 26
_MOST_MODES = 200
# Orders along the reed and across its whole width of the trial pressures.
_TRIAL_ORDERS = (4, 8)


class ReedPart(Protocol):
    """Motions of a reed that are solved for by themselves, in r reduced coordinates.

    Those of one symmetry (`basis.HalfBasis`), or all of a whole reed.
    """

    @property
    def stiffness_terms(self) -> Array:
        """Stiffness (9, r, r) per unit of each independent stiffness of the cane."""
        ...

    @property
    def mass(self) -> Array:
        """Mass (r, r) per unit density."""
        ...

    @property
    def surface_z(self) -> Array:
        """Deflection (p, r) of the bark side at the nodes of the plan."""
        ...

    @property
    def load_z(self) -> Array:
        """Deflection (q, r) of the flat side at the points of a pressure, times their area."""
        ...


@dataclass(frozen=True)
class WholeReed:
    """A reed of any shape whose E_L and G_LT may take any value within the box of its basis.

    Attributes
    ----------
    geometry : ReedGeometry
    cane : Cane
        Constants other than E_L and G_LT.
    plan_m : (p, 2) float
        Nodes (x, y) of the plan, y of either sign, at which `surface_z` is given.
    load_points_m : (q, 2) float
        Where a pressure on the flat side is sampled.
    stiffness_terms : (9, r, r) float
        Stiffness per unit of each independent stiffness of the cane.
    mass : (r, r) float
        Mass per unit density.
    surface_z : (p, r) float
        Deflection u_z of the bark side.
    load_z : (q, r) float
        Deflection of the flat side at the quadrature points of a pressure, times their area.
    """

    geometry: ReedGeometry
    cane: Cane
    plan_m: Array
    load_points_m: Array
    stiffness_terms: Array
    mass: Array
    surface_z: Array
    load_z: Array


@dataclass(frozen=True)
class _Elements:
    """Finite elements of a clamped whole reed.

    Attributes
    ----------
    matrices : ReedMatrices
    free : (f,) int
        Degrees of freedom left.
    mass : (f, f) sparse
        Per unit density.
    """

    matrices: ReedMatrices
    free: NDArray[np.intp]
    mass: sparse.csc_array


def parts_of(reed: ReducedReed | WholeReed) -> Mapping[Symmetry | None, ReedPart]:
    """Parts of a reed by the symmetry of their motions; None stands for motions of any shape.

    The part of a symmetry is given over y ≥ 0, that of any shape over the whole plan.
    """
    if isinstance(reed, WholeReed):
        return {None: reed}
    return dict(reed.halves.items())


def build_whole_reed(
    geometry: ReedGeometry, level: MeshLevel, settings: BasisSettings
) -> WholeReed:
    """Compute a reduced basis of a whole reed from finite-element snapshots.

    Parameters
    ----------
    geometry : ReedGeometry
    level : MeshLevel
    settings : BasisSettings
        `modes` and `size` are those of both symmetries together.

    Raises
    ------
    ImpossibleReedError
        For an impossible geometry or material (see `build_whole_mesh`, `stiffness_terms_pa`), and
        one that has over 200 modes below 20 kHz.
    """
    mesh = build_whole_mesh(geometry, level)
    matrices = assemble(mesh)
    free = np.flatnonzero(~np.repeat(mesh.clamped, 3))
    elements = _Elements(matrices, free, mass(matrices, 1.0)[free][:, free])
    points, faces = flat_side(mesh)
    loads = np.zeros((3 * len(mesh.nodes_m), int(np.prod(_TRIAL_ORDERS))))
    loads[2::3] = faces.T @ _trial_pressures(geometry, points)
    basis = _basis(elements, loads, settings)
    return _reduced(geometry, settings.cane, mesh, elements, basis, points, faces)


def _basis(elements: _Elements, loads: Array, settings: BasisSettings) -> Array:
    """Basis (f, r) of the modes of all materials and of the shapes (3n, t) under static loads."""
    *corners, middle = network(settings)
    reference = _stiffness(elements, middle)
    solve = factor(reference)
    count = settings.modes or _modes_taken(elements, reference, solve, middle.density_kg_m3)
    shapes = lowest_modes(reference, elements.mass, count, solve)[1]
    parts = [shapes, solve(loads[elements.free])]
    for cane in corners:
        parts.append(lowest_modes(_stiffness(elements, cane), elements.mass, count)[1])
    snapshots = np.hstack(parts)
    size = settings.size or int(_KEPT_SHARE * snapshots.shape[1])
    # The middle of the box serves as the reference.
    return pod(snapshots, reference, size)


def _stiffness(elements: _Elements, cane: Cane) -> sparse.csc_array:
    everywhere = stiffness(elements.matrices, stiffness_terms_pa(cane))
    return everywhere[elements.free][:, elements.free]


def _modes_taken(
    elements: _Elements,
    reference: sparse.csc_array,
    solve: Callable[[Array], Array],
    density_kg_m3: float,
) -> int:
    """How many modes to take, given the stiffness (f, f) in the middle of the box."""
    count = _FIRST_COUNT
    while count <= _MOST_MODES:
        unit_hz = lowest_modes(reference, elements.mass, count, solve)[0]
        below = int(np.count_nonzero(unit_hz < HIGHEST_HZ * np.sqrt(density_kg_m3)))
        if below < count:
            return math.ceil(_TAKEN_BEYOND * max(below, 1))
        count *= 2
    raise ImpossibleReedError(
        f"the reed has over {_MOST_MODES // 2} modes below {HIGHEST_HZ:.0f} Hz, more than cane can "
        "have; check moduli, density and thickness"
    )


def _trial_pressures(geometry: ReedGeometry, points_m: Array) -> Array:
    """Smooth pressures (q, t) at points (q, 2), whose static shapes enrich the basis."""
    x_m, y_m = points_m.T
    along = 2 * x_m / geometry.outline.length_m - 1
    across = y_m / np.maximum(half_width_m(geometry.outline, x_m), 1e-6)
    orders_x, orders_y = _TRIAL_ORDERS
    products: Array = np.einsum(
        "qm,qn->qmn", legvander(along, orders_x - 1), legvander(across, orders_y - 1)
    )
    return products.reshape(len(points_m), -1)


def _reduced(
    geometry: ReedGeometry,
    cane: Cane,
    mesh: ReedMesh,
    elements: _Elements,
    basis: Array,
    points_m: Array,
    faces: sparse.csr_array,
) -> WholeReed:
    """Project everything on a basis (f, r)."""
    size = basis.shape[1]
    full = np.zeros((3 * len(mesh.nodes_m), size))
    full[elements.free] = basis
    shapes = full.reshape(-1, 3, size)
    vertical = shapes[:, 2]
    return WholeReed(
        geometry=geometry,
        cane=cane,
        plan_m=mesh.nodes_m.reshape(*mesh.block, 3)[:, :, -1, :2].reshape(-1, 2),
        load_points_m=points_m,
        stiffness_terms=projected_stiffness(elements.matrices, shapes),
        mass=basis.T @ (elements.mass @ basis),
        surface_z=vertical.reshape(*mesh.block, size)[:, :, -1].reshape(-1, size),
        load_z=faces @ vertical,
    )
