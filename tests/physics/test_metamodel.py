"""Metamodels against the paper's table, finite differences and formulas they must recover."""

import numpy as np
import pytest

from physics.reed.reduction.metamodel import (
    REFERENCE_HZ,
    Equation1,
    fit_equation_1,
    paper_network_pa,
)


@pytest.fixture(scope="module")
def table_9(tables):
    modes = tables["metamodel"]["modes"]
    return Equation1(tuple(modes), np.array([mode["a"] for mode in modes.values()]))


def test_table_9_gives_the_frequencies_of_the_reference_material(table_9):
    # Computed by hand from Eq. 1 at 14 000 and 1100 MPa.
    cents, _, _ = table_9.evaluate(np.array(14e9), np.array(1.1e9))
    hz = dict(zip(table_9.modes, REFERENCE_HZ * 2 ** (cents / 1200), strict=True))
    assert hz["F1"] == pytest.approx(2208, abs=1)
    assert hz["T3"] == pytest.approx(9532, abs=1)
    assert hz["F4"] == pytest.approx(16480, abs=1)


def test_slopes_are_those_of_finite_differences(table_9):
    rng = np.random.default_rng(1)
    E, G = rng.uniform(8e9, 17e9, (7, 11)), rng.uniform(0.8e9, 1.7e9, (7, 11))
    _, by_E, by_G = table_9.evaluate(E, G)
    step = 1e-5
    for slope, up, down in (
        (by_E, (E * np.exp(step), G), (E * np.exp(-step), G)),
        (by_G, (E, G * np.exp(step)), (E, G * np.exp(-step))),
    ):
        difference = table_9.evaluate(*up)[0] - table_9.evaluate(*down)[0]
        np.testing.assert_allclose(slope, difference / (2 * step), rtol=1e-6, atol=1e-4)


def test_a_fit_recovers_the_formula_it_is_given(table_9):
    E, G = paper_network_pa()
    cents, _, _ = table_9.evaluate(E[:, None], G[:, None])
    fitted = fit_equation_1(table_9.modes, E, G, cents)
    np.testing.assert_allclose(fitted.coefficients, table_9.coefficients, rtol=1e-6)


def test_the_network_has_92_materials_within_the_papers_ranges():
    E, G = paper_network_pa()
    assert len(E) == len(G) == 92
    assert (E.min(), E.max(), G.min(), G.max()) == (8e9, 17e9, 0.8e9, 1.7e9)
    assert len({*zip(E, G, strict=True)}) == 92
