"""Levenberg-Marquardt steps for many problems at once, compared with scipy one by one."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from fitting.levenberg_marquardt import Damping, NormalEquations, minimise_all

T = np.linspace(0, 1, 30)
TRUE = np.array([[1.0, -2.0, 0.3], [3.0, -0.5, -1.0], [0.2, 1.0, 2.0]])
DAMPING = Damping(first=1e-2, after_gain=0.3, after_loss=5, constant=1e-12)


def model(x):
    return x[:, :1] * np.exp(x[:, 1:2] * T) + x[:, 2:]


DATA = model(TRUE) + 0.01 * np.random.default_rng(0).standard_normal((3, len(T)))


EVERY = np.arange(3)


def cost_terms(x, which=EVERY):
    return np.sum((DATA[which] - model(x)) ** 2, axis=1)[None]


def equations(x, which):
    grown = np.exp(x[:, 1:2] * T)
    jacobian = np.stack([grown, x[:, :1] * T * grown, np.ones_like(grown)], axis=2)
    matrix = np.einsum("stu,stv->suv", jacobian, jacobian)
    return NormalEquations(
        cost_terms(x, which),
        np.einsum("stu,st->su", jacobian, DATA[which] - model(x)),
        matrix,
        np.trace(matrix, axis1=1, axis2=2),
    )


def test_all_problems_reach_the_minimum_of_scipy():
    start = np.tile([1.0, 0.1, 0.0], (3, 1))
    x, (cost,) = minimise_all(equations, cost_terms, start, 60, DAMPING)
    for s in range(3):
        found = least_squares(lambda z, s=s: DATA[s] - model(z[None])[0], start[s])
        assert x[s] == pytest.approx(found.x, rel=1e-4, abs=1e-4)
        assert cost[s] == pytest.approx(2 * found.cost, rel=1e-6)


@pytest.mark.parametrize("iterations", [1, 2, 7])
def test_cost_never_increases_and_belongs_to_the_result(iterations):
    start = np.tile([5.0, 3.0, -2.0], (3, 1))
    x, terms = minimise_all(equations, cost_terms, start, iterations, DAMPING)
    np.testing.assert_array_equal(terms, cost_terms(x))
    assert np.all(terms <= cost_terms(start))


def test_a_problem_does_not_depend_on_the_others():
    start = np.tile([1.0, 0.1, 0.0], (3, 1))
    together, _ = minimise_all(equations, cost_terms, start, 5, DAMPING)
    changed = start.copy()
    changed[1:] = 0.5
    other, _ = minimise_all(equations, cost_terms, changed, 5, DAMPING)
    np.testing.assert_array_equal(together[0], other[0])


def test_steps_end_when_they_are_expected_to_gain_little():
    counted = np.zeros(3, int)

    def counting(x, which):
        counted[which] += 1
        return equations(x, which)

    start = np.tile([1.0, 0.1, 0.0], (3, 1))
    all_steps, _ = minimise_all(equations, cost_terms, start, 60, DAMPING)
    start[2] = all_steps[2]
    x, terms = minimise_all(counting, cost_terms, start, 60, DAMPING, least_gain=1e-6)
    # One that is there already is not followed as long as the others.
    assert counted[2] < counted[:2].min()
    assert counted.max() < 60
    np.testing.assert_array_equal(terms, cost_terms(x))
    assert cost_terms(x) == pytest.approx(cost_terms(all_steps), abs=1e-5)
