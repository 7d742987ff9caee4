"""Displacement fitted to block amplitudes that the formula makes, of a plate that is no reed."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import j1

from fitting.errors import FitError
from fitting.holograms import alternating_minimisation as settling
from fitting.holograms.alternating_minimisation import Solution
from fitting.holograms.amplitudes import block_object_field
from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import BlockAmplitudes
from fitting.holograms.continuation import Continuation, continued, starts_of
from fitting.holograms.displacement import (
    fit_displacements,
    refit_displacements,
)
from fitting.holograms.object_field import CommonModeError, smooth_functions
from fitting.holograms.problem import (
    GAIN_NEPERS,
    Normal,
    Problem,
    normal,
)
from fitting.holograms.right_fringes.retries import field_of_others, relative_misfit, unexplained
from fitting.holograms.right_fringes.single_holograms import _likely_sizes, tried_again
from fitting.holograms.right_fringes.trials import agree, in_other_fringes, same_fringe
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements
from tests.numbers import complex_normal

# Modes of the plate; the last one is never in resonance, of it only the tail is there.
NAMES = ("F1", "T1", "F2", "T2", "X1")
MODE_HZ = np.array([1500.0, 2400.0, 3500.0, 4300.0, 9000.0])
PARTICIPATION = np.array([1, 0.8j, 0.5 - 0.3j, 0.6, 0.4])
LOSS = 0.03
DRIVE_HZ = 1200 * 2 ** (np.arange(84) * 25 / 1200)
# The drive grows by an octave every few steps, until the resonances are as high as they may be.
CALM_RAD, OCTAVE = 0.35, 5
# Holograms are brighter and darker by chance, as the module has it: standard deviation in nepers.
GAIN = 0.05
# Light is what the noise is the unit of: mean signal-to-noise of a block at |F| = 1.
LIGHT = 30.0
POINTS = 400


@dataclass(frozen=True)
class Sweep:
    """What was planted, and what is seen of it."""

    modal: np.ndarray
    gain: np.ndarray
    object_field: np.ndarray
    block_amplitudes: BlockAmplitudes
    basis: ShapeBasis

    @property
    def true_rad(self):
        return self.modal @ self.basis.shapes


def moved(u):
    """F(u) = u J₁(|u|)/|u| to double precision."""
    phi = np.abs(u)
    return u * np.divide(j1(phi), phi, out=np.full_like(phi, 0.5), where=phi > 0)


def plate(rng, points):
    """Coordinates of points, and a basis of the shapes of a plate clamped at x = 1."""
    x, y = rng.uniform(0, 1, points), rng.uniform(-1, 1, points)
    u = 1 - x
    columns = [
        u**2,
        u**1.5 * y,
        u**2 * (1 - 2.2 * x),
        u**1.5 * y * np.cos(3.5 * x),
        u**2 * (1 - 2.5 * y**2),
    ]
    shapes = np.stack(columns, axis=1)
    shapes /= np.abs(shapes).max(axis=0)
    functions = np.linalg.svd(shapes, full_matrices=False)[0] * np.sqrt(points)
    coordinates = (functions.T @ shapes / points).T
    none = np.zeros(5), np.zeros((2, 5, 5)), np.array([1e3, 2e4]), np.zeros((2, 5, 5))
    functions = functions.astype(np.float32)
    return x, y, ShapeBasis(functions, coordinates, NAMES, MODE_HZ, *none, np.ones(5), {})


def planted(
    seed=0, peak_rad=97.0, object_field=LIGHT, points=POINTS, calm_rad=CALM_RAD, factor=1.0
):
    """Draw a sweep; `peak_rad` is that of F1's resonance at full drive, which later ones share."""
    rng = np.random.default_rng(seed)
    x, y, basis = plate(rng, points)
    turn = np.exp(2j * np.pi * rng.uniform(size=len(DRIVE_HZ)))
    resonance = 1 / (1 + 1j * LOSS - (DRIVE_HZ[:, None] / MODE_HZ) ** 2)
    modal = peak_rad * LOSS * resonance * PARTICIPATION
    ramp = calm_rad / np.abs(modal[0]).max() * 2 ** (np.arange(len(DRIVE_HZ)) / OCTAVE)
    modal *= (np.minimum(1, ramp) * factor * turn)[:, None]
    # Blocks of some eight speckles.
    a = (
        object_field
        * np.sqrt(rng.gamma(8, 1 / 8, points))
        * np.exp(2j * np.pi * rng.uniform(size=points))
    )
    gain = GAIN * rng.standard_normal(len(DRIVE_HZ))
    u = modal @ basis.shapes @ basis.functions.T.astype(float)
    seen = np.exp(gain)[:, None] * a * moved(u)
    value = (seen + complex_normal(rng, *u.shape)).T.astype(np.complex64)
    steps = np.arange(len(DRIVE_HZ))
    block_amplitudes = BlockAmplitudes(
        value,
        x,
        y,
        (1e-9, 1e-9),
        np.full((2, points), 0.3),
        1.0,
        np.ones(points),
        steps,
        steps,
        DRIVE_HZ,
        np.ones(len(steps)),
    )
    return Sweep(modal, gain, a, block_amplitudes, basis)


def with_value(sweep, value):
    return replace(
        sweep, block_amplitudes=replace(sweep.block_amplitudes, value=value.astype(np.complex64))
    )


def solve(sweep) -> Displacements:
    return fit_displacements(sweep.block_amplitudes, sweep.basis)


def solve_and_settle(sweep) -> Displacements:
    """The same with enough last turns between light and amplitudes that little changes then."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fitting.holograms.alternating_minimisation._SETTLED", 0.05)
        patch.setattr("fitting.holograms.solved_sweep._MOST_TURNS", 60)
        return solve(sweep)


def largest_rad(sweep):
    """Largest phase (k,) of each hologram."""
    return np.abs(sweep.true_rad @ sweep.basis.functions.T).max(axis=1)


def error_rad(sweep, found):
    """Errors (k, j) when every hologram is turned as is best for it."""
    overlap = np.sum(sweep.true_rad.conj() * found.amplitude_rad, axis=1)
    return found.amplitude_rad - sweep.true_rad * np.exp(1j * np.angle(overlap))[:, None]


def share_of_error(sweep, found):
    """Errors (k,) as a share of what each hologram shows."""
    return np.linalg.norm(error_rad(sweep, found), axis=1) / np.linalg.norm(sweep.true_rad, axis=1)


def jacobian(object_field, functions, a):
    """Derivatives (n, 2j + 1) of light times F, by differences.

    By real, then imaginary parts of a, and by log gain.
    """
    step, columns = 1e-6, []
    for move in step * np.concatenate([np.eye(len(a)), 1j * np.eye(len(a))]):
        ahead, behind = (moved(functions @ (a + sign * move)) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    return object_field[:, None] * np.stack([*columns, moved(functions @ a)], axis=1)


def fisher(object_field, functions, a, variance=0.0, gain_nepers=GAIN):
    """Information (2j, 2j) in block amplitudes with complex noise of variance 1.

    Of amplitudes, where the gain is unknown but small, and the light has a variance.
    """
    J = jacobian(object_field, functions.astype(float), a)
    noise = 1 + variance * np.abs(moved(functions.astype(float) @ a)) ** 2
    whole = 2 * ((J.conj().T / noise) @ J).real
    whole[-1, -1] += gain_nepers**-2
    return whole[:-1, :-1] - np.outer(whole[:-1, -1], whole[-1, :-1]) / whole[-1, -1]


def common_factor(sweep, found):
    """Complex factor of all light found to that planted."""
    return np.sum(sweep.object_field.conj() * mean_field(sweep, found)) / np.sum(
        np.abs(sweep.object_field) ** 2
    )


def mean_field(sweep, found):
    """Object field (n,) from all holograms together; each row of the found ones lacks its own."""
    whole = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    steps, weight = np.arange(len(found.gain)), 1 / np.maximum(found.misfit, 1)
    return block_object_field(whole, steps, found.amplitude_rad, found.gain, weight)


def normalised_square(error, information):
    """Mean over coordinates of errors squared (k,), in units of what information says."""
    parts = np.concatenate([error.real, error.imag], axis=1)
    return np.einsum("ki,kij,kj->k", parts, information, parts) / parts.shape[1]


@pytest.fixture(scope="module")
def sweep():
    return planted()


@pytest.fixture(scope="module")
def solved(sweep):
    return solve(sweep)


@pytest.fixture(scope="module")
def settled(sweep):
    return solve_and_settle(sweep)


# --- A sweep of many fringes -------------------------------------------------------------------


def test_the_sweep_has_small_amplitudes_first_and_many_fringes_then(sweep):
    """What the others rely on."""
    largest = largest_rad(sweep)
    assert largest[0] < 0.7
    assert np.count_nonzero(largest > 20) > 10
    assert largest.max() > 70


def test_every_hologram_is_explained_down_to_its_noise(settled):
    assert settled.reached.all()
    # Less what ten numbers of each hologram and one of each block's 84 block amplitudes explain.
    assert settled.misfit.mean() == pytest.approx(1 - 5 / POINTS - 1 / 84, abs=0.015)
    # Of 400 complex numbers: standard deviation 0.05.
    assert np.abs(settled.misfit - 1).max() < 0.2


def test_amplitudes_are_found_up_to_one_phase_for_each_hologram(sweep, settled):
    share = share_of_error(sweep, settled)
    assert np.median(share) < 0.01
    # A small-amplitude hologram may be a brighter one as well.
    fringes = largest_rad(sweep) > 3
    assert share[fringes].max() < 0.04
    assert share[~fringes].max() < 3 * GAIN


def test_errors_are_those_of_the_noise(sweep, settled):
    """Information by differences of the formula, as if the light were known."""
    functions = sweep.basis.functions
    lights = np.exp(sweep.gain)[:, None] * sweep.object_field
    information = np.array(
        [fisher(lit, functions, a) for lit, a in zip(lights, settled.amplitude_rad, strict=True)]
    )
    square = normalised_square(error_rad(sweep, settled), information)
    # One phase is taken off each hologram, but the light is known from these holograms only.
    assert 0.7 < square.mean() < 1.5
    assert square.max() < 7


def test_light_is_found_where_blocks_move(sweep, settled):
    u = sweep.true_rad @ sweep.basis.functions.T
    stated = np.sum(np.abs(moved(u)) ** 2, axis=0)
    moving = stated > 1
    assert np.count_nonzero(moving) > 0.7 * POINTS
    # All gains together and the light have one common factor.
    error = mean_field(sweep, settled) / common_factor(sweep, settled) - sweep.object_field
    assert np.sqrt(np.mean(np.abs(error[moving] / sweep.object_field[moving]) ** 2)) < 0.03
    assert settled.object_field.dtype == np.complex64


def test_light_has_next_to_no_factor(sweep, settled):
    """Gains are known to be small, so light is known to be what it is."""
    assert np.abs(common_factor(sweep, settled)) == pytest.approx(1, abs=GAIN)


def test_the_last_turns_settle(sweep, solved, settled):
    share, best = share_of_error(sweep, solved), share_of_error(sweep, settled)
    assert np.median(share) < 2 * np.median(best)


def test_errors_are_those_of_the_information(sweep, solved):
    square = normalised_square(error_rad(sweep, solved), solved.information)
    assert 0.7 < square.mean() < 1.5


def assert_information(sweep, found, k, gain):
    stated = found.information[k] * max(found.misfit[k], 1)
    object_field = np.exp(gain) * found.object_field[k]
    expected = fisher(
        object_field,
        sweep.basis.functions,
        found.amplitude_rad[k],
        np.exp(2 * gain) * found.field_variance[k],
        found.gain_nepers,
    )
    assert stated == pytest.approx(expected, abs=0.03 * np.abs(expected).max())


@pytest.mark.parametrize("k", [20, 45, 60, 83])
def test_information_is_that_of_the_formula(sweep, settled, k):
    assert_information(sweep, settled, k, sweep.gain[k])


@pytest.mark.parametrize("k", [0, 1])
def test_information_of_small_amplitudes_is_that_of_the_formula(sweep, settled, k):
    """In them amplitude and gain are the same, so that the gain found is 0."""
    assert_information(sweep, settled, k, 0.0)


def test_blocks_that_share_noise_count_for_less(sweep, solved):
    blocks = replace(sweep.block_amplitudes, independent_fraction=0.5)
    found = solve(replace(sweep, block_amplitudes=blocks))
    whole, half = solved.information, found.information
    # Where fringes show the gain, all is half; where its prior does, that counts as before.
    bright = np.abs(solved.amplitude_rad @ sweep.basis.functions.T).max(axis=1) > 6
    assert np.trace(half[bright], axis1=1, axis2=2) == pytest.approx(
        0.5 * np.trace(whole[bright], axis1=1, axis2=2), rel=0.02
    )
    for k, gain in ((0, 0.0), (1, 0.0), (45, found.gain[45])):
        stated = fisher(
            np.exp(gain) * found.object_field[k],
            sweep.basis.functions,
            found.amplitude_rad[k],
            np.exp(2 * gain) * found.field_variance[k],
            np.sqrt(0.5) * found.gain_nepers,
        )
        assert half[k] == pytest.approx(0.5 * stated, abs=0.02 * np.abs(stated).max())
    for shared in ("precision", "pull"):
        one, other = (getattr(each.common_mode, shared) for each in (found, solved))
        assert one == pytest.approx(0.5 * other)
    assert found.common_mode.response == pytest.approx(solved.common_mode.response)


def test_misfit_weakens_information(sweep, solved):
    rng = np.random.default_rng(8)
    value = sweep.block_amplitudes.value.copy()
    value[:, 30] += 2 * complex_normal(rng, len(value))
    found = solve(with_value(sweep, value))
    assert found.misfit[30] - solved.misfit[30] == pytest.approx(4, rel=0.2)
    before, after = (np.trace(d.information[30]) for d in (solved, found))
    assert before / after == pytest.approx(found.misfit[30] / max(solved.misfit[30], 1), rel=0.1)


def assert_followed(sweep, found):
    """Assert that every fringe is counted."""
    share, fringes = share_of_error(sweep, found), largest_rad(sweep) > 3
    assert share[fringes].max() < 0.06
    assert share[~fringes].max(initial=0) < 4 * GAIN


# --- Higher resonances, brighter light, lines of the air ----------------------------------------


def test_resonances_of_more_than_five_micrometres_are_followed():
    """At 650 nm these are 97 rad."""
    sweep = planted(peak_rad=125.0)
    assert largest_rad(sweep).max() > 97
    found = solve_and_settle(sweep)
    assert found.reached.all()
    assert_followed(sweep, found)
    assert found.misfit.max() < 1.3


@pytest.mark.parametrize("light", [300.0])
def test_more_light_does_no_harm(light):
    sweep = planted(object_field=light)
    found = solve(sweep)
    assert found.reached.all()
    assert_followed(sweep, found)


def test_a_line_of_the_air_is_followed():
    """All shapes grow together in a few holograms, and fall again."""
    factor = np.ones(84)
    factor[58:62] = [1.6, 2.8, 2.2, 1.3]
    sweep = planted(factor=factor)
    found = solve_and_settle(sweep)
    assert found.reached.all()
    assert_followed(sweep, found)
    alone = np.linalg.norm(found.amplitude_rad[57:60], axis=1)
    assert alone[2] / alone[0] > 2


@pytest.fixture(scope="module")
def spoilt(sweep):
    """Hologram 30 shows something else entirely."""
    value = sweep.block_amplitudes.value.copy()
    value[:, 30] = 10 * complex_normal(np.random.default_rng(9), len(value))
    return solve_and_settle(with_value(sweep, value))


def test_a_hologram_of_something_else_is_reported(spoilt):
    assert spoilt.misfit[30] > 50
    assert not spoilt.reached[30]


def test_beyond_a_hologram_of_something_else_the_sweep_goes_on(sweep, spoilt, settled):
    others = np.arange(84) != 30
    assert spoilt.reached[others].all()
    assert np.count_nonzero(spoilt.misfit > 1.2 * settled.misfit) < 5


def test_a_hologram_of_something_else_spoils_no_other(sweep, spoilt, settled):
    others = np.arange(84) != 30
    assert (spoilt.misfit[others] < 1.2 * settled.misfit[others]).all()


@pytest.mark.parametrize(
    "seed",
    [pytest.param(0, marks=pytest.mark.slow), 2, pytest.param(6, marks=pytest.mark.slow)],
)
def test_a_sweep_may_begin_with_fringes(seed):
    sweep = planted(seed, calm_rad=300.0)
    assert largest_rad(sweep).min() > 6
    found = solve(sweep)
    assert found.reached.all()
    assert_followed(sweep, found)


@pytest.mark.parametrize("seed", range(3))
def test_vibrations_below_the_first_fringe_are_not_taken_for_larger_ones(seed, monkeypatch):
    # Brightness scatters as on ordinary benches, but no hologram shows by how much.
    monkeypatch.setitem(globals(), "GAIN", 0.003)
    weak = planted(seed, peak_rad=1.0, object_field=60.0)
    largest_rad = np.abs(weak.true_rad @ weak.basis.functions.T).max()
    found = solve(weak)
    assert np.abs(found.amplitude_rad @ weak.basis.functions.T).max() == pytest.approx(
        largest_rad, rel=0.25
    )
    assert np.abs(found.gain).max() < GAIN_NEPERS


def test_every_guess_of_a_set_becomes_a_start_of_its_own(sweep):
    whole = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    sets = list(Continuation(whole, sweep.block_amplitudes, sweep.basis).starts())
    starts = list(starts_of(whole, sweep.block_amplitudes, sweep.basis))
    single = [guess for _, guesses in sets if len(guesses) > 1 for guess in guesses]
    assert [guesses for _, guesses in starts[: len(sets)]] == [guesses for _, guesses in sets]
    assert [guesses for _, guesses in starts[len(sets) :]] == [[guess] for guess in single]


def counted_starts(monkeypatch):
    """Note from how many starts a sweep is solved."""
    begun = []

    def noted(*arguments):
        begun.append(arguments[-1])
        return continued(*arguments)

    monkeypatch.setattr("fitting.holograms.displacement.continued", noted)
    return begun


def test_no_other_start_is_tried_once_all_holograms_are_explained(monkeypatch):
    begun = counted_starts(monkeypatch)
    # Brightness scatters as that of benches does, not as much as it may.
    monkeypatch.setattr("tests.fitting.holograms.test_displacement.GAIN", 0.005)
    solve(planted())
    assert len(begun) == 1


def test_other_starts_are_tried_where_brightness_scatters_as_much_as_it_may(sweep, monkeypatch):
    begun = counted_starts(monkeypatch)
    assert np.std(sweep.gain) > 0.9 * GAIN
    solve(sweep)
    assert len(begun) > 1


@pytest.fixture
def nothing_explained(monkeypatch):
    """No hologram is explained, whatever a start finds."""
    monkeypatch.setattr("fitting.holograms.displacement._EXPLAINED", 0.0)
    monkeypatch.setattr(
        "fitting.holograms.solved_sweep.unexplained", lambda misfit, _seen: np.arange(len(misfit))
    )


@pytest.mark.usefixtures("nothing_explained")
def test_few_starts_are_tried_where_hardly_anything_is_explained(sweep, monkeypatch):
    begun = counted_starts(monkeypatch)
    monkeypatch.setattr("fitting.holograms.displacement.agree", lambda *_: False)
    solve(sweep)
    assert len(begun) == 3


@pytest.mark.usefixtures("nothing_explained")
def test_what_two_starts_agree_about_is_not_looked_for_again(sweep, monkeypatch):
    begun = counted_starts(monkeypatch)
    solve(sweep)
    assert len(begun) == 2


@pytest.mark.usefixtures("nothing_explained")
def test_a_start_that_looks_better_is_compared_after_both_were_refined(sweep, monkeypatch):
    """A start that lost its way at few holograms looks worse than it is."""
    module, rough = "fitting.holograms.displacement", iter("abc")
    costs = {"a": 10.0, "b": 8.0, "c": 9.0, "A": 5.0, "B": 7.0}

    def solution(tag):
        every = np.ones(len(DRIVE_HZ))
        gains = {"gain": 0 * every, "gain_nepers": GAIN_NEPERS}
        return SimpleNamespace(tag=tag, misfit=every, amplitude_rad=None, **gains)

    monkeypatch.setattr(f"{module}.continued", lambda *_: True)
    monkeypatch.setattr(f"{module}._from_search", lambda *_: solution(next(rough)))
    monkeypatch.setattr(f"{module}._refined", lambda *a: solution(a[1].tag.upper()))
    monkeypatch.setattr(f"{module}.with_all_blocks", lambda _, found: found)
    monkeypatch.setattr(f"{module}._unlikelihood", lambda _, found: costs[found.tag])
    monkeypatch.setattr(f"{module}.agree", lambda *_: False)
    assert solve(sweep).tag == "A"
    costs["B"], rough = 4.0, iter("abc")
    assert solve(sweep).tag == "B"


@pytest.mark.usefixtures("nothing_explained")
def test_the_same_start_again_is_no_agreement(sweep, monkeypatch):
    begun = counted_starts(monkeypatch)
    whole = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    start = next(starts_of(whole, sweep.block_amplitudes, sweep.basis))
    monkeypatch.setattr("fitting.holograms.displacement.starts_of", lambda *_: [start] * 4)
    solve(sweep)
    assert len(begun) == 3


def test_light_that_modes_have_determined_is_held(sweep, settled, monkeypatch):
    """Without modes some blocks come first, with the factor free, and all of them with it held."""
    seen = []

    def noted(sweep_of_blocks, at, turns):
        seen.append((sweep_of_blocks.common, sweep_of_blocks.problem.blocks))
        return settling.settled(sweep_of_blocks, at, turns)

    monkeypatch.setattr("fitting.holograms.solved_sweep.settled", noted)
    monkeypatch.setattr("fitting.holograms.solved_sweep._BLOCKS_OF_FUNCTION", 1)
    solve(sweep)
    assert {blocks for common, blocks in seen if common} == {134}
    assert [blocks for common, blocks in seen if not common] == [POINTS]
    assert seen[-1] == (False, POINTS)
    seen.clear()
    q = settled.common_mode.precision.shape[1]
    nothing, off = np.zeros((84, q)), np.zeros(84, bool)
    refit_displacements(
        sweep.block_amplitudes, sweep.basis, settled, [settled.amplitude_rad], off, nothing
    )
    assert set(seen) == {(False, POINTS)}


def test_starts_agree_if_most_displacements_with_fringes_are_in_the_same(sweep, settled):
    problem = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    largest = np.hypot(*problem.displacement(settled.amplitude_rad)).max(axis=1)
    fringed = np.flatnonzero(largest > 2.5)
    few, most = fringed[: len(fringed) // 10], fringed[len(fringed) // 10 :]

    def moved(factor, number):
        amplitude = settled.amplitude_rad.copy()
        amplitude[number] *= factor
        return replace(settled, amplitude_rad=amplitude)

    turned = moved(1.1 * np.exp(2j), slice(None))
    assert agree(problem, settled.amplitude_rad, turned.amplitude_rad)
    # At 10 rad the next fringe is farther than this.
    other_fringe = moved(1 + np.pi / 10, few)
    assert agree(problem, settled.amplitude_rad, other_fringe.amplitude_rad)
    apart = in_other_fringes(problem, settled.amplitude_rad, other_fringe.amplitude_rad)
    assert apart.tolist() == few.tolist()
    apart = moved(1 + np.pi / 10, most).amplitude_rad
    assert not agree(problem, settled.amplitude_rad, apart)
    # Without fringes, a brighter object field looks like a smaller displacement.
    dimmer = moved(0.5, np.flatnonzero(largest < 1.0))
    assert in_other_fringes(problem, settled.amplitude_rad, dimmer.amplitude_rad).size == 0


def test_what_led_a_hologram_astray_is_looked_for_beside_it(sweep, settled):
    whole = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    lost = np.array([59, 60, 61])
    amplitude = settled.amplitude_rad.copy()
    amplitude[lost] *= 0.4
    at = Solution(amplitude, settled.gain, settled.object_field, settled.field_variance)
    found, better = tried_again(whole, at, lost[:1])
    assert set(better.tolist()) == set(lost.tolist())
    for number in lost:
        overlap = np.vdot(found.amplitude[number], settled.amplitude_rad[number])
        ends = (
            np.linalg.norm(found.amplitude[number]),
            np.linalg.norm(settled.amplitude_rad[number]),
        )
        assert np.abs(overlap) == pytest.approx(ends[1] ** 2, rel=0.1)
        assert ends[0] == pytest.approx(ends[1], rel=0.05)


def test_another_solution_is_tried_where_neighbours_are_lost_too(sweep, settled):
    whole = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    lost, middle = np.arange(54, 69), 61
    amplitude = settled.amplitude_rad.copy()
    amplitude[lost] *= 0.05
    at = Solution(amplitude, settled.gain, settled.object_field, settled.field_variance)

    def kept(other):
        found, _ = tried_again(whole, at, np.array([middle]), [] if other is None else [other])
        return np.linalg.norm(found.amplitude[middle]) / np.linalg.norm(
            settled.amplitude_rad[middle]
        )

    assert kept(settled.amplitude_rad) == pytest.approx(1, rel=0.05)
    assert not 0.9 < kept(None) < 1.1


def test_holograms_in_a_wrong_fringe_are_solved_from_their_neighbours(sweep, settled):
    whole = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    lost = np.array([40, 61])
    amplitude = settled.amplitude_rad.copy()
    amplitude[lost] *= 0.4
    misfit = settled.misfit.copy()
    misfit[lost] = 50.0
    bad = unexplained(misfit, whole.seen)
    assert set(lost.tolist()) <= set(bad.tolist())
    at = Solution(amplitude, settled.gain, settled.object_field, settled.field_variance)
    found, better = tried_again(whole, at, bad)
    assert set(better.tolist()) == set(lost.tolist())
    for number in lost:
        true = settled.amplitude_rad[number]
        turned = found.amplitude[number] * np.exp(
            1j * np.angle(np.vdot(found.amplitude[number], true))
        )
        assert np.linalg.norm(turned - true) < 0.05 * np.linalg.norm(true)


def test_what_noise_does_not_explain_is_found_and_nothing_else():
    rng = np.random.default_rng(3)
    seen = np.full(200, 3000.0)
    misfit = 1 + rng.standard_normal(200) / np.sqrt(3000)
    assert unexplained(misfit, seen).size == 0
    misfit[[17, 90]] = 1.2, np.inf
    assert unexplained(misfit, seen).tolist() == [17, 90]
    assert unexplained(np.full(4, np.inf), seen[:4]).tolist() == [0, 1, 2, 3]


def test_speckle_that_changes_counts_in_proportion_to_the_signal():
    signal = np.geomspace(1.0, 1e4, 101)
    misfit = 1 + 2e-3 * signal
    assert relative_misfit(misfit, signal) == pytest.approx(np.ones(101), rel=1e-6)
    assert relative_misfit(np.ones(101), signal) == pytest.approx(np.ones(101))
    misfit[50] *= 5
    assert np.argmax(relative_misfit(misfit, signal)) == 50


def test_slow_changes_of_brightness_belong_to_an_object_field_that_changes():
    """Gains far beyond their scatter would contradict their prior, and displacements would pay."""
    sweep, rng = planted(), np.random.default_rng(7)
    steps = np.arange(len(DRIVE_HZ))
    slow = 0.2 * np.sin(steps / 14)
    walk = np.cumsum(0.02 * complex_normal(rng, POINTS, len(steps)), axis=1)
    quiet = np.exp(slow - 0.95 * sweep.gain)
    found = solve(with_value(sweep, sweep.block_amplitudes.value * (1 + walk) * quiet))
    smooth, field = (
        np.polynomial.Chebyshev.fit(steps, each, 8)(steps)
        for each in (found.gain, np.log(np.abs(found.object_field).mean(axis=1)))
    )
    assert np.std(smooth) < 0.2 * np.std(slow)
    assert np.corrcoef(field, slow)[0, 1] > 0.9
    assert found.gain_nepers < 0.01


def test_a_sweep_of_hundreds_of_fringes_is_refused():
    sweep = planted(peak_rad=1000.0, calm_rad=300.0)
    assert largest_rad(sweep).min() > 80
    with pytest.raises(FitError, match="less volts"):
        solve(sweep)


def test_without_light_a_sweep_is_refused(sweep):
    noise = complex_normal(np.random.default_rng(10), *sweep.block_amplitudes.value.shape)
    with pytest.raises(FitError, match="shows any light"):
        solve(with_value(sweep, noise))


# --- What is known by now ------------------------------------------------------------------------


def test_holograms_in_a_wrong_fringe_are_found_where_they_are_expected(sweep, settled):
    """Two holograms tell nothing of the truth, but modes do, up to a phase."""
    lost = np.array([40, 61])
    off = np.isin(np.arange(84), lost)
    amplitude, misfit = settled.amplitude_rad.copy(), settled.misfit.copy()
    amplitude[lost] *= 0.3
    misfit[lost] = 1e4
    before = replace(settled, amplitude_rad=amplitude, misfit=misfit)
    expected = 1.01 * sweep.true_rad * np.exp(2j * np.arange(84))[:, None]
    together = np.zeros(settled.common_mode.precision.shape[:2])
    # Of several expectations the one that explains a hologram counts.
    several = 0.6 * expected, expected, 1.3 * expected
    found = refit_displacements(sweep.block_amplitudes, sweep.basis, before, several, off, together)
    assert found.reached.all()
    assert found.misfit[lost].max() < 1.3
    assert share_of_error(sweep, found)[lost].max() < 0.04


def test_holograms_in_wrong_fringes_say_nothing_of_the_light(sweep, settled):
    """A third of the displacement at every fifth hologram, and light where something moves."""
    whole = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    lost = np.arange(2, 84, 5)
    amplitude = settled.amplitude_rad.copy()
    amplitude[lost] *= 0.3
    at = Solution(amplitude, settled.gain, settled.object_field, settled.field_variance)

    def error(off, change):
        found = field_of_others(whole, at, off, settled.misfit, change).object_field
        rows = np.broadcast_to(found, settled.object_field.shape)[lost]
        bright = np.abs(moved(settled.amplitude_rad[lost] @ sweep.basis.functions.T))
        light = settled.object_field[lost]
        return np.linalg.norm(bright * (rows - light)) / np.linalg.norm(bright * light)

    for change in (settled.change, None):
        assert error(lost, change) < 0.02
        assert error(lost[:0], change) > 0.1


def test_fringes_are_the_same_but_for_a_phase_and_the_brightness_of_light(settled):
    one = settled.amplitude_rad[[40, 61]]
    assert same_fringe(one, 1.1 * np.exp(2j) * one).all()
    assert not same_fringe(one, 1.3 * one).any()
    # A hologram that has no solution before and after has not moved.
    assert same_fringe(0 * one, 0 * one).all()
    assert not same_fringe(0 * one, one).any()


@pytest.mark.parametrize("expected", [0.3, 1.0, 3.5])
def test_the_size_of_what_modes_expect_is_scanned(sweep, settled, expected):
    """A mode whose frequency is wrong has the right shape."""
    whole = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    at = Solution(settled.amplitude_rad, settled.gain, settled.object_field, settled.field_variance)
    for number in (40, 61):
        true = settled.amplitude_rad[number]
        starts = _likely_sizes(whole, at, number, expected * true * np.exp(1j))
        sizes = np.linalg.norm(starts, axis=1) / np.linalg.norm(true)
        assert sizes[0] == pytest.approx(expected)
        # Half a step between sizes.
        assert np.abs(np.log(sizes[1:])).min() < 0.5 * np.log(25) / 40 + 1e-6


def test_what_is_expected_counts_only_if_it_explains_a_hologram(sweep, settled):
    largest = int(largest_rad(sweep).argmax())
    off = np.arange(84) == largest
    together = np.zeros(settled.common_mode.precision.shape[:2])
    expected = 0.6 * sweep.true_rad
    found = refit_displacements(
        sweep.block_amplitudes, sweep.basis, settled, [expected], off, together
    )
    assert found.misfit[largest] == pytest.approx(settled.misfit[largest], rel=0.02)


def test_a_sweep_of_something_else_is_refused(sweep, settled):
    rng = np.random.default_rng(12)
    value = sweep.block_amplitudes.value.T
    noise = with_value(sweep, (30 * complex_normal(rng, *value.shape)).T)
    before = replace(settled, misfit=np.full(84, np.inf))
    together = np.zeros(settled.common_mode.precision.shape[:2])
    everything, expected = np.ones(84, dtype=bool), [settled.amplitude_rad]
    with pytest.raises(FitError, match="none of 84 holograms"):
        refit_displacements(
            noise.block_amplitudes, sweep.basis, before, expected, everything, together
        )


def test_light_of_another_sweep_is_found_with_the_displacements(settled):
    """The other sweep has expected displacements that are 8 % too large, in darker light.

    At a tenth of the volts, hardly a hologram passes the first maximum of J₁.
    """
    calm = planted(factor=0.1)
    true, everything = calm.true_rad, np.ones(84, dtype=bool)
    light = (calm.object_field / 1.08).astype(np.complex64)
    before = replace(settled, object_field=light, misfit=np.full(84, np.inf), change=None)
    together = np.zeros(settled.common_mode.precision.shape[:2])
    found = refit_displacements(
        calm.block_amplitudes, calm.basis, before, [1.08 * true], everything, together
    )
    size = [np.linalg.norm(each, axis=1) for each in (found.amplitude_rad, true)]
    # Light that stays as it is leaves 5 %.
    assert np.median(size[0] / size[1]) == pytest.approx(1, abs=0.03)


@pytest.fixture(scope="module")
def plateau():
    """Sweep in dim light that stays just beyond the first bright fringe for long.

    Functions are many: they let a shape bend where it crosses the fringe.
    """
    dim = planted(object_field=30.0)
    rng = np.random.default_rng(11)
    x, y, shapes = (
        dim.block_amplitudes.x_m,
        dim.block_amplitudes.y_m,
        dim.basis.shapes @ dim.basis.functions.T,
    )
    more = [(1 - x) ** 2 * x**i * y**j for i in range(6) for j in range(4)]
    every = np.concatenate([shapes.T, np.stack(more, axis=1)], axis=1)
    functions = np.linalg.svd(every, full_matrices=False)[0][:, :24] * np.sqrt(len(x))
    basis = replace(
        dim.basis,
        functions=functions.astype(np.float32),
        shapes=(functions.T @ shapes.T / len(x)).T,
    )
    dim = replace(dim, basis=basis)
    largest = np.interp(np.arange(84), [0, 14, 22, 50, 64, 83], [0.4, 2.0, 2.6, 3.0, 9.0, 4.0])
    # Nothing but the first mode, and a little of the second.
    modal = np.zeros((84, 5), complex)
    modal[:, 0], modal[:, 1] = largest, 0.1j * largest
    modal *= np.exp(2j * np.pi * rng.uniform(size=(84, 1)))
    u = modal @ dim.basis.shapes @ dim.basis.functions.T.astype(float)
    value = (dim.object_field * moved(u) + complex_normal(rng, *u.shape)).T
    return with_value(replace(dim, modal=modal, gain=np.zeros(84)), value)


@pytest.mark.parametrize("last", [1.0, 0.4])
def test_the_light_of_the_others_tells_two_branches_of_a_fringe_apart(plateau, last):
    """Whichever is tried last: each hologram alone could have light that explains either."""
    size = plateau.basis.functions.shape[1]
    smooth = smooth_functions(plateau.block_amplitudes.x_m, plateau.block_amplitudes.y_m)
    nothing = np.zeros((84, 2 * smooth.shape[1] - 1))
    known = np.zeros((84, nothing.shape[1], nothing.shape[1]))
    shared = CommonModeError(np.zeros((84, 2 * size, nothing.shape[1])), known, nothing)
    before = Displacements(
        amplitude_rad=plateau.true_rad.copy(),
        information=np.zeros((84, 2 * size, 2 * size)),
        common_mode=shared,
        misfit=np.ones(84),
        gain=np.zeros(84),
        gain_nepers=0.05,
        object_field=plateau.object_field.astype(np.complex64),
        field_variance=None,
        change=None,
        recording_rank=np.arange(84),
        reached=np.ones(84, dtype=bool),
    )
    off = np.isin(np.arange(84), np.arange(26, 50, 4))
    several = [factor * plateau.true_rad for factor in (1.4 - last, last)]
    found = refit_displacements(
        plateau.block_amplitudes, plateau.basis, before, several, off, nothing
    )
    assert share_of_error(plateau, found)[off].max() < 0.15


@pytest.fixture
def lit(plateau):
    """Search in that sweep, its light known."""
    whole = Problem.of(plateau.block_amplitudes.value, plateau.basis.functions, BesselTable())
    continuation = Continuation(whole, plateau.block_amplitudes, plateau.basis)
    continuation.begin([0], [])
    continuation.object_field = plateau.object_field.astype(np.complex64)
    return continuation


def test_of_two_equal_ones_the_expected_is_taken(plateau, lit):
    """Block amplitudes of 2.6 rad and of 1.2 rad are equal; a shape may pass between the two."""
    for step in range(20, 50, 2):
        true = plateau.true_rad[step]
        starts = np.array([true, 0.4 * true])
        shares = []
        for expected in (true, 0.4 * true):
            lit.misfit[step] = np.inf
            lit.attempt(step, starts, ((lit.whole, 1, 12),), expected)
            # Both explain the hologram.
            assert lit.misfit[step] == pytest.approx(1, abs=0.35)
            found = lit.amplitude[step]
            turned = found * np.exp(1j * np.angle(np.vdot(found, true)))
            shares.append(np.linalg.norm(turned - true) / np.linalg.norm(true))
        assert shares[0] < 0.12
        assert shares[1] > 0.2


def test_a_trend_goes_on_as_it_did_before_with_the_phase_of_the_hologram(plateau, lit):
    lit.amplitude[[57, 58]] = plateau.true_rad[[57, 58]]
    lit.solved[58] = True
    assert lit.trend(59, 58) is None
    lit.solved[57] = True
    found, true = lit.trend(59, 58), plateau.true_rad[59]
    assert np.linalg.norm(found - true) < 0.06 * np.linalg.norm(true)
    # But no further than resonances are steep.
    lit.amplitude[57] *= 0.01
    grown = np.linalg.norm(lit.trend(59, 58)) / np.linalg.norm(lit.amplitude[58])
    assert grown == pytest.approx(1.7)


def test_a_trend_grows_towards_a_resonance_as_it_does_near_a_pole(lit):
    """Half a width, then a width nearer to the pole: 1/8, 1/6, so 1/4 comes next."""
    lit.amplitude[[57, 58], 0] = 8 / 8, 8 / 6
    lit.solved[[57, 58]] = True
    assert np.linalg.norm(lit.trend(59, 58)) == pytest.approx(8 / 4)


def test_the_prior_of_shapes_does_not_shrink_displacements_turn_by_turn(plateau):
    """Without fringes, brighter light with smaller displacements explains a sweep as well."""
    calm = np.arange(8)
    weak = 0.05 * plateau.true_rad[calm]
    u = weak @ plateau.basis.functions.T.astype(float)
    value = plateau.block_amplitudes.value.copy()
    noise = complex_normal(np.random.default_rng(6), *u.shape)
    value[:, calm] = (plateau.object_field * moved(u) + noise).T
    dim = with_value(plateau, value)
    whole = Problem.of(dim.block_amplitudes.value, dim.basis.functions, BesselTable())
    search = Continuation(whole, dim.block_amplitudes, dim.basis)
    search.begin([0], [])
    search.object_field = plateau.object_field.astype(np.complex64)
    search.amplitude[calm], search.misfit[calm] = weak, 1.0
    search.solved[calm] = True
    search.update_object_field(turns=20)
    before, after = (np.linalg.norm(each) for each in (weak, search.amplitude[calm]))
    assert after == pytest.approx(before, rel=0.02)


def test_a_hologram_does_not_take_shapes_of_other_frequencies_for_a_fringe(plateau, lit):
    """What the prior costs decides between solutions that explain a hologram as well."""
    step = 30
    true = plateau.true_rad[step]
    far = plateau.basis.shapes[np.argmax(np.abs(np.log(MODE_HZ / DRIVE_HZ[step])))]
    own, odd = (lit.oddness(step, each[None], POINTS)[0] for each in (true, far + 0j))
    assert odd > 10 * own
    # The same for any size.
    assert lit.oddness(step, 3 * far[None] + 0j, POINTS)[0] == pytest.approx(odd)


def test_the_prior_decides_where_an_odd_shape_explains_a_hologram_a_little_better(
    plateau, lit, monkeypatch
):
    step = 30
    true = plateau.true_rad[step]
    far = plateau.basis.shapes[np.argmax(np.abs(np.log(MODE_HZ / DRIVE_HZ[step])))] + 0j
    # Less than what the prior takes.
    least = lit.oddness(step, far[None], POINTS) - lit.oddness(step, true[None], POINTS)
    costs = {"far": POINTS * (2.0 - 0.5 * least[0]), "true": POINTS * 2.0}

    def fitted(_problem, _field, _steps, start, *_):
        a, gain = start
        odd = np.isclose(a[:, None] @ far.conj(), np.linalg.norm(far) ** 2)[:, 0]
        return a, gain, np.where(odd, costs["far"], costs["true"])

    monkeypatch.setattr("fitting.holograms.continuation.fit_amplitudes", fitted)
    for starts in ([far, true], [far], [true]):
        # What was found before gives way, or does not, by the same costs.
        lit.attempt(step, np.array(starts), ((lit.whole, 1, 1),))
        assert np.allclose(lit.amplitude[step], true)
    lit.misfit[step] = np.inf
    lit.attempt(step, far[None], ((lit.whole, 1, 1),))
    assert np.allclose(lit.amplitude[step], far)
    lit.attempt(step, true[None], ((lit.whole, 1, 1),))
    assert np.allclose(lit.amplitude[step], true)


# --- Invariance --------------------------------------------------------------------------------


def assert_alike(one, other):
    """Assert that amplitudes agree up to one phase for each hologram."""
    a, b = one.amplitude_rad, other.amplitude_rad
    overlap = np.abs(np.sum(a.conj() * b, axis=1))
    # What rounding leaves, of single precision over many turns.
    norms = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    assert norms[0] == pytest.approx(norms[1], rel=2e-3)
    assert overlap == pytest.approx(norms[0] * norms[1], rel=2e-3)


def test_the_phase_of_a_hologram_is_of_no_matter(sweep, solved):
    turn = np.exp(2j * np.pi * np.random.default_rng(11).uniform(size=84))
    turned = solve(with_value(sweep, sweep.block_amplitudes.value * turn))
    assert_alike(turned, solved)
    assert turned.misfit == pytest.approx(solved.misfit, rel=5e-3)


def test_the_phase_of_a_block_is_that_of_its_light(sweep, solved):
    turn = np.exp(2j * np.pi * np.random.default_rng(12).uniform(size=POINTS))
    turned = solve(with_value(sweep, sweep.block_amplitudes.value * turn[:, None]))
    assert_alike(turned, solved)
    ratio = turned.object_field / (solved.object_field * turn)
    assert np.abs(ratio / ratio[0] - 1).max() < 0.05


# --- Derivatives -------------------------------------------------------------------------------

LEVELS_RAD = {"still": 0.0, "next to still": 1e-4, "small": 0.3, "fringes": 8.0, "large": 20.0}


@dataclass(frozen=True)
class Point:
    """Amplitudes and gain at which few blocks are linearised, and what came of it."""

    value: np.ndarray
    lit: np.ndarray
    functions: np.ndarray
    a: np.ndarray
    normal: Normal

    def misfit(self, move):
        """Sum of squares near the point; moves are of amplitudes and log gain."""
        expected = np.exp(move[-1].real) * self.lit * moved(self.functions @ (self.a + move[:-1]))
        return np.sum(np.abs(self.value - expected) ** 2)


@pytest.fixture(params=LEVELS_RAD)
def point(request):
    rng = np.random.default_rng(13)
    _, _, basis = plate(rng, 200)
    object_field, gain = LIGHT * complex_normal(rng, 200), 0.2
    a = LEVELS_RAD[request.param] * complex_normal(rng, 5)
    value = object_field * moved(basis.functions @ complex_normal(rng, 5)) + complex_normal(
        rng, 200
    )
    problem = Problem.of(value[:, None].astype(np.complex64), basis.functions, BesselTable())
    linear = normal(
        problem, object_field.astype(np.complex64), np.array([0]), a[None], np.array([gain])
    )
    return Point(value, np.exp(gain) * object_field, basis.functions.astype(float), a, linear)


def test_the_misfit_is_the_sum_of_squares(point):
    assert point.normal.misfit[0] == pytest.approx(point.misfit(np.zeros(6)), rel=1e-4)


def test_the_gradient_is_minus_half_the_slope_of_the_misfit(point):
    step, slopes = 1e-5, []
    for unit in [*np.eye(6)[:5], *(1j * np.eye(6)[:5]), np.eye(6)[5]]:
        ahead, behind = (point.misfit(sign * step * unit) for sign in (1, -1))
        slopes.append((ahead - behind) / (2 * step))
    expected = -0.5 * np.array(slopes)
    assert point.normal.gradient[0] == pytest.approx(expected, abs=5e-4 * np.abs(expected).max())


def test_the_matrix_is_that_of_the_derivatives(point):
    J = jacobian(point.lit, point.functions, point.a)
    expected = (J.conj().T @ J).real
    assert point.normal.matrix[0] == pytest.approx(expected, abs=5e-4 * np.abs(expected).max())


def test_holograms_are_linearised_side_by_side_as_if_alone(sweep):
    problem = Problem.of(sweep.block_amplitudes.value, sweep.basis.functions, BesselTable())
    object_field, steps = sweep.object_field.astype(np.complex64), np.array([3, 40, 41])
    whole = normal(problem, object_field, steps, sweep.true_rad[steps], sweep.gain[steps])
    for place, step in enumerate(steps):
        one = normal(
            problem, object_field, steps[[place]], sweep.true_rad[[step]], sweep.gain[[step]]
        )
        assert one.misfit[0] == pytest.approx(whole.misfit[place], rel=1e-5)
        scale = np.abs(one.matrix).max()
        assert whole.matrix[place] == pytest.approx(one.matrix[0], abs=1e-5 * scale)
        scale = np.abs(one.gradient).max()
        assert whole.gradient[place] == pytest.approx(one.gradient[0], abs=1e-3 * scale)
