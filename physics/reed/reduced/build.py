"""Compute a `ReducedReed` by finite elements."""

from dataclasses import replace

import numpy as np
from scipy import linalg

from holography.arrays import Array
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.fem import Symmetry, factor
from physics.reed.elements.integrals import integrals
from physics.reed.elements.mesh import MeshLevel, ReedMesh
from physics.reed.geometry import ReedGeometry
from physics.reed.mode_classification import vamp_profiles
from physics.reed.radiation import air_load
from physics.reed.reduced.boundary import (
    bark_fields,
    bark_side,
    moved_edge,
    strip_displacements,
    strip_products_m2,
)
from physics.reed.reduced.reed import (
    BasisSettings,
    FrontEdge,
    ReducedReed,
    ReedPart,
    ShapeMeasures,
)
from physics.reed.reduced.snapshots import (
    Elements,
    Motions,
    Progress,
    elements_of,
    spanning_shapes,
)

# Takes the displacement of a point to that of its mirror image.
_REFLECTION = np.array([1.0, -1.0, 1.0])
# Fraction of the work that the snapshots are, and after the parts.
_SNAPSHOTS_DONE, _PARTS_DONE = 0.8, 0.9
# Step of the front edge in m. Chosen: a hundredth of the shortest element next to it, so that
# differences are exact to 1e-4.
_EDGE_STEP_M = 2e-6


def build_reduced_reed(
    geometry: ReedGeometry,
    level: MeshLevel,
    settings: BasisSettings,
    progress: Progress = lambda _: None,
) -> ReducedReed:
    """Compute a reduced reed from finite-element snapshots.

    Parameters
    ----------
    geometry : ReedGeometry
    level : MeshLevel
    settings : BasisSettings
    progress : callable, optional
        Called, in this thread, with the fraction of the work that is done.

    Raises
    ------
    ImpossibleReedError
        For an impossible geometry or material (see `build_whole_mesh`, `stiffness_terms_pa`), and
        a reed that has over 100 modes of a symmetry below 20 kHz.
    """
    elements = elements_of(geometry, level)
    spans = spanning_shapes(
        geometry, elements, settings, lambda share: progress(_SNAPSHOTS_DONE * share)
    )
    middle = settings.box.middle
    whole = len(elements.motions) == 1
    shapes, parts = [], []
    for motions, span in zip(elements.motions, spans, strict=True):
        own, part = _part(geometry, elements, motions, span, middle)
        shapes.append(own)
        parts.append(part)
    progress(_PARTS_DONE)
    bark = bark_side(elements.mesh)
    reed = ReducedReed(
        geometry=geometry,
        box=settings.box,
        plan_m=_plan_m(elements.mesh).reshape(-1, 2),
        load_points_m=elements.load_points_m,
        bark_m=bark.points_m,
        area_m2=bark.area_m2,
        strip_m2=(2 if whole else 1) * strip_products_m2(geometry.clamp),
        loose={
            None if whole else motions.symmetries[0]: part
            for motions, part in zip(elements.motions, parts, strict=True)
        },
        edge=_front_edge(geometry, elements.mesh, shapes),
    )
    reed = replace(reed, air=air_load(reed))
    progress(1.0)
    return reed


def _at_nodes(mesh: ReedMesh, motions: Motions, span: Array) -> Array:
    """Displacements (n, 3, r) at all nodes of shapes (f, r)."""
    everywhere = np.zeros((mesh.nodes_m.size, span.shape[1]))
    everywhere[motions.free] = span
    return everywhere.reshape(len(mesh.nodes_m), 3, -1)


def _plan_m(mesh: ReedMesh) -> Array:
    """Plan coordinates (nx, ny, 2) of the columns of nodes."""
    return np.asarray(mesh.nodes_m.reshape(*mesh.block, 3)[:, :, -1, :2])


def _part(
    geometry: ReedGeometry, elements: Elements, motions: Motions, span: Array, middle: Cane
) -> tuple[Array, ReedPart]:
    """Shapes (n, 3, s) of a part's coordinates, and the part: everything projected on them."""
    mesh = elements.mesh
    held = span.shape[1]
    lifts = _lifts(geometry, elements, motions, middle)
    shapes = np.concatenate([_at_nodes(mesh, motions, span), lifts], axis=2)
    stiffness_terms, unit_mass = integrals(mesh, shapes)
    K = np.tensordot(stiffness_terms_pa(middle), stiffness_terms, axes=1)[:held, :held]
    eigenvalues, modes = linalg.eigh(K, unit_mass[:held, :held])
    turn = linalg.block_diag(modes, np.eye(lifts.shape[2]))
    shapes = shapes @ turn
    size, vertical = shapes.shape[2], shapes[:, 2]
    strain, motion = bark_fields(mesh, shapes)
    return shapes, ReedPart(
        held=held,
        middle_hz=np.sqrt(eigenvalues / middle.density_kg_m3) / (2 * np.pi),
        stiffness_terms=turn.T @ stiffness_terms @ turn,
        mass=turn.T @ unit_mass @ turn,
        surface_z=vertical.reshape(*mesh.block, size)[:, :, -1].reshape(-1, size),
        load_z=elements.faces @ vertical,
        strain=strain,
        motion=motion,
        measures={
            symmetry: _measures(geometry, elements, own)
            for symmetry, own in _by_symmetry(mesh, motions, shapes).items()
        },
    )


def _lifts(geometry: ReedGeometry, elements: Elements, motions: Motions, middle: Cane) -> Array:
    """Shapes (n, 3, m) at rest of a reed whose strips are moved."""
    mesh, free = elements.mesh, motions.free
    x, y, _ = mesh.nodes_m[mesh.clamped].T
    moved = [strip_displacements(geometry.clamp, x, y, symmetry) for symmetry in motions.symmetries]
    lifts = np.zeros((len(mesh.nodes_m), 3, sum(own.shape[2] for own in moved)))
    lifts[mesh.clamped] = np.concatenate(moved, axis=2)
    flat = lifts.reshape(-1, lifts.shape[2])
    K = elements.stiffness(middle)[free]
    flat[free] = -factor(K[:, free].tocsc())(K @ flat)
    return lifts


def _by_symmetry(mesh: ReedMesh, motions: Motions, shapes: Array) -> dict[Symmetry, Array]:
    """Split motions (n, 3, s) by symmetry; those of half a reed have one already."""
    if len(motions.symmetries) == 1:
        return {motions.symmetries[0]: shapes}
    columns = shapes.reshape(*mesh.block, *shapes.shape[1:])
    mirrored = columns[:, ::-1].reshape(shapes.shape) * _REFLECTION[:, None]
    return {
        Symmetry.SYMMETRIC: 0.5 * (shapes + mirrored),
        Symmetry.ANTISYMMETRIC: 0.5 * (shapes - mirrored),
    }


def _measures(geometry: ReedGeometry, elements: Elements, shapes: Array) -> ShapeMeasures:
    mesh, node_mass = elements.mesh, elements.matrices.mass

    def product(left: Array, right: Array) -> Array:
        return np.asarray(left.T @ (node_mass @ right))

    lateral, vertical = shapes[:, 1], shapes[:, 2]
    heel = vertical * (mesh.nodes_m[:, :1] > geometry.vamp_x_m[-1])
    plan_m = _plan_m(mesh)
    # One side stands for both.
    side = plan_m[0, :, 1] >= 0
    bark = vertical.reshape(*mesh.block, -1)[:, side, -1]
    profiles, vamp = vamp_profiles(plan_m[:, side], bark, geometry.vamp_x_m[-1])
    return ShapeMeasures(
        mass=np.sum([product(shapes[:, k], shapes[:, k]) for k in range(3)], axis=0),
        lateral_mass=product(lateral, lateral),
        heel_mass=product(heel, heel),
        profiles=profiles,
        vamp_square=vamp.T @ vamp,
    )


def _front_edge(geometry: ReedGeometry, mesh: ReedMesh, shapes: list[Array]) -> FrontEdge:
    """Derivatives by central differences of a mesh whose nodes go along with the edge.

    What the shapes are at the nodes stays: to first order that is the reed computed again.
    """
    everything = np.concatenate(shapes, axis=2)
    owner = np.repeat(np.arange(len(shapes)), [own.shape[2] for own in shapes])
    coupled = owner[:, None] != owner
    stiffness_terms, masses = [], []
    for tilted in (False, True):
        ahead, behind = (
            integrals(
                replace(mesh, nodes_m=moved_edge(geometry, mesh, step_m, tilted=tilted)), everything
            )
            for step_m in (_EDGE_STEP_M, -_EDGE_STEP_M)
        )
        terms, unit_mass = (
            (one - other) / (2 * _EDGE_STEP_M) for one, other in zip(ahead, behind, strict=True)
        )
        if len(shapes) > 1:
            # An odd change couples only motions of different symmetry, an even one only equal ones.
            kept = coupled if tilted else ~coupled
            terms, unit_mass = terms * kept, unit_mass * kept
        stiffness_terms.append(terms)
        masses.append(unit_mass)
    return FrontEdge(np.stack(stiffness_terms), np.stack(masses))
