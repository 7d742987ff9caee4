"""Meshes of half a reed and of a whole one: where nodes lie, and which reeds are refused."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import roots_jacobi

from physics.errors import ImpossibleReedError
from physics.reed.elements.fem import assemble
from physics.reed.elements.mesh import (
    HalfReedMesh,
    MeshLevel,
    build_least_mesh,
    build_mesh,
    build_whole_mesh,
    lobatto_points,
)
from physics.reed.geometry import (
    Clamp,
    ClampSide,
    Outline,
    ReedGeometry,
    ThicknessMap,
    half_width_m,
    kink_x_m,
    thickness_m,
    tip_x_m,
)

LEVELS = [MeshLevel(orders=(2, 2, 2)), MeshLevel(), MeshLevel(orders=(4, 4, 2))]


@pytest.fixture(scope="module", params=LEVELS, ids=lambda level: "".join(map(str, level.orders)))
def mesh(request):
    return build_mesh(ReedGeometry(), request.param)


def columns(mesh):
    """Nodes of the block, (nx, ny, nz, 3)."""
    return mesh.nodes_m.reshape(*mesh.block, 3)


@pytest.mark.parametrize("order", [2, 3, 4, 5])
def test_lobatto_points_are_the_roots_of_a_jacobi_polynomial(order):
    inner = 0.5 * (1 + roots_jacobi(order - 1, 1, 1)[0])
    np.testing.assert_allclose(lobatto_points(order), [0, *inner, 1], atol=1e-14)


def test_nodes_lie_between_the_flat_side_and_the_bark(mesh):
    nodes = columns(mesh)
    x, y, z = np.moveaxis(nodes, -1, 0)
    np.testing.assert_array_equal(z[..., 0], 0)
    np.testing.assert_allclose(z[..., -1], thickness_m(ReedGeometry(), x[..., 0], y[..., 0]))
    assert np.all(np.diff(z, axis=2) > 0)


def test_border_nodes_lie_on_the_contour(mesh):
    plan = columns(mesh)[:, :, 0, :2]
    tip, side = plan[0], plan[:, -1]
    np.testing.assert_allclose(tip[:, 0], tip_x_m(Outline(), tip[:, 1]), atol=1e-12)
    # The kink's line bends the rows behind it by a few µm: the side is straight there.
    np.testing.assert_allclose(side[:, 1], half_width_m(Outline(), side[:, 0]), atol=1e-6)
    np.testing.assert_allclose(plan[-1, :, 0], 67.5e-3)


def test_a_line_of_nodes_follows_the_kink(mesh):
    plan = columns(mesh)[:, :, 0, :2]
    distance = np.abs(plan[..., 0] - kink_x_m(ReedGeometry(), plan[..., 1]).reshape(plan.shape[:2]))
    assert distance.max(axis=1).min() < 1e-9


def test_clamped_nodes_are_those_under_the_strip_on_the_bark(mesh):
    x, y, z = mesh.nodes_m[mesh.clamped].T
    assert (x.min(), x.max()) == pytest.approx((38.2e-3, 61.2e-3))
    assert (y.min(), y.max()) == pytest.approx((2.5e-3, 3.5e-3))
    np.testing.assert_allclose(z, thickness_m(ReedGeometry(), x, y))
    inside = (np.abs(mesh.nodes_m[:, 0] - 50e-3) < 8e-3) & (mesh.nodes_m[:, 1] == 3e-3)
    assert mesh.clamped[inside].sum() * mesh.block[2] == inside.sum()


def test_midplane_nodes_are_those_on_the_axis(mesh):
    np.testing.assert_array_equal(mesh.midplane, mesh.nodes_m[:, 1] == 0)
    assert mesh.midplane.sum() == mesh.block[0] * mesh.block[2]


def test_elements_share_faces_and_use_every_node(mesh):
    assert set(mesh.elements.ravel()) == set(range(len(mesh.nodes_m)))
    elements_along = [(n - 1) // p for n, p in zip(mesh.block, mesh.orders, strict=True)]
    assert len(mesh.elements) == np.prod(elements_along)
    assert all(len(set(element)) == element.size for element in mesh.elements)


def test_volume_is_that_of_the_paper_and_of_the_integrated_thickness(mesh):
    volume = 2 * assemble(mesh).mass.sum()
    points, weights = np.polynomial.legendre.leggauss(200)
    pieces = np.array([0, 1.13196, 2.94661, 34.7, 67.5]) * 1e-3
    integrated = 0.0
    for start, end in pairwise(pieces):
        x = (0.5 * (start + end) + 0.5 * (end - start) * points)[:, None]
        width = half_width_m(Outline(), x)
        section = (thickness_m(ReedGeometry(), x, width * points) * weights).sum(axis=1)
        integrated += 0.5 * (end - start) * weights @ (section * width[:, 0])
    assert volume == pytest.approx(integrated, rel=1e-4)
    assert volume == pytest.approx(1653.2e-9, abs=0.1e-9)


@pytest.mark.parametrize("offset_m", [-80e-6, -200e-6])
def test_a_reed_without_thickness_is_refused(offset_m):
    with pytest.raises(ImpossibleReedError, match="thickness must be positive"):
        build_mesh(replace(ReedGeometry(), thickness_offset_m=offset_m), MeshLevel())


FINE = MeshLevel(orders=(2, 2, 2), edge_breaks_m=(-0.1e-3, 0.1e-3, 0.9e-3))
ON_VAMP = Clamp(x_m=(25e-3, 50e-3), y_m=(1e-3, 3e-3))
EVEN_MAP = ThicknessMap((0.0, 30e-3), (-6e-3, 6e-3), ((5e-6, 5e-6), (-5e-6, -5e-6)))
OTHERS = [
    ReedGeometry(clamp=Clamp(side=ClampSide.FLAT)),
    ReedGeometry(clamp=Clamp(side=ClampSide.BOTH)),
    ReedGeometry(clamp=ON_VAMP),
    ReedGeometry(clamp=Clamp(x_m=(36e-3, 67.5e-3), y_m=(0.0, 5.5e-3))),
    ReedGeometry(thickness_offset_m=-30e-6),
    ReedGeometry(thickness_map=EVEN_MAP),
]


@pytest.mark.parametrize("geometry", OTHERS)
@pytest.mark.parametrize("level", [MeshLevel(orders=(2, 2, 2)), FINE])
def test_other_clamps_and_thicknesses_are_meshed_whole(geometry, level):
    mesh = build_mesh(geometry, level)
    volume = 2 * assemble(mesh).mass.sum()
    nodes = columns(mesh)
    x, y, z = np.moveaxis(nodes[:, :, -1], -1, 0)
    np.testing.assert_allclose(z, thickness_m(geometry, x, y), rtol=1e-12)
    reference = 2 * assemble(build_mesh(replace(geometry, clamp=Clamp()), level)).mass.sum()
    assert volume == pytest.approx(reference, rel=2e-4)


@pytest.mark.parametrize("geometry", OTHERS)
@pytest.mark.parametrize("level", [MeshLevel(orders=(2, 2, 2)), FINE])
def test_what_is_held_is_the_strip(geometry, level):
    mesh, clamp = build_mesh(geometry, level), geometry.clamp
    x, y, z = mesh.nodes_m[mesh.clamped].T
    assert (x.min(), x.max()) == pytest.approx(clamp.x_m)
    assert (y.min(), y.max()) == pytest.approx(clamp.y_m)
    thickness = thickness_m(geometry, x, y)
    bark, flat = np.isclose(z, thickness, rtol=1e-12), z == 0
    assert np.all(bark | flat)
    assert bark.any() == (clamp.side != ClampSide.FLAT)
    assert flat.any() == (clamp.side != ClampSide.BARK)
    if clamp.side is ClampSide.BOTH:
        assert bark.sum() == flat.sum()


def test_graded_faces_lie_next_to_the_edges_of_the_strip():
    nodes = columns(build_mesh(ReedGeometry(), FINE))
    for x_mm in (38.1, 38.2, 38.3):
        assert np.isclose(nodes[:, 0, 0, 0], x_mm * 1e-3, atol=1e-9).any()
    for y_mm in (2.4, 2.5, 2.6, 3.4, 3.5, 3.6):
        assert np.isclose(nodes[-20, :, 0, 1], y_mm * 1e-3, atol=1e-9).any()


@pytest.mark.parametrize(
    ("clamp", "words"),
    [
        (Clamp(x_m=(5e-3, 61.2e-3)), "must leave the rounded tip, 7.4 mm, free"),
        (Clamp(x_m=(34.8e-3, 61.2e-3)), "where vamp meets heel, at 34.72 mm"),
        (Clamp(x_m=(38.2e-3, 68e-3)), "outside the reed"),
    ],
)
def test_a_clamp_where_no_mesh_can_follow_is_refused(clamp, words):
    with pytest.raises(ImpossibleReedError, match=words):
        build_mesh(ReedGeometry(clamp=clamp), MeshLevel())


def test_half_a_reed_does_not_stand_for_an_uneven_one():
    with pytest.raises(ImpossibleReedError, match="not even in y"):
        build_mesh(UNEVEN, MeshLevel())


# --- Whole reeds -------------------------------------------------------------------------------

# Thicker on the right, up to the heel and beyond it.
UNEVEN_MAP = ThicknessMap((5e-3, 45e-3), (-5e-3, 6e-3), ((-8e-6, 5e-6), (-30e-6, 40e-6)))
UNEVEN = ReedGeometry(thickness_map=UNEVEN_MAP)
QUADRATIC = MeshLevel(orders=(2, 2, 2))


@pytest.mark.parametrize("geometry", OTHERS)
@pytest.mark.parametrize("level", LEVELS[1:])
def test_an_even_reed_is_its_half_and_the_mirror_image(geometry, level):
    half, whole = build_mesh(geometry, level), build_whole_mesh(geometry, level)
    nx, ny, nz = half.block
    assert whole.block == (nx, 2 * ny - 1, nz)
    right = np.s_[:, ny - 1 :]
    np.testing.assert_allclose(columns(whole)[right], columns(half), rtol=1e-12)
    np.testing.assert_array_equal(columns(whole)[right][:, 0, :, 1], 0)
    np.testing.assert_array_equal(
        whole.clamped.reshape(whole.block)[right], half.clamped.reshape(half.block)
    )
    mirrored = columns(whole)[:, ::-1] * [1, -1, 1]
    np.testing.assert_allclose(mirrored, columns(whole), rtol=1e-12)
    np.testing.assert_array_equal(
        whole.clamped.reshape(whole.block), whole.clamped.reshape(whole.block)[:, ::-1]
    )
    assert np.all(np.diff(columns(whole)[..., 1], axis=1) > 0)
    assert len(whole.elements) == 2 * len(half.elements)
    assert assemble(whole).mass.sum() == pytest.approx(2 * assemble(half).mass.sum(), rel=1e-12)


def test_each_side_of_an_uneven_reed_has_its_own_thickness():
    nodes = columns(build_whole_mesh(UNEVEN, QUADRATIC))
    x, y, z = np.moveaxis(nodes[:, :, -1], -1, 0)
    np.testing.assert_allclose(z, thickness_m(UNEVEN, x, y), rtol=1e-12)
    np.testing.assert_allclose(y, -y[:, ::-1], rtol=1e-12)
    assert np.abs(z - z[:, ::-1]).max() > 20e-6


def test_a_line_of_nodes_follows_the_kink_on_either_side():
    """Which a map takes half a millimetre nearer to the tip on one side than on the other."""
    plan = columns(build_whole_mesh(UNEVEN, QUADRATIC))[:, :, 0, :2]
    distance = np.abs(plan[..., 0] - kink_x_m(UNEVEN, plan[..., 1]).reshape(plan.shape[:2]))
    row = distance.max(axis=1).argmin()
    assert distance[row].max() < 1e-9
    assert np.abs(plan[row, :, 0] - plan[row, ::-1, 0]).max() > 0.2e-3


def test_mirror_images_have_mirrored_meshes():
    image = ThicknessMap(
        UNEVEN_MAP.x_m,
        tuple(-y for y in UNEVEN_MAP.y_m[::-1]),
        tuple(row[::-1] for row in UNEVEN_MAP.deviation_m),
    )
    here = columns(build_whole_mesh(UNEVEN, QUADRATIC))
    there = columns(build_whole_mesh(replace(UNEVEN, thickness_map=image), QUADRATIC))
    np.testing.assert_allclose(there[:, ::-1] * [1, -1, 1], here, rtol=1e-12)


def test_a_whole_reed_too_thin_on_one_side_is_refused():
    thin = replace(UNEVEN_MAP, deviation_m=((-110e-6, 0.0), (-110e-6, 0.0)))
    with pytest.raises(
        ImpossibleReedError, match=r"µm thick at x = .*, y = -\d.\d\d mm; thickness must be"
    ):
        build_whole_mesh(ReedGeometry(thickness_map=thin), MeshLevel())


def test_a_whole_reed_held_outside_itself_is_refused():
    with pytest.raises(ImpossibleReedError, match="outside the reed"):
        build_whole_mesh(replace(UNEVEN, clamp=Clamp(x_m=(38.2e-3, 68e-3))), MeshLevel())


def test_the_least_mesh_is_a_half_of_even_reeds_only():
    assert isinstance(
        build_least_mesh(ReedGeometry(thickness_map=EVEN_MAP), LEVELS[0]), HalfReedMesh
    )
    whole = build_least_mesh(UNEVEN, LEVELS[0])
    assert not isinstance(whole, HalfReedMesh)
    assert whole.nodes_m[:, 1].min() == pytest.approx(-whole.nodes_m[:, 1].max())
