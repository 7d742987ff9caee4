"""Priors with pairs of parameters that are tied, against the normal distribution that they are."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from fitting.modal.expected.prior import Prior, Ties
from fitting.modal.first_state import LAST
from fitting.modal.model import stage_prior

# Parameters in rows; the first and third pair is tied, and one parameter is fixed.
TIED = np.array([[[0, 2], [1, 3]], [[1, 3], [4, 0]]])
FIXED = (1, 2)


@pytest.fixture(scope="module")
def prior():
    rng = np.random.default_rng(1)
    centre, precision = rng.standard_normal((4, 5)), rng.uniform(0.5, 4, (4, 5))
    centre[tuple(TIED)], precision[FIXED] = 0.0, np.inf
    return Prior(centre, precision, Ties(TIED, rng.uniform(0.5, 2, (2, 2)), 3.0))


@pytest.fixture(scope="module")
def whole(prior):
    """Precision of all free parameters, from its definition."""
    free = np.flatnonzero(prior.free)
    matrix = np.diag(prior.precision.ravel()[free])
    for pair in range(2):
        row = np.zeros(prior.precision.size)
        for parameter in range(2):
            place = np.ravel_multi_index(TIED[:, parameter, pair], prior.precision.shape)
            row[place] = prior.ties.weights[parameter, pair]
        matrix += 3.0 * np.outer(row[free], row[free])
    return matrix


@pytest.fixture
def x(prior):
    drawn = np.random.default_rng(2).standard_normal(prior.centre.shape)
    drawn[FIXED] = prior.centre[FIXED]
    return drawn


def test_cost_and_volume_are_the_density(prior, whole, x):
    free = prior.free
    density = stats.multivariate_normal(prior.centre[free], np.linalg.inv(whole)).logpdf(x[free])
    constant = -0.5 * len(whole) * np.log(2 * np.pi)
    assert 0.5 * (prior.log_volume - prior.cost(x)) + constant == pytest.approx(density)


def test_pull_is_half_the_slope_of_the_cost(prior, whole, x):
    assert prior.pull(x)[prior.free] == pytest.approx(whole @ (x - prior.centre)[prior.free])
    assert prior.pull(x)[FIXED] == 0


def test_matrices_and_standard_deviations_are_those_of_the_precision(prior, whole):
    matrix = np.zeros((len(whole) + 2,) * 2)
    prior.add_to(matrix)
    assert matrix[:-2, :-2] == pytest.approx(whole)
    assert not matrix[-2:].any()
    assert prior.spread[prior.free] == pytest.approx(np.sqrt(np.diag(np.linalg.inv(whole))))
    assert prior.spread[FIXED] == 0


def test_the_share_of_the_prior_is_the_trace_of_its_precision_times_the_covariance(prior, whole):
    covariance = np.linalg.inv(whole + np.diag(np.random.default_rng(3).uniform(0, 1, len(whole))))
    assert prior.share(covariance, prior.free) == pytest.approx(np.trace(whole @ covariance))
    # Of one pair alone.
    among = np.zeros_like(prior.free)
    among[tuple(TIED[:, :, 0])] = True
    numbers = np.flatnonzero(among[prior.free])
    block = np.ix_(numbers, numbers)
    expected = np.trace(whole[block] @ covariance[block])
    assert prior.share(covariance, among) == pytest.approx(expected)


# --- Shapes of modes ---------------------------------------------------------------------------


def model_of(scale):
    """Three modes, of which two are 20 cents apart; the third lies beyond the sweep."""
    return SimpleNamespace(
        hz=np.geomspace(2e3, 8e3, 40),
        powers=np.ones((40, 2)),
        reference=np.eye(3),
        reference_hz=np.array([4e3, 4e3 * 2 ** (20 / 1200), 12e3]),
        active=np.array([0, 1]),
        passive=np.array([2]),
        forms=SimpleNamespace(scale=np.asarray(scale)),
        slots=6,
    )


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (1.0, 0.3, 1.0)])
def test_two_modes_may_exchange_shapes_but_not_have_the_same(scale):
    """Turned shapes of unit mass contain each other with opposite signs, parallel ones do not."""
    model = model_of(scale)
    prior = stage_prior(model, LAST, model.reference_hz[:2], np.ones(3))
    alone = replace(prior, ties=Ties(np.zeros((2, 2, 0), int), np.zeros((2, 0)), 0.0))
    costs = {}
    for name, sign in (("turned", -1.0), ("parallel", 1.0)):
        x = prior.centre.copy()
        mass = np.array(scale) * model.reference_hz
        # As much of the other shape of unit mass in either.
        x[2 + 1, 0], x[2 + 0, 1] = 0.3 * mass[1] / mass[0], sign * 0.3 * mass[0] / mass[1]
        costs[name] = prior.cost(x) - alone.cost(x)
    assert costs["turned"] == pytest.approx(0, abs=1e-9)
    # 0.6 where 0.08 is usual.
    assert costs["parallel"] == pytest.approx((0.6 / 0.08) ** 2)
