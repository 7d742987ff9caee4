"""The reed's shape against the formulas of the paper's appendix."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physics.errors import ImpossibleReedError
from physics.reed.geometry import (
    Clamp,
    Outline,
    ReedGeometry,
    ThicknessMap,
    half_width_m,
    heel_m,
    is_even,
    kink_x_m,
    require_possible,
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
    before, after = half_width_m(Outline(), np.array([x_mm - 1e-9, x_mm + 1e-9]) * MM)
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
    # The centre of the corner's arc, sqrt(16.65) mm off the axis, is printed as 4.08044.
    expected = pytest.approx(y_mm * MM, abs=0.5e-5 * MM)
    assert half_width_m(Outline(), np.array(x_mm * MM)) == expected


def test_pieces_of_the_contour_end_where_the_paper_says():
    assert Outline().tip_arc_end_m == pytest.approx(1.13196 * MM, abs=0.5e-5 * MM)
    assert Outline().side_start_m == pytest.approx(2.94661 * MM, abs=1e-5 * MM)


OTHER = Outline(
    tip_radius_m=15e-3,
    corner_radius_m=2.2e-3,
    corner_x_m=3.6e-3,
    side_half_width_m=7.9e-3,
    side_taper=0.03,
    length_m=72e-3,
)


def test_pieces_of_any_contour_meet():
    for x_m in (OTHER.tip_arc_end_m, OTHER.side_start_m):
        before, after = half_width_m(OTHER, x_m + np.array([-1e-12, 1e-12]))
        assert before == pytest.approx(after, abs=1e-10)
    # The tip's arc and the corner's touch: no kink.
    slopes = np.gradient(half_width_m(OTHER, OTHER.tip_arc_end_m + np.arange(-3, 4) * 1e-7), 1e-7)
    assert np.abs(np.diff(slopes)).max() < 1e-3


def test_a_thickness_map_is_added_point_by_point():
    points = ThicknessMap((0.0, 10 * MM), (-5 * MM, 5 * MM), ((1e-6, 3e-6), (5e-6, 9e-6)))
    measured = replace(ReedGeometry(), thickness_map=points)
    x, y = np.array([0.0, 5.0, 10.0, 40.0]) * MM, np.array([-5.0, 0.0, 5.0, 9.0]) * MM
    added = vamp_m(measured, x, y) - vamp_m(ReedGeometry(), x, y)
    np.testing.assert_allclose(added, [1e-6, 4.5e-6, 9e-6, 9e-6], atol=1e-12)


def test_a_reed_is_even_if_its_thickness_map_is():
    axes = (0.0, 10 * MM), (-5 * MM, 5 * MM)
    even = ThicknessMap(*axes, ((1e-6, 1e-6), (2e-6, 2e-6)))
    odd = ThicknessMap(*axes, ((1e-6, 1e-6), (2e-6, -2e-6)))
    one_sided = ThicknessMap((0.0, 10 * MM), (0.0, 5 * MM), even.deviation_m)
    assert is_even(ReedGeometry())
    assert is_even(replace(ReedGeometry(), thickness_map=even))
    for uneven in (odd, one_sided):
        assert not is_even(replace(ReedGeometry(), thickness_map=uneven))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"clamp": Clamp(x_m=(61.2 * MM, 38.2 * MM))}, "ends of the clamp .* ascend, but are 61.2"),
        ({"clamp": Clamp(x_m=(38.2 * MM, 68 * MM))}, "lies outside the reed, which is 67.5 mm"),
        ({"clamp": Clamp(x_m=(-1 * MM, 61.2 * MM))}, "lies outside the reed"),
        ({"clamp": Clamp(y_m=(3.5 * MM, 2.5 * MM))}, "edges of the clamp across .* ascend"),
        ({"clamp": Clamp(y_m=(2.5 * MM, 6 * MM))}, "half width there is 5.83 mm"),
        ({"clamp": Clamp(y_m=(-1 * MM, 1 * MM))}, "lies outside the reed"),
        ({"clamp": Clamp(x_m=(38.2 * MM, np.nan))}, "must be finite"),
        ({"vamp_x_m": (0.0, 5e-3, 4e-3)}, "abscissae of the vamp's network must be finite and asc"),
        ({"vamp_y_m": (0.0, 6e-3, 4e-3)}, "distances of the vamp's network"),
        ({"vamp_z_m": ReedGeometry().vamp_z_m[:2]}, "3 rows of 8 thicknesses"),
        ({"heel_radius_m": 5e-3}, "heel's radius, 5 mm, must exceed .* 6.54 mm"),
        ({"outline": Outline(tip_radius_m=-1.0)}, "must be positive"),
        ({"outline": Outline(corner_radius_m=4e-3)}, "does not touch a tip"),
        ({"outline": Outline(side_half_width_m=9e-3)}, "does not meet the corner"),
        ({"thickness_map": ThicknessMap((0.0, 1e-3), (0.0, 1e-3), ((0.0,), (0.0,)))}, "row of dev"),
        ({"thickness_map": ThicknessMap((1e-3, 0.0), (0.0, 1e-3), ())}, "abscissae of the thick"),
    ],
)
def test_what_no_reed_can_be_is_refused(wrong, words):
    with pytest.raises(ImpossibleReedError, match=words):
        require_possible(replace(ReedGeometry(), **wrong))


@settings(deadline=None)
@given(st.floats(min_value=1e-6, max_value=1.0))
def test_tip_is_the_inverse_of_the_contour(share):
    y = share * Outline().turn_m[1]
    # The square root of the arc magnifies rounding near the axis.
    assert half_width_m(Outline(), tip_x_m(Outline(), np.array(y))) == pytest.approx(
        y, rel=1e-5, abs=1e-11
    )


def test_the_tips_corner_lies_on_the_contour_at_45_degrees():
    x, y = Outline().turn_m
    assert half_width_m(Outline(), np.array(x)) == pytest.approx(y, rel=1e-9)
    slope = np.diff(half_width_m(Outline(), np.array([x - 1e-8, x + 1e-8])))[0] / 2e-8
    assert slope == pytest.approx(1.0, rel=1e-4)


def test_the_reed_is_thick_everywhere_inside_its_contour():
    x = np.linspace(0.01, 67.49, 300)[:, None] * MM
    y = np.linspace(0, 1, 60) * half_width_m(Outline(), x)
    assert thickness_m(ReedGeometry(), x, y).min() > 20e-6
