"""Structures: numbers of coefficients, the printed matrices, what contains what."""

from itertools import pairwise

import numpy as np
import pytest

from fitting.errors import FitInputError
from fitting.statistics.hypotheses import paper_structures
from fitting.statistics.hypotheses.structure import (
    PARAMETER_SIZES,
    coefficients_within,
    written,
)
from physics.reed.cane.viscoelastic import Series, h4_matrix

RELATIVE = 1 / PARAMETER_SIZES[:, None]
CHAIN = ("H4", "H5", "H6", "H7", "H8")


@pytest.fixture
def at(structures, off_start):
    """Return a function that gives a structure by name, with coefficients off its start."""
    return lambda name: (structures[name], off_start(structures[name]))


@pytest.mark.parametrize("name", [f"H{rank}" for rank in range(1, 9)])
def test_counts_are_those_of_the_papers_table(tables, structures, name):
    printed = tables["hypotheses"][name]
    structure = structures[name]
    assert len(structure.coefficients) == len(set(structure.coefficients)) == printed["active"]
    assert structure.components == printed["K"]
    assert structure.all_of_equation_1 == ("66" in printed["other"])


def test_h9_has_a_component_for_every_parameter(tables, structures):
    structure = structures["H9"]
    assert structure.components == tables["hypotheses"]["H9"]["K"]
    e = np.random.default_rng(0).standard_normal((3, 12))
    v = structure.parameters(structure.start, e)
    mean = structure.parameters(structure.start, 0 * e)
    np.testing.assert_allclose(((v - mean) / PARAMETER_SIZES).reshape(3, 12), e, atol=1e-9)


def test_both_readings_of_h6_have_44_coefficients(at):
    assert len(paper_structures.h6_constant_dashpots().coefficients) == 44
    structure, coefficients = at("H6 (constant dashpots)")
    jacobian = structure.matrices(coefficients)[:, [2, 5], 1:]
    assert (jacobian == 0).all()


def test_h4_is_the_matrix_of_the_twin(structures):
    structure = structures["H4"]
    matrices = structure.matrices(structure.start)
    for matrix, series in zip(matrices, Series, strict=True):
        np.testing.assert_allclose(matrix, h4_matrix(series), atol=1e-9)


def test_h4_is_h5_with_the_ties_of_eq_11(at):
    h4, coefficients = at("H4")
    c = dict(zip(h4.coefficients, coefficients, strict=True))
    h5, _ = at("H5")
    d = dict(zip(h5.coefficients, coefficients_within(h5, h4, coefficients), strict=True))
    assert d["d12"] == pytest.approx(c["d12"])
    assert d["d22"] == pytest.approx(2 * d["d12"])
    assert d["d13"] == pytest.approx(d["d12"])
    assert d["d23"] == pytest.approx(-d["d12"])
    assert d["d40"] == d["d50"] == pytest.approx(6 * d["d41"])
    assert d["d51"] == pytest.approx(2 * d["d41"])
    assert d["d53"] == pytest.approx(-2 * d["d41"])
    assert (d["c22"], d["c24"]) == pytest.approx((0.5, 0.5))


def test_h5_is_eq_9_and_10(at):
    h5, coefficients = at("H5")
    c = dict(zip(h5.coefficients, coefficients, strict=True))
    e = np.random.default_rng(1).standard_normal((1, 4))
    (e1, e2, e3, e4) = e[0]
    v = h5.parameters(coefficients, e)[0]
    for series in range(2):
        if series:
            e1, e2 = c["c10"] + e1, c["c20"] + c["c22"] * e2 + c["c24"] * e4
            e3 = c["c30"] + e3
        expected = (
            c["d10"] + c["d12"] * e2 + c["d13"] * e3,
            c["d20"] + c["d22"] * e2 + c["d23"] * e3,
            c["d30"],
            c["d40"] + c["d41"] * e1,
            c["d50"] + c["d51"] * e1 + c["d53"] * e3,
            c["d60"],
        )
        assert v[series] == pytest.approx(expected)


@pytest.mark.parametrize("name", ["H1", "H2", "H3"])
def test_elastic_cane_has_no_maxwell_arm(at, name):
    structure, coefficients = at(name)
    matrices = structure.matrices(coefficients)
    assert (matrices[:, [1, 2, 4, 5]] == 0).all()
    assert (matrices[:, [0, 3], 0] > 0).all()
    assert (name == "H3") == (not np.array_equal(*matrices))


@pytest.mark.parametrize(("inner", "outer"), list(pairwise(CHAIN)))
def test_each_hypothesis_of_the_chain_contains_the_one_before(at, inner, outer):
    narrow, coefficients = at(inner)
    wide, _ = at(outer)
    found = wide.matrices(coefficients_within(wide, narrow, coefficients))
    np.testing.assert_allclose(found * RELATIVE, narrow.matrices(coefficients) * RELATIVE)


def test_both_readings_of_h6_contain_h5_and_lie_in_h7(at):
    h5, coefficients = at("H5")
    h6 = paper_structures.h6_constant_dashpots()
    inside = coefficients_within(h6, h5, coefficients)
    h7, _ = at("H7")
    found = h7.matrices(coefficients_within(h7, h6, inside))
    np.testing.assert_allclose(found * RELATIVE, h5.matrices(coefficients) * RELATIVE)


@pytest.mark.parametrize(("inner", "outer"), [("H5", "H4"), ("H3", "H4"), ("H7", "H6")])
def test_what_is_no_special_case_is_refused(at, inner, outer):
    narrow, coefficients = at(inner)
    with pytest.raises(FitInputError, match=f"{inner} is no special case of {outer}"):
        coefficients_within(at(outer)[0], narrow, coefficients)


def test_slopes_are_the_derivatives_of_the_matrices(structure, off_start):
    coefficients, direction = off_start(structure), off_start(structure, fraction=1, seed=8)
    # Bilinear in the coefficients: central differences are exact.
    ahead, behind = (structure.matrices(coefficients + s * direction) for s in (1, -1))
    along = np.tensordot(direction, structure.jacobian(coefficients), axes=1)
    np.testing.assert_allclose(along * RELATIVE, (ahead - behind) / 2 * RELATIVE, atol=1e-12)


def test_rotatable_components_are_those_that_coefficients_make_up_for(structure, off_start):
    """M turned infinitesimally is again an M of the structure, or is not."""
    if not structure.orthonormal or structure.components < 2:
        assert structure.rotatable == ()
        return
    coefficients = off_start(structure)
    matrices = structure.matrices(coefficients) * RELATIVE
    jacobian = structure.jacobian(coefficients) * RELATIVE
    spanned = jacobian.reshape(len(jacobian), -1).T
    spanned = spanned / np.linalg.norm(spanned, axis=0)
    for i in range(structure.components):
        for k in range(i):
            turned = np.zeros_like(matrices)
            turned[..., 1 + i], turned[..., 1 + k] = matrices[..., 1 + k], -matrices[..., 1 + i]
            wanted = turned.ravel()
            made = spanned @ np.linalg.lstsq(spanned, wanted, rcond=None)[0]
            is_made = np.linalg.norm(made - wanted) < 1e-8 * np.linalg.norm(wanted)
            assert is_made == ({i, k} <= set(structure.rotatable))


def test_matrices_and_start_must_name_the_same_coefficients():
    with pytest.raises(ValueError, match="give one for each"):
        written("X", ("a b",), (("1 0",), ("1 0",)), {"a": 1.0})
    with pytest.raises(ValueError, match="give one for each"):
        written("X", ("a",), (("1",), ("1",)), {"a": 1.0, "b": 1.0})


def test_matrices_are_read_as_written():
    x = written("X", ("a -b", "2*a -0.5*b"), (("1 0", "0 1"), ("1 -3", "b 0")), {"a": 5, "b": 7})
    np.testing.assert_array_equal(x.hat.at(x.start), [[5, -7], [10, -3.5]])
    np.testing.assert_array_equal(x.check.at(x.start), [[[1, 0], [0, 1]], [[1, -3], [7, 0]]])
