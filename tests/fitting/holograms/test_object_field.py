"""Light and displacements together: derivatives, flat directions, and how they are reported."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1

from fitting.holograms.bessel import BesselTable
from fitting.holograms.object_field import (
    field_factor,
    field_step,
    linearise,
    response_of_small,
    smooth_functions,
)
from fitting.holograms.problem import Problem, normal
from tests.numbers import complex_normal

POINTS, HOLOGRAMS, FUNCTIONS = 300, 14, 3
# Polynomials of total degree 10 in two variables; magnitude and phase, which has no constant.
SMOOTH, VALUES = 66, 131


def moved(u):
    """F(u) = u J₁(|u|)/|u|."""
    phi = np.abs(u)
    return u * np.divide(j1(phi), phi, out=np.full_like(phi, 0.5), where=phi > 0)


class Sweep:
    """Block amplitudes by the formula, of holograms with a largest phase of `largest_rad`."""

    def __init__(self, largest_rad, noise=1.0, seed=0, holograms=HOLOGRAMS):
        rng = np.random.default_rng(seed)
        self.x, self.y = rng.uniform(0, 30e-3, POINTS), rng.uniform(-6e-3, 6e-3, POINTS)
        u = 1 - self.x / 35e-3
        shapes = np.stack([u**2, u**2 * self.y / 6e-3, u**3 * np.cos(150 * self.x)], axis=1)
        self.functions = np.linalg.svd(shapes, full_matrices=False)[0] * np.sqrt(POINTS)
        a = complex_normal(rng, holograms, FUNCTIONS)
        a *= largest_rad / np.abs(a @ self.functions.T).max(axis=1)[:, None]
        self.a = a * rng.uniform(0.3, 1, holograms)[:, None]
        self.gain = 0.02 * rng.standard_normal(holograms)
        self.object_field = 30 * complex_normal(rng, POINTS)
        seen = np.exp(self.gain)[:, None] * self.object_field * moved(self.a @ self.functions.T)
        value = (seen + noise * complex_normal(rng, holograms, POINTS)).T
        self.problem = Problem.of(value, self.functions, BesselTable())
        self.smooth = smooth_functions(self.x, self.y)
        self.weight = rng.uniform(0.5, 1, holograms)

    def linear(self, object_field=None, a=None):
        object_field = self.object_field if object_field is None else object_field
        a = self.a if a is None else a
        return linearise(self.problem, self.smooth, object_field, a, self.gain, self.weight)


def prior(amplitude=1e-4, gain=200.0):
    """Precision of amplitudes and log gain."""
    return np.diag([amplitude] * 2 * FUNCTIONS + [gain])


# --- The factor --------------------------------------------------------------------------------


def test_smooth_functions_are_polynomials_of_total_degree_ten():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(2, 5, 200), rng.uniform(-1, 4, 200)
    smooth = smooth_functions(x, y)
    assert smooth.shape == (200, SMOOTH)
    assert smooth[:, 0] == pytest.approx(np.ones(200))
    for i, j in ((10, 0), (0, 10), (4, 6), (5, 5)):
        target = x**i * y**j
        coefficients = np.linalg.lstsq(smooth, target, rcond=None)[0]
        assert smooth @ coefficients == pytest.approx(target, abs=1e-9 * np.abs(target).max())
    # Far from the origin, powers are nearly polynomials of a lower degree.
    target = (x - 3.5) ** 6 * (y - 1.5) ** 5
    coefficients = np.linalg.lstsq(smooth, target, rcond=None)[0]
    assert np.abs(smooth @ coefficients - target).max() > 1e-6 * np.abs(target).max()


def test_a_factor_is_the_exponential_of_magnitude_and_phase():
    smooth = smooth_functions(*np.random.default_rng(2).uniform(0, 1, (2, 50)))
    move = np.random.default_rng(3).normal(0, 0.1, VALUES)
    factor = field_factor(smooth, move)
    assert np.log(np.abs(factor)) == pytest.approx(smooth @ move[:SMOOTH], abs=1e-6)
    # Of the phase there is no constant: that of the holograms is free.
    assert np.angle(factor) == pytest.approx(smooth[:, 1:] @ move[SMOOTH:], abs=1e-6)
    both = field_factor(smooth, move) * field_factor(smooth, -move)
    assert np.abs(both - 1).max() < 1e-6


# --- Derivatives -------------------------------------------------------------------------------


@pytest.mark.parametrize("largest_rad", [0.5, 9.0])
def test_equations_of_holograms_are_those_of_the_search(largest_rad):
    sweep = Sweep(largest_rad)
    linear, steps = sweep.linear(), np.arange(HOLOGRAMS)
    expected = normal(sweep.problem, sweep.object_field, steps, sweep.a, sweep.gain)
    assert linear.normal.misfit == pytest.approx(expected.misfit, rel=1e-12)
    assert linear.normal.gradient == pytest.approx(expected.gradient, rel=1e-9)
    assert linear.normal.matrix == pytest.approx(expected.matrix, rel=1e-9)


@pytest.mark.parametrize("largest_rad", [0.5, 9.0])
def test_gradients_of_the_light_are_minus_half_the_slope_of_the_misfit(largest_rad):
    sweep, count = Sweep(largest_rad), SMOOTH
    linear = sweep.linear()

    def misfit(move):
        factor = np.exp(sweep.smooth @ (move[:count] + 1j * move[count:]))
        return sweep.weight @ sweep.linear(sweep.object_field * factor).normal.misfit

    slopes = []
    for unit in np.eye(2 * count):
        slopes.append((misfit(1e-5 * unit) - misfit(-1e-5 * unit)) / 2e-5)
    expected = -0.5 * np.array(slopes)
    found = linear.field_gradient.sum(axis=0)
    assert found == pytest.approx(expected, abs=2e-4 * np.abs(expected).max())


@pytest.mark.parametrize("largest_rad", [0.5, 9.0])
def test_couplings_are_products_of_derivatives(largest_rad):
    """By differences of the block amplitudes themselves, of one hologram."""
    sweep, k, step = Sweep(largest_rad), 5, 1e-6
    linear, count = sweep.linear(), SMOOTH
    lit = np.exp(sweep.gain[k]) * sweep.object_field
    at = moved(sweep.a[k] @ sweep.functions.T)
    columns = []
    for move in step * np.concatenate([np.eye(FUNCTIONS), 1j * np.eye(FUNCTIONS)]):
        ahead, behind = (moved((sweep.a[k] + s * move) @ sweep.functions.T) for s in (1, -1))
        columns.append(lit * (ahead - behind) / (2 * step))
    own = np.stack([*columns, lit * at], axis=1)
    sideband_equations = (lit * at)[:, None] * np.concatenate(
        [sweep.smooth, 1j * sweep.smooth], axis=1
    )
    expected = (own.conj().T @ sideband_equations).real
    assert linear.coupling[k] == pytest.approx(expected, abs=1e-4 * np.abs(expected).max())
    whole = sum(
        w * np.exp(2 * g) * np.abs(sweep.object_field * moved(a @ sweep.functions.T)) ** 2
        for w, g, a in zip(sweep.weight, sweep.gain, sweep.a, strict=True)
    )
    square = sweep.smooth.T @ (whole[:, None] * sweep.smooth)
    assert linear.field_matrix.shape == (HOLOGRAMS, count, count)
    found = linear.field_matrix.sum(axis=0)
    assert np.abs(found - square).max() < 1e-5 * square.max()
    # Among many elements some are nearly zero, and only rounding.
    low = np.array([i + j <= 6 for i in range(11) for j in range(11 - i)])
    assert found[np.ix_(low, low)] == pytest.approx(square[np.ix_(low, low)], rel=1e-4)


@pytest.mark.parametrize("largest_rad", [0.5, 9.0])
def test_products_without_the_matrices_are_those_with_them(largest_rad):
    linear, rng = Sweep(largest_rad).linear(), np.random.default_rng(6)
    holograms = rng.standard_normal((HOLOGRAMS, 2 * FUNCTIONS + 1))
    expected = np.einsum("kxc,kx->kc", linear.coupling, holograms)
    assert linear.on_field(holograms) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    whole = linear.field_matrix.sum(axis=0)
    assert linear.whole_field_matrix == pytest.approx(whole, abs=1e-10 * np.abs(whole).max())


def test_a_step_uses_the_curvature_of_all_holograms_together():
    sweep = Sweep(9.0)
    x = np.concatenate([sweep.a.real, sweep.a.imag, sweep.gain[:, None]], axis=1)
    step = field_step(sweep.linear(), prior(), x)
    whole = 0.5 * step.common_mode.precision.sum(axis=0)
    assert step.curvature == pytest.approx(whole, abs=1e-9 * np.abs(whole).max())


# --- Steps -------------------------------------------------------------------------------------


def test_a_step_takes_a_wrong_factor_back(monkeypatch):
    """Light is too bright by a smooth factor, and all displacements stay: fringes tell."""
    monkeypatch.setattr("fitting.holograms.object_field._STEP", 10.0)
    sweep = Sweep(9.0, noise=0.0)
    wrong = np.zeros(VALUES)
    wrong[[1, 9]] = 0.004, -0.003
    object_field = sweep.object_field * field_factor(sweep.smooth, wrong)
    linear = sweep.linear(object_field)
    x = np.concatenate([sweep.a.real, sweep.a.imag, sweep.gain[:, None]], axis=1)
    step = field_step(linear, prior(), 0 * x)
    assert step.move[[1, 9]] == pytest.approx([-0.004, 0.003], abs=3e-4)
    after = object_field * field_factor(sweep.smooth, step.move)
    y = sweep.a + step.holograms[:, :FUNCTIONS] + 1j * step.holograms[:, FUNCTIONS : 2 * FUNCTIONS]
    assert sweep.linear(after, y).normal.misfit.sum() < 0.01 * linear.normal.misfit.sum()


@pytest.mark.parametrize("common", [True, False])
def test_the_pull_of_holograms_goes_where_the_search_would(monkeypatch, common):
    """Also where the factor is held: then only displacements change, with light as it is."""
    monkeypatch.setattr("fitting.holograms.object_field._STEP", 1e6)
    sweep = Sweep(9.0)
    wrong = np.zeros(VALUES)
    wrong[[1, 9]] = 0.004, -0.003
    linear = sweep.linear(sweep.object_field * field_factor(sweep.smooth, wrong))
    x = np.concatenate([sweep.a.real, sweep.a.imag, sweep.gain[:, None]], axis=1)
    free = field_step(linear, prior(), x)
    step = field_step(linear, prior(), x, common=common)
    shared = step.common_mode
    assert shared.pull.shape == (HOLOGRAMS, VALUES)
    assert free.move == pytest.approx(np.linalg.solve(shared.whole, shared.pull.sum(axis=0)))
    if common:
        assert step.move == pytest.approx(free.move)
        return
    assert not step.move.any()
    # What the factor would have taken along is all that is missing.
    along = shared.response @ free.move
    assert free.holograms[:, :-1] - step.holograms[:, :-1] == pytest.approx(along)


def test_the_phase_of_smooth_light_is_never_determined_and_its_magnitude_only_by_fringes():
    """Of a factor that turns one shape into another: the third is not far from the first."""
    known = []
    for largest_rad in (0.3, 9.0):
        sweep = Sweep(largest_rad, noise=0.0)
        x = np.concatenate([sweep.a.real, sweep.a.imag, sweep.gain[:, None]], axis=1)
        sweep.weight = np.ones(HOLOGRAMS)
        shared = field_step(sweep.linear(), prior(gain=1e4), x).common_mode
        assert shared.response.shape == (HOLOGRAMS, 2 * FUNCTIONS, VALUES)
        # A constant factor of the magnitude: the displacements absorb it completely while small.
        known.append(shared.whole[0, 0])
        if largest_rad < 1:
            amplitudes = np.concatenate([sweep.a.real, sweep.a.imag], axis=1)
            assert shared.response[:, :, 0] == pytest.approx(-amplitudes, rel=0.2, abs=0.02)
    assert known[1] > 100 * known[0]


def test_precision_gives_how_far_light_may_be_off(monkeypatch):
    """Many noises: what steps from the truth go, in units of what they may."""
    monkeypatch.setattr("fitting.holograms.object_field._STEP", 10.0)
    squares = []
    for seed in range(12):
        sweep = Sweep(3.0, seed=seed)
        sweep.weight = np.ones(HOLOGRAMS)
        x = np.concatenate([sweep.a.real, sweep.a.imag, sweep.gain[:, None]], axis=1)
        step = field_step(sweep.linear(), prior(gain=1e6), 0 * x)
        eigenvalues, vectors = np.linalg.eigh(step.common_mode.whole)
        # What the data do not tell is held by the prior.
        sure = eigenvalues > 30
        squares.append(np.mean((vectors.T @ step.move)[sure] ** 2 * eigenvalues[sure]))
    assert 0.8 < np.mean(squares) < 1.25


# --- Responses of other amplitudes -------------------------------------------------------------


def common_mode_of(sweep, a):
    """Common-mode error of a sweep, linearised at amplitudes."""
    x = np.concatenate([a.real, a.imag, sweep.gain[:, None]], axis=1)
    shared = field_step(sweep.linear(a=a), prior(gain=1e4), x).common_mode
    small = response_of_small(sweep.functions, sweep.smooth, sweep.object_field)
    return replace(shared, small=small)


def in_rows(values):
    """Real, then imaginary parts of the middle axis of values (k, j, q)."""
    return np.concatenate([values.real, values.imag], axis=1)


def test_small_displacements_respond_in_proportion_to_themselves():
    sweep = Sweep(0.1, noise=0.0)
    shared = common_mode_of(sweep, sweep.a)
    expected = in_rows(np.einsum("qij,kj->kiq", shared.small, sweep.a))
    off = np.linalg.norm(shared.response - expected, axis=(0, 1))
    assert (off < 0.02 * np.linalg.norm(expected, axis=(0, 1))).all()


@pytest.mark.parametrize("largest_rad", [0.1, 3.0])
def test_responses_lose_the_noise_of_amplitudes(largest_rad):
    sweep = Sweep(largest_rad, noise=0.0)
    size = np.sqrt(np.mean(np.abs(sweep.a) ** 2, axis=1, keepdims=True))
    measured = sweep.a + 0.1 * size * complex_normal(np.random.default_rng(7), *sweep.a.shape)
    true, noisy = common_mode_of(sweep, sweep.a), common_mode_of(sweep, measured)
    better = noisy.responding_at(sweep.a, measured)
    off, before = (np.linalg.norm(each.response - true.response) for each in (better, noisy))
    # Across fringes a part of the response does not follow the amplitudes.
    assert off < (0.05 if largest_rad < 1 else 1.0) * before
    assert noisy.responding_at(measured, measured).response == pytest.approx(noisy.response)


def test_without_the_response_of_small_displacements_nothing_changes():
    sweep = Sweep(0.1)
    shared = replace(common_mode_of(sweep, sweep.a), small=None)
    assert shared.responding_at(2 * sweep.a, sweep.a) is shared


def test_holograms_without_displacements_say_nothing():
    sweep = Sweep(0.1)
    shared = common_mode_of(sweep, sweep.a)
    places = np.arange(HOLOGRAMS) + 2
    wide = shared.among(HOLOGRAMS + 3, places)
    for name in ("response", "precision", "pull"):
        whole = getattr(wide, name)
        assert (whole[places] == getattr(shared, name)).all()
        assert not np.delete(whole, places, axis=0).any()
