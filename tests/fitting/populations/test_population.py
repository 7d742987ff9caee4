"""Fits of populations against canes that are known, scipy, and the fit of single reeds."""

from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from fitting.cane.excess_scatter import added_cents, is_misfit
from fitting.cane.reed_fit import COMPONENTS, fit_components
from fitting.errors import FitInputError
from fitting.forward import PaperModel, hz_of
from fitting.paper.constants import adjusted_metamodel
from fitting.populations import population as populations
from fitting.populations.flags import Flag, PopulationFit, count_flags
from fitting.populations.population import fit_population, fit_stream
from fitting.resonance import Resonance
from physics.errors import ImpossibleReedError
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    require_physical,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduction.log_polynomial import (
    REED_BOX,
    Box,
    fit_log_polynomial,
    network_pa,
)
from physics.reed.reduction.metamodel import Equation1

GRID_CENTS = 25 / np.sqrt(12)
FORMULA = adjusted_metamodel(PAPER_MODES)
A_ONLY, BOTH = (Series.A,), tuple(Series)


def polynomial_of(metamodel, box):
    """Polynomials that follow another metamodel over a box."""
    E, G = network_pa(box, 14)
    cents, _, _ = metamodel.evaluate(E[:, None], G[:, None])
    return fit_log_polynomial(metamodel.modes, E, G, cents, 5, box)


POLYNOMIAL = polynomial_of(FORMULA, REED_BOX)
METAMODELS = pytest.mark.parametrize(
    "metamodel", [FORMULA, POLYNOMIAL], ids=["formula", "polynomial"]
)


def population_cents(components, metamodel, series=BOTH):
    """Cents (n, s, m) of reeds, each mode with the moduli of its own frequency: fixed points.

    NaN for modes whose moduli are none.
    """
    # A column per component makes a cane of all reeds, which broadcasts over the modes.
    columns = Components(*np.transpose(components)[..., None])
    rows = []
    for s in series:
        cane = viscoelastic_cane(columns, s)
        cents = np.full((len(components), len(metamodel.modes)), 2400.0)
        with np.errstate(invalid="ignore"):
            for _ in range(60):
                hz = hz_of(cents)
                E, G = (storage_modulus_pa(z, hz) for z in (cane.young_L, cane.shear_LT))
                cents = metamodel.evaluate(E, G)[0]
        rows.append(cents)
    return np.stack(rows, axis=1)


def physical(components):
    try:
        for series in Series:
            require_physical(viscoelastic_cane(Components(*components), series))
    except ImpossibleReedError:
        return False
    return True


def canes(rng, count):
    """Components (count, 4) of N(0, 1); those outside physics are drawn again."""
    rows = []
    while len(rows) < count:
        drawn = rng.standard_normal(4)
        if physical(drawn):
            rows.append(drawn)
    return np.array(rows)


def on_grid(cents):
    """Each resonance at the nearest picture of a sweep."""
    return 25 * np.round(cents / 25)


def same(one, other):
    """Whether two fits agree to the last bit."""
    return all(
        np.array_equal(getattr(one, f.name), getattr(other, f.name), equal_nan=True)
        for f in fields(PopulationFit)
    )


def chosen(fit, reeds):
    return PopulationFit(*(getattr(fit, f.name)[reeds] for f in fields(PopulationFit)))


def joined(fits):
    return PopulationFit(
        *(np.concatenate([getattr(fit, f.name) for fit in fits]) for f in fields(PopulationFit))
    )


@pytest.fixture(scope="module")
def reeds():
    return canes(np.random.default_rng(1), 150)


@pytest.fixture(scope="module")
def exact(reeds):
    """Cents (150, 2, 11) of the paper's formula, without error."""
    return population_cents(reeds, FORMULA)


# --- Recovery ----------------------------------------------------------------------------------


@METAMODELS
@pytest.mark.parametrize("series", [A_ONLY, BOTH])
def test_components_come_back_from_exact_resonances(reeds, metamodel, series):
    known = reeds[:60, : len(series) + 2]
    padded = np.pad(known, ((0, 0), (0, 4 - known.shape[1])))
    fit = fit_population(population_cents(padded, metamodel, series), 1.0, metamodel)
    np.testing.assert_allclose(fit.components, known, atol=1e-5)
    assert fit.rms_cents.max() < 1e-3
    assert fit.reduced_chi2.max() < 1e-6
    assert (fit.used == 11 * len(series)).all()
    assert not (fit.flags & ~int(Flag.OUTSIDE_METAMODEL)).any()


@pytest.mark.parametrize("series", [A_ONLY, BOTH])
def test_scipy_finds_the_same_least_squares_and_errors(reeds, exact, series):
    rng = np.random.default_rng(2)
    errors = rng.uniform(4, 12, (len(series), 11))
    observed = exact[:6, : len(series)] + errors * rng.standard_normal((6, len(series), 11))
    count = 2 + len(series)

    def weighted(components, reed):
        padded = np.pad(components, (0, 4 - count))
        return ((observed[reed] - population_cents([padded], FORMULA, series)[0]) / errors).ravel()

    fit = fit_population(observed, errors, FORMULA)
    for reed in range(6):
        found = least_squares(weighted, np.zeros(count), args=(reed,), jac="3-point", xtol=1e-12)
        stated = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
        freedom = 11 * len(series) - count
        if chi2.sf(2 * found.cost, freedom) < 0.05:
            stated = stated * np.sqrt(2 * found.cost / freedom)
        # To a small part of the error, and the error to the bend of the slopes within it.
        np.testing.assert_allclose(fit.components[reed], found.x, atol=2e-3 * stated.min())
        np.testing.assert_allclose(fit.errors[reed], stated, rtol=2e-3)
        assert fit.reduced_chi2[reed] == pytest.approx(2 * found.cost / freedom, rel=1e-4)
        residual = weighted(found.x, reed).reshape(errors.shape) * errors
        assert fit.rms_cents[reed] == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-3)


def test_the_fit_of_single_reeds_says_the_same(reeds, exact):
    observed = exact[:3] + 9 * np.random.default_rng(3).standard_normal((3, 2, 11))
    fit = fit_population(observed, GRID_CENTS, FORMULA)
    for reed in range(3):
        resonances = {
            s: {
                name: Resonance(name, float(hz_of(cents)), GRID_CENTS, 1, 5.0)
                for name, cents in zip(PAPER_MODES, row, strict=True)
            }
            for s, row in zip(Series, observed[reed], strict=True)
        }
        single = fit_components(resonances, PaperModel(iterations=60))
        for k, name in enumerate(COMPONENTS):
            error = single.components[name].error
            assert fit.components[reed, k] == pytest.approx(
                single.components[name].value, abs=0.01 * error
            )
            assert fit.errors[reed, k] == pytest.approx(error, rel=0.01)
        assert fit.rms_cents[reed] == pytest.approx(single.rms_cents, rel=1e-3)


@METAMODELS
def test_the_25_cent_grid_allows_a_ninth_of_a_standard_deviation(reeds, metamodel):
    truth = canes(np.random.default_rng(4), 400)
    fit = fit_population(on_grid(population_cents(truth, metamodel)), GRID_CENTS, metamodel)
    missed = fit.components - truth
    # Cramér and Rao allow 0.05, 0.07, 0.08 and 0.11; 400 reeds know the rms to 4 %.
    assert (np.sqrt(np.mean(missed**2, axis=0)) < [0.055, 0.08, 0.085, 0.12]).all()
    covered = np.mean(np.abs(missed) < fit.errors, axis=0)
    assert ((covered > 0.62) & (covered < 0.74)).all()
    assert np.mean(fit.reduced_chi2) == pytest.approx(1.0, abs=0.08)


def test_errors_are_the_spread_of_noisy_fits(exact):
    rng = np.random.default_rng(5)
    noisy = exact[0] + 3.0 * rng.standard_normal((600, 2, 11))
    fit = fit_population(noisy, 3.0, FORMULA)
    # 600 fits: the spread itself is uncertain by 3 %.
    np.testing.assert_allclose(fit.components.std(axis=0), np.median(fit.errors, axis=0), rtol=0.1)


# --- What is missing, and what counts how much -------------------------------------------------


def test_missing_resonances_are_left_out(reeds, exact):
    rng = np.random.default_rng(6)
    missing = rng.random(exact.shape) < 0.4
    fit = fit_population(np.where(missing, np.nan, exact), 1.0, FORMULA)
    whole = fit_population(exact, 1.0, FORMULA)
    enough = (~missing).sum(axis=2).min(axis=1) >= 5
    np.testing.assert_array_equal(fit.used, (~missing).sum(axis=(1, 2)))
    np.testing.assert_allclose(fit.components[enough], reeds[enough], atol=1e-4)
    assert (fit.errors[enough] > whole.errors[enough]).all()


def test_an_error_may_be_stated_for_each_series_mode_or_reed(exact):
    noisy = exact + 7 * np.random.default_rng(7).standard_normal(exact.shape)
    errors = np.random.default_rng(8).uniform(2, 20, (2, 11))
    expected = fit_population(noisy, np.broadcast_to(errors, exact.shape).copy(), FORMULA)
    assert same(fit_population(noisy, errors, FORMULA), expected)
    alone = fit_population(noisy[3:4], errors, FORMULA)
    assert same(alone, fit_population(noisy[3:4], errors[None], FORMULA))
    of_modes = fit_population(noisy, errors[0], FORMULA)
    assert same(of_modes, fit_population(noisy, np.stack([errors[0]] * 2), FORMULA))


def test_a_resonance_of_great_error_pulls_at_nothing(exact):
    noisy, errors = exact[:20].copy(), np.full((2, 11), 5.0)
    noisy[:, 0, 4] += 800
    errors[0, 4] = 1e7
    far = fit_population(noisy, errors, FORMULA)
    noisy[:, 0, 4] = np.nan
    np.testing.assert_allclose(
        far.components, fit_population(noisy, errors, FORMULA).components, atol=1e-5
    )


# --- Misfit ------------------------------------------------------------------------------------


def test_only_what_chance_does_not_explain_is_a_misfit():
    for freedom in (1, 7, 18):
        limit = chi2.isf(0.05, freedom) / freedom
        reduced = np.array([0.0, 0.3, 0.999 * limit, 1.001 * limit, 30.0, np.nan])
        expected = [False, False, False, True, True, False]
        assert is_misfit(reduced, np.full(6, freedom)).tolist() == expected


def test_a_misfit_grows_the_errors_by_its_root(exact):
    noisy = exact + 25 * np.random.default_rng(9).standard_normal(exact.shape)
    loud, stated = (fit_population(noisy, error, FORMULA) for error in (5.0, 25.0))
    small = stated.reduced_chi2 < 1
    assert small.sum() > 50
    assert (loud.reduced_chi2 > 5).all()
    grown = loud.errors / stated.errors
    expected = np.sqrt(stated.reduced_chi2[small, None]) * np.ones(4)
    np.testing.assert_allclose(grown[small], expected, rtol=1e-3)


def test_an_added_error_makes_squares_as_many_as_freedoms():
    rng = np.random.default_rng(10)
    residual, errors = rng.normal(0, 20, (50, 11)), rng.uniform(0.3, 10, (50, 11))
    residual[3, 4:6] = np.nan
    freedom = np.full(50, 7)
    added = added_cents(residual, errors, freedom)
    assert (added > 0).all()
    squares = np.nansum(residual**2 / (errors**2 + added[:, None] ** 2), axis=1)
    np.testing.assert_allclose(squares, freedom, rtol=1e-6)
    np.testing.assert_array_equal(added_cents(0.1 * errors, errors, freedom), np.zeros(50))
    even = added_cents(residual[:1], np.full((1, 11), 2.0), freedom[:1])
    assert even == pytest.approx(np.sqrt(np.sum(residual[:1] ** 2) / 7 - 4))


def uneven(exact):
    """Reeds that are 15 cents off the formula, of modes known to 0.3 to 10 cents."""
    rng = np.random.default_rng(12)
    errors = rng.permuted(np.broadcast_to(np.geomspace(0.3, 10, 11), exact.shape), axis=2)
    return exact + np.hypot(errors, 15) * rng.standard_normal(exact.shape), errors


def test_the_mode_known_best_does_not_rule_over_all_others(exact, reeds):
    noisy, errors = uneven(exact)
    fit = fit_population(noisy, errors, FORMULA)
    known = fit_population(noisy, np.hypot(errors, 15), FORMULA)
    missed, least = (np.sqrt(np.mean((f.components - reeds) ** 2, axis=0)) for f in (fit, known))
    assert (missed < 1.1 * least).all(), (missed, least)
    normalised = np.sqrt(np.mean(((fit.components - reeds) / fit.errors) ** 2, axis=0))
    assert (np.abs(normalised - 1) < 0.25).all(), normalised
    assert np.median(fit.excess_scatter_cents) == pytest.approx(15, rel=0.1)


def test_a_misfit_is_that_of_single_reeds(exact):
    noisy, errors = uneven(exact)
    fit = fit_population(noisy[:5], errors[:5], FORMULA)
    for reed in range(5):
        found = {
            series: {
                name: Resonance(name, float(hz_of(noisy[reed, s, m])), errors[reed, s, m], 1, 5.0)
                for m, name in enumerate(FORMULA.modes)
            }
            for s, series in enumerate(Series)
        }
        alone = fit_components(found, PaperModel(iterations=30))
        assert fit.excess_scatter_cents[reed] == pytest.approx(alone.excess_scatter_cents, rel=0.02)
        for k, name in enumerate(COMPONENTS):
            assert fit.components[reed, k] == pytest.approx(alone.components[name].value, abs=0.02)
            assert fit.errors[reed, k] == pytest.approx(alone.components[name].error, rel=0.05)


# --- Flags -------------------------------------------------------------------------------------


# Cents at 14 and 1.1 GPa, and their slopes with ln E_L and ln G_LT, of made-up modes: half as steep
# as those of a reed, so that even a cane whose springs pull has them all.
LINES = {
    "F1": (1400, 350, 20),
    "T1": (1600, 80, 300),
    "F2": (2200, 330, 50),
    "T2": (2600, 120, 260),
    "X1": (3000, 200, 180),
    "F3": (3400, 310, 80),
    "T3": (3500, 50, 330),
}
WIDE = Box((1e6, 1e12), (1e6, 1e12))


def straight_lines(box=WIDE, **changes):
    """Metamodel of straight lines in the logarithms of the moduli, fitted over a box."""
    base, by_E, by_G = np.transpose([*(LINES | changes).values()])
    E, G = network_pa(box, 3)
    cents = base + np.outer(np.log(E / 14e9), by_E) + np.outer(np.log(G / 1.1e9), by_G)
    return fit_log_polynomial(tuple(LINES | changes), E, G, cents, 1, box)


def test_an_ordinary_fit_bears_no_flag(exact):
    fit = fit_population(exact, 1.0, FORMULA)
    assert (fit.flags == 0).all()
    assert count_flags(fit.flags) == {}


@pytest.mark.parametrize(
    ("components", "flag"),
    [
        ((0.0, -2.0, -14.2, 2.0), Flag.E1_NOT_POSITIVE),
        ((2.5, -4.2, 3.2, 0.0), Flag.E2_NOT_POSITIVE),
        ((-6.05, 0.0, -4.6, 0.0), Flag.G1_NOT_POSITIVE),
        ((-2.0, 0.0, 1.6, 0.0), Flag.G2_NOT_POSITIVE),
    ],
)
@pytest.mark.parametrize("series", [A_ONLY, BOTH])
def test_springs_outside_physics_are_found_as_they_are_and_reported(components, flag, series):
    metamodel = straight_lines()
    cents = population_cents([components], metamodel, series)
    assert np.isfinite(cents).all()
    fit = fit_population(cents, 1.0, metamodel)
    np.testing.assert_allclose(fit.components[0], components[: fit.components.shape[1]], atol=1e-3)
    assert Flag(int(fit.flags[0])) == flag
    assert count_flags(fit.flags) == {flag.name: 1}


def test_springs_of_series_b_are_looked_at_too():
    # Drying takes E2 of series B below zero, and leaves series A alone.
    metamodel, components = straight_lines(), (0.0, 0.0, 0.0, -10.0)
    cents = population_cents([components], metamodel)
    fit = fit_population(cents, 1.0, metamodel)
    np.testing.assert_allclose(fit.components[0], components, atol=1e-3)
    assert count_flags(fit.flags) == {"E2_NOT_POSITIVE": 1}
    assert not fit_population(cents[:, :1], 1.0, metamodel).flags.any()


def test_springs_are_not_looked_at_in_a_series_without_resonances():
    # E1 is 1 GPa in series A; what it would be in series B, -0.2 GPa, was never observed.
    metamodel, components = straight_lines(), (0.0, 1.0, -15.5, 0.0)
    cents = population_cents([components], metamodel)
    cents[:, 1] = np.nan
    fit = fit_population(cents, 1.0, metamodel)
    np.testing.assert_allclose(fit.components[0, :3], components[:3], atol=1e-3)
    assert count_flags(fit.flags) == {"UNDETERMINED": 1}


def test_a_storage_modulus_below_zero_is_reported_of_modes_that_were_not_observed():
    # G1 < 0: shear is positive where the dashpot stiffens it, not at a hundred hertz.
    metamodel = straight_lines(F1=(-4500, 350, 20))
    components = (-6.05, 0.0, -4.6, 0.0)
    cents = population_cents([components], metamodel)
    assert np.argwhere(np.isnan(cents)).tolist() == [[0, 0, 0]]
    fit = fit_population(cents, 1.0, metamodel)
    np.testing.assert_allclose(fit.components[0], components, atol=1e-3)
    assert set(count_flags(fit.flags)) == {"G1_NOT_POSITIVE", "STORAGE_MODULUS_NOT_POSITIVE"}


def test_moduli_where_the_metamodel_was_not_fitted_are_reported_of_observed_modes():
    narrow = straight_lines(Box((5e9, 16e9), (0.1e9, 9e9)))
    mean = population_cents(np.zeros((1, 4)), narrow)
    beyond = np.stack(
        [
            storage_modulus_pa(viscoelastic_cane(Components(), s).young_L, hz_of(cents)) > 16e9
            for s, cents in zip(Series, mean[0], strict=True)
        ]
    )
    assert 1 <= beyond.sum() < 7
    fit = fit_population(mean, 1.0, narrow)
    np.testing.assert_allclose(fit.components, 0, atol=1e-5)
    assert count_flags(fit.flags) == {"OUTSIDE_METAMODEL": 1}
    mean[0, beyond] = np.nan
    assert not fit_population(mean, 1.0, narrow).flags.any()


@dataclass(frozen=True)
class Following:
    """The paper's formula, which follows F2 only where E_L is above 12 GPa."""

    modes = FORMULA.modes

    def evaluate(self, E_L_pa, G_LT_pa):
        return FORMULA.evaluate(E_L_pa, G_LT_pa)

    def follows(self, E_L_pa, G_LT_pa):
        return (E_L_pa > 12e9) | (np.array(self.modes) != "F2")


def test_modes_that_are_not_followed_are_left_out_and_reported(exact):
    # Wherever it is observed F2 is wrong, as that of a reed whose modes exchange shapes.
    noise = 7 * np.random.default_rng(20).standard_normal(exact.shape)
    observed = exact + noise
    f2 = FORMULA.modes.index("F2")
    fit = fit_population(observed, 7.0, Following())
    without = np.where(fit.left_out, np.nan, observed)
    assert fit.left_out[..., f2].any(axis=1).sum() > 10
    assert not fit.left_out[..., f2].all(axis=1).all()
    assert not np.delete(fit.left_out, f2, axis=2).any()
    expected = fit_population(without, 7.0, FORMULA)
    for name in ("components", "errors", "reduced_chi2", "rms_cents", "used"):
        assert np.array_equal(getattr(fit, name), getattr(expected, name))
    left_out = fit.left_out.any(axis=(1, 2))
    assert ((fit.flags & Flag.MODES_LEFT_OUT) != 0).tolist() == left_out.tolist()


def test_what_is_left_without_them_may_be_too_little(exact):
    observed = np.full((1, 1, 11), np.nan)
    kept = [FORMULA.modes.index(name) for name in ("F1", "T1", "F2", "X1")]
    # E_L of this reed lies below 12 GPa at F2.
    softest = np.argmin(exact[:, 0, 0])
    observed[0, 0, kept] = exact[softest, 0, kept]
    fit = fit_population(observed, 7.0, Following())
    assert Flag(int(fit.flags[0])) == Flag.TOO_FEW_RESONANCES | Flag.MODES_LEFT_OUT
    assert np.isnan(fit.components).all()
    assert fit.used.tolist() == [3]


def test_a_formula_without_limits_has_no_outside(exact):
    assert not fit_population(exact + 400, 1.0, FORMULA).flags[0] & Flag.OUTSIDE_METAMODEL


@pytest.mark.parametrize(("series", "count"), [(A_ONLY, 3), (BOTH, 4)])
def test_too_few_resonances_fit_nothing(exact, series, count):
    few = np.full((3, len(series), 11), np.nan)
    few[0, 0, :count] = exact[0, 0, :count]
    few[1, 0, : count + 1] = exact[1, 0, : count + 1]
    fit = fit_population(few, 1.0, FORMULA)
    assert fit.used.tolist() == [count, count + 1, 0]
    for reed in (0, 2):
        assert np.isnan(fit.components[reed]).all()
        assert np.isinf(fit.errors[reed]).all()
        assert np.isnan(fit.reduced_chi2[reed])
        assert np.isnan(fit.rms_cents[reed])
        assert fit.flags[reed] == Flag.TOO_FEW_RESONANCES
    assert not fit.flags[1] & Flag.TOO_FEW_RESONANCES
    assert np.isfinite(fit.components[1, :3]).all()


def test_what_the_resonances_do_not_tell_apart_is_not_known(reeds, exact):
    observed = exact[:2].copy()
    # Series A knows nothing of drying; in series B alone e2 and e4 have the same effect.
    observed[0, 1], observed[1, 0] = np.nan, np.nan
    fit = fit_population(observed, 1.0, FORMULA)
    assert np.isnan(fit.components).tolist() == [[False] * 3 + [True], [False, True, False, True]]
    assert np.isinf(fit.errors).tolist() == np.isnan(fit.components).tolist()
    np.testing.assert_allclose(fit.components[0, :3], reeds[0, :3], atol=1e-4)
    np.testing.assert_allclose(fit.components[1, [0, 2]], reeds[1, [0, 2]], atol=1e-4)
    assert (fit.flags == Flag.UNDETERMINED).all()


def test_a_reed_without_series_b_is_fitted_as_in_series_a_alone(exact):
    noisy = exact[:30] + 12 * np.random.default_rng(14).standard_normal((30, 2, 11))
    noisy[:, 1] = np.nan
    alone = fit_population(noisy[:, :1], GRID_CENTS, FORMULA)
    fit = fit_population(noisy, GRID_CENTS, FORMULA)
    np.testing.assert_allclose(fit.components[:, :3], alone.components, atol=1e-4)
    np.testing.assert_allclose(fit.errors[:, :3], alone.errors, rtol=1e-3)
    np.testing.assert_allclose(fit.reduced_chi2, alone.reduced_chi2, rtol=1e-4)
    assert (fit.flags == alone.flags | Flag.UNDETERMINED).all()


def test_flexural_modes_alone_say_something_of_shear(reeds, exact):
    flexural = np.where([name.startswith("F") for name in PAPER_MODES], exact, np.nan)
    fit = fit_population(flexural, 0.1, FORMULA)
    usual = (fit.flags & Flag.NOT_CONVERGED) == 0
    assert usual.mean() > 0.9
    assert not (fit.flags & Flag.UNDETERMINED).any()
    assert (fit.errors[usual, 0] > 3 * fit.errors[usual, 1]).mean() > 0.5


def test_a_fit_that_does_not_end_says_so(monkeypatch, reeds, exact):
    monkeypatch.setattr(populations, "_MOST_EVALUATIONS", 2)
    monkeypatch.setattr(populations, "_FEW_EVALUATIONS", 2)
    fit = fit_population(exact, 1.0, FORMULA)
    assert (fit.flags & Flag.NOT_CONVERGED).all()
    assert np.isfinite(fit.components).all()


def test_frequencies_that_no_cane_has_are_not_forced_upon_one(exact):
    # Ten octaves too low: moduli would have to fall a millionfold.
    fit = fit_population(exact[:5] - 12_000, 1.0, FORMULA)
    assert fit.flags.all()
    assert (fit.reduced_chi2 > 1e4).all()


def test_flags_read_as_words():
    both = Flag.G2_NOT_POSITIVE | Flag.NOT_CONVERGED
    assert {"G2_NOT_POSITIVE", "NOT_CONVERGED"} == {flag.name for flag in Flag(int(both))}
    counted = count_flags(np.array([0, int(both), int(Flag.G2_NOT_POSITIVE)]))
    assert counted == {"NOT_CONVERGED": 1, "G2_NOT_POSITIVE": 2}


# --- Steps that lead astray --------------------------------------------------------------------


# At −3 the spring G2 would be exactly zero, and its sign that of rounding.
@pytest.mark.parametrize("e1", [-2.6, -2.8, -2.99])
def test_a_first_step_to_moduli_below_zero_is_cut(e1):
    # So soft in shear that the slope at the mean reed points below zero.
    components = (e1, 0.3, 0.0, 0.5)
    fit = fit_population(population_cents([components], FORMULA), 1.0, FORMULA)
    np.testing.assert_allclose(fit.components[0], components, atol=1e-4)
    assert fit.flags[0] == 0


@pytest.mark.parametrize(
    ("components", "missing"),
    [
        ((-2.06, 1.39, 0.41), ("F2", "F3", "T3")),
        ((-2.56, 0.56, 0.33), ("X1", "T3")),
        ((-3.28, 1.52, -0.72), ("T2", "F3", "T3")),
    ],
)
def test_a_step_to_moduli_that_no_mode_can_have_is_no_solution(components, missing):
    # Without the modes that hold shear, the way from the mean reed leads past G' < 0.
    metamodel = straight_lines()
    cents = population_cents([(*components, 0.0)], metamodel, A_ONLY)
    cents[..., [metamodel.modes.index(name) for name in missing]] = np.nan
    fit = fit_population(cents, 1.0, metamodel)
    np.testing.assert_allclose(fit.components[0], components, atol=1e-3)
    assert fit.flags[0] == 0


def test_wild_resonances_leave_hardly_a_reed_without_least_squares(exact):
    rng = np.random.default_rng(13)
    wild = exact + 300 * rng.standard_normal(exact.shape)
    # A hundred times the stated errors, in which the shortness of a last step is measured.
    fit = fit_population(wild, 1.0, FORMULA)
    assert np.mean((fit.flags & Flag.NOT_CONVERGED) != 0) < 0.12
    assert (fit.reduced_chi2 > 10).all()


@pytest.mark.parametrize("running", [(1e7, 100, 0), (2000, 1e7, 0)])
def test_an_unobserved_mode_may_run_away(reeds, running):
    # At ten million cents a frequency is beyond floating point; a slope of as much makes every
    # step a long one.
    tame, wild = straight_lines(X9=(2000, 100, 0)), straight_lines(X9=running)
    cents = population_cents(reeds[:40], tame)
    cents[..., tame.modes.index("X9")] = np.nan
    fit = fit_population(cents, 1.0, wild)
    np.testing.assert_allclose(fit.components, reeds[:40], atol=1e-4)
    assert not (fit.flags & ~int(Flag.STORAGE_MODULUS_NOT_POSITIVE)).any()


def test_reeds_far_out_in_the_population_settle():
    rng = np.random.default_rng(10)
    drawn = [row for row in 2.2 * rng.standard_normal((400, 4)) if physical(row)]
    cents = population_cents(drawn, straight_lines())
    fit = fit_population(cents, 1.0, straight_lines())
    assert not fit.flags.any()
    np.testing.assert_allclose(fit.components, drawn, atol=2e-3)


# --- Populations in pieces ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def crowd(exact):
    """Six hundred reeds with all that may happen to one: noise, gaps, wild and missing ones."""
    rng = np.random.default_rng(11)
    cents = np.tile(exact, (4, 1, 1))
    cents += rng.choice([5.0, 40.0, 400.0], (len(cents), 1, 1)) * rng.standard_normal(cents.shape)
    cents[rng.random(cents.shape) < 0.3] = np.nan
    cents[::97] = np.nan
    return cents


@pytest.fixture(scope="module")
def crowd_fit(crowd):
    return fit_population(crowd, GRID_CENTS, POLYNOMIAL)


def test_the_crowd_has_all_kinds(crowd_fit):
    assert len(count_flags(crowd_fit.flags)) >= 5
    assert 0.2 < np.mean(crowd_fit.flags == 0) < 0.9


@pytest.mark.parametrize(("size", "first"), [(1, 12), (7, 40), (590, 600)])
def test_a_reed_does_not_feel_the_others(crowd, crowd_fit, size, first):
    pieces = [crowd[k : min(k + size, first)] for k in range(0, first, size)]
    fits = joined([fit_population(piece, GRID_CENTS, POLYNOMIAL) for piece in pieces])
    assert same(fits, chosen(crowd_fit, np.arange(first)))


def test_the_order_of_reeds_is_of_no_matter(crowd, crowd_fit):
    order = np.random.default_rng(12).permutation(len(crowd))
    assert same(fit_population(crowd[order], GRID_CENTS, POLYNOMIAL), chosen(crowd_fit, order))


def test_an_empty_population_is_a_population():
    fit = fit_population(np.empty((0, 2, 11)), 1.0, FORMULA)
    assert fit.components.shape == fit.errors.shape == (0, 4)
    assert len(fit.flags) == 0


@pytest.mark.parametrize("workers", [1, 2])
def test_a_stream_gives_the_same_in_order(crowd, crowd_fit, workers):
    cuts = [0, 250, 251, 430, 600]
    chunks = [crowd[start:stop] for start, stop in pairwise(cuts)]
    fits = list(fit_stream(chunks, GRID_CENTS, POLYNOMIAL, workers))
    assert [len(fit.used) for fit in fits] == [len(chunk) for chunk in chunks]
    assert same(joined(fits), crowd_fit)


@pytest.mark.parametrize(("workers", "held"), [(1, 0), (2, 3)])
def test_a_stream_holds_few_chunks(exact, workers, held):
    drawn = 0

    def endless():
        nonlocal drawn
        while True:
            drawn += 1
            yield exact[:30]

    stream = fit_stream(endless(), 1.0, FORMULA, workers)
    for given in range(1, 9):
        assert len(next(stream).used) == 30
        assert drawn - given <= held
    # Whoever has enough may leave.
    stream.close()


def test_a_chunk_that_cannot_be_fitted_ends_the_stream_with_the_reason(exact):
    chunks = [exact[:5], exact[:5, :, :3]]
    with pytest.raises(FitInputError, match=r"\(5, 2, 3\)"):
        list(fit_stream(chunks, 1.0, FORMULA, workers=2))


# --- What cannot be fitted ---------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(2, 11), (5, 3, 11), (5, 0, 11), (5, 2, 10), (1, 5, 2, 11)])
def test_other_shapes_are_refused_with_the_right_one(shape):
    with pytest.raises(FitInputError, match=r"\(reeds, series, modes\).* metamodel's 11 modes"):
        fit_population(np.zeros(shape), 1.0, FORMULA)


@pytest.mark.parametrize("error", [0.0, -1.0, np.inf, np.nan])
def test_errors_that_are_none_are_refused(exact, error):
    with pytest.raises(FitInputError, match=r"not positive and finite; mark .* by NaN"):
        fit_population(exact, error, FORMULA)


def test_errors_of_missing_resonances_are_of_no_matter(exact):
    observed, errors = exact[:4].copy(), np.full((4, 2, 11), 5.0)
    observed[:, 1, 3], errors[:, 1, 3] = np.nan, np.nan
    assert (fit_population(observed, errors, FORMULA).used == 21).all()


def test_errors_of_another_shape_are_refused(exact):
    with pytest.raises(FitInputError, match=r"errors of shape \(3,\) do not broadcast"):
        fit_population(exact, np.ones(3), FORMULA)


def test_infinite_resonances_are_refused(exact):
    observed = exact.copy()
    observed[2, 1, 0] = -np.inf
    with pytest.raises(FitInputError, match="infinite cents; mark what is missing by NaN"):
        fit_population(observed, 1.0, FORMULA)


def test_no_workers_are_refused(exact):
    with pytest.raises(FitInputError, match="0 workers fit nothing; give at least 1"):
        next(fit_stream([exact], 1.0, FORMULA, workers=0))


# --- Other metamodels --------------------------------------------------------------------------


def test_names_and_number_of_modes_are_the_metamodels(reeds):
    few = Equation1(("T2", "F1", "X1", "F2"), FORMULA.coefficients[[3, 0, 4, 2]])
    fit = fit_population(population_cents(reeds[:10], few), 1.0, few)
    np.testing.assert_allclose(fit.components, reeds[:10], atol=1e-4)
    assert (fit.used == 8).all()
