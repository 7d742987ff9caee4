"""Groups of holograms in wrong fringes, which only move together."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from fitting.holograms import solved_sweep
from fitting.holograms.alternating_minimisation import (
    Solution,
    Sweep,
    cost,
    settled,
    with_field,
)
from fitting.holograms.bessel import BesselTable
from fitting.holograms.displacement import _in_order, _refined, fit_displacements
from fitting.holograms.problem import GAIN_NEPERS, Problem
from fitting.holograms.right_fringes import groups, retries, single_holograms, trials
from fitting.holograms.right_fringes.failed_trials import FailedTrials
from fitting.holograms.right_fringes.groups import (
    _at_rest,
    _beyond,
    _Candidates,
    _candidates,
    _continuous,
    _neighbourhoods,
    _off_a_pole,
    breaks,
    moved_together,
    smoothest,
)
from fitting.holograms.right_fringes.retries import in_right_fringes
from fitting.holograms.right_fringes.single_holograms import tried_again
from fitting.holograms.right_fringes.trials import (
    in_other_fringes,
    same_fringe,
    with_fringes,
    with_wrong_gain,
)
from fitting.holograms.solved_sweep import Level, with_steady_light
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


def test_a_group_continues_its_neighbours_where_it_should_be(problem, found, astray):
    at = replace(astray, object_field=found.object_field, field_variance=found.field_variance)
    around = np.arange(LOST[0] - 4, LOST[-1] + 5)
    there = smoothest(problem, at, around)
    assert same_fringe(there.amplitude, found.amplitude_rad).all()
    rest = np.setdiff1d(np.arange(len(there.gain)), around)
    assert (there.amplitude[rest] == at.amplitude[rest]).all()
    # What is changed in a copy is not changed in what was given.
    assert not same_fringe(at.amplitude[LOST], found.amplitude_rad[LOST]).any()


@pytest.mark.parametrize("below", [True, False])
def test_solutions_come_from_both_sides(problem, found, below):
    """Where one side is wrong as far as a size reaches, the right solution is that of the other."""
    at = Solution(found.amplitude_rad.copy(), found.gain, found.object_field, found.field_variance)
    number = int(LOST[3])
    wrong = slice(number - 2, number + 1) if below else slice(number, number + 3)
    at.amplitude[wrong] *= 0.05
    solutions = _candidates(problem, at, np.array([number]))[number]
    assert same_fringe(found.amplitude_rad[number], solutions.amplitude).any()


def test_no_more_solutions_are_kept_than_wanted(problem, astray, monkeypatch):
    many = _candidates(problem, astray, LOST)
    assert max(len(many[int(number)].gain) for number in LOST) > 1
    monkeypatch.setattr(groups, "_KEPT", 1)
    few = _candidates(problem, astray, LOST)
    assert {len(few[int(number)].gain) for number in LOST} == {1}


def test_what_is_in_its_fringe_stays_there(problem, found):
    at = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    assert smoothest(problem, at, LOST) is None


def test_a_group_at_the_end_of_a_sweep_continues_its_other_side(problem, found):
    at = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    last = len(found.gain) - 1
    amplitude = found.amplitude_rad.copy()
    amplitude[last] *= 0.3
    there = smoothest(problem, replace(at, amplitude=amplitude), np.array([last]))
    assert same_fringe(there.amplitude, found.amplitude_rad).all()


def test_two_holograms_are_too_few_to_continue_each_other(problem, found):
    for few in (np.array([30, 31]), np.array([30])):
        at = Solution(found.amplitude_rad[few], found.gain[few], found.object_field[few])
        assert smoothest(problem.some(few), at, np.arange(len(few))) is None


def test_every_second_block_of_a_solution_is_that_of_the_problem(problem, found):
    at = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    half = at.every(2)
    np.testing.assert_array_equal(half.object_field, found.object_field[:, ::2])
    np.testing.assert_array_equal(half.field_variance, found.field_variance[:, ::2])
    assert half.object_field.shape[1] == problem.every(2).blocks
    assert half.positions is None
    one = replace(at, object_field=found.object_field[0], positions=np.ones((len(half.gain), 2)))
    assert one.every(3).object_field.shape == found.object_field[0, ::3].shape
    assert len(one.every(3).positions) == len(one.positions[::3])


def test_a_hologram_without_a_solution_is_solved_from_its_neighbours(sweep, found):
    number = int(LOST[3])
    misfit, amplitude = found.misfit.copy(), found.amplitude_rad.copy()
    misfit[number], amplitude[number] = np.inf, 0
    rough = replace(found, misfit=misfit, amplitude_rad=amplitude)
    there = _refined(Level.of(sweep.block_amplitudes, sweep.basis), rough)
    assert np.isfinite(there.misfit).all()
    assert same_fringe(there.amplitude_rad[number], found.amplitude_rad[number])


def test_few_odd_gains_are_in_order_and_no_hologram_far_from_its_noise(problem, found):
    gain, scatter_nepers = np.zeros(len(found.gain)), 0.5 * GAIN_NEPERS
    gain[:2] = 5 * scatter_nepers
    right = replace(found, gain=gain, gain_nepers=scatter_nepers)
    assert _in_order(problem, right)
    gain = gain.copy()
    gain[2] = -5 * scatter_nepers
    assert not _in_order(problem, replace(right, gain=gain))
    reached = found.reached.copy()
    reached[7] = False
    assert not _in_order(problem, replace(right, reached=reached))


def test_brightness_that_scatters_up_to_its_limit_is_that_of_wrong_fringes(problem, found):
    still = np.zeros(len(found.gain))
    widest = replace(found, gain=still, gain_nepers=GAIN_NEPERS)
    assert not _in_order(problem, widest)
    assert _in_order(problem, replace(widest, gain_nepers=0.9 * GAIN_NEPERS))
    # Without fringes nothing shows how much it scatters.
    assert _in_order(problem, replace(widest, amplitude_rad=1e-3 * found.amplitude_rad))


@pytest.mark.parametrize("wrong", [True, False])
def test_gains_that_wrong_fringes_needed_do_not_count(sweep, found, monkeypatch, wrong):
    """Once a group has moved, the scatter of gains is found again."""
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    moved = []

    def in_right(_sweep, at, step, *_):
        if not wrong or moved:
            return at, step
        moved.append(True)
        amplitude = at.amplitude.copy()
        amplitude[LOST] *= 0.3
        return replace(at, amplitude=amplitude), step

    monkeypatch.setattr(solved_sweep, "in_right_fringes", in_right)
    monkeypatch.setattr(solved_sweep, "gain_scatter", lambda *_: 0.01 if moved else 0.05)
    everything = np.ones(len(found.gain), bool)
    there = solved_sweep.finished(level, found.solution, everything, found.change)
    assert there.gain_nepers == (0.01 if wrong else 0.05)


def test_without_fringes_no_displacement_is_in_a_wrong_one(problem, found):
    at = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    assert not with_fringes(problem, found.amplitude_rad)[0]
    amplitude = found.amplitude_rad.copy()
    amplitude[0] *= 0.3
    assert smoothest(problem, replace(at, amplitude=amplitude), np.array([0])) is None


@pytest.mark.parametrize("position", [-2.5, -0.4, 0.1, 1.5])
@pytest.mark.parametrize("loss", [0.1, 1.0, 10.0])
def test_neighbours_of_a_pole_are_its_response_wherever_it_is(position, loss):
    """One pole with any loss, in units of the steps, and no loss at all."""
    before, here, after = 1 / np.abs(np.array([-1.0, 0.0, 1.0]) - position - 1j * loss)
    assert _off_a_pole(before, here, after) == pytest.approx(0.0, abs=1e-12)
    # Less than the smaller neighbour, or far more than either, is not.
    low, high = 2 / (1 / before + 1 / after), 2 / abs(1 / before - 1 / after)
    assert _off_a_pole(before, 0.5 * low, after) == pytest.approx(np.log(2))
    assert _off_a_pole(before, 3 * high, after) == pytest.approx(np.log(3))


@pytest.mark.parametrize("seed", range(8))
def test_the_best_path_is_that_of_all_paths(seed):
    """Against a search through all of them."""
    rng = np.random.default_rng(seed)
    counts = 2, 1, 3, 2, 3
    candidates = [
        _Candidates(rng.normal(size=(s, 4)) + 1j * rng.normal(size=(s, 4)), np.zeros(s))
        for s in counts
    ]

    def apart(path):
        a = np.array([each.amplitude[s] for each, s in zip(candidates, path, strict=True)])
        former, here, after = a[:-2], a[1:-1], a[2:]
        sizes = [np.linalg.norm(each, axis=1) for each in (former, here, after)]
        broken = _beyond(former, here, after) ** 2 + _beyond(after, here, former) ** 2
        return np.sum(broken + _off_a_pole(*sizes) ** 2)

    best = min(itertools.product(*map(range, counts)), key=apart)
    assert _continuous(candidates) == list(best)


def test_places_near_each_other_are_looked_at_together():
    odd = np.array([2, 3, 19, 40])
    found = [(int(each[0]), int(each[-1])) for each in _neighbourhoods(odd, 44)]
    assert found == [(0, 25), (34, 43)]
    assert list(_neighbourhoods(np.zeros(0, np.intp), 44)) == []


def test_a_group_that_was_rejected_is_not_tried_again(sweep, problem, found, monkeypatch):
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    there = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    at, step = settled(blocks, there, 1)
    monkeypatch.setattr(groups, "suspects", lambda *_: LOST)
    monkeypatch.setattr(groups, "smoothest", lambda _problem, at, _group: at)
    failed = FailedTrials()
    assert moved_together(blocks, at, step, 1, failed) is None
    around = np.arange(LOST[0] - 6, LOST[-1] + 7)
    assert failed.has_group(around[0], at.amplitude[around])
    monkeypatch.setattr(groups, "smoothest", lambda *_: pytest.fail("tried again"))
    assert moved_together(blocks, at, step, 1, failed) is None


def test_a_hologram_that_was_not_explained_better_is_not_tried_again(problem, found, monkeypatch):
    at = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    failed = FailedTrials()
    _, better = tried_again(problem, at, LOST[3:4], (), failed)
    assert not better.size
    monkeypatch.setattr(single_holograms, "solved_from", lambda *_: pytest.fail("tried again"))
    tried_again(problem, at, LOST[3:4], (), failed)


def test_a_hologram_that_has_moved_is_tried_again(problem, astray):
    failed = FailedTrials()
    _, better = tried_again(problem, astray, LOST[:1], (), failed)
    assert better.size
    _, again = tried_again(problem, astray, LOST[:1], (), failed)
    assert LOST[0] in again


@pytest.fixture
def moving(sweep, problem, found, monkeypatch):
    """Let a hologram move to 0.3 times what it is in each turn; returns in which it was tried."""
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    there = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    at, step = settled(blocks, there, 1)
    number = int(LOST[3])

    def move(_problem, at, off, *_):
        tried.append(int(number in off))
        amplitude = at.amplitude.copy()
        amplitude[off] *= 0.3
        return replace(at, amplitude=amplitude), off

    tried = list[int]()
    monkeypatch.setattr(retries, "tried_again", move)
    monkeypatch.setattr(retries, "moved_together", lambda *_: None)
    monkeypatch.setattr(retries, "_misfitting", lambda *_: np.array([number]))
    monkeypatch.setattr(retries, "with_wrong_gain", lambda *_: np.zeros(0, np.intp))

    def in_turns(settle):
        monkeypatch.setattr(retries, "settled", lambda _, there, __: (settle(at, there), step))
        in_right_fringes(blocks, at, step, 1)
        return tried

    return in_turns


def test_a_hologram_that_moves_back_again_and_again_is_left_where_it_is(moving):
    assert moving(lambda first, _there: first) == [1, 1, 0]


def test_a_hologram_that_moves_on_is_tried_again(moving):
    assert moving(lambda _first, there: there) == [1] * 8


def test_what_failed_in_light_that_a_group_had_bent_is_tried_in_other_light(
    sweep, problem, found, monkeypatch
):
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    there = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    at, step = settled(blocks, there, 1)
    memories = list[FailedTrials]()
    moves = iter([(at, step), None])

    def tried(_problem, at, _off, _others, failed):
        memories.append(failed)
        return at, np.zeros(0, np.intp)

    monkeypatch.setattr(retries, "tried_again", tried)
    monkeypatch.setattr(retries, "moved_together", lambda *_: next(moves))
    in_right_fringes(blocks, at, step, 1)
    assert len(memories) == 2
    assert memories[0] is not memories[1]


def test_trials_fail_again_from_the_same_fringes_only():
    rng = np.random.default_rng(3)
    starts = rng.standard_normal((4, 3)) + 1j * rng.standard_normal((4, 3))
    failed = FailedTrials()
    assert not failed.has_hologram(7, starts)
    failed.add_hologram(7, starts)
    assert not failed.has_hologram(8, starts)
    # In any order, up to a phase, and less than a fringe apart.
    near = 1.1 * starts[::-1] * np.exp(1j * np.arange(4))[:, None]
    assert failed.has_hologram(7, near)
    assert failed.has_hologram(7, near[:2])
    assert not failed.has_hologram(7, np.vstack([near, 2 * near[:1]]))


def test_a_part_of_a_group_that_failed_fails_again():
    rng = np.random.default_rng(4)
    a = rng.standard_normal((9, 3)) + 1j * rng.standard_normal((9, 3))
    failed = FailedTrials()
    failed.add_group(20, a)
    assert failed.has_group(20, a)
    assert failed.has_group(22, a[2:7])
    assert not failed.has_group(22, a[3:8])
    assert not failed.has_group(18, a[:4])
    assert not failed.has_group(25, np.vstack([a[5:], a[:1]]))
    moved = a.copy()
    moved[4] *= 0.5
    assert not failed.has_group(20, moved)
    assert failed.has_group(25, moved[5:])


@pytest.mark.parametrize("together", [True, False])
def test_a_group_whose_gains_are_wrong_moves_together(
    sweep, problem, found, astray, monkeypatch, together
):
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    # Alone no hologram is tried again.
    monkeypatch.setattr(retries, "unexplained", lambda *_: np.zeros(0, np.intp))
    monkeypatch.setattr(retries, "tried_again", lambda _problem, at, *_: (at, np.zeros(0, np.intp)))
    monkeypatch.setattr(groups, "breaks", lambda *_: np.zeros(0, np.intp))
    monkeypatch.setattr(retries, "with_wrong_gain", lambda *_: np.zeros(0, np.intp))
    wrong = iter([LOST] if together else [])
    monkeypatch.setattr(groups, "with_wrong_gain", lambda *_: next(wrong, np.zeros(0, np.intp)))
    at, step = settled(blocks, astray, 1)
    there, _ = in_right_fringes(blocks, at, step, 8)
    assert same_fringe(there.amplitude[LOST], found.amplitude_rad[LOST]).all() == together


def test_a_group_that_is_explained_no_better_stays(sweep, problem, found, monkeypatch):
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    at, step = settled(
        blocks,
        Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance),
        2,
    )

    def misled(_problem, at, group):
        amplitude = at.amplitude.copy()
        amplitude[group] *= 0.3
        return replace(at, amplitude=amplitude)

    monkeypatch.setattr(groups, "smoothest", misled)
    monkeypatch.setattr(groups, "with_wrong_gain", lambda *_: LOST)
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
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    there = Solution(folded, found.gain.copy(), found.object_field, found.field_variance)
    there = with_field(problem, there, np.ones(len(folded)), found.change)
    monkeypatch.setattr(retries, "unexplained", lambda *_: np.zeros(0, np.intp))
    for module in (retries, groups):
        monkeypatch.setattr(module, "with_wrong_gain", lambda *_: np.zeros(0, np.intp))
    monkeypatch.setattr(retries, "tried_again", lambda _problem, at, *_: (at, np.zeros(0, np.intp)))
    at, step = settled(blocks, there, 1)
    assert not same_fringe(at.amplitude[LOST], found.amplitude_rad[LOST]).any()
    at, _ = in_right_fringes(blocks, at, step, 8)
    assert same_fringe(at.amplitude, found.amplitude_rad).all()


def test_what_falls_into_another_fringe_as_a_group_moves_is_tried_again(
    sweep, problem, found, monkeypatch
):
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    blocks = Sweep(problem, problem.exact(), level.smooth, found.change)
    fallen, others = found.amplitude_rad.copy(), np.arange(LOST[0] - 6, LOST[0] - 2)
    fallen[others] *= 0.3
    start = Solution(fallen, found.gain, found.object_field, found.field_variance)
    costs = cost(problem, replace(start, amplitude=found.amplitude_rad))
    alone, _ = settled(blocks, start, 4)
    assert not same_fringe(alone.amplitude[others], found.amplitude_rad[others]).any()
    there, _ = _at_rest(blocks, start, costs, 4)
    assert same_fringe(there.amplitude, found.amplitude_rad).all()
    # Where all costs less than before, they are left to the next search.
    monkeypatch.setattr(groups, "tried_again", lambda *_: pytest.fail("tried again"))
    there, _ = _at_rest(blocks, start, costs + 1e4, 4)
    assert (there.amplitude == alone.amplitude).all()


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
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    found = fit_displacements(sweep.block_amplitudes, sweep.basis)
    assert found.gain_nepers < 0.004
    loose = replace(found, gain_nepers=0.05)
    steady = with_steady_light(level, loose)
    assert steady.gain_nepers < 0.004
    assert same_fringe(steady.amplitude_rad, found.amplitude_rad).all()


def test_light_that_is_not_steady_stays_as_it_is(sweep, found):
    """Its holograms differ by 5 %."""
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    assert found.gain_nepers == pytest.approx(0.05, rel=0.2)
    # No gain is far off by the scatter of most: nothing is tried.
    assert with_steady_light(level, found) is found
    # If the scatter seems to be larger than that of most, all is tried, and found again.
    again = with_steady_light(level, replace(found, gain_nepers=0.2))
    assert again.gain_nepers == pytest.approx(0.05, rel=0.2)
    assert same_fringe(again.amplitude_rad, found.amplitude_rad).all()


def test_the_likelier_of_steady_and_unsteady_light_is_kept(sweep, found, monkeypatch):
    level, costs = Level.of(sweep.block_amplitudes, sweep.basis), iter([1.0, 2.0])
    monkeypatch.setattr(solved_sweep, "whole_cost", lambda *_: next(costs))
    loose = replace(found, gain_nepers=0.2)
    assert with_steady_light(level, loose) is loose
    assert next(costs, None) is None


def test_trials_that_have_led_to_the_same_solution_are_followed_once(problem, found, monkeypatch):
    number, sizes, solve = int(LOST[3]), [], trials.fit_amplitudes

    def counted(few, field, steps, start, iterations, prior):
        sizes.append(len(steps))
        return solve(few, field, steps, start, iterations, prior)

    monkeypatch.setattr(trials, "fit_amplitudes", counted)
    at = Solution(found.amplitude_rad, found.gain, found.object_field, found.field_variance)
    amplitude = found.amplitude_rad.copy()
    amplitude[number] *= 0.3
    there, better = tried_again(problem, replace(at, amplitude=amplitude), np.array([number]))
    assert list(better) == [number]
    assert same_fringe(there.amplitude[number], found.amplitude_rad[number])
    first, *later = sizes[:3]
    assert first == 20
    assert max(later) < first / 2


def test_light_is_as_steady_as_that_of_holograms_with_fringes(sweep, found, monkeypatch):
    """The others determine no brightness: their gains are 0, whatever the light does."""
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    fringes = np.flatnonzero(with_fringes(level.problem, found.amplitude_rad))
    few = np.isin(np.arange(len(found.gain)), fringes[:20])
    assert np.count_nonzero(found.gain[few]) > len(few) / 10
    dim = replace(
        found,
        gain=np.where(few, found.gain, 0.0),
        amplitude_rad=np.where(few[:, None], found.amplitude_rad, 0.0),
    )
    # Nothing is tried: where most gains are 0, and where fewer than eight holograms have fringes.
    monkeypatch.setattr(solved_sweep, "settled", None)
    assert with_steady_light(level, dim) is dim
    none = replace(found, amplitude_rad=0 * found.amplitude_rad)
    assert with_steady_light(level, none) is none


def test_odd_gains_without_other_fringes_change_nothing(sweep, found):
    level = Level.of(sweep.block_amplitudes, sweep.basis)
    loudest = int(np.argmax(np.sum(np.abs(found.amplitude_rad) ** 2, axis=1)))
    gain = found.gain.copy()
    gain[loudest] += 0.4
    odd = replace(found, gain=gain)
    assert with_steady_light(level, odd) is odd
