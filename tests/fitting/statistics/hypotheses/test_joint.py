"""Joint fits: derivatives, recovery of known populations, invariants, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.errors import FitInputError
from fitting.paper.constants import H4_ADJUSTMENT_CENTS, TABLE_9
from fitting.statistics.factors import orthonormal
from fitting.statistics.hypotheses.arrow import ArrowPoint
from fitting.statistics.hypotheses.joint import continued, fit_hypothesis
from fitting.statistics.hypotheses.population import (
    Priors,
    Unknowns,
    coefficient_sizes,
)
from fitting.statistics.hypotheses.prediction import paper_resonances
from fitting.statistics.hypotheses.structure import PARAMETER_SIZES
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduction.metamodel import Equation1

NO_PRIORS = Priors(adjustment_cents=np.inf, coefficient_share=np.inf, parameter_share=np.inf)
ADJUSTMENTS = np.array([H4_ADJUSTMENT_CENTS[name] for name in PAPER_MODES])


def randomly(point, seed, size=1e-4):
    """A small step in all unknowns."""
    rng = np.random.default_rng(seed)
    return ArrowPoint(
        size * rng.standard_normal(point.shared.shape), size * rng.standard_normal(point.own.shape)
    )


def residuals(population, at):
    """Residuals and rows of priors."""
    cents = population.residual_cents(at)
    prior = population.prior_weights * (at.shared - population.prior_centre)
    own = population.own_weight_cents * at.own.ravel()
    return np.concatenate([cents[~np.isnan(cents)], prior, own])


# --- Derivatives ---------------------------------------------------------------------------------


@pytest.mark.parametrize("converged", [False, True])
def test_slopes_are_those_of_central_differences(posed, structure, converged):
    population, at = posed(structure, converged=converged)
    here = population.normal_equations(at)
    steps = [randomly(at, seed) for seed in range(2)]
    changes = [
        (residuals(population, at.plus(s)) - residuals(population, at.plus(s, -1))) / 2
        for s in steps
    ]
    for step, change in zip(steps, changes, strict=True):
        rows = residuals(population, at)
        scale = np.linalg.norm(change) * np.linalg.norm(rows)
        assert here.expected_decrease(step) == pytest.approx(-change @ rows, abs=1e-6 * scale)
    for i, k in ((0, 0), (0, 1), (1, 1)):
        product = changes[i] @ changes[k]
        scale = np.linalg.norm(changes[i]) * np.linalg.norm(changes[k])
        assert here.times(steps[i]).dot(steps[k]) == pytest.approx(product, abs=1e-5 * scale)


def test_the_cost_is_that_of_the_residuals(posed, structure):
    population, at = posed(structure)
    squares = np.sum(residuals(population, at) ** 2)
    assert population.cost(at) == pytest.approx(squares)
    assert population.normal_equations(at).cost == pytest.approx(squares)


def test_steps_keep_the_components_orthonormal_to_first_order(posed, structure):
    population, at = posed(structure)
    step = population.normal_equations(at).step(1e-3).own
    if structure.orthonormal and structure.components:
        assert np.abs(step).max() > 1e-3
        assert step.sum(axis=0) == pytest.approx(np.zeros(structure.components), abs=1e-8)
        turn = at.own.T @ step
        assert np.abs(turn + turn.T).max() < 1e-8
        free = np.ix_(structure.rotatable, structure.rotatable)
        assert np.abs(turn[free]).max(initial=0) < 1e-8


def test_what_is_not_observed_does_not_matter(posed, structures):
    population, at = posed(structures["H4"])
    # A mode that is missing in its series on some reeds.
    reed, series, mode = np.argwhere(np.isnan(population.observed_cents))[0]
    observed = population.observed_cents.copy()
    observed[reed, series, mode] = 3000
    seen = replace(population, observed_cents=observed)
    assert seen.cost(at) > population.cost(at)
    assert not np.array_equal(
        seen.normal_equations(at).own[reed], population.normal_equations(at).own[reed]
    )
    observed[reed, series, mode] = np.nan
    assert seen.cost(at) == population.cost(at)


def test_coefficient_sizes_change_a_parameter_by_its_own_size(structures):
    h4 = structures["H4"]
    sizes = dict(zip(h4.coefficients, coefficient_sizes(h4, h4.start), strict=True))
    E1, E2, E3, G1, G2, G3 = PARAMETER_SIZES
    assert sizes["d10"] == pytest.approx(E1)
    # Most of all it moves E2 of series B, by 2 c20 − c30.
    assert sizes["d12"] == pytest.approx(E2 / (2 * 2.197 + 0.8294))
    assert (sizes["d30"], sizes["d60"]) == pytest.approx((E3, G3))
    assert sizes["c10"] == pytest.approx(min(G1 / 115.7, G2 / 231.4))


# --- Recovery ------------------------------------------------------------------------------------


def test_h4_comes_back_from_clean_observations_and_a_rough_start(clean, rough_h4, structures):
    assert np.abs(rough_h4.start / structures["H4"].start - 1).max() > 0.2
    fit = fit_hypothesis(clean.observed_cents, rough_h4, priors=NO_PRIORS, tolerance=1e-16)
    assert fit.converged
    assert fit.iterations < 15
    assert fit.rmsd_cents < 1e-6
    np.testing.assert_allclose(fit.unknowns.coefficients, structures["H4"].start, rtol=1e-8)
    np.testing.assert_allclose(fit.unknowns.components, clean.components, atol=1e-8)
    np.testing.assert_allclose(fit.unknowns.adjustments_cents[:, 0], ADJUSTMENTS, atol=1e-5)
    assert fit.physical.all()


def test_converged_moduli_come_back_as_well(structures, clean):
    """Observations of the model converged, fitted converged: the exact answer; else not."""
    h4, model = structures["H4"], paper_resonances(converged=True)
    truth = Unknowns(h4.start, ADJUSTMENTS[:, None], clean.components)
    once = fit_hypothesis(clean.observed_cents, h4, start=truth, most_iterations=1)
    settled = replace(once.population, model=model)
    observed = clean.observed_cents - settled.residual_cents(settled.point(truth))
    settings = {"priors": NO_PRIORS, "tolerance": 1e-16}
    fit = fit_hypothesis(observed, h4, model=model, **settings)
    np.testing.assert_allclose(fit.unknowns.coefficients, h4.start, rtol=1e-7)
    assert fit.rmsd_cents < 1e-5
    assert fit_hypothesis(observed, h4, **settings).rmsd_cents > 0.01


@pytest.mark.parametrize("seed", range(3))
def test_the_misfit_is_the_noise_over_the_degrees_of_freedom(draw, structures, seed):
    known = draw(seed, noise_cents=30)
    fit = fit_hypothesis(known.observed_cents, structures["H4"])
    # 1140 observations; 9 coefficients, 11 adjustments, 220 components with 14 constraints.
    assert fit.degrees_of_freedom == 1140 - (9 + 11 + 220 - 14) == 914
    expected = 30 * np.sqrt(914 / 1140)
    assert fit.rmsd_cents == pytest.approx(expected, abs=3 * expected / np.sqrt(2 * 914))
    assert fit.residual_sd_cents == pytest.approx(30, abs=3 * 30 / np.sqrt(2 * 914))


def test_h1_leaves_the_spread_about_the_mean_of_both_series(tables, structures):
    """From means, SDs and counts of Table 1 alone: 79.1 cents (the paper prints 76.2)."""
    rng = np.random.default_rng(0)
    observed = np.full((55, 2, 11), np.nan)
    for mode, name in enumerate(PAPER_MODES):
        for series, row in enumerate(tables["observed_resonances"][name].values()):
            values = orthonormal(rng.standard_normal((row["identified"], 1)))[:, 0]
            hz = row["mean_hz"] + row["sd_hz"] * values
            observed[: row["identified"], series, mode] = 1200 * np.log2(hz / 1396.9)
    fit = fit_hypothesis(observed, structures["H1"])
    assert fit.rmsd_cents == pytest.approx(79.1, abs=0.3)
    spread = observed - np.nanmean(observed, axis=(0, 1))
    assert fit.rmsd_cents == pytest.approx(np.sqrt(np.nanmean(spread**2)), rel=1e-5)


def test_any_metamodel_and_choice_of_modes_can_be_fitted(clean, structures):
    kept = [PAPER_MODES.index(name) for name in ("T2", "F1", "F3", "X2", "T1", "F2")]
    modes = tuple(PAPER_MODES[i] for i in kept)
    model = paper_resonances(modes)
    assert model.metamodel == model.metamodel
    assert isinstance(model.metamodel, Equation1)
    np.testing.assert_array_equal(model.metamodel.coefficients, [TABLE_9[name] for name in modes])
    settings = {"priors": NO_PRIORS, "tolerance": 1e-16}
    fit = fit_hypothesis(
        clean.observed_cents[:, :, kept], structures["H4"], model=model, **settings
    )
    assert list(fit.equation_1_changes) == list(modes)
    np.testing.assert_allclose(fit.unknowns.coefficients, structures["H4"].start, rtol=1e-6)
    assert fit.equation_1_changes["F3"][0] == pytest.approx(H4_ADJUSTMENT_CENTS["F3"], abs=1e-3)


# --- Invariants ----------------------------------------------------------------------------------


def test_components_have_mean_0_sd_1_and_no_correlation(noisy, structures):
    for name in ("H2", "H3", "H4", "H5"):
        e = fit_hypothesis(noisy.observed_cents, structures[name]).unknowns.components
        K = structures[name].components
        extended = np.concatenate([np.ones((55, 1)), e], axis=1)
        wanted = np.diag([55.0] + [54.0] * K)
        assert np.abs(extended.T @ extended - wanted).max() < 1e-8


@pytest.mark.parametrize("name", ["H1", "H2", "H4", "H5"])
def test_mean_error_of_each_mode_over_both_series_is_zero(noisy, structures, name):
    """The paper's rule for a_m0 is what least squares does, but for what a prior holds back."""
    priors = Priors(adjustment_cents=np.inf)
    start = None
    if name == "H1":
        # Moduli and adjustments are one and the same to H1: any moduli will do.
        start = Unknowns(structures["H1"].start, np.zeros((11, 1)), np.empty((55, 0)))
    fit = fit_hypothesis(
        noisy.observed_cents, structures[name], start=start, priors=priors, tolerance=1e-14
    )
    assert np.abs(np.nansum(fit.residual_cents, axis=(0, 1))).max() < 1e-3
    priors = Priors()
    fit = fit_hypothesis(noisy.observed_cents, structures[name], priors=priors, tolerance=1e-14)
    held = (priors.noise_cents / priors.adjustment_cents) ** 2
    left = np.nansum(fit.residual_cents, axis=(0, 1))
    np.testing.assert_allclose(left, held * fit.unknowns.adjustments_cents[:, 0], atol=1e-3)
    assert np.abs(np.nanmean(fit.residual_cents, axis=(0, 1))).max() < 0.4


def test_a_constant_on_one_mode_moves_only_its_adjustment(noisy, structures):
    moved = noisy.observed_cents.copy()
    moved[:, :, 4] += 40
    fits = [
        fit_hypothesis(cents, structures["H4"], priors=NO_PRIORS, tolerance=1e-13)
        for cents in (noisy.observed_cents, moved)
    ]
    one, other = (fit.unknowns for fit in fits)
    expected = np.zeros(11)
    expected[4] = 40
    np.testing.assert_allclose(
        (other.adjustments_cents - one.adjustments_cents)[:, 0], expected, atol=1e-3
    )
    np.testing.assert_allclose(other.coefficients, one.coefficients, rtol=1e-5)
    np.testing.assert_allclose(other.components, one.components, atol=1e-5)


def test_the_order_of_reeds_does_not_matter(noisy, structures):
    order = np.random.default_rng(1).permutation(55)
    fits = [
        fit_hypothesis(cents, structures["H4"], tolerance=1e-12)
        for cents in (noisy.observed_cents, noisy.observed_cents[order])
    ]
    np.testing.assert_allclose(*(fit.unknowns.coefficients for fit in fits), rtol=1e-5)
    one, other = (fit.unknowns.components for fit in fits)
    np.testing.assert_allclose(other, one[order], atol=1e-5)


def test_where_the_rotation_is_free_the_start_decides_it(noisy, structures):
    """A start that is turned gives the same frequencies, and components turned equally."""
    h4 = fit_hypothesis(noisy.observed_cents, structures["H4"])
    h7 = structures["H7"]
    start = continued(h4, h7)
    turn = np.linalg.qr(np.random.default_rng(6).standard_normal((4, 4)))[0]
    matrices = h7.matrices(start.coefficients)
    matrices[..., 1:] = matrices[..., 1:] @ turn.T
    # The coefficients of H7 are the elements of M of series A, then B.
    turned = Unknowns(matrices.ravel(), start.adjustments_cents, start.components @ turn.T)
    # A prior on the coefficients is not the same in every direction.
    priors = Priors(coefficient_share=np.inf)
    settings = {"priors": priors, "most_iterations": 4, "tolerance": 0.0}
    one, other = (
        fit_hypothesis(noisy.observed_cents, h7, start=s, **settings).unknowns
        for s in (start, turned)
    )
    assert np.abs(one.components - start.components).max() > 0.1
    aligned = one.components.T @ start.components
    np.testing.assert_allclose(other.components, one.components @ turn.T, atol=0.02)
    # As little turned as can be: closest to the start among all rotations.
    np.testing.assert_allclose(aligned, aligned.T, atol=0.02 * np.abs(aligned).max())


# --- What priors do ------------------------------------------------------------------------------


def test_a_prior_keeps_adjustments_small_at_little_cost(noisy, structures):
    fits = {
        sd: fit_hypothesis(
            noisy.observed_cents, structures["H2"], priors=Priors(adjustment_cents=sd)
        )
        for sd in (30.0, 100.0, np.inf)
    }
    size = {sd: np.sqrt(np.mean(f.unknowns.adjustments_cents**2)) for sd, f in fits.items()}
    assert 1.2 * size[30.0] < size[100.0] < 0.7 * size[np.inf]
    assert fits[np.inf].rmsd_cents <= fits[100.0].rmsd_cents < fits[np.inf].rmsd_cents + 2


def test_a_prior_holds_coefficients_of_h7_where_data_do_not(noisy, structures):
    h4 = fit_hypothesis(noisy.observed_cents, structures["H4"])
    h7 = structures["H7"]
    start = continued(h4, h7)

    def moved(fraction):
        fit = fit_hypothesis(
            noisy.observed_cents, h7, start=start, priors=Priors(coefficient_share=fraction)
        )
        return np.abs((fit.unknowns.coefficients - start.coefficients) / fit.population.sizes)

    assert moved(1e-4).max() < 1e-3 < moved(0.1).max() < moved(0.5).max()


def test_canes_that_cannot_exist_are_flagged_not_clipped(clean, structures):
    """e1 − e3 < −3 makes G2 negative; the observations of such a reed are met all the same."""
    h4 = structures["H4"]
    e = clean.components.copy()
    e[5, [0, 2]] = -2.0, 2.5
    e = orthonormal(e)
    truth = Unknowns(h4.start, ADJUSTMENTS[:, None], e)
    fit = fit_hypothesis(clean.observed_cents, h4, start=truth, most_iterations=1)
    cents = clean.observed_cents - fit.population.residual_cents(fit.population.point(truth))
    assert (h4.parameters(h4.start, e)[5, :, 4] < 0).any()
    fit = fit_hypothesis(cents, h4, priors=NO_PRIORS, tolerance=1e-14)
    np.testing.assert_array_equal(fit.physical, (h4.parameters(h4.start, e) > 0).all(axis=2))
    assert not fit.physical[5].all()
    assert fit.rmsd_cents < 1e-5


def test_each_way_of_not_existing_is_flagged(clean, structures):
    fit = fit_hypothesis(clean.observed_cents, structures["H4"], most_iterations=3)
    fine = np.ones((55, 2, 6))
    assert replace(fit, parameters=fine).physical.all()
    for parameter, worst in enumerate((0.0, -1e-9, -1e-9, 0.0, -1e-9, -1e-9)):
        spoilt = fine.copy()
        spoilt[17, 1, parameter] = worst
        physical = replace(fit, parameters=spoilt).physical
        assert not physical[17, 1]
        assert np.count_nonzero(~physical) == 1
    # Elastic cane has no Maxwell arm, and exists.
    assert fit_hypothesis(clean.observed_cents, structures["H2"]).physical.all()


def test_asking_for_more_than_rounding_allows_ends_soon(noisy, structures):
    fit = fit_hypothesis(noisy.observed_cents, structures["H4"], tolerance=0.0)
    assert fit.converged
    assert fit.iterations < 25


# --- What is refused -----------------------------------------------------------------------------


def test_arrays_of_another_shape_are_refused(clean, structures):
    with pytest.raises(FitInputError, match=r"11 modes\), the modes in the order F1, T1"):
        fit_hypothesis(clean.observed_cents[:, :, :10], structures["H4"])
    with pytest.raises(FitInputError, match="2 series"):
        fit_hypothesis(clean.observed_cents[:, 0], structures["H4"])


def test_too_few_reeds_are_refused(clean, structures):
    with pytest.raises(FitInputError, match="give at least 6"):
        fit_hypothesis(clean.observed_cents[:5], structures["H4"])


def test_a_mode_that_no_reed_showed_is_refused(clean, structures):
    cents = clean.observed_cents.copy()
    cents[:, :, PAPER_MODES.index("X3")] = np.nan
    with pytest.raises(FitInputError, match="mode X3 was identified on no reed"):
        fit_hypothesis(cents, structures["H4"])


def test_a_reed_that_says_too_little_is_named(clean, structures):
    cents = clean.observed_cents.copy()
    cents[7, 1] = np.nan
    with pytest.raises(FitInputError, match=r"reed 7 .* has 11 resonances, .* 4 components"):
        fit_hypothesis(cents, structures["H4"])
    # Without drying nothing is asked of series B.
    assert fit_hypothesis(cents, structures["H2"]).converged


def test_infinite_observations_are_refused(clean, structures):
    cents = clean.observed_cents.copy()
    cents[0, 0, 0] = np.inf
    with pytest.raises(FitInputError, match="infinite"):
        fit_hypothesis(cents, structures["H4"])


def test_a_start_that_does_not_belong_is_refused(clean, structures):
    h4 = structures["H4"]
    start = Unknowns(h4.start, np.zeros((11, 1)), clean.components[:, :3])
    with pytest.raises(FitInputError, match=r"give \(9,\), \(55, 4\) and 11"):
        fit_hypothesis(clean.observed_cents, h4, start=start)


def test_a_start_outside_the_model_is_refused(clean, structures):
    h4 = structures["H4"]
    coefficients = h4.start.copy()
    coefficients[h4.coefficients.index("d10")] = -9000
    start = Unknowns(coefficients, np.zeros((11, 1)), clean.components)
    with pytest.raises(FitInputError, match="storage modulus is not positive"):
        fit_hypothesis(clean.observed_cents, h4, start=start)
