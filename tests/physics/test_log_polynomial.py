"""Polynomials of logarithms against numpy's, finite differences and formulas they must recover."""

import numpy as np
import pytest
from numpy.polynomial import chebyshev

from physics.reed.reduced.elastic import elastic_modes
from physics.reed.reduction.log_polynomial import (
    REED_BOX,
    Box,
    Cells,
    LogPolynomial,
    finite_element_polynomial,
    fit_log_polynomial,
    network_pa,
)
from physics.reed.reduction.metamodel import REFERENCE_HZ, Equation1

MODES = ("F1", "T1", "X1")
BOX = Box((8e9, 16e9), (0.5e9, 2e9))
# Made-up formula of the paper's kind, cents above F6 for moduli in MPa.
FORMULA = Equation1(
    MODES,
    np.array(
        [
            [2334.56, -1165877, 0.2763, -21.99, 145883795, -0.000324],
            [1481.7, -642027, 5.0725, 569.69, 83451520, -0.005886],
            [3153.73, -822597, 3.1425, 604.29, 105032670, -0.003785],
        ]
    ),
)


def random_polynomial(rng, degree, box=BOX):
    """Polynomials with all coefficients of a total degree of the same order."""
    coefficients = rng.normal(0, 100, (len(MODES), degree + 1, degree + 1))
    i, j = np.indices(coefficients.shape[1:])
    coefficients[:, i + j > degree] = 0
    return LogPolynomial(MODES, box, coefficients)


def random_moduli(rng, shape, box=BOX):
    return rng.uniform(*box.E_L_pa, shape), rng.uniform(*box.G_LT_pa, shape)


def by_numpy(polynomial, E, G):
    """Cents by numpy's Clenshaw recurrences, mode by mode."""
    unit = [
        2 * (np.log(x) - np.log(low)) / (np.log(high) - np.log(low)) - 1
        for x, (low, high) in ((E, polynomial.box.E_L_pa), (G, polynomial.box.G_LT_pa))
    ]
    return np.stack(
        [
            chebyshev.chebval2d(unit[0][..., m], unit[1][..., m], c)
            for m, c in enumerate(polynomial.coefficients)
        ],
        axis=-1,
    )


# --- Evaluation --------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("shape", [(), (1,), (1500,), (40, 2), (3, 2, 5)])
def test_values_are_those_of_chebyshev_polynomials(degree, shape):
    rng = np.random.default_rng(1)
    polynomial = random_polynomial(rng, degree)
    E, G = random_moduli(rng, (*shape, len(MODES)))
    cents, by_E, by_G = polynomial.evaluate(E, G)
    assert cents.shape == by_E.shape == by_G.shape == E.shape
    np.testing.assert_allclose(cents, by_numpy(polynomial, E, G), atol=1e-9)


@pytest.mark.parametrize("degree", [1, 2, 5])
def test_slopes_are_those_of_finite_differences(degree):
    rng = np.random.default_rng(2)
    polynomial = random_polynomial(rng, degree)
    E, G = random_moduli(rng, (60, len(MODES)))
    _, by_E, by_G = polynomial.evaluate(E, G)
    step = 1e-4
    for slope, up, down in (
        (by_E, (E * np.exp(step), G), (E * np.exp(-step), G)),
        (by_G, (E, G * np.exp(step)), (E, G * np.exp(-step))),
    ):
        difference = polynomial.evaluate(*up)[0] - polynomial.evaluate(*down)[0]
        np.testing.assert_allclose(slope, difference / (2 * step), rtol=1e-5, atol=0.01)


def test_the_layout_in_memory_is_of_no_matter():
    rng = np.random.default_rng(3)
    polynomial = random_polynomial(rng, 5)
    E, G = random_moduli(rng, (2100, len(MODES)))
    expected = polynomial.evaluate(E, G)
    for same in ((np.asfortranarray(E), np.asfortranarray(G)), (E, np.asfortranarray(G))):
        for value, wanted in zip(polynomial.evaluate(*same), expected, strict=True):
            np.testing.assert_array_equal(value, wanted)


def test_one_material_serves_all_modes():
    rng = np.random.default_rng(4)
    polynomial = random_polynomial(rng, 4)
    E, G = random_moduli(rng, (9, 1))
    spread = polynomial.evaluate(np.repeat(E, 3, axis=1), np.repeat(G, 3, axis=1))
    for value, wanted in zip(polynomial.evaluate(E, G), spread, strict=True):
        np.testing.assert_array_equal(value, wanted)
    single = polynomial.evaluate(np.array(E[4, 0]), np.array(G[4, 0]))
    np.testing.assert_array_equal(single[0], spread[0][4])


def test_moduli_that_are_handed_in_stay_as_they_are():
    rng = np.random.default_rng(5)
    E, G = random_moduli(rng, (len(MODES), 20))
    kept = E.copy(), G.copy()
    random_polynomial(rng, 3).evaluate(E.T, G.T)
    np.testing.assert_array_equal(E, kept[0])
    np.testing.assert_array_equal(G, kept[1])


# --- The box -----------------------------------------------------------------------------------


def test_edges_lie_within_the_box_and_what_is_beyond_does_not():
    for E in BOX.E_L_pa:
        for G in BOX.G_LT_pa:
            assert BOX.within(np.array(E), np.array(G))
    inner = np.array([9e9]), np.array([1e9])
    for E, G in ((7.9e9, 1e9), (16.1e9, 1e9), (9e9, 0.49e9), (9e9, 2.1e9), (-9e9, 1e9)):
        both = BOX.within(np.append(inner[0], E), np.append(inner[1], G))
        assert both.tolist() == [True, False]
    assert not BOX.within(np.array(np.nan), np.array(1e9))
    assert random_polynomial(np.random.default_rng(1), 2).within(*inner).all()


def test_nodes_of_a_network_fill_the_box_from_within():
    E, G = network_pa(BOX, 12)
    assert len({*zip(E, G, strict=True)}) == 144
    assert BOX.within(E, G).all()
    for modulus, (low, high) in ((E, BOX.E_L_pa), (G, BOX.G_LT_pa)):
        assert modulus.min() < low * 1.01
        assert modulus.max() > high / 1.01
        unit = 2 * np.log(modulus / low) / np.log(high / low) - 1
        np.testing.assert_allclose(chebyshev.chebval(unit, np.eye(13)[12]), 0, atol=1e-12)


@pytest.mark.parametrize("ends", [(0, 1e9), (-1e9, 1e9), (2e9, 2e9), (3e9, 2e9), (np.nan, 1e9)])
def test_ranges_of_no_moduli_are_refused(ends):
    with pytest.raises(ValueError, match=r"G_LT .* is no range of moduli; give"):
        Box((8e9, 16e9), ends)
    with pytest.raises(ValueError, match=r"E_L .* is no range of moduli; give"):
        Box(ends, (1e9, 2e9))


# --- Fitting -----------------------------------------------------------------------------------


def test_a_fit_recovers_the_polynomial_it_is_given():
    given = random_polynomial(np.random.default_rng(6), 4)
    E, G = network_pa(BOX, 9)
    fitted = fit_log_polynomial(MODES, E, G, given.evaluate(E[:, None], G[:, None])[0], 4, BOX)
    np.testing.assert_allclose(fitted.coefficients, given.coefficients, atol=1e-9)
    assert fitted.degree == 4


def test_what_is_missing_of_one_mode_is_skipped():
    rng = np.random.default_rng(7)
    given = random_polynomial(rng, 3)
    E, G = network_pa(BOX, 8)
    cents = given.evaluate(E[:, None], G[:, None])[0]
    cents[rng.random(cents.shape) < 0.5] = np.nan
    fitted = fit_log_polynomial(MODES, E, G, cents, 3, BOX)
    np.testing.assert_allclose(fitted.coefficients, given.coefficients, atol=1e-8)


def test_the_papers_formula_is_followed_ever_closer():
    E, G = network_pa(BOX, 14)
    cents = FORMULA.evaluate(E[:, None], G[:, None])[0]
    moduli = random_moduli(np.random.default_rng(8), (500, len(MODES)))
    expected = FORMULA.evaluate(*moduli)
    worst = []
    for degree in (2, 4, 6):
        fitted = fit_log_polynomial(MODES, E, G, cents, degree, BOX).evaluate(*moduli)
        worst.append([np.abs(f - e).max() for f, e in zip(fitted, expected, strict=True)])
    assert worst[1][0] < 0.2
    assert worst[2][0] < 0.005
    # Cents per e-fold.
    assert max(worst[2][1:]) < 0.1
    assert worst[0][0] > 10 * worst[1][0] > 100 * worst[2][0]


def test_too_few_materials_are_refused_with_the_mode():
    E, G = network_pa(BOX, 4)
    cents = np.zeros((16, 3))
    cents[9:, 1] = np.nan
    with pytest.raises(ValueError, match=r"9 materials fix 8 of the 10 coefficients of T1; comp"):
        fit_log_polynomial(MODES, E, G, cents, 3, BOX)


def test_materials_on_a_line_do_not_fix_a_surface():
    E = np.linspace(8e9, 16e9, 50)
    with pytest.raises(ValueError, match="fix 3 of the 6 coefficients of F1"):
        fit_log_polynomial(MODES, E, np.full(50, 1e9), np.zeros((50, 3)), 2, BOX)


def test_moduli_in_mpa_are_refused_with_the_remedy():
    E, G = network_pa(BOX, 4)
    with pytest.raises(ValueError, match=r"16 materials such as .* outside .* moduli are in Pa"):
        fit_log_polynomial(MODES, E / 1e6, G / 1e6, np.zeros((16, 3)), 2, BOX)


def test_a_constant_is_no_metamodel():
    E, G = network_pa(BOX, 4)
    with pytest.raises(ValueError, match="degree 0 follows no slope; give at least 1"):
        fit_log_polynomial(MODES, E, G, np.zeros((16, 3)), 0, BOX)


# --- Finite elements ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def of_coarse_reed(coarse_reed):
    return finite_element_polynomial(coarse_reed, count=18)


@pytest.fixture(scope="module")
def deviations(coarse_reed, of_coarse_reed):
    """Polynomial less finite elements in cents, (n, m), where the paper's reeds are."""
    E, G = random_moduli(np.random.default_rng(9), 120, Box((10e9, 17e9), (0.8e9, 1.6e9)))
    cents = np.full((len(E), len(of_coarse_reed.modes)), np.nan)
    for n, material in enumerate(zip(E, G, strict=True)):
        found = elastic_modes(coarse_reed, *map(float, material))
        for m, name in enumerate(of_coarse_reed.modes):
            if name in found:
                cents[n, m] = 1200 * np.log2(found[name].frequency_hz / REFERENCE_HZ)
    deviation = of_coarse_reed.evaluate(E[:, None], G[:, None])[0] - cents
    return dict(zip(of_coarse_reed.modes, deviation.T, strict=True))


@pytest.mark.parametrize("mode", ["F1", "T1", "T3", "X3"])
def test_modes_that_keep_their_shape_are_followed_to_a_tenth_of_a_cent(deviations, mode):
    assert np.abs(deviations[mode]).max() < 0.1


@pytest.mark.parametrize("mode", ["T2", "F3", "X2", "T4"])
def test_modes_that_cross_others_are_followed_to_half_a_cent_but_where_they_do(deviations, mode):
    assert np.nanpercentile(np.abs(deviations[mode]), 75) < 0.5


@pytest.mark.parametrize("mode", ["F2", "X1"])
def test_modes_that_lie_near_others_are_followed_to_a_few_cents(deviations, mode):
    # X1 is hardly anywhere far from L1, nor F2 from T2 where the cane is soft in shear.
    assert np.nanpercentile(np.abs(deviations[mode]), 75) < 4


def test_where_a_polynomial_is_said_to_follow_its_mode_it_does(coarse_reed, of_coarse_reed):
    E, G = random_moduli(np.random.default_rng(10), 150, Box((8e9, 20e9), (0.5e9, 1.9e9)))
    said = of_coarse_reed.follows(E[:, None], G[:, None])
    found = of_coarse_reed.evaluate(E[:, None], G[:, None])[0]
    off, missing = np.zeros(found.shape), np.zeros(found.shape, dtype=bool)
    for n, material in enumerate(zip(E, G, strict=True)):
        modes = elastic_modes(coarse_reed, *map(float, material))
        for m, name in enumerate(of_coarse_reed.modes):
            missing[n, m] = name not in modes
            if not missing[n, m]:
                cents = 1200 * np.log2(modes[name].frequency_hz / REFERENCE_HZ)
                off[n, m] = abs(found[n, m] - cents)
    # Between the corners of a cell a crossing may just begin.
    assert np.percentile(off[said], 99.5) < 12
    assert not missing[said].any()
    # Where nothing is promised much is indeed wrong, and where nothing is wrong much is promised.
    assert np.median(off[~said & ~missing]) > 8
    assert np.mean(said[(off < 1) & ~missing]) > 0.8


def test_cells_are_looked_up_by_mode_and_by_both_moduli():
    followed = np.zeros((2, 2, 3), dtype=bool)
    followed[0, 1, 0] = followed[1, 0, 2] = True
    with pytest.raises(ValueError, match="cells"):
        LogPolynomial(MODES, BOX, np.zeros((3, 2, 2)), Cells(np.linspace(-1, 1, 3), followed))
    followed = np.zeros((3, 2, 2), dtype=bool)
    followed[0, 1, 0] = followed[2, 0, 1] = True
    cells = Cells(np.linspace(-1, 1, 3), followed)
    polynomial = LogPolynomial(MODES, BOX, np.zeros((3, 2, 2)), cells)
    (soft, stiff), (limp, rigid) = (
        (1.01 * low, 0.99 * high) for low, high in (BOX.E_L_pa, BOX.G_LT_pa)
    )
    assert polynomial.follows([[stiff]], [[limp]]).tolist() == [[True, False, False]]
    assert polynomial.follows([[soft]], [[rigid]]).tolist() == [[False, False, True]]
    # Beyond the box as at its edge.
    far = polynomial.follows([[10 * stiff] * 3, [soft] * 3], [[0.1 * limp] * 3, [rigid] * 3])
    assert far.tolist() == [[True, False, False], [False, False, True]]


def test_without_cells_a_polynomial_is_followed_everywhere():
    polynomial = LogPolynomial(MODES, BOX, np.zeros((3, 2, 2)))
    assert (
        polynomial.follows(np.full((4, 3), 1e9), np.full((4, 1), 1e9)).tolist() == [[True] * 3] * 4
    )


def test_the_box_of_a_reed_is_that_of_its_basis(of_coarse_reed):
    assert of_coarse_reed.box is REED_BOX
    assert of_coarse_reed.degree == 5
