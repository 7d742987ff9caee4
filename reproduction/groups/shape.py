"""The reed's shape: contour, vamp and heel, clamp (paper, appendix on the shape)."""

from collections.abc import Iterator

import numpy as np

from fitting.paper.printed import Printed
from physics.reed.elements.fem import assemble
from physics.reed.elements.mesh import FAST, build_mesh
from physics.reed.geometry import (
    ReedGeometry,
    half_width_m,
    heel_m,
    kink_x_m,
    vamp_m,
)
from reproduction.rows import (
    Group,
    Row,
    from_text,
    not_printed,
)

_WHERE = "appendix on the shape"
# One abscissa on each branch of the contour, mm.
_ON_BRANCHES_MM = (0.6, 2.0, 30.0)
# Numerators and denominators printed for p1 and p2.
_PRINTED_POLYNOMIAL = (((-65, 81, -16), 720), ((5, -9, 4), 2880))


def compare_shape(numbers: Printed, geometry: ReedGeometry) -> Group:
    """Compare the geometry of the finite elements with the text."""
    return Group(
        "shape",
        "Shape of the reed",
        "Our geometry, from arcs and splines, evaluated where the text gives numbers or "
        "formulas. Tolerated: half a unit of the last printed digit.",
        (
            *_contour_rows(numbers, geometry),
            *_vamp_rows(numbers, geometry),
            *_heel_and_clamp_rows(numbers, geometry),
        ),
    )


def printed_contour_mm(x_mm: float) -> float:
    """Half width by the paper's ``contour(x)``, which is 0 beyond both ends."""
    if not 0 <= x_mm < 67.5:
        return 0.0
    if x_mm < 1.13196:
        return float(np.sqrt((24.4 - x_mm) * x_mm))
    if x_mm < 2.94661:
        return float(4.08044 + np.sqrt(-5.31 + 6.8 * x_mm - x_mm**2))
    return 263 / 40 - 11 / 900 * x_mm


def _contour_rows(numbers: Printed, geometry: ReedGeometry) -> Iterator[Row]:
    outline, text = geometry.outline, numbers.text
    joints_m = {
        "end of the tip's arc": (text["contour_first_mm"], outline.tip_arc_end_m),
        "beginning of the side": (text["contour_second_mm"], outline.side_start_m),
    }
    for name, (printed_mm, ours_m) in joints_m.items():
        yield from_text(_WHERE, f"contour, {name}", printed_mm, 1e3 * ours_m, 5e-6, "mm")
    for name, (printed_mm, _) in joints_m.items():
        step = printed_contour_mm(printed_mm) - printed_contour_mm(printed_mm - 1e-9)
        yield from_text(
            _WHERE, f"contour, step at the {name}", 0, 1e3 * step, 0.05, "µm",
            "of the printed formula, which is to be continuous",
        )  # fmt: skip
    for x_mm in _ON_BRANCHES_MM:
        ours_mm = 1e3 * float(half_width_m(outline, np.array(1e-3 * x_mm)))
        yield from_text(
            _WHERE, f"contour at x = {x_mm:g} mm", printed_contour_mm(x_mm), ours_mm, 5e-5, "mm"
        )


def _vamp_rows(numbers: Printed, geometry: ReedGeometry) -> Iterator[Row]:
    x_mm, *printed_mm = np.array(numbers.vamp_thickness_mm.rows).T
    off_mm = [
        1e3 * vamp_m(geometry, 1e-3 * x_mm, np.full_like(x_mm, 1e-3 * y_mm)) - z_mm
        for y_mm, z_mm in zip((0, 4, 6), printed_mm, strict=True)
    ]
    yield from_text(
        "Table 8", "vamp, farthest from its 24 points", 0, 1e3 * float(np.abs(off_mm).max()), 0.5,
        "µm",
    )  # fmt: skip
    # p0, p1, p2 in terms of s0, s1, s2, for y in mm.
    coefficients = np.linalg.inv(np.vander(np.square([0.0, 4.0, 6.0]), increasing=True))
    for degree, (numerators, denominator) in enumerate(_PRINTED_POLYNOMIAL, 1):
        for s, numerator in enumerate(numerators):
            yield from_text(
                _WHERE, f"p{degree}: {denominator} times the coefficient of s{s}", numerator,
                denominator * float(coefficients[degree, s]), 1e-9,
            )  # fmt: skip


def _heel_and_clamp_rows(numbers: Printed, geometry: ReedGeometry) -> Iterator[Row]:
    text, clamp = numbers.text, geometry.clamp
    yield from_text(
        "Modeling the reed", "heel, diameter", text["heel_diameter_mm"],
        2e3 * geometry.heel_radius_m, 0.05, "mm",
    )  # fmt: skip
    yield from_text(
        "Modeling the reed", "heel, greatest thickness", text["heel_thickness_mm"],
        1e3 * float(heel_m(geometry, np.array(0.0))), 0.05, "mm",
    )  # fmt: skip
    yield from_text(
        "Reed excitation", "length of the free vamp", text["vamp_length_mm"], 1e3 * clamp.x_m[0],
        0.5, "mm", "to the clamp",
    )  # fmt: skip
    edge_m = float(half_width_m(geometry.outline, np.array(geometry.vamp_x_m[-1])))
    for name, y_m in (("on the axis", 0.0), ("at the edge", edge_m)):
        kink_m = float(kink_x_m(geometry, np.array([y_m]))[0])
        yield not_printed(_WHERE, f"vamp meets heel {name}, x", 1e3 * kink_m, "mm")
    yield not_printed(_WHERE, "volume of the reed", volume_mm3(geometry), "mm³")


def volume_mm3(geometry: ReedGeometry) -> float:
    """Volume of the reed by the quadrature of its finite elements."""
    matrices = assemble(build_mesh(geometry, FAST))
    return 2e9 * float(matrices.mass.sum())
