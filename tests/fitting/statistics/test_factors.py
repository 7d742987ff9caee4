"""Principal components, VARIMAX, regression: analytic answers, invariants, the paper's Table 2."""

import numpy as np
import pytest
from scipy.stats import ortho_group, pearsonr

from fitting.errors import FitError
from fitting.statistics.factors import (
    Factors,
    complete_variables,
    correlations,
    orthonormal,
    principal_factors,
    reconstruct,
    rotated,
    varimax,
    varimax_factors,
)


@pytest.fixture
def population():
    """Twenty reeds, six correlated variables of very different spread, none centred."""
    rng = np.random.default_rng(4)
    return 3000 + rng.standard_normal((20, 6)) @ rng.standard_normal((6, 6)) * [1, 2, 5, 9, 20, 50]


@pytest.fixture(scope="session")
def table_2(tables):
    """The paper's rotated loadings: 14 variables, then e1 to e4."""
    return np.array(list(tables["rotated_loadings"].values()))


def unevenness(loadings, kaiser):
    if kaiser:
        loadings = loadings / np.linalg.norm(loadings, axis=1, keepdims=True)
    return (loadings**2).var(axis=0).sum()


@pytest.mark.parametrize("r", [0.0, 0.6, -0.9])
def test_two_variables_have_the_factors_of_their_correlation(r):
    independent = orthonormal(np.random.default_rng(1).standard_normal((30, 2)))
    values = np.column_stack(
        [100 + 7 * independent[:, 0], 40 * independent @ [r, np.sqrt(1 - r**2)]]
    )
    found = principal_factors(values, 2)
    np.testing.assert_allclose(found.fractions, [(1 + abs(r)) / 2, (1 - abs(r)) / 2], atol=1e-12)
    np.testing.assert_allclose(found.spectrum, found.fractions, atol=1e-12)
    if r:
        expected = np.sqrt((1 + abs(r)) / 2)
        np.testing.assert_allclose(np.sort(found.loadings[:, 0] * [1, np.sign(r)]), expected)


@pytest.mark.parametrize(("matrix", "of"), [("correlation", np.corrcoef), ("covariance", np.cov)])
def test_shares_are_eigenvalues_of_the_matrix(population, matrix, of):
    eigenvalues = np.linalg.eigvalsh(of(population.T))[::-1]
    found = principal_factors(population, 3, matrix=matrix)
    np.testing.assert_allclose(found.spectrum, eigenvalues / eigenvalues.sum())
    np.testing.assert_allclose(found.fractions, found.spectrum[:3])


@pytest.mark.parametrize("matrix", ["correlation", "covariance"])
def test_scores_are_standardised_and_loadings_correlate_them_with_the_variables(population, matrix):
    found = principal_factors(population, 3, matrix=matrix)
    np.testing.assert_allclose(found.scores.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(np.cov(found.scores.T), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.loadings, correlations(population, found.scores), atol=1e-12)
    assert np.all(found.loadings[np.abs(found.loadings).argmax(axis=0), range(3)] > 0)


def test_all_factors_give_the_variables_back(population):
    found = principal_factors(population, 6)
    standard = (population - population.mean(axis=0)) / population.std(axis=0, ddof=1)
    np.testing.assert_allclose(found.scores @ found.loadings.T, standard, atol=1e-10)


def test_the_scale_of_a_variable_matters_to_the_covariance_only(population):
    scaled = population * [1, 1, 1, 1, 1, 30]
    np.testing.assert_allclose(
        principal_factors(scaled, 2).scores, principal_factors(population, 2).scores
    )
    fractions = principal_factors(scaled, 2, matrix="covariance").fractions
    assert fractions[0] > principal_factors(population, 2, matrix="covariance").fractions[0] + 0.01


def test_more_variables_than_reeds(population):
    found = principal_factors(population[:4], 3)
    assert found.spectrum.shape == (3,)
    assert found.fractions.sum() == pytest.approx(1)
    with pytest.raises(ValueError, match="4 factors of a population of 3 dimensions"):
        principal_factors(population[:4], 4)


def test_impossible_factors_are_refused(population):
    with pytest.raises(ValueError, match="ask for 1 to 6"):
        principal_factors(population, 0)
    with pytest.raises(ValueError, match="1 reeds have no factors"):
        principal_factors(population[:1], 1)
    with pytest.raises(ValueError, match="variable 2 is the same on all reeds"):
        principal_factors(np.where(np.arange(6) == 2, 4321.1, population), 2)
    population[3, 1] = np.nan
    with pytest.raises(ValueError, match="choose the complete_variables"):
        principal_factors(population, 2)


def test_complete_variables_are_those_found_on_all_reeds(population):
    population[3, 1] = population[0, 5] = np.nan
    assert complete_variables(population).tolist() == [0, 2, 3, 4]
    with pytest.raises(FitError, match="1 of 6 variables"):
        complete_variables(np.where(np.arange(6) == 2, population, np.nan))
    with pytest.raises(FitError, match="2 reeds"):
        complete_variables(population[:2])


def test_varimax_leaves_the_papers_table_2_as_it_is(table_2):
    """With components among the rows and rows of length 1, and in no other way."""
    np.testing.assert_allclose(table_2 @ varimax(table_2), table_2, atol=5e-4)
    for rows, kaiser in ((table_2, False), (table_2[:14], True)):
        moved = np.abs(rows @ varimax(rows, kaiser=kaiser) - rows).max()
        assert moved > 5e-3


def test_varimax_finds_table_2_again(table_2):
    mixed = table_2 @ ortho_group.rvs(4, random_state=7)
    weights = np.r_[np.full(14, 1 / 14), np.zeros(4)]
    start = Factors(np.zeros((1, 4)), mixed, weights, np.ones(4))
    np.testing.assert_allclose(rotated(start, varimax(mixed)).loadings, table_2, atol=5e-4)


def test_table_2_bears_the_shares_of_a_correlation_matrix(table_2, tables):
    """Not those of a covariance matrix: what the paper's factors were made from."""
    variables = table_2[:14]
    names = list(tables["rotated_loadings"])[:14]
    modes = [tables["observed_resonances"][name[1:]][name[0]] for name in names]
    sd = np.array([mode["sd_hz"] / mode["mean_hz"] for mode in modes])
    printed = np.array(tables["pca"]["both"]["variance_percent"])

    def misfit(weighted):
        eigenvalues = np.linalg.eigvalsh(weighted.T @ weighted)[::-1]
        return np.abs(100 * eigenvalues / total - printed).max()

    total = 14
    assert misfit(variables) < 0.6
    total = (sd**2).sum()
    assert misfit(sd[:, None] * variables) > 1.5


@pytest.mark.parametrize("kaiser", [True, False])
def test_varimax_of_two_factors_is_the_best_of_all_angles(kaiser):
    loadings = np.random.default_rng(3).uniform(-1, 1, (9, 2))
    rotation = varimax(loadings, kaiser=kaiser)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(2), atol=1e-12)

    def at(angle):
        c, s = np.cos(angle), np.sin(angle)
        return unevenness(loadings @ [[c, -s], [s, c]], kaiser)

    best = max(at(angle) for angle in np.linspace(0, np.pi / 2, 20001))
    assert unevenness(loadings @ rotation, kaiser) == pytest.approx(best, rel=1e-7)


@pytest.mark.parametrize("kaiser", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_varimax_never_makes_loadings_more_even(seed, kaiser):
    loadings = np.random.default_rng(seed).standard_normal((14, 4))
    rotation = varimax(loadings, kaiser=kaiser)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(4), atol=1e-12)
    assert unevenness(loadings @ rotation, kaiser) > unevenness(loadings, kaiser)
    again = varimax(loadings @ rotation, kaiser=kaiser)
    np.testing.assert_allclose(again, np.eye(4), atol=1e-6)
    assert np.array_equal(rotation, varimax(loadings, kaiser=kaiser))


def test_varimax_leaves_loadings_alone_that_no_rotation_changes():
    angles = 0.1 + np.pi / 4 * np.arange(8)
    octagon = np.column_stack([np.cos(angles), np.sin(angles)])
    assert np.array_equal(varimax(octagon), np.eye(2))
    assert np.array_equal(varimax(np.zeros((8, 2))), np.eye(2))


def test_varimax_undoes_the_rotation_of_a_simple_structure():
    """Each variable on one factor, one on none: no rotation is more uneven."""
    simple = np.zeros((10, 3))
    simple[range(9), np.arange(9) % 3] = np.linspace(0.5, 0.9, 9)
    mixed = simple @ ortho_group.rvs(3, random_state=2)
    found = mixed @ varimax(mixed)
    np.testing.assert_allclose(np.sort(np.abs(found), axis=1), np.sort(simple, axis=1), atol=1e-8)


def test_rotated_factors_are_in_order_of_variance_with_positive_peaks(population):
    found = principal_factors(population, 4)
    turned = rotated(found, ortho_group.rvs(4, random_state=1))
    assert np.all(np.diff(turned.fractions) <= 0)
    assert turned.fractions.sum() == pytest.approx(found.fractions.sum())
    assert np.all(turned.loadings[np.abs(turned.loadings).argmax(axis=0), range(4)] > 0)
    np.testing.assert_allclose(np.cov(turned.scores.T), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(turned.loadings, correlations(population, turned.scores), atol=1e-12)
    # Rotation shows the same plane of factors from another side.
    np.testing.assert_allclose(
        turned.scores @ turned.loadings.T, found.scores @ found.loadings.T, atol=1e-10
    )


def test_additional_variables_take_part_in_the_rotation_only(population):
    found = principal_factors(population, 2)
    additional = found.scores @ [[0.6, -0.8], [0.8, 0.6]]
    alone, many = varimax_factors(found), varimax_factors(found, np.tile(additional, 50))
    assert alone.fractions.sum() == pytest.approx(many.fractions.sum())
    assert np.abs(alone.loadings - many.loadings).max() > 0.01
    pulled = np.abs(correlations(additional, many.scores))
    np.testing.assert_allclose(np.sort(pulled, axis=1), [[0, 1], [0, 1]], atol=0.05)


def test_correlations_delete_missing_observations_by_pairs(population):
    rng = np.random.default_rng(8)
    # Far from zero a sum of squares less the square of a sum would leave nothing.
    values = np.where(rng.random(population.shape) < 0.3, np.nan, population + 1e6)
    found = correlations(values, values[:, :2])
    for i, row in enumerate(found):
        for j, value in enumerate(row):
            both = np.isfinite(values[:, i]) & np.isfinite(values[:, j])
            expected = pearsonr(values[both, i], values[both, j]).statistic
            assert value == pytest.approx(expected, abs=1e-6)


def test_correlations_that_cannot_be_known_are_nan():
    line = np.arange(7.0)
    line[0] = np.nan
    two, none = np.where(line < 3, line, np.nan), np.full(7, np.nan)
    constant = np.full(7, 1234.1)
    # Different on the one reed that the line lacks, so that what is left is rounding.
    elsewhere = np.where(np.isnan(line), 1334.4, 1234.1)
    columns = np.column_stack([line, -line, two, none, constant, elsewhere])
    found = correlations(line[:, None], columns)
    np.testing.assert_allclose(found, [[1, -1, np.nan, np.nan, np.nan, np.nan]])
    np.testing.assert_allclose(correlations(columns, line[:, None]), found.T)


def test_regression_recovers_what_is_linear_in_the_factors(population):
    scores = principal_factors(population, 2).scores
    truth = np.array([[4000, 30, -5], [600, 0, 44], [2500, -7, 7.0]])
    cents = np.column_stack([np.ones(20), scores]) @ truth.T
    observed = cents.copy()
    observed[[0, 7, 11], [0, 1, 1]] = np.nan
    found = reconstruct(observed, scores)
    np.testing.assert_allclose(found.coefficients, truth, atol=1e-9)
    np.testing.assert_allclose(found.cents, cents)
    assert found.rmsd_cents == pytest.approx(0, abs=1e-9)


def test_misfit_of_regression_is_the_variance_of_the_factors_left_out(population):
    found = principal_factors(population, 3, matrix="covariance")
    left_out = np.linalg.eigvalsh(np.cov(population.T))[:3].sum()
    rmsd = reconstruct(population, found.scores).rmsd_cents
    assert rmsd == pytest.approx(np.sqrt(left_out * 19 / (20 * 6)))


def test_misfit_counts_what_was_observed(population):
    """A variable that follows no factor, seen on half of the reeds, misses by its own spread."""
    scores = np.repeat([[1.0], [-1.0], [1.0], [-1.0], [1.0]], 4, axis=0)
    alternating = 100 + 6 * np.resize([1.0, 1.0, -1.0, -1.0], 20)
    observed = np.column_stack([50 * scores[:, 0], alternating])
    observed[10:, 0] = np.nan
    assert reconstruct(observed, scores).rmsd_cents == pytest.approx(6 * np.sqrt(20 / 30))


def test_a_variable_seen_on_too_few_reeds_is_refused(population):
    population[3:, 4] = np.nan
    with pytest.raises(FitError, match="variable 4 was found on 3 reeds"):
        reconstruct(population, np.random.default_rng(1).standard_normal((20, 2)))


def test_orthonormal_components_satisfy_the_papers_condition():
    drawn = 0.3 + 1.4 * np.random.default_rng(6).standard_normal((55, 4))
    made = orthonormal(drawn)
    extended = np.column_stack([np.ones(55), made])
    np.testing.assert_allclose(extended.T @ extended, np.diag([55, 54, 54, 54, 54]), atol=1e-10)
    np.testing.assert_allclose(orthonormal(made), made, atol=1e-12)


def test_orthonormal_components_keep_their_meaning():
    """Of all orthonormal sets the nearest; Gram and Schmidt's favours the first component."""
    drawn = np.random.default_rng(6).standard_normal((12, 4))
    drawn[:, 1] += drawn[:, 0]
    centred = drawn - drawn.mean(axis=0)
    made = orthonormal(drawn)
    q, r = np.linalg.qr(centred)
    others = [q * np.sign(np.diag(r)) * np.sqrt(11)]
    others += [made @ ortho_group.rvs(4, random_state=seed) for seed in range(20)]
    assert all(np.linalg.norm(made - centred) < np.linalg.norm(other - centred) for other in others)
    # Which component comes first does not matter.
    np.testing.assert_allclose(orthonormal(drawn[:, ::-1])[:, ::-1], made, atol=1e-12)


def test_dependent_components_are_refused():
    drawn = np.random.default_rng(6).standard_normal((12, 3))
    with pytest.raises(ValueError, match="depend on one another"):
        orthonormal(np.column_stack([drawn, drawn.sum(axis=1)]))
    for reeds in (1, 2, 3):
        with pytest.raises(ValueError, match=f"3 components on {reeds} reeds"):
            orthonormal(drawn[:reeds])
