"""The arrow-shaped least squares against dense algebra and problems with known minima."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.linalg import null_space

from fitting.statistics.hypotheses.arrow import (
    ArrowEquations,
    ArrowPoint,
    minimise,
)

REEDS, OWN, SHARED, ROWS = 7, 3, 5, 9


@pytest.fixture
def blocks():
    """Random Jacobian and residuals of seven reeds, and two constraints."""
    rng = np.random.default_rng(4)
    by_own = rng.standard_normal((REEDS, ROWS, OWN))
    by_shared = rng.standard_normal((REEDS, ROWS, SHARED))
    residual = rng.standard_normal((REEDS, ROWS))
    return by_own, by_shared, residual, rng.standard_normal((REEDS, OWN, 2))


def equations(by_own, by_shared, residual, constraints):
    return ArrowEquations(
        cost=float(np.sum(residual**2)),
        own=np.swapaxes(by_own, 1, 2) @ by_own,
        cross=np.swapaxes(by_own, 1, 2) @ by_shared,
        shared=np.einsum("nxp,nxq->pq", by_shared, by_shared),
        own_descent=np.einsum("nxk,nx->nk", by_own, residual),
        shared_descent=np.einsum("nxp,nx->p", by_shared, residual),
        constraints=constraints,
    )


def dense(by_own, by_shared, constraints):
    """Jacobian (rows, unknowns) and an orthonormal basis of the steps allowed."""
    jacobian = np.zeros((REEDS * ROWS, SHARED + REEDS * OWN))
    for n in range(REEDS):
        rows = slice(n * ROWS, (n + 1) * ROWS)
        jacobian[rows, :SHARED] = by_shared[n]
        jacobian[rows, SHARED + n * OWN : SHARED + (n + 1) * OWN] = by_own[n]
    forbidden = np.zeros((constraints.shape[-1], jacobian.shape[1]))
    forbidden[:, SHARED:] = constraints.reshape(REEDS * OWN, -1).T
    return jacobian, null_space(forbidden)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_step_is_that_of_the_dense_constrained_least_squares(blocks, damping):
    by_own, by_shared, residual, constraints = blocks
    jacobian, allowed = dense(by_own, by_shared, constraints)
    normal = jacobian.T @ jacobian
    normal += damping * np.diag(np.diag(normal))
    right = allowed.T @ jacobian.T @ residual.ravel()
    expected = allowed @ np.linalg.solve(allowed.T @ normal @ allowed, right)
    step = equations(*blocks).step(damping)
    np.testing.assert_allclose(np.append(step.shared, step.own), expected, atol=1e-10)


def test_information_on_the_shared_is_the_inverse_of_their_covariance(blocks):
    by_own, by_shared, _, constraints = blocks
    jacobian, allowed = dense(by_own, by_shared, constraints)
    covariance = allowed @ np.linalg.inv(allowed.T @ jacobian.T @ jacobian @ allowed) @ allowed.T
    information = equations(*blocks).information_on_shared()
    np.testing.assert_allclose(np.linalg.inv(information), covariance[:SHARED, :SHARED], atol=1e-10)


def test_inner_product_and_expected_decrease_are_those_of_the_dense_jacobian(blocks):
    by_own, by_shared, residual, constraints = blocks
    jacobian, _ = dense(by_own, by_shared, constraints)
    rng = np.random.default_rng(5)
    a, b = (
        ArrowPoint(rng.standard_normal(SHARED), rng.standard_normal((REEDS, OWN))) for _ in "ab"
    )
    flat_a, flat_b = (np.append(p.shared, p.own) for p in (a, b))
    here = equations(*blocks)
    assert here.times(a).dot(b) == pytest.approx(flat_a @ jacobian.T @ jacobian @ flat_b)
    assert here.expected_decrease(a) == pytest.approx(flat_a @ jacobian.T @ residual.ravel())


@dataclass
class Curved:
    """Rosenbrock's valley in the shared unknown and that of a single reed, counted calls.

    `steepness` sets how narrow it is; the cost is infinite left of `wall`.
    """

    steepness: float = 10.0
    wall: float = -np.inf
    floor: float = 0.0

    def _residual(self, at):
        x, y = at.shared[0], at.own[0, 0]
        return np.array([1 - x, self.steepness * (y - x**2), self.floor * (1 + (x - 1) ** 2)])

    def cost(self, at):
        return float(np.sum(self._residual(at) ** 2)) if at.shared[0] > self.wall else np.inf

    def normal_equations(self, at):
        x = at.shared[0]
        by_own = np.array([[[0.0], [self.steepness], [0.0]]])
        by_shared = np.array([[[-1.0], [-2 * self.steepness * x], [2 * self.floor * (x - 1)]]])
        return equations(by_own, by_shared, -self._residual(at)[None], np.empty((1, 1, 0)))

    def onto_constraints(self, near):
        return near


def test_the_end_of_a_curved_valley_is_found():
    start = ArrowPoint(np.array([-1.2]), np.array([[1.0]]))
    found = minimise(Curved(), start, tolerance=1e-20, most_iterations=100)
    assert found.converged
    assert found.cost == pytest.approx(Curved().cost(found.point), abs=1e-30)
    assert found.cost == pytest.approx(0, abs=1e-18)
    assert (found.point.shared[0], found.point.own[0, 0]) == pytest.approx((1, 1), abs=1e-8)


def test_a_search_never_enters_where_there_is_no_answer():
    start = ArrowPoint(np.array([-1.2]), np.array([[1.0]]))
    found = minimise(Curved(wall=-1.3), start, tolerance=1e-20, most_iterations=100)
    assert found.converged
    assert found.point.shared[0] == pytest.approx(1)


def test_a_search_that_ends_at_the_edge_of_the_model_says_so():
    start = ArrowPoint(np.array([3.0]), np.array([[9.0]]))
    found = minimise(Curved(wall=2.0), start, tolerance=1e-10, most_iterations=300)
    assert found.point.shared[0] == pytest.approx(2, abs=0.1)
    assert not found.converged


def test_large_residuals_do_not_slow_the_search():
    """On this floor Gauss-Newton steps overshoot threefold: 77 iterations unaccelerated."""
    start = ArrowPoint(np.array([1.2]), np.array([[1.44]]))
    found = minimise(Curved(floor=1), start, tolerance=1e-13, most_iterations=100)
    assert found.converged
    assert found.iterations < 30
    assert found.point.shared[0] == pytest.approx(1, abs=1e-7)


def test_the_last_step_is_taken_and_counted():
    problem = Curved(steepness=1.0, floor=0.5)
    start = ArrowPoint(np.array([1.2]), np.array([[1.44]]))
    found = minimise(problem, start, tolerance=1e-3, most_iterations=100)
    assert found.converged
    assert found.cost == pytest.approx(problem.cost(found.point), rel=1e-14)
    assert found.cost < 0.25 + 1e-5


def test_a_search_that_ran_out_of_iterations_says_so():
    start = ArrowPoint(np.array([-1.2]), np.array([[1.0]]))
    found = minimise(Curved(), start, tolerance=1e-20, most_iterations=2)
    assert not found.converged
    assert found.iterations == 2
    assert found.cost == Curved().cost(found.point) < Curved().cost(start)


def test_the_cost_never_increases():
    start = ArrowPoint(np.array([-1.2]), np.array([[1.0]]))
    costs = [
        minimise(Curved(), start, tolerance=1e-20, most_iterations=n).cost for n in range(1, 41, 3)
    ]
    assert (np.diff(costs) <= 0).all()
    assert costs[-1] < 1e-15
