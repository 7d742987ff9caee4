"""The reduced basis against the finite elements that it stands for."""

from dataclasses import replace

import numpy as np
import pytest

from physics.errors import ImpossibleReedError
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.fem import (
    Symmetry,
    assemble,
    factor,
    free_dofs,
    lowest_modes,
    mass,
    stiffness,
)
from physics.reed.elements.mesh import MeshLevel, build_mesh
from physics.reed.geometry import (
    Outline,
    ReedGeometry,
    half_width_m,
)
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.build import build_reduced_reed
from physics.reed.reduced.elastic import elastic_modes, named_modes, reduced_modes
from physics.reed.reduced.reed import BasisSettings, ReedBox
from protocols.reed import ReedFile

BOTH = list(Symmetry)
# As few elements as a reed can have.
TINY = MeshLevel(orders=(2, 2, 2), vamp_element_m=14e-3, heel_element_m=23e-3, z_breaks=(0.0, 1.0))


def random_canes(count, seed, **spread):
    """Materials with E_L and G_LT drawn from the box of the basis, others scaled by a factor."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        others = {
            name: getattr(Cane(), name) * rng.uniform(1 / factor, factor)
            for name, factor in spread.items()
        }
        yield replace(
            Cane(), E_L_pa=rng.uniform(7e9, 21e9), G_LT_pa=rng.uniform(0.45e9, 2e9), **others
        )


def full_hz(matrices, mesh, cane, symmetry, count):
    free = free_dofs(mesh, symmetry)
    K = stiffness(matrices, stiffness_terms_pa(cane))[free][:, free]
    M = mass(matrices, cane.density_kg_m3)[free][:, free]
    return np.sort(lowest_modes(K, M, count)[0])


def reduced_hz(reed, cane, symmetry, count):
    terms = stiffness_terms_pa(cane)
    return reduced_modes(reed.parts[symmetry], terms, cane.density_kg_m3)[0][:count]


@pytest.mark.parametrize("symmetry", BOTH)
def test_reduced_frequencies_lie_less_than_a_third_of_a_cent_above_the_full_ones(
    symmetry, coarse_reed, coarse_mesh, coarse_matrices
):
    for cane in random_canes(4, seed=5):
        full = full_hz(coarse_matrices, coarse_mesh, cane, symmetry, 9)
        excess = 1200 * np.log2(reduced_hz(coarse_reed, cane, symmetry, 9) / full)
        audible = full < 20e3
        assert audible.sum() >= 6
        assert excess[audible].max() < 0.3
        # Rayleigh and Ritz: a subspace bounds every eigenvalue from above.
        assert excess.min() > -1e-4


@pytest.mark.parametrize("symmetry", BOTH)
def test_every_stiffness_is_projected(symmetry, coarse_reed, coarse_mesh, coarse_matrices):
    """The other seven constants changed too: still an upper bound, and not a wild one."""
    spread = dict.fromkeys(
        ("E_T_pa", "E_R_pa", "G_LR_pa", "G_TR_pa", "nu_LT", "nu_LR", "nu_TR"), 1.5
    )
    for cane in random_canes(2, seed=6, **spread):
        full = full_hz(coarse_matrices, coarse_mesh, cane, symmetry, 6)
        excess = 1200 * np.log2(reduced_hz(coarse_reed, cane, symmetry, 6) / full)
        assert excess.min() > -1e-4
        assert excess.max() < 15


@pytest.mark.parametrize("symmetry", BOTH)
def test_projections_are_symmetric_and_positive(symmetry, coarse_reed):
    half = coarse_reed.parts[symmetry]
    K = np.tensordot(stiffness_terms_pa(Cane()), half.stiffness_terms, axes=1)
    for matrix in (K, half.mass):
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
        np.linalg.cholesky(matrix)
    # Normal stiffnesses and shears each store energy of their own; the couplings need not.
    for term in (0, 1, 2, 6, 7, 8):
        eigenvalues = np.linalg.eigvalsh(half.stiffness_terms[term])
        assert eigenvalues[0] > -1e-9 * eigenvalues[-1]


def test_partial_masses_are_shares_of_the_kinetic_energy(standard_reed):
    """Of a mode of unit mass: none of the vamp's is lateral, L1 bends sideways, H1 in the heel."""
    shares = {}
    for name, mode in elastic_modes(standard_reed, 14e9, 1.1e9).items():
        half = standard_reed.parts[mode.symmetry].measures[mode.symmetry]
        v = mode.coordinates
        shares[name] = [520.0 * v @ part @ v for part in (half.lateral_mass, half.heel_mass)]
    every = np.array(list(shares.values()))
    assert every.min() >= 0
    assert every.sum(axis=1).max() < 1
    assert max(sum(shares[name]) for name in PAPER_MODES) < 0.3
    lateral, heel = shares["L1"]
    assert lateral > 0.6
    assert lateral + heel < 0.95
    lateral, heel = shares["H1"]
    # Nearly all of it, and it moves along z (a share of 0.97 by another finite-element program).
    assert 0.9 < heel < 0.98
    assert lateral < 0.03


def test_modes_are_orthogonal(coarse_reed):
    terms = stiffness_terms_pa(Cane())
    for half in coarse_reed.parts.values():
        frequencies, shapes = reduced_modes(half, terms, 520.0)
        K = np.tensordot(terms, half.stiffness_terms, axes=1)
        identity = np.eye(len(frequencies))
        np.testing.assert_allclose(shapes.T @ (520.0 * half.mass) @ shapes, identity, atol=1e-8)
        omega2 = (2 * np.pi * frequencies) ** 2
        np.testing.assert_allclose(shapes.T @ K @ shapes / omega2, identity, atol=1e-7)
        assert np.all(np.diff(frequencies) >= 0)


def bark_side(mesh, displacement):
    """Deflection u_z at the nodes of the bark side, (p,)."""
    return displacement[2::3].reshape(mesh.block)[:, :, -1].ravel()


@pytest.mark.parametrize("symmetry", BOTH)
def test_static_deflection_under_a_pressure_is_that_of_the_full_model(
    symmetry, standard_reed, standard_mesh, standard_matrices, consistent_load
):
    """A pressure that is none of the trial shapes, integrated over the flat side by quadrature.

    How exactly the reduced reed integrates pressure is measured in ``test_response.py``.
    """

    def pressure(x_m, y_m):
        return np.exp(-(((x_m - 8e-3) / 6e-3) ** 2)) * (1 + 0.4 * y_m / 5e-3)

    free = free_dofs(standard_mesh, symmetry)
    load = np.zeros(3 * len(standard_mesh.nodes_m))
    load[2::3] = consistent_load(standard_mesh, pressure).real
    cane = Cane(E_L_pa=11e9, G_LT_pa=0.8e9)
    K = stiffness(standard_matrices, stiffness_terms_pa(cane))[free][:, free]
    full = np.zeros_like(load)
    full[free] = factor(K)(load[free])
    expected = full[2::3].reshape(standard_mesh.block)[:, :, -1].ravel()
    half = standard_reed.parts[symmetry]
    K = np.tensordot(stiffness_terms_pa(cane), half.stiffness_terms, axes=1)
    coordinates = np.linalg.solve(K, pressure(*standard_reed.load_points_m.T) @ half.load_z)
    error = np.abs(half.surface_z @ coordinates - expected).max()
    assert error < 0.02 * np.abs(expected).max()


def test_a_uniform_pressure_pushes_with_the_area_of_the_flat_side(coarse_mesh, consistent_load):
    """The yardstick of the tests of loads itself."""
    x = np.linspace(0, 67.5e-3, 20001)
    area = np.trapezoid(half_width_m(Outline(), x), x)
    pushed = consistent_load(coarse_mesh, lambda x_m, _y: np.ones_like(x_m)).sum()
    assert pushed == pytest.approx(area, rel=2e-4)


def test_a_larger_basis_is_never_worse(geometry, coarse_level, coarse_reed):
    poor = build_reduced_reed(
        geometry,
        coarse_level,
        BasisSettings(
            ReedBox(E_L_pa=(14e9, 14e9), G_LT_pa=(1.1e9, 1.1e9)), modes=10, size=14, snapshots=0
        ),
    )
    cane = Cane(E_L_pa=9e9, G_LT_pa=1.6e9)
    for symmetry in Symmetry:
        rich_hz = reduced_hz(coarse_reed, cane, symmetry, 8)
        poor_hz = reduced_hz(poor, cane, symmetry, 8)
        assert np.all(poor_hz > rich_hz * (1 - 1e-6))
        assert np.any(poor_hz > rich_hz * 1.001)


def test_a_clarinets_reed_has_84_coordinates_and_11_modes_with_names(coarse_reed):
    for half in coarse_reed.parts.values():
        assert half.mass.shape == (84, 84)
    assert [np.count_nonzero(half.middle_hz < 20e3) for half in coarse_reed.parts.values()] == [
        9,
        8,
    ]
    assert named_modes(coarse_reed) == 11


def test_the_middle_of_the_box_has_the_geometric_means_of_the_moduli(coarse_reed):
    cane = Cane(E_L_pa=np.sqrt(7e9 * 22e9), G_LT_pa=np.sqrt(0.4e9 * 2.1e9))
    for half in coarse_reed.parts.values():
        expected, _ = reduced_modes(half, stiffness_terms_pa(cane), cane.density_kg_m3)
        # Rounding in a span whose shapes differ by many powers of ten in stiffness.
        np.testing.assert_allclose(half.middle_hz, expected, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["alto-saxophone", "bass-clarinet"])
def test_larger_reeds_have_all_their_modes_below_20_khz(name, coarse_level):
    """Named, even in the softest cane, and as exactly as a clarinet's."""
    geometry = ReedFile.from_file(name).geometry()
    reed = build_reduced_reed(geometry, coarse_level, BasisSettings())
    mesh = build_mesh(geometry, coarse_level)
    matrices = assemble(mesh)
    for cane in (Cane(E_L_pa=7e9, G_LT_pa=0.45e9), *random_canes(1, seed=9)):
        for symmetry in Symmetry:
            full = full_hz(matrices, mesh, cane, symmetry, 18)
            excess = 1200 * np.log2(reduced_hz(reed, cane, symmetry, 18) / full)
            audible = full < 20e3
            assert excess[audible].max() < 0.3
            assert audible.sum() <= named_modes(reed) < 18
    assert named_modes(reed) > 11


@pytest.mark.slow
def test_numbers_that_are_given_are_kept(geometry):
    def sizes(**settings):
        reed = build_reduced_reed(geometry, TINY, BasisSettings(**settings))
        return [half.mass.shape[0] for half in reed.parts.values()]

    assert sizes(modes=5, size=12) == [12, 12]
    assert sizes(modes=6) == [42, 42]
    default, same = sizes()
    assert default == same
    assert default > 42
    assert sizes(size=20) == [20, 20]


def test_an_impossible_reed_is_refused(coarse_level):
    with pytest.raises(ImpossibleReedError, match="thickness"):
        build_reduced_reed(ReedGeometry(thickness_offset_m=-90e-6), coarse_level, BasisSettings())
    with pytest.raises(ImpossibleReedError, match="Poisson"):
        build_reduced_reed(
            ReedGeometry(), coarse_level, BasisSettings(ReedBox(cane=Cane(nu_TR=1.2)))
        )
    jelly = BasisSettings(ReedBox(cane=Cane(density_kg_m3=520e4)))
    with pytest.raises(ImpossibleReedError, match="over 100 modes below 20000 Hz"):
        build_reduced_reed(ReedGeometry(), TINY, jelly)


def test_a_reed_without_modes_below_20_khz_has_a_basis_all_the_same(geometry):
    light = BasisSettings(ReedBox(cane=Cane(density_kg_m3=1.0)))
    reed = build_reduced_reed(geometry, TINY, light)
    assert min(half.middle_hz[0] for half in reed.parts.values()) > 20e3
    assert {"F1", "T1"} <= set(elastic_modes(reed, 14e9, 1.1e9, air_fraction=0.0))
