"""Groups of holograms in wrong fringes, which only move together."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.holograms import displacement, retries
from fitting.holograms.alternating_minimisation import Solution, Sweep, settled, with_field
from fitting.holograms.bessel import BesselTable
from fitting.holograms.displacement import _Level, _with_steady_light, fit_displacements
from fitting.holograms.problem import Problem
from fitting.holograms.retries import (
    breaks,
    followed,
    in_other_fringes,
    in_right_fringes,
    same_fringe,
    with_fringes,
    with_wrong_gain,
)
from tests.fitting.holograms.test_displacement import planted

# Around the peak of F1, on both sides of its largest displacement.
LOST = np.arange(24, 31)


@pytest.fixture(scope="module")
def sweep():
    return planted()


@pytest.fixture(scope="module")
def found(sweep):
    return fit_displacements(sweep.block_amplitudes, sweep.basis)


@pytest.fixture(scope="module")
def problem(sweep, found):
    blocks = sweep.block_amplitudes
    problem = Problem.of(blocks.value, sweep.basis.functions, BesselTable())
    return replace(problem, gain_nepers=found.gain_nepers)


@pytest.fixture(scope="module")
def astray(problem, found):
    """A group in fringes that are too low, and light that follows it."""
    amplitude = found.amplitude_rad.copy()
    amplitude[LOST] *= 0.3
    there = Solution(amplitude, found.gain.copy(), found.object_field, found.field_variance)
    return with_field(problem, there, np.ones(len(amplitude)), found.change)


@pytest.mark.parametrize("along", [1, -1])
def test_a_group_is_followed_from_either_side_to_where_it_should_be(problem, found, astray, along):
    at = replace(astray, object_field=found.object_field, field_variance=found.field_variance)
    there = followed(problem, at, LOST, along)
    assert same_fringe(there.amplitude, found.amplitude_rad).all()
    rest = np.setdiff1d(np.arange(len(there.gain)), LOST)
    assert (there.amplitude[rest] == at.amplitude[rest]).all()
    # What is changed in a copy is not changed in what was given.
    assert not same_fringe(at.amplitude[LOST], found.amplitude_rad[LOST]).any()


@pytest.mark.parametrize("along", [1, -1])
def test_what_is_in_its_fringe_stays_there(problem, found, along):
    at = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    assert followed(problem, at, LOST, along) is None


def test_a_group_at_the_end_of_a_sweep_is_followed_from_its_other_side_only(problem, found):
    at = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    last = np.array([len(found.gain) - 1])
    amplitude = found.amplitude_rad.copy()
    amplitude[last] *= 0.3
    lost = replace(at, amplitude=amplitude)
    assert followed(problem, lost, last, -1) is None
    assert same_fringe(followed(problem, lost, last, 1).amplitude[last], found.amplitude_rad[last])


@pytest.mark.parametrize("together", [True, False])
def test_a_group_whose_gains_are_wrong_moves_together(
    sweep, problem, found, astray, monkeypatch, together
):
    level = _Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    # Alone no hologram is tried again.
    monkeypatch.setattr(retries, "unexplained", lambda *_: np.zeros(0, np.intp))
    monkeypatch.setattr(retries, "tried_again", lambda _problem, at, *_: (at, np.zeros(0, np.intp)))
    monkeypatch.setattr(retries, "breaks", lambda *_: np.zeros(0, np.intp))
    first = [LOST] if together else []
    wrong = iter([*first, *first])
    monkeypatch.setattr(retries, "with_wrong_gain", lambda *_: next(wrong, np.zeros(0, np.intp)))
    at, step = settled(blocks, astray, 1)
    there, _ = in_right_fringes(blocks, at, step, 8)
    assert same_fringe(there.amplitude[LOST], found.amplitude_rad[LOST]).all() == together


def test_a_group_that_is_explained_no_better_stays(sweep, problem, found, monkeypatch):
    level = _Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    at, step = settled(
        blocks,
        Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance),
        2,
    )

    def misled(_problem, at, group, _along):
        amplitude = at.amplitude.copy()
        amplitude[group] *= 0.3
        return replace(at, amplitude=amplitude)

    monkeypatch.setattr(retries, "followed", misled)
    monkeypatch.setattr(retries, "with_wrong_gain", lambda *_: LOST)
    there, _ = in_right_fringes(blocks, at, step, 8)
    assert same_fringe(there.amplitude, at.amplitude).all()


@pytest.fixture(scope="module")
def folded(problem, found):
    """Displacements of which some return where they should pass the first maximum of J₁."""
    u = found.amplitude_rad[LOST] @ problem.functions.T
    size = np.abs(u)
    back = np.where(size > 1.84, np.maximum(3.68 - size, 0.2) / np.maximum(size, 1e-9), 1.0) * u
    amplitude = found.amplitude_rad.copy()
    amplitude[LOST] = back @ np.linalg.pinv(problem.functions.astype(float)).T
    return amplitude


def test_displacements_break_where_they_go_on_in_another_fringe(problem, found, folded):
    assert not breaks(problem, found.amplitude_rad).size
    assert breaks(problem, folded).tolist() == [LOST[0] - 1, LOST[-1]]
    # The phase of a hologram is arbitrary, and below the first maximum there are no fringes.
    turned = np.exp(1j * np.arange(len(folded)))[:, None] * folded
    assert breaks(problem, turned).tolist() == [LOST[0] - 1, LOST[-1]]
    assert not breaks(problem, 0.05 * folded).size


def test_a_group_that_breaks_off_moves_together(sweep, problem, found, folded, monkeypatch):
    """Its gains are as they should be, and none of it is explained better alone."""
    level = _Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    there = Solution(folded, found.gain.copy(), found.object_field, found.field_variance)
    there = with_field(problem, there, np.ones(len(folded)), found.change)
    monkeypatch.setattr(retries, "unexplained", lambda *_: np.zeros(0, np.intp))
    monkeypatch.setattr(retries, "with_wrong_gain", lambda *_: np.zeros(0, np.intp))
    monkeypatch.setattr(retries, "tried_again", lambda _problem, at, *_: (at, np.zeros(0, np.intp)))
    at, step = settled(blocks, there, 1)
    assert not same_fringe(at.amplitude[LOST], found.amplitude_rad[LOST]).any()
    at, _ = in_right_fringes(blocks, at, step, 8)
    assert same_fringe(at.amplitude, found.amplitude_rad).all()


def test_two_starts_may_differ_by_more_than_two_solutions_of_one_start(problem, found):
    one = found.amplitude_rad
    fringes = np.flatnonzero(with_fringes(problem, 1.3 * one, one))
    assert fringes.size
    assert in_other_fringes(problem, one, 1.22 * one).size == 0
    np.testing.assert_array_equal(in_other_fringes(problem, one, 1.3 * one), fringes)
    assert not same_fringe(one, 1.22 * one).any()


def test_gains_are_wrong_beyond_four_times_their_scatter():
    assert with_wrong_gain(np.array([0.0, 0.05, -0.039, -0.041]), 0.01).tolist() == [1, 3]


def test_light_that_is_steady_is_found_to_be_so(monkeypatch):
    """A scatter of gains that wrong fringes have made does not stay."""
    monkeypatch.setattr("tests.fitting.holograms.test_displacement.GAIN", 0.0)
    sweep = planted(3)
    level = _Level.of(sweep.block_amplitudes, sweep.basis)
    found = fit_displacements(sweep.block_amplitudes, sweep.basis)
    assert found.gain_nepers < 0.004
    loose = replace(found, gain_nepers=0.05)
    steady = _with_steady_light(level, loose)
    assert steady.gain_nepers < 0.004
    assert same_fringe(steady.amplitude_rad, found.amplitude_rad).all()


def test_light_that_is_not_steady_stays_as_it_is(sweep, found):
    """Its holograms differ by 5 %."""
    level = _Level.of(sweep.block_amplitudes, sweep.basis)
    assert found.gain_nepers == pytest.approx(0.05, rel=0.2)
    # No gain is far off by the scatter of most: nothing is tried.
    assert _with_steady_light(level, found) is found
    # If the scatter seems to be larger than that of most, all is tried, and found again.
    again = _with_steady_light(level, replace(found, gain_nepers=0.12))
    assert again.gain_nepers == pytest.approx(0.05, rel=0.2)
    assert same_fringe(again.amplitude_rad, found.amplitude_rad).all()


def test_the_likelier_of_steady_and_unsteady_light_is_kept(sweep, found, monkeypatch):
    level, costs = _Level.of(sweep.block_amplitudes, sweep.basis), iter([1.0, 2.0])
    monkeypatch.setattr(displacement, "whole_cost", lambda *_: next(costs))
    loose = replace(found, gain_nepers=0.12)
    assert _with_steady_light(level, loose) is loose
    assert next(costs, None) is None


def test_trials_that_have_led_to_the_same_solution_are_followed_once(problem, found, monkeypatch):
    number, sizes, solve = int(LOST[3]), [], retries.fit_amplitudes

    def counted(few, field, steps, start, iterations, prior):
        sizes.append(len(steps))
        return solve(few, field, steps, start, iterations, prior)

    monkeypatch.setattr(retries, "fit_amplitudes", counted)
    at = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    amplitude = found.amplitude_rad.copy()
    amplitude[number] *= 0.3
    there, better = retries.tried_again(
        problem, replace(at, amplitude=amplitude), np.array([number])
    )
    assert list(better) == [number]
    assert same_fringe(there.amplitude[number], found.amplitude_rad[number])
    first, *later = sizes[:3]
    assert first == 20
    assert max(later) < first / 2
