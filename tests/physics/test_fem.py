"""Energies of the finite elements: patch test, rigid motions, mass, eigenproblem."""

import numpy as np
import pytest
from scipy import linalg

from physics.errors import ImpossibleReedError
from physics.reed.cane.material import (
    Cane,
    stiffness_matrix_pa,
    stiffness_terms_pa,
)
from physics.reed.elements.fem import (
    Symmetry,
    assemble,
    factor,
    free_dofs,
    lowest_modes,
    mass,
    stiffness,
)
from tests.physics.canes import ODD_CANE

# Axes of a unit (engineering) strain each, in Voigt order xx, yy, zz, yz, xz, xy.
STRAINS = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)]


@pytest.fixture(scope="module")
def odd_stiffness(coarse_matrices):
    return stiffness(coarse_matrices, stiffness_terms_pa(ODD_CANE))


@pytest.fixture(scope="module")
def strained(coarse_mesh):
    """Displacements of the six unit strains, (3n, 6)."""
    fields = []
    for i, j in STRAINS:
        u = np.zeros_like(coarse_mesh.nodes_m)
        u[:, i] += 0.5 * coarse_mesh.nodes_m[:, j]
        u[:, j] += 0.5 * coarse_mesh.nodes_m[:, i]
        fields.append(u.ravel())
    return np.stack(fields, axis=1)


def rigid_motions(nodes_m):
    """Three translations and three rotations about the nodes' centre, (3n, 6)."""
    moved = [np.broadcast_to(np.eye(3)[axis], nodes_m.shape) for axis in range(3)]
    moved += [np.cross(np.eye(3)[axis], nodes_m - nodes_m.mean(axis=0)) for axis in range(3)]
    return np.stack([u.ravel() for u in moved], axis=1)


def inner_nodes(mesh):
    """Nodes on no face of the block, (n,) bool."""
    inside = np.zeros(mesh.block, dtype=bool)
    inside[1:-1, 1:-1, 1:-1] = True
    return inside.ravel()


def test_patch_energy_is_that_of_a_uniform_strain(coarse_matrices, odd_stiffness, strained):
    """On the real, curved mesh: ``u·K v = V σ(u):ε(v)`` for all six strains at once."""
    volume = coarse_matrices.mass.sum()
    energies = strained.T @ (odd_stiffness @ strained) / volume
    expected = stiffness_matrix_pa(ODD_CANE)
    np.testing.assert_allclose(energies, expected, rtol=1e-9, atol=1e-7 * expected[0, 0])


def test_patch_leaves_the_inside_in_equilibrium(coarse_mesh, odd_stiffness, strained):
    forces = (odd_stiffness @ strained).reshape(-1, 3, 6)
    inside = inner_nodes(coarse_mesh)
    assert inside.sum() > 100
    assert np.abs(forces[inside]).max() < 1e-9 * np.abs(forces).max()


def test_rigid_motions_cost_nothing(coarse_mesh, odd_stiffness):
    rigid = rigid_motions(coarse_mesh.nodes_m)
    scale = abs(odd_stiffness).sum(axis=1).max() * np.abs(rigid).max(axis=0)
    assert np.all(np.abs(odd_stiffness @ rigid).max(axis=0) < 1e-10 * scale)


def test_a_free_body_has_six_rigid_motions_over_both_symmetries(box_mesh):
    mesh = box_mesh((12e-3, 4e-3, 3e-3), (2, 1, 1), (2, 2, 2))
    matrices = assemble(mesh)
    K = stiffness(matrices, stiffness_terms_pa(ODD_CANE)).toarray()
    M = mass(matrices, 520.0).toarray()
    for symmetry in Symmetry:
        free = free_dofs(mesh, symmetry)
        pick = np.ix_(free, free)
        eigenvalues = linalg.eigh(K[pick], M[pick], eigvals_only=True)
        assert np.count_nonzero(np.abs(eigenvalues) < 1e-8 * eigenvalues[3]) == 3
        assert eigenvalues[3] > 0


def test_translations_carry_the_mass_of_the_reed(coarse_mesh, coarse_matrices):
    M = mass(coarse_matrices, 520.0)
    translations = rigid_motions(coarse_mesh.nodes_m)[:, :3]
    half_reed_kg = 520.0 * 1653.2e-9 / 2
    np.testing.assert_allclose(
        translations.T @ (M @ translations), half_reed_kg * np.eye(3), rtol=1e-4, atol=1e-12
    )


def test_rotations_carry_the_moments_of_inertia_of_a_box(box_mesh):
    lengths = np.array([5e-3, 3e-3, 2e-3])
    mesh = box_mesh(lengths, (2, 1, 1), (2, 3, 2))
    M = mass(assemble(mesh), 700.0)
    rotations = rigid_motions(mesh.nodes_m)[:, 3:]
    body_kg = 700.0 * np.prod(lengths)
    inertia = body_kg / 12 * (np.sum(lengths**2) - lengths**2)
    # Node coordinates are symmetric about the box's centre, so the motions are too.
    np.testing.assert_allclose(
        rotations.T @ (M @ rotations), np.diag(inertia), rtol=1e-9, atol=1e-20
    )


def test_stiffness_is_symmetric_and_positive(coarse_mesh, coarse_matrices, odd_stiffness):
    assert abs(odd_stiffness - odd_stiffness.T).max() < 1e-12 * abs(odd_stiffness).max()
    for symmetry in Symmetry:
        free = free_dofs(coarse_mesh, symmetry)
        # Cholesky fails unless every motion costs energy.
        np.linalg.cholesky(odd_stiffness[free][:, free].toarray())
    M = coarse_matrices.mass
    assert abs(M - M.T).max() < 1e-15 * abs(M).max()


def test_stiffness_is_linear_in_its_terms(coarse_matrices):
    terms = np.random.default_rng(3).uniform(1e8, 1e10, (2, 9))
    both = stiffness(coarse_matrices, terms[0] + 3 * terms[1])
    parts = stiffness(coarse_matrices, terms[0]) + 3 * stiffness(coarse_matrices, terms[1])
    assert abs(both - parts).max() < 1e-12 * abs(both).max()


def test_symmetries_hold_what_their_motions_cannot_move(coarse_mesh):
    """Together they hold each component on y = 0 once, and the clamped nodes twice."""
    held = np.zeros((2, *coarse_mesh.nodes_m.shape), dtype=bool)
    for k, symmetry in enumerate((Symmetry.SYMMETRIC, Symmetry.ANTISYMMETRIC)):
        held[k].ravel()[...] = True
        held[k].ravel()[free_dofs(coarse_mesh, symmetry)] = False
    on_axis = coarse_mesh.midplane & ~coarse_mesh.clamped
    np.testing.assert_array_equal(held[0, on_axis], [[False, True, False]] * on_axis.sum())
    np.testing.assert_array_equal(held[1, on_axis], [[True, False, True]] * on_axis.sum())
    assert held[:, coarse_mesh.clamped].all()
    elsewhere = ~coarse_mesh.midplane & ~coarse_mesh.clamped
    assert not held[:, elsewhere].any()


def test_lowest_modes_solve_the_eigenproblem(coarse_mesh, coarse_matrices):
    free = free_dofs(coarse_mesh, Symmetry.ANTISYMMETRIC)
    K = stiffness(coarse_matrices, stiffness_terms_pa(Cane()))[free][:, free]
    M = mass(coarse_matrices, 520.0)[free][:, free]
    frequencies, shapes = lowest_modes(K, M, 6)
    np.testing.assert_allclose(shapes.T @ (M @ shapes), np.eye(6), atol=1e-9)
    residual = K @ shapes - M @ shapes * (2 * np.pi * frequencies) ** 2
    assert np.abs(residual).max() < 1e-7 * np.abs(K @ shapes).max()


def test_lowest_modes_are_the_lowest(box_mesh):
    mesh = box_mesh((12e-3, 4e-3, 3e-3), (2, 1, 1), (2, 2, 2), lambda x, _y, _z: x == 0)
    matrices = assemble(mesh)
    for symmetry in Symmetry:
        free = free_dofs(mesh, symmetry)
        K = stiffness(matrices, stiffness_terms_pa(ODD_CANE))[free][:, free]
        M = mass(matrices, 520.0)[free][:, free]
        every = np.sqrt(linalg.eigh(K.toarray(), M.toarray(), eigvals_only=True)) / (2 * np.pi)
        np.testing.assert_allclose(lowest_modes(K, M, 5)[0], every[:5], rtol=1e-8)


def test_the_same_reed_gives_the_same_bits(coarse_mesh, coarse_matrices):
    free = free_dofs(coarse_mesh, Symmetry.SYMMETRIC)
    K = stiffness(coarse_matrices, stiffness_terms_pa(Cane()))[free][:, free]
    M = mass(coarse_matrices, 520.0)[free][:, free]
    np.testing.assert_array_equal(lowest_modes(K, M, 4)[1], lowest_modes(K, M, 4)[1])


def test_factor_solves(coarse_mesh, coarse_matrices):
    free = free_dofs(coarse_mesh, Symmetry.SYMMETRIC)
    K = stiffness(coarse_matrices, stiffness_terms_pa(Cane()))[free][:, free]
    load = np.random.default_rng(4).standard_normal(K.shape[0])
    residual = K @ factor(K)(load) - load
    assert np.abs(residual).max() < 1e-6 * np.abs(load).max()


def test_an_element_turned_inside_out_is_refused(box_mesh):
    mesh = box_mesh((1e-3, 1e-3, 1e-3), (1, 1, 1), (2, 2, 2))
    mesh.nodes_m[:, 2] *= -1
    with pytest.raises(ImpossibleReedError, match="inside out"):
        assemble(mesh)
