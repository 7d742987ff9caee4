"""Quadratic tetrahedra against analytic integrals, hexahedra on the same nodes, and a beam."""

from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from physics.errors import ImpossibleReedError
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.fem import (
    Symmetry,
    assemble,
    free_dofs,
    lowest_modes,
    mass,
    stiffness,
)
from physics.reed.elements.tetrahedra import (
    PLAIN,
    assemble_tetrahedra,
    lattice,
    split,
    tetrahedral_reed,
)
from physics.reed.geometry import (
    Clamp,
    ClampSide,
    half_width_m,
    thickness_m,
)
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.modes import reed_modes
from physics.reed.reduction.sensitivity import MODULI, rayleigh_sensitivities

LENGTHS_M = (3.0, 2.0, 1.0)
ISOTROPIC = Cane(1e9, 1e9, 1e9, 0.5e9, 0.5e9, 0.5e9, 0.0, 0.0, 0.0, 1000.0)


@pytest.fixture(scope="module")
def box(box_mesh):
    return box_mesh(LENGTHS_M, (3, 2, 1), (2, 2, 2))


@pytest.fixture(scope="module")
def bent_box(box):
    """The same nodes moved by a polynomial of degree 2, so that edges are curved."""
    x, y, z = box.nodes_m.T
    moved = np.stack([x + 0.03 * y**2, y + 0.02 * x * z, z + 0.04 * x**2], axis=1)
    return replace(box, nodes_m=moved)


@pytest.fixture(scope="module")
def named(geometry):
    return reed_modes(geometry, Cane(), PLAIN, 22.5e3)


@pytest.fixture(scope="module")
def reeds(geometry, named):
    return [tetrahedral_reed(geometry, Cane(), named, size_m) for size_m in (2e-3, 1.4e-3)]


def test_six_tetrahedra_fill_a_hexahedron(box):
    elements = split(box.elements)
    corners = box.nodes_m[elements[:, :4]]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert len(elements) == 6 * len(box.elements)
    np.testing.assert_allclose(volumes, np.prod(LENGTHS_M) / len(elements))
    assert np.array_equal(np.unique(elements), np.arange(len(box.nodes_m)))


def test_neighbours_meet_face_to_face(box):
    faces = Counter(
        tuple(sorted(face)) for corners in split(box.elements)[:, :4].tolist()
        for face in combinations(corners, 3)
    )  # fmt: skip
    assert set(faces.values()) == {1, 2}
    # Two triangles to each of the 22 faces of hexahedra on the boundary.
    assert Counter(faces.values())[1] == 2 * 22


def test_other_nodes_are_midpoints_of_edges(box):
    elements = split(box.elements)
    pairs = np.array(list(combinations(range(4), 2)))
    middles = box.nodes_m[elements[:, pairs]].mean(axis=2)
    np.testing.assert_allclose(box.nodes_m[elements[:, 4:]], middles, atol=1e-14)


def test_integrals_of_quadratic_fields_are_exact(box):
    """∫ ∂_i u ∂_j v and ∫ u v, against Gauss's rule of high order on the box."""
    matrices = assemble_tetrahedra(box.nodes_m, split(box.elements))
    points, weights = np.polynomial.legendre.leggauss(6)
    axes = [0.5 * length * (1 + points) for length in LENGTHS_M]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    weight = np.einsum("a,b,c->abc", *[0.5 * length * weights for length in LENGTHS_M])

    def u(x, y, z):
        return 1 + x**2 + 2 * x * y - y * z

    def v(x, y, z):
        return z**2 - 3 * x * z + y

    slopes_u = {"x": 2 * x + 2 * y, "y": 2 * x - z, "z": -y}
    slopes_v = {"x": -3 * z, "y": np.ones_like(x), "z": 2 * z - 3 * x}
    at_nodes = u(*box.nodes_m.T), v(*box.nodes_m.T)
    for pair, matrix in matrices.gradients.items():
        expected = np.sum(weight * slopes_u[pair[0]] * slopes_v[pair[1]])
        assert at_nodes[0] @ matrix @ at_nodes[1] == pytest.approx(expected, rel=1e-12), pair
    expected = np.sum(weight * u(x, y, z) * v(x, y, z))
    assert at_nodes[0] @ matrices.mass @ at_nodes[1] == pytest.approx(expected, rel=1e-12)


def test_linear_fields_on_curved_elements_are_those_of_hexahedra(bent_box):
    ours = assemble_tetrahedra(bent_box.nodes_m, split(bent_box.elements))
    theirs = assemble(bent_box)
    fields = np.column_stack([np.ones(len(bent_box.nodes_m)), bent_box.nodes_m])
    for pair in ("xx", "xy", "yx", "zz"):
        np.testing.assert_allclose(
            fields.T @ ours.gradients[pair] @ fields,
            fields.T @ theirs.gradients[pair] @ fields,
            rtol=1e-4, atol=1e-9,
        )  # fmt: skip


def test_elements_turned_inside_out_are_refused(box):
    elements = split(box.elements)[:, [0, 2, 1, 3, 5, 4, 6, 7, 8, 9]]
    with pytest.raises(ImpossibleReedError, match="inside out"):
        assemble_tetrahedra(box.nodes_m, elements)


def test_a_cantilever_has_the_frequency_of_euler_and_bernoulli(box_mesh):
    length_m, height_m = 40.0, 1.0
    mesh = box_mesh((length_m, 1.0, height_m), (24, 1, 1), (2, 2, 2), lambda x, y, z: x == 0)
    matrices = assemble_tetrahedra(mesh.nodes_m, split(mesh.elements))
    free = free_dofs(mesh, Symmetry.SYMMETRIC)
    K = stiffness(matrices, stiffness_terms_pa(ISOTROPIC))[free][:, free]
    M = mass(matrices, ISOTROPIC.density_kg_m3)[free][:, free]
    speed_m_s = np.sqrt(ISOTROPIC.E_L_pa / ISOTROPIC.density_kg_m3)
    expected_hz = 1.8751**2 / (2 * np.pi) * speed_m_s * height_m / np.sqrt(12) / length_m**2
    assert lowest_modes(K, M, 2)[0].min() == pytest.approx(expected_hz, rel=3e-3)


@pytest.mark.parametrize(("size_m", "tip_size_m"), [(2e-3, None), (3e-3, 1e-3)])
def test_elements_are_as_small_as_asked(geometry, size_m, tip_size_m):
    divided = lattice(geometry, size_m, tip_size_m=tip_size_m).mesh
    plan = divided.nodes_m.reshape(*divided.block, 3)[::2, ::2, -1, :2]
    along = np.linalg.norm(np.diff(plan, axis=0), axis=-1)
    across = np.linalg.norm(np.diff(plan, axis=1), axis=-1)
    at_tip = plan[:-1, 0, 0] < 6e-3
    tip_m = tip_size_m or size_m
    # Curved edges of the parent are measured along the curve: a few per cent longer than its parts.
    assert along[at_tip].max() <= 1.03 * tip_m
    assert along[~at_tip].max() <= 1.03 * size_m
    assert across.max() <= 1.03 * tip_m
    assert along.max() > 0.6 * size_m


def test_the_lattice_has_the_reeds_shape(geometry):
    mesh = lattice(geometry, 1.6e-3).mesh
    x, y = mesh.nodes_m.T[:2]
    bark = mesh.nodes_m.reshape(*mesh.block, 3)[:, :, -1].reshape(-1, 3)
    np.testing.assert_allclose(
        bark[:, 2], thickness_m(geometry, bark[:, 0], bark[:, 1]), atol=1e-12
    )
    width_m = half_width_m(geometry.outline, x)
    # Between nodes of the parent its edge is a polynomial, some micrometres from the arc.
    assert np.max(y - width_m) < 1e-5
    assert np.array_equal(mesh.midplane, y < 1e-9)
    matrices = assemble_tetrahedra(mesh.nodes_m, split(mesh.elements))
    assert 2e9 * matrices.mass.sum() == pytest.approx(1653.2, abs=0.2)


@pytest.mark.parametrize("side", list(ClampSide))
def test_the_strip_holds_the_same_rectangle(geometry, side):
    held = replace(geometry, clamp=Clamp(side=side))
    mesh = lattice(held, 2e-3).mesh
    x, y, z = mesh.nodes_m.T
    (x0, x1), (y0, y1) = held.clamp.x_m, held.clamp.y_m
    inside = (x > x0 - 1e-9) & (x < x1 + 1e-9) & (y > y0 - 1e-9) & (y < y1 + 1e-9)
    bark, flat = np.isclose(z, thickness_m(held, x, y), atol=1e-12), z == 0
    faces = {ClampSide.BARK: bark, ClampSide.FLAT: flat, ClampSide.BOTH: bark | flat}[side]
    assert np.array_equal(mesh.clamped, inside & faces)


def test_values_are_carried_to_the_nodes(geometry):
    divided = lattice(geometry, 2e-3)
    parent = divided.parent.nodes_m
    field = np.stack([parent[:, 0], parent[:, 1], np.ones(len(parent))], axis=1)
    expected = np.stack([*divided.mesh.nodes_m.T[:2], np.ones(len(divided.mesh.nodes_m))], axis=1)
    np.testing.assert_allclose(divided.carried(field), expected, atol=1e-12)


@pytest.mark.parametrize("sizes", [(0.0, None), (-1e-3, None), (2e-3, 0.0)])
def test_impossible_sizes_are_refused(geometry, sizes):
    with pytest.raises(ValueError, match="give positive sizes"):
        lattice(geometry, sizes[0], tip_size_m=sizes[1])


def test_tetrahedra_bear_the_names_of_what_they_are_like(reeds):
    for reed in reeds:
        similarity = {mode.name: mode.similarity for mode in reed.modes}
        assert set(PAPER_MODES) <= set(similarity)
        assert min(similarity[name] for name in PAPER_MODES) > 0.9
        frequencies = [mode.frequency_hz for mode in reed.modes]
        assert frequencies == sorted(frequencies)
        symmetric = {mode.name for mode in reed.modes if mode.symmetry is Symmetry.SYMMETRIC}
        assert {"F1", "F2", "F3", "F4", "T2", "T4", "X2"} <= symmetric
        assert {"T1", "T3", "X1", "X3", "L1"}.isdisjoint(symmetric)


def test_smaller_tetrahedra_are_softer_and_all_are_stiff(reeds, named):
    """T3 and T4 of the paper, 9532 and 14149 Hz, lie between those of 2 mm and the limit."""
    coarse, fine = ({mode.name: mode.frequency_hz for mode in reed.modes} for reed in reeds)
    limit = {mode.name: mode.frequency_hz for mode in named}
    for name in PAPER_MODES:
        assert coarse[name] > fine[name] > limit[name], name
    assert limit["T3"] < 9532 < coarse["T3"]
    assert limit["T4"] < 14149 < coarse["T4"]
    assert [reed.nodes for reed in reeds] == sorted(reed.nodes for reed in reeds)
    assert 4000 < reeds[0].nodes < 6000


def test_their_moduli_share_one_half_too_with_a_false_part_for_g_tr(reeds):
    for reed, least in zip(reeds, (0.02, 0.01), strict=True):
        slopes = rayleigh_sensitivities(reed.matrices, reed.modes, Cane())
        for row in slopes.values():
            assert row[: len(MODULI)].sum() == pytest.approx(0.5, abs=1e-6)
        column = MODULI.index("G_TR")
        # Converged elements have 0.001.
        assert np.mean([slopes[name][column] for name in ("T1", "T2", "T3", "T4")]) > least


def test_modes_of_another_mesh_give_no_names(geometry, named):
    other = [replace(mode, shape=mode.shape[:-1]) for mode in named]
    with pytest.raises(ValueError, match="lie on another mesh"):
        tetrahedral_reed(geometry, Cane(), other, 2e-3)
