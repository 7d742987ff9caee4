"""Turns of light and displacement: where they go, and what holds them if a step is a long one."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.holograms import alternating_minimisation as settling
from fitting.holograms.alternating_minimisation import (
    Solution,
    alternating_step,
    moved_alone,
    settled,
)
from fitting.holograms.object_field import FieldStep
from tests.fitting.holograms.test_displacement import complex_normal
from tests.fitting.holograms.test_object_field import FUNCTIONS, HOLOGRAMS, VALUES, Sweep

# Holograms with more values than a common-mode error has: it could be any move of fewer.
MANY = 34
# What the log of the light may change by at once.
LARGEST = 0.3


def whole_sweep(sweep):
    return settling.Sweep(sweep.problem, sweep.problem.exact(), sweep.smooth, None)


def turn(sweep, at):
    return alternating_step(whole_sweep(sweep), at)


def truth(sweep):
    return Solution(sweep.a, sweep.gain, sweep.object_field.astype(np.complex64))


@pytest.fixture
def thrown(monkeypatch):
    """Return a function that replaces the Newton step by one of a given size."""

    def throw(sweep, log_factor, change):
        """`log_factor` of the first smooth function but the constant; `change` of amplitudes."""
        move = np.zeros(2 * sweep.smooth.shape[1] - 1)
        move[1] = log_factor / np.abs(sweep.smooth[:, 1]).max()
        holograms = np.full((HOLOGRAMS, 2 * FUNCTIONS + 1), change)

        def step(linear, held, x, *, common):
            return FieldStep(move, holograms, linear, held, holograms)

        monkeypatch.setattr(settling, "field_step", step)

    return throw


def test_at_the_truth_nothing_moves():
    sweep = Sweep(6.0, noise=0.0)
    at, _ = turn(sweep, truth(sweep))
    # But what all gains have in common, which is light.
    common = np.mean(sweep.gain - at.gain)
    assert np.abs(at.object_field / (sweep.object_field * np.exp(common)) - 1).max() < 1e-3
    assert at.amplitude == pytest.approx(sweep.a, abs=2e-3)
    assert at.gain + common == pytest.approx(sweep.gain, abs=2e-3)


def test_light_off_by_a_smooth_factor_comes_back():
    """Turns of light block by block and of amplitudes alone would take hundreds."""
    sweep = Sweep(6.0, noise=0.0)
    factor = np.exp(0.1 * sweep.smooth[:, 1] + 0.1j * sweep.smooth[:, 2])
    at = Solution(sweep.a, sweep.gain, (sweep.object_field * factor).astype(np.complex64))
    for _ in range(4):
        at, _ = turn(sweep, at)
    off = np.abs(at.object_field / sweep.object_field)
    assert off.std() / off.mean() < 0.01


@pytest.mark.parametrize(("asked", "done"), [(0.2, 0.2), (0.6, LARGEST), (30.0, LARGEST)])
def test_long_steps_of_the_light_are_cut_short_and_those_of_holograms_with_them(
    thrown, asked, done
):
    sweep = Sweep(6.0)
    thrown(sweep, 0.0, 0.0)
    still, _ = turn(sweep, truth(sweep))
    thrown(sweep, asked, 0.1)
    moved, _ = turn(sweep, truth(sweep))
    change = np.log(np.abs(moved.object_field / still.object_field))
    assert np.abs(change).max() == pytest.approx(done, rel=1e-3)
    expected = 0.1 * (1 + 1j) * done / asked
    assert moved.amplitude - still.amplitude == pytest.approx(
        np.full_like(sweep.a, expected), abs=1e-4
    )


def test_holograms_that_nothing_explains_are_not_thrown_with_the_light(thrown):
    sweep = Sweep(6.0)
    rng = np.random.default_rng(8)
    strange = 5
    noise = 15 * complex_normal(rng, sweep.problem.blocks)
    sweep.problem.real[strange], sweep.problem.imaginary[strange] = noise.real, noise.imag
    thrown(sweep, 0.0, 0.0)
    still, _ = turn(sweep, truth(sweep))
    thrown(sweep, 0.1, 0.1)
    moved, _ = turn(sweep, truth(sweep))
    change = np.abs(moved.amplitude - still.amplitude).max(axis=1)
    assert change[strange] == 0
    assert np.delete(change, strange) == pytest.approx(np.full(HOLOGRAMS - 1, 0.1 * 2**0.5))


# --- When nothing moves any more ---------------------------------------------------------------


@pytest.fixture(scope="module")
def stepped():
    """Displacements and the last step at an optimum of a noisy sweep."""
    sweep = Sweep(6.0, holograms=MANY)
    at = truth(sweep)
    for _ in range(3):
        at, step = turn(sweep, at)
    return at.amplitude, step, sweep.problem.seen


def halves(a):
    return np.concatenate([a.real, a.imag], axis=1)


def whole(parts):
    return parts[:, :FUNCTIONS] + 1j * parts[:, FUNCTIONS:]


def test_a_common_mode_error_and_phases_of_holograms_do_not_count_as_moves(stepped):
    a, step, seen = stepped
    rng = np.random.default_rng(3)
    common = whole(step.common_mode.response @ (1e-3 * rng.standard_normal(VALUES)))
    turned = 1j * a * (1e-3 * rng.standard_normal(len(a)))[:, None]
    own = whole(1e-3 * rng.standard_normal((len(a), 2 * FUNCTIONS)))
    assert moved_alone(a, a, step, seen) == pytest.approx(0, abs=1e-9)
    alone = moved_alone(a, a + own, step, seen)
    assert moved_alone(a, a + common + turned, step, seen) < 0.02 * alone
    assert moved_alone(a, a + own + common, step, seen) == pytest.approx(alone, rel=0.1)


def test_moves_are_counted_in_standard_errors(stepped):
    a, step, seen = stepped
    normal, rng = step.linear.normal, np.random.default_rng(4)
    information = 2 * np.einsum("kii->ki", normal.matrix)[:, : 2 * FUNCTIONS]
    information /= np.maximum(normal.misfit / seen, 1)[:, None]
    drawn = rng.standard_normal((60, *information.shape)) / np.sqrt(information)
    moved = np.array([moved_alone(a, a + whole(each), step, seen) for each in drawn])
    # What all holograms share takes VALUES degrees of freedom, and phases one of each hologram.
    left = 1 - (VALUES + len(a)) / information.size
    assert np.mean(moved**2) == pytest.approx(left, rel=0.15)
    tenth = moved_alone(a, a + 0.1 * whole(drawn[0]), step, seen)
    assert tenth == pytest.approx(0.1 * moved[0], rel=0.1)


def test_turns_end_with_displacements_that_more_turns_do_not_change(monkeypatch):
    sweep, taken = Sweep(6.0, holograms=MANY), []
    counted = alternating_step

    def step(*args):
        taken.append(args)
        return counted(*args)

    monkeypatch.setattr(settling, "alternating_step", step)
    all_of_it = whole_sweep(sweep)
    rng = np.random.default_rng(5)
    off = 1 + 0.05 * complex_normal(rng, MANY, FUNCTIONS)
    start = replace(truth(sweep), amplitude=sweep.a * off)
    early, last = settled(all_of_it, start, 60)
    turns = len(taken)
    assert 1 < turns < 30
    monkeypatch.setattr(settling, "_STILL", 0.0)
    monkeypatch.setattr(settling, "_SETTLED", -np.inf)
    late, _ = settled(all_of_it, start, 60)
    assert len(taken) == turns + 60
    assert moved_alone(early.amplitude, late.amplitude, last, sweep.problem.seen) < 0.2


def test_with_the_factor_held_its_equations_are_needed_at_both_ends_only(monkeypatch):
    sweep, linearised = Sweep(6.0, holograms=MANY), []
    plain = settling.linearise

    def counted(*args):
        linearised.append(args)
        return plain(*args)

    held = replace(whole_sweep(sweep), common=False)
    off = 1 + 0.05 * complex_normal(np.random.default_rng(5), MANY, FUNCTIONS)
    start = replace(truth(sweep), amplitude=sweep.a * off)
    at = start
    for _ in range(40):
        at, step = alternating_step(held, at)
    monkeypatch.setattr(settling, "linearise", counted)
    quick, last = settled(held, start, 40)
    assert len(linearised) == 2
    assert moved_alone(quick.amplitude, at.amplitude, step, sweep.problem.seen) < 0.1
    # The equations that are returned are those of the end.
    ends = last.linear.normal.misfit, step.linear.normal.misfit
    np.testing.assert_allclose(*ends, rtol=1e-2)
    linearised.clear()
    settled(held, start, 1)
    assert len(linearised) == 1
