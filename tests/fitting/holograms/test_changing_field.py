"""The object field that changes, against dense Gaussian algebra and planted changes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j0

from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import SidebandAmplitudes
from fitting.holograms.changing_field import (
    FieldChange,
    field_estimate,
    found_change,
    renewal_of,
    unlikelihood,
)
from fitting.holograms.problem import Problem
from tests.numbers import complex_normal

HOLOGRAMS, BLOCKS, LIGHT = 40, 600, 30.0


def sweep_of(change, blocks=BLOCKS, order=None, seed=1):
    """A plate that moves like a piston of known amplitude, its field, and what is recorded."""
    rng = np.random.default_rng(seed)
    power = LIGHT**2 * rng.gamma(8, 1 / 8, blocks)
    steps = complex_normal(rng, HOLOGRAMS, blocks) * np.sqrt(change.walk * power)
    steps[0] = np.sqrt(power) * np.exp(2j * np.pi * rng.uniform(size=blocks))
    order = np.arange(HOLOGRAMS) if order is None else order
    field = np.cumsum(steps, axis=0)[order]
    own = complex_normal(rng, HOLOGRAMS, blocks) * np.sqrt(change.scatter * power)
    a = (0.5 + rng.uniform(size=(HOLOGRAMS, 1))) * np.exp(1j * rng.uniform(size=(HOLOGRAMS, 1)))
    functions = np.ones((blocks, 1))
    still = Problem.of(np.zeros((blocks, HOLOGRAMS), complex), functions, BesselTable())
    u, v = still.bessel_vectors(a)
    seen = (u + 1j * v) * (field + own) + complex_normal(rng, HOLOGRAMS, blocks)
    problem = Problem.of(seen.T, functions, BesselTable(), (), order)
    return problem, a, field, u + 1j * v


def test_field_of_a_hologram_is_the_conditional_mean_given_the_others():
    change = FieldChange(walk=0.01, scatter=0.003)
    order = np.random.default_rng(3).permutation(HOLOGRAMS)
    problem, a, field, shown = sweep_of(change, 5, order)
    found = field_estimate(problem, a, np.zeros(HOLOGRAMS), field, change, np.ones(HOLOGRAMS))
    power = np.mean(np.abs(field) ** 2, axis=0)
    seen = problem.real + 1j * problem.imaginary
    for n in range(5):
        prior = power[n] * (1 + change.walk * np.minimum.outer(order, order))
        for k in (0, 7, HOLOGRAMS - 1):
            rest = np.delete(np.arange(HOLOGRAMS), k)
            h = np.diag(shown[rest, n])
            own = change.scatter * power[n] * h @ h.conj().T
            covariance = h @ prior[np.ix_(rest, rest)] @ h.conj().T + own + np.eye(len(rest))
            gain = prior[k, rest] @ h.conj().T @ np.linalg.inv(covariance)
            assert found.mean[k, n] == pytest.approx(gain @ seen[rest, n], rel=1e-5)
            left = prior[k, k] - (gain @ h @ prior[rest, k]).real
            expected = left + change.scatter * power[n]
            assert found.variance[k, n] == pytest.approx(expected, rel=1e-5)


def test_hologram_says_nothing_of_its_own_field():
    change = FieldChange(walk=1e-3, scatter=1e-4)
    problem, a, field, _ = sweep_of(change)
    other = replace(problem, real=problem.real.copy())
    other.real[9] += 100.0
    zero, one = np.zeros(HOLOGRAMS), np.ones(HOLOGRAMS)
    before = field_estimate(problem, a, zero, field, change, one)
    after = field_estimate(other, a, zero, field, change, one)
    assert np.array_equal(before.mean[9], after.mean[9])
    assert np.abs(before.mean[10] - after.mean[10]).max() > 1


def test_hologram_without_weight_counts_for_nothing():
    change = FieldChange(walk=1e-3, scatter=1e-4)
    problem, a, field, _ = sweep_of(change)
    weight = np.where(np.arange(HOLOGRAMS) == 9, 0.0, 1.0)
    other = replace(problem, real=problem.real.copy())
    other.real[9] += 100.0
    zero = np.zeros(HOLOGRAMS)
    before = field_estimate(problem, a, zero, field, change, weight)
    after = field_estimate(other, a, zero, field, change, weight)
    assert np.array_equal(before.mean, after.mean)


@pytest.mark.parametrize(
    "change",
    [FieldChange(3e-4, 1e-7), FieldChange(1e-7, 3e-4), FieldChange(1e-4, 4e-4)],
)
def test_changes_are_found(change):
    problem, a, field, _ = sweep_of(change, 2400)
    every = np.ones(HOLOGRAMS, bool)
    found = found_change(problem, a, np.zeros(HOLOGRAMS), field, every)
    # 600 blocks of 40 holograms determine a variance to some per cent; a change of less than a
    # twentieth of the noise does not matter.
    for one, other in ((found.walk, change.walk), (found.scatter, change.scatter)):
        assert one == pytest.approx(other, rel=0.2, abs=0.05 * LIGHT**-2)


def test_field_that_does_not_change_is_found_not_to():
    problem, a, field, _ = sweep_of(FieldChange(0, 0))
    found = found_change(problem, a, np.zeros(HOLOGRAMS), field, np.ones(HOLOGRAMS, bool))
    # The noise of a block is 1/30 of its light: what is found is far below its square.
    assert found.walk < 0.01 * LIGHT**-2
    assert found.scatter < 0.03 * LIGHT**-2


def test_other_sidebands_say_of_the_field_what_they_show():
    change = FieldChange(walk=1e-3, scatter=1e-6)
    problem, a, field, _ = sweep_of(change)
    rng = np.random.default_rng(5)
    still = SidebandAmplitudes(
        0, np.zeros((BLOCKS, HOLOGRAMS), np.complex64), np.ones(HOLOGRAMS, bool)
    )
    two = Problem.of(
        (problem.real + 1j * problem.imaginary).T, problem.functions, problem.bessel, (still,)
    )

    seen = j0(np.abs(a)) * field + complex_normal(rng, HOLOGRAMS, BLOCKS)
    side = replace(two.others[0], real=seen.real, imaginary=seen.imag)
    zero, one = np.zeros(HOLOGRAMS), np.ones(HOLOGRAMS)
    alone = field_estimate(problem, a, zero, field, change, one)
    both = field_estimate(replace(two, others=(side,)), a, zero, field, change, one)
    errors = [np.mean(np.abs(found.mean - field) ** 2) for found in (alone, both)]
    assert errors[1] < errors[0]
    assert np.mean(both.variance) == pytest.approx(errors[1], rel=0.2)
    assert np.mean(alone.variance) == pytest.approx(errors[0], rel=0.2)


def test_likelihood_is_that_of_all_holograms_together():
    change = FieldChange(walk=1e-3, scatter=3e-4)
    order = np.random.default_rng(3).permutation(HOLOGRAMS)
    problem, a, field, shown = sweep_of(change, 41, order)
    zero, one = np.zeros(HOLOGRAMS), np.ones(HOLOGRAMS)
    power, expected, first, light = np.mean(np.abs(field) ** 2, axis=0), 0.0, 0.0, 0.0
    seen = problem.real + 1j * problem.imaginary
    start = int(np.argmin(order))
    for n in range(0, 41, 4):
        h = np.diag(shown[:, n])
        prior = power[n] * (1 + change.walk * np.minimum.outer(order, order))
        own = change.scatter * power[n] * np.eye(HOLOGRAMS)
        covariance = h @ (prior + own) @ h.conj().T + np.eye(HOLOGRAMS)
        expected += np.linalg.slogdet(covariance)[1]
        expected += (seen[:, n].conj() @ np.linalg.solve(covariance, seen[:, n])).real
        alone, bright = covariance[start, start].real, abs(seen[start, n]) ** 2
        first += np.log(alone) + bright / alone
        light += np.log(bright) + 1
    # Nothing predicts the first: light of any size explains it as well.
    expected += min(light - first, 0.0)
    assert unlikelihood(problem, a, zero, field, change, one) == pytest.approx(expected, rel=1e-6)


def test_the_right_displacements_are_likelier_than_half_of_them_and_a_field_that_changes_more():
    change = FieldChange(walk=1e-4, scatter=1e-6)
    problem, a, field, _ = sweep_of(change)
    zero, one = np.zeros(HOLOGRAMS), np.ones(HOLOGRAMS)
    right = unlikelihood(problem, a, zero, field, change, one)
    for more in (1, 10, 100):
        other = FieldChange(more * change.walk, change.scatter)
        assert unlikelihood(problem, 0.5 * a, zero, 2 * field, other, one) > right + 100


def test_a_hologram_that_is_not_explained_costs_what_light_of_any_size_costs():
    change = FieldChange(walk=1e-4, scatter=1e-6)
    problem, a, field, _ = sweep_of(change)
    zero, ninth = np.zeros(HOLOGRAMS), np.arange(HOLOGRAMS) == 9
    right = unlikelihood(problem, a, zero, field, change, np.ones(HOLOGRAMS))
    without = unlikelihood(problem, a, zero, field, change, np.where(ninth, np.inf, 1.0))
    wrong = np.where(ninth[:, None], 5 * a, a)
    lost = unlikelihood(problem, wrong, zero, field, change, np.where(ninth, 1e4, 1.0))
    assert right < without - 100
    assert lost == pytest.approx(without, abs=0.01 * (without - right))


@pytest.mark.parametrize("sharing", [1, 4])
def test_renewed_speckle_changes_the_smooth_factor_as_it_changes_means_over_blocks(sharing):
    """Blocks that share their noise four by four are a quarter as many."""
    rng, walk, blocks = np.random.default_rng(12), 1e-4, 240
    x, y = rng.uniform(-1, 1, (2, blocks))
    smooth = np.stack([np.ones(blocks), x, y, x * y], axis=1)
    smooth = np.repeat(smooth[: blocks // sharing], sharing, axis=0)
    change = np.sqrt(walk) * complex_normal(rng, 4000, blocks // sharing)
    change = np.repeat(change, sharing, axis=1)
    onto = np.linalg.pinv(smooth)
    coefficients = np.concatenate([change.real @ onto.T, (change.imag @ onto.T)[:, 1:]], axis=1)
    found = renewal_of(smooth, walk, 1 / sharing)
    size = np.sqrt(np.diag(found))
    relative = np.cov(coefficients.T) / np.outer(size, size)
    assert relative == pytest.approx(found / np.outer(size, size), abs=0.1)
