"""What the camera sees of a mode: shapes between the nodes, on both sides of the axis."""

import numpy as np
import pytest
from scipy.interpolate import BarycentricInterpolator

from physics.reed.elements.fem import Symmetry
from physics.reed.elements.mesh import lobatto_points
from physics.reed.geometry import Outline, half_width_m
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.elastic import elastic_modes
from physics.reed.surface import on_reed, surface_shapes


def test_contour_bounds_the_reed():
    x = np.array([-1e-3, 0.5e-3, 10e-3, 30e-3])
    width = half_width_m(Outline(), x)
    np.testing.assert_array_equal(on_reed(Outline(), x, 0.99 * width), [False, True, True, True])
    np.testing.assert_array_equal(on_reed(Outline(), x, -0.99 * width), [False, True, True, True])
    np.testing.assert_array_equal(on_reed(Outline(), x, 1.01 * width), [False] * 4)


def test_shapes_at_the_nodes_are_those_of_the_basis(coarse_reed):
    x, y = coarse_reed.plan_m.T
    for symmetry, shapes in surface_shapes(coarse_reed, x, y).items():
        expected = coarse_reed.parts[symmetry].surface_z
        off_axis = y > 0
        np.testing.assert_allclose(
            shapes[off_axis], expected[off_axis], atol=1e-6 * np.abs(expected).max()
        )


def test_halves_are_even_and_odd(coarse_reed):
    rng = np.random.default_rng(7)
    x = rng.uniform(3e-3, 37e-3, 50)
    y = rng.uniform(0, 5e-3, 50)
    left, right = surface_shapes(coarse_reed, x, y), surface_shapes(coarse_reed, x, -y)
    even, odd = Symmetry.SYMMETRIC, Symmetry.ANTISYMMETRIC
    np.testing.assert_array_equal(left[even], right[even])
    np.testing.assert_array_equal(left[odd], -right[odd])
    assert not surface_shapes(coarse_reed, x, np.zeros(50))[odd].any()


def test_every_point_inside_the_contour_has_a_shape(coarse_reed):
    x = np.linspace(1e-6, 38e-3, 60)
    y = half_width_m(Outline(), x) * (1 - 1e-9)
    for shapes in surface_shapes(coarse_reed, x, y).values():
        assert np.isfinite(shapes).all()


@pytest.mark.parametrize("name", PAPER_MODES)
def test_modes_between_the_nodes_are_those_of_the_elements(name, standard_reed, standard_mesh):
    """Against the elements' own polynomials on the bark side."""
    mesh = standard_mesh
    px, py, _ = mesh.orders
    local = np.array([0.13, 0.37, 0.61, 0.88])
    to_x, to_y = (
        BarycentricInterpolator(lobatto_points(order), np.eye(order + 1))(local)
        for order in (px, py)
    )
    mode = elastic_modes(standard_reed, 14e9, 1.1e9)[name]
    at_nodes = standard_reed.parts[mode.symmetry].surface_z @ mode.coordinates
    plan = np.column_stack([standard_reed.plan_m, at_nodes]).reshape(*mesh.block[:2], 3)
    patches = [
        np.einsum("pa,qb,abc->pqc", to_x, to_y, plan[i : i + px + 1, j : j + py + 1])
        for i in range(0, mesh.block[0] - 1, px)
        for j in range(0, mesh.block[1] - 1, py)
    ]
    x, y, expected = np.concatenate([patch.reshape(-1, 3) for patch in patches]).T
    seen = x < 38e-3
    shapes = surface_shapes(standard_reed, x[seen], y[seen])[mode.symmetry]
    error = np.abs(shapes @ mode.coordinates - expected[seen])
    assert error.max() < 0.01 * np.abs(at_nodes).max()
    assert np.sqrt(np.mean(error**2)) < 0.001 * np.abs(at_nodes).max()
