"""Shapes of a reed's modes, and the few functions that span them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from fitting.holograms.object_field import smooth_functions
from fitting.holograms.shape_basis import _functions, shape_basis
from physics.reed.cane.material import stiffness_terms_pa
from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import Outline, half_width_m
from physics.reed.mode_classification import PAPER_MODES, is_symmetric
from physics.reed.reduced.dynamics import CaneLaw, State
from physics.reed.reduced.elastic import elastic_modes, named_vibrations, reduced_modes
from physics.reed.reduced.losses import radiated
from physics.reed.reduced.vibrations import vibrations
from physics.reed.surface import surface_shapes

# In the middle of the sweep, of the paper's mean cane.
E_L_PA, G_LT_PA = 10.5e9, 1.0e9
# Shapes up to here are promised to be met.
EXACT_HZ = 22e3


@pytest.fixture(scope="module")
def points():
    """Points (x, y) on the reed's bark side, those off the axis in mirrored pairs."""
    x, y = np.meshgrid(np.arange(0.7e-3, 35.5e-3, 0.8e-3), np.arange(0.3e-3, 7e-3, 0.7e-3))
    inside = y < half_width_m(Outline(), x) - 0.25e-3
    x, y = x[inside], y[inside]
    return np.concatenate([x, x]), np.concatenate([y, -y])


@pytest.fixture(scope="module")
def basis(reed, points):
    return shape_basis(reed, E_L_PA, G_LT_PA, *points)


@pytest.fixture(scope="module")
def deflection(basis):
    """Shapes (n, m) of all modes, put together again."""
    return basis.functions @ basis.shapes.T


@pytest.fixture(scope="module")
def exact(reed, points):
    """Shapes (n, m), straight from the reduced reed, in order of frequency."""
    terms = stiffness_terms_pa(replace(reed.cane, E_L_pa=E_L_PA, G_LT_pa=G_LT_PA))
    surface, found = surface_shapes(reed, *points), []
    for symmetry, half in reed.parts.items():
        hz, vectors = reduced_modes(half, terms, reed.cane.density_kg_m3)
        shapes = surface[symmetry] @ vectors
        found += zip(hz, (shapes / np.abs(shapes).max(axis=0)).T, strict=True)
    return np.stack([shape for _, shape in sorted(found, key=lambda mode: mode[0])], axis=1)


def mirrored(column):
    half = len(column) // 2
    return np.concatenate([column[half:], column[:half]])


def test_functions_are_orthonormal_over_the_points(basis, points):
    gram = basis.functions.T.astype(float) @ basis.functions / len(points[0])
    assert gram == pytest.approx(np.eye(len(gram)), abs=1e-5)
    assert basis.functions.dtype == np.float32


def test_there_are_as_many_shapes_names_and_frequencies(basis, points):
    modes, functions = basis.shapes.shape
    assert len(basis.names) == len(basis.hz) == modes
    assert basis.functions.shape == (len(points[0]), functions)
    assert 20 <= functions <= 36


def test_frequencies_ascend_and_reach_beyond_the_sweep(basis):
    assert (np.diff(basis.hz) > 0).all()
    assert basis.hz[-1] > 30e3


def test_names_are_the_papers_and_each_is_given_once(basis):
    assert set(PAPER_MODES) <= set(basis.names)
    assert len(set(basis.names)) == len(basis.names)


def test_the_same_functions_are_there_at_other_points(reed, points, basis):
    same = basis.at(reed, *points)
    assert same.functions == pytest.approx(basis.functions, abs=1e-4)
    x, y = points
    moved = basis.at(reed, x + 0.15e-3, y - 0.1e-3)
    assert moved.functions.dtype == np.float32
    terms = stiffness_terms_pa(replace(reed.cane, E_L_pa=E_L_PA, G_LT_pa=G_LT_PA))
    there, here = surface_shapes(reed, x + 0.15e-3, y - 0.1e-3), surface_shapes(reed, x, y)
    for symmetry, half in reed.parts.items():
        hz, vectors = reduced_modes(half, terms, reed.cane.density_kg_m3)
        exact = there[symmetry] @ vectors / np.abs(here[symmetry] @ vectors).max(axis=0)
        for m in np.flatnonzero(hz < EXACT_HZ):
            found = moved.functions @ basis.shapes[np.argmin(np.abs(basis.hz - hz[m]))]
            assert np.std(found - exact[:, m]) < 0.02 * np.std(exact[:, m])


def test_names_and_frequencies_are_those_of_the_reed(basis, reed):
    hz = dict(zip(basis.names, basis.hz, strict=True))
    # Shapes are those in a vacuum: air changes them by a thousandth.
    modes = elastic_modes(reed, E_L_PA, G_LT_PA, air_fraction=0.0)
    for name in PAPER_MODES:
        assert hz[name] == pytest.approx(modes[name].frequency_hz, rel=1e-9)


def test_modes_without_a_name_are_distinguished(basis, reed):
    unnamed = [n for n in basis.names if n not in elastic_modes(reed, E_L_PA, G_LT_PA)]
    assert len(unnamed) > 5
    assert all(n.split()[0] in {"symmetric", "antisymmetric"} for n in unnamed)


def test_flexural_modes_mirror_and_transversal_ones_turn_over(basis, deflection):
    for name in PAPER_MODES:
        shape = deflection[:, basis.names.index(name)]
        sign = 1 if is_symmetric(name) else -1
        assert np.abs(shape - sign * mirrored(shape)).max() < 5e-3
    assert is_symmetric("F1")
    assert not is_symmetric("T1")


def test_shapes_within_the_sweep_are_met_to_a_small_share(basis, deflection, exact):
    exact = exact[:, : len(basis.hz)]
    error = np.sqrt(np.mean((deflection - exact) ** 2, axis=0) / np.mean(exact**2, axis=0))
    assert error[basis.hz < EXACT_HZ].max() < 0.02
    # Of modes far beyond the sweep some share at least.
    assert error.max() < 0.9


def test_shapes_have_a_largest_deflection_of_one(basis, deflection):
    within = basis.hz < EXACT_HZ
    assert np.abs(deflection[:, within]).max(axis=0) == pytest.approx(1, abs=0.03)


def test_a_shape_of_the_tip_bends_more_often_the_higher_it_is(basis, points, deflection):
    """F1, F2, F3, F4 have 0, 1, 2, 3 nodal lines across, so as many changes of sign on the axis."""
    x, y = points
    axis = (y > 0) & (y < 0.5e-3) & (x < 30e-3)
    order = np.argsort(x[axis])
    for number in (1, 2, 3):
        along = deflection[axis, basis.names.index(f"F{number}")][order]
        strong = np.sign(along[np.abs(along) > 0.02])
        assert np.count_nonzero(np.diff(strong)) == number - 1


def test_softer_cane_lowers_frequencies_but_hardly_changes_shapes(reed, points, basis, deflection):
    softer = shape_basis(reed, 0.8 * E_L_PA, 0.8 * G_LT_PA, *points)
    there = softer.functions @ softer.shapes.T
    for name in ("F1", "T1", "F2", "T2"):
        m, other = basis.names.index(name), softer.names.index(name)
        assert softer.hz[other] < 0.95 * basis.hz[m]
        one, two = deflection[:, m], there[:, other]
        assert (one @ two) ** 2 / ((one @ one) * (two @ two)) > 0.99


def test_functions_span_what_counts_and_leave_out_what_does_not():
    rng = np.random.default_rng(1)
    span = rng.standard_normal((400, 3))
    deflection = np.concatenate([span, span @ rng.standard_normal((3, 4))], axis=1)
    deflection = np.concatenate([deflection, 1e-5 * rng.standard_normal((400, 1))], axis=1)
    functions, weights = _functions(deflection, np.linspace(1e3, 20e3, 8))
    assert deflection @ weights == pytest.approx(functions, abs=1e-6)
    assert functions.shape == (400, 3)
    assert functions.T @ functions / 400 == pytest.approx(np.eye(3), abs=1e-9)
    rest = span - functions @ (functions.T @ span) / 400
    assert np.abs(rest).max() < 1e-4


def test_there_are_never_more_functions_than_48_and_low_modes_come_first():
    rng = np.random.default_rng(2)
    deflection = rng.standard_normal((500, 60))
    hz = np.concatenate([np.full(20, 5e3), np.full(40, 39e3)])
    functions, _ = _functions(deflection, hz)
    assert functions.shape == (500, 48)

    def left(shapes):
        rest = shapes - functions @ (functions.T @ shapes) / 500
        return np.linalg.norm(rest) / np.linalg.norm(shapes)

    assert left(deflection[:, :20]) < 0.3 < left(deflection[:, 20:])


def test_smooth_factors_turn_the_first_mode_into_any_other(points, basis, deflection):
    """Where F1 dominates, light with such a factor looks like a part of the other mode in it."""
    first = deflection[:, basis.names.index("F1")]
    factors = smooth_functions(*points) * first[:, None]
    for number in np.flatnonzero(basis.hz < 20e3):
        shape = deflection[:, number]
        near = factors @ np.linalg.lstsq(factors, shape, rcond=None)[0]
        assert np.linalg.norm(shape - near) < 0.1 * np.linalg.norm(shape), basis.names[number]


def test_what_a_mode_loses_by_its_own_sound_is_that_of_the_reduced_reed(reed, basis):
    """Compared with its vibrations in air, whose frequencies differ by the mass of the air."""
    cane = replace(reed.cane, E_L_pa=E_L_PA, G_LT_pa=G_LT_PA)
    found = vibrations(reed, State(CaneLaw(cane), air=reed.air), EXACT_HZ)
    expected = {
        mode.name: (own, hz)
        for mode, own, hz in zip(named_vibrations(found), radiated(found), found.hz, strict=True)
    }
    own = np.diagonal(basis.sound, axis1=1, axis2=2)
    for name in ("F2", "F3", "F4"):
        loss, hz = expected[name]
        at = CubicSpline(np.log(basis.sound_hz), own[:, basis.names.index(name)])(np.log(hz))
        assert at / (2 * np.pi * hz) == pytest.approx(loss, rel=0.1)


def test_losses_and_sound_connect_modes_of_one_symmetry_both_ways(basis, deflection):
    even = np.array([is_even(column) for column in deflection.T])
    F1, F3 = basis.names.index("F1"), basis.names.index("F3")
    assert np.abs(basis.sound[:, F1, F3]).max() > 1
    for each in (*basis.shares, *basis.sound):
        assert not np.any(each[even][:, ~even])
        assert each == pytest.approx(each.T, abs=1e-6 * np.abs(each).max())


def test_the_largest_deflections_are_those_of_modes_of_unit_mass(reed, basis, points):
    for name in ("F1", "F2", "F3"):
        m = basis.names.index(name)
        mass_kg = modal_mass_kg(reed, points, basis.hz[m])
        assert mass_kg * basis.largest[m] ** 2 == pytest.approx(1.0, rel=1e-6)


def test_shear_has_a_part_of_the_energy_of_each_mode(basis):
    """T modes twist: most of their energy is in shear. The clamp takes little of F, T and X."""
    own = np.diagonal(basis.shares, axis1=1, axis2=2)
    assert np.all((own > 0) & (own < 1))
    F1, T1 = (basis.names.index(name) for name in ("F1", "T1"))
    assert own[0, F1] < 0.2 < 0.5 < own[0, T1]
    paper = np.array([name in PAPER_MODES for name in basis.names])
    assert own[1, paper].max() < 0.2
    # The reed moves sideways in L1, against beds that shear.
    assert 0.2 < own[1, basis.names.index("L1")] < 0.4
    assert own[1].max() < 0.4


def modal_mass_kg(reed, points, hz):
    """Mass of an even mode whose largest deflection at the points is 1."""
    terms = stiffness_terms_pa(replace(reed.cane, E_L_pa=E_L_PA, G_LT_pa=G_LT_PA))
    half = reed.parts[Symmetry.SYMMETRIC]
    found_hz, vectors = reduced_modes(half, terms, reed.cane.density_kg_m3)
    m = int(np.abs(found_hz - hz).argmin())
    return np.abs(surface_shapes(reed, *points)[Symmetry.SYMMETRIC] @ vectors[:, m]).max() ** -2


def is_even(column):
    return np.dot(column, mirrored(column)) > 0


def test_stiffening_is_that_of_the_name_in_whatever_order(basis):
    names = basis.names[5], basis.names[0], basis.names[2]
    np.testing.assert_array_equal(basis.stiffening_of(names), basis.stiffening[[5, 0, 2]])


@pytest.mark.parametrize("count", [25, 40, 60])
def test_there_are_as_many_functions_as_shapes_need(count):
    """Reeds that are larger than the clarinet's have more modes below 36 kHz."""
    rng = np.random.default_rng(6)
    deflection = np.linalg.qr(rng.standard_normal((400, count)))[0]
    functions, _ = _functions(deflection, np.linspace(1e3, 20e3, count))
    assert functions.shape[1] == min(count, 48)
    left = deflection - functions @ np.linalg.lstsq(functions, deflection, rcond=None)[0]
    assert (np.abs(left).max() < 1e-9) == (count <= 48)
