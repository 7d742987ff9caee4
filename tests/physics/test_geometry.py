"""The reed's shape against the formulas of the paper's appendix."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physics.reed.geometry import (
    TIP_CORNER_M,
    ReedGeometry,
    half_width_m,
    heel_m,
    kink_x_m,
    thickness_m,
    tip_x_m,
    vamp_m,
)

MM = 1e-3


def test_vamp_passes_through_the_network_of_points(tables):
    rows = np.array(tables["vamp_thickness_mm"]["rows"])
    for y_mm, column in ((0, 1), (4, 2), (6, 3)):
        for side in (1, -1):
            vamp = vamp_m(ReedGeometry(), rows[:, 0] * MM, np.full(len(rows), side * y_mm * MM))
            np.testing.assert_allclose(vamp, rows[:, column] * MM, rtol=1e-12)


def test_vamp_is_a_biquadratic_across():
    """Its section at any x is the even polynomial of degree 4 through y = 0, 4 and 6 mm."""
    x = np.full(3, 17.3 * MM)
    known = np.array([0.0, 4.0, 6.0])
    p = np.linalg.solve(np.vander(known**2, increasing=True), vamp_m(ReedGeometry(), x, known * MM))
    y = np.array([1.3, 2.9, 5.1])
    np.testing.assert_allclose(
        vamp_m(ReedGeometry(), x, y * MM), np.vander(y**2, 3, increasing=True) @ p, rtol=1e-12
    )


def test_thickness_offset_lifts_the_vamp_alone():
    thicker = replace(ReedGeometry(), thickness_offset_m=10e-6)
    x, y = np.linspace(1, 60, 20) * MM, np.linspace(-5, 5, 20) * MM
    np.testing.assert_allclose(vamp_m(thicker, x, y) - vamp_m(ReedGeometry(), x, y), 10e-6)
    np.testing.assert_array_equal(heel_m(thicker, y), heel_m(ReedGeometry(), y))


def test_heel_is_the_papers_cylinder():
    y = np.array([0.0, 2.0, -5.0])
    np.testing.assert_allclose(
        heel_m(ReedGeometry(), y * MM), (-14.1 + np.sqrt(17.4**2 - y**2)) * MM, rtol=1e-12
    )


def test_vamp_meets_heel_where_the_kink_is():
    y = np.linspace(0, 6, 7) * MM
    x = kink_x_m(ReedGeometry(), y)
    assert x[0] == pytest.approx(34.72 * MM, abs=0.01 * MM)
    np.testing.assert_allclose(vamp_m(ReedGeometry(), x, y), heel_m(ReedGeometry(), y), atol=1e-12)


def test_thickness_is_that_of_vamp_before_the_kink_and_of_heel_behind_it():
    y = np.array([0.0, 3 * MM])
    kink = kink_x_m(ReedGeometry(), y)
    for shift, expected in (
        (-1 * MM, vamp_m(ReedGeometry(), kink - 1 * MM, y)),
        (1 * MM, heel_m(ReedGeometry(), y)),
    ):
        np.testing.assert_array_equal(thickness_m(ReedGeometry(), kink + shift, y), expected)


@pytest.mark.parametrize("x_mm", [1.13196, 2.94661])
def test_contour_is_continuous_where_its_pieces_meet(x_mm):
    before, after = half_width_m(np.array([x_mm - 1e-9, x_mm + 1e-9]) * MM)
    assert before == pytest.approx(after, abs=3e-8)


@pytest.mark.parametrize(
    ("x_mm", "y_mm"),
    [
        (0.5, np.sqrt(23.9 * 0.5)),
        (2.0, 4.08044 + np.sqrt(-5.31 + 6.8 * 2.0 - 4.0)),
        (30.0, 263 / 40 - 11 / 30),
        (67.5, 5.75),
    ],
)
def test_contour_is_the_papers(x_mm, y_mm):
    assert half_width_m(np.array(x_mm * MM)) == pytest.approx(y_mm * MM, rel=1e-12)


@settings(deadline=None)
@given(st.floats(min_value=1e-6, max_value=1.0))
def test_tip_is_the_inverse_of_the_contour(share):
    y = share * TIP_CORNER_M[1]
    # The square root of the arc magnifies rounding near the axis.
    assert half_width_m(tip_x_m(np.array(y))) == pytest.approx(y, rel=1e-5, abs=1e-11)


def test_the_tips_corner_lies_on_the_contour_at_45_degrees():
    x, y = TIP_CORNER_M
    assert half_width_m(np.array(x)) == pytest.approx(y, rel=1e-9)
    slope = np.diff(half_width_m(np.array([x - 1e-8, x + 1e-8])))[0] / 2e-8
    assert slope == pytest.approx(1.0, rel=1e-4)


def test_the_reed_is_thick_everywhere_inside_its_contour():
    x = np.linspace(0.01, 67.49, 300)[:, None] * MM
    y = np.linspace(0, 1, 60) * half_width_m(x)
    assert thickness_m(ReedGeometry(), x, y).min() > 20e-6
