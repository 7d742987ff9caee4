"""Fit the complex displacement of the whole reed in every hologram to its block amplitudes.

The amplitudes of a block are ``A c_k F(u_k)`` (see `fitting.holograms.block_amplitudes`). The
object field A is unknown and the same in all holograms, c_k is the phase of a hologram, and
``u_k = Σ_j a_kj Φ_j`` is the complex phase amplitude, a sum of few functions Φ. Object field and
amplitudes are fitted by alternating minimisation from the start that
`fitting.holograms.continuation` finds. The phase of a hologram is part of its amplitudes, because
``F(u e^{iθ}) = F(u) e^{iθ}``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

from fitting.errors import FitError
from fitting.holograms.alternating_minimisation import (
    FAR,
    Solution,
    Sweep,
    middle,
    settled,
    whole_cost,
    with_field,
)
from fitting.holograms.amplitudes import (
    LEAST_GAIN_NEPERS,
    block_object_field,
    gain_scatter,
)
from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import BlockAmplitudes
from fitting.holograms.changing_field import (
    FieldChange,
    field_estimate,
    found_change,
    same_change,
    unlikelihood,
)
from fitting.holograms.continuation import (
    CONTINUATION_STRIDE,
    Continuation,
    continued,
    enough,
    starts_of,
)
from fitting.holograms.object_field import (
    CommonModeError,
    FieldStep,
    field_factor,
    response_of_small,
    smooth_functions,
)
from fitting.holograms.problem import Problem
from fitting.holograms.retries import (
    agree,
    all_from_expected,
    field_of_others,
    in_other_fringes,
    in_right_fringes,
    relative_misfit,
    tried_again,
    unexplained,
    with_wrong_gain,
)
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.within_blocks import mean_bend, spread_slopes
from holography.arrays import Array, Complex64Array, ComplexArray, IndexArray

# Most turns of the alternating minimisation, and of one whose result is refined later.
_MOST_TURNS, _QUICK_TURNS = 30, 2
# Most starts of the continuation while the best explains less than most of the sweep, and while it
# leaves single holograms unexplained: all displacements may then be too small by a factor.
_FEW_STARTS, _MOST_STARTS = 3, 10
_MOST_EXPLAINED, _EXPLAINED = 0.8, 2.0
# If a smaller fraction of the holograms is explained, the continuation is repeated with the
# converged object field.
_ENOUGH = 0.95
# How often the change of the object field is found again, with the displacements that it gives.
_MOST_CHANGES = 3
# Scatter of all gains over that of most, up to which nothing is odd. Chosen: usually it is 1.
_LIKE_MOST = 2.0
# Fringes are found with every third block, as by the continuation, and displacements with all of
# them. Chosen: with at least this number of blocks for each function, a fit takes 6 % of the noise.
_BLOCKS_OF_FUNCTION = 16


@dataclass(frozen=True)
class Displacements:
    """Complex phase amplitudes of every hologram, with their information.

    Attributes
    ----------
    amplitude_rad : (k, j) complex128
        Coordinates of u in a `ShapeBasis`; the phase common to one hologram is arbitrary.
    information : (k, 2j, 2j) float
        Inverse covariance of their real, then imaginary parts, from noise and misfit.
    common_mode : CommonModeError
        Error that all of them have in common, in addition to their noise.
    recording_rank : (k,) int
        Rank of each hologram in the order of recording.
    misfit : (k,) float
        Mean square residual of the block amplitudes, in units of the noise.
    gain : (k,) float
        Log of the brightness of holograms.
    gain_nepers : float
        Standard deviation of its changes from hologram to hologram.
    object_field : (n,) or (k, n) complex64
        Object field of each block in every hologram, in units of the noise.
    field_variance : (k, n) float32, optional
        Its variance; None if the object field is taken to be the same in all holograms.
    change : FieldChange, optional
        How much the object field changes; None if that is not known.
    reached : (k,) bool
        Whether the misfit of a hologram is near that of its noise.
    positions : (n, 2) complex, optional
        Mean positions of the light within each block, see
        `fitting.holograms.within_blocks.speckle_positions`.
    """

    amplitude_rad: ComplexArray
    information: Array
    common_mode: CommonModeError
    recording_rank: IndexArray
    misfit: Array
    gain: Array
    gain_nepers: float
    object_field: Complex64Array
    field_variance: NDArray[np.float32] | None
    change: FieldChange | None
    reached: NDArray[np.bool_]
    positions: ComplexArray | None = None

    @property
    def solution(self) -> Solution:
        """Amplitudes, gains and object field of all holograms."""
        light = self.object_field, self.field_variance, self.positions
        return Solution(self.amplitude_rad, self.gain, *light)


def fit_displacements(block_amplitudes: BlockAmplitudes, basis: ShapeBasis) -> Displacements:
    """Find the vibration of the whole reed in every hologram of a sweep.

    Parameters
    ----------
    block_amplitudes : BlockAmplitudes
    basis : ShapeBasis
        At the points of the block amplitudes.

    Raises
    ------
    FitError
        If hardly any hologram can be explained.
    """
    level = _Level.of(block_amplitudes, basis)
    few = level.every(level.stride)
    best = _best_start(few, level, block_amplitudes, basis)
    if best is None:
        raise FitError(
            f"hardly any of {len(block_amplitudes.drive_hz)} holograms can be explained as "
            "vibrations of this reed: none shows any light, or there are too many fringes; begin "
            "with less volts"
        )
    return best if level.stride == 1 else _of_all_blocks(level, best)


@dataclass(frozen=True)
class _Level:
    """The problem of a sweep with all blocks, or with some of them.

    Attributes
    ----------
    problem : Problem
    smooth : (n, c) float
        See `fitting.holograms.object_field.smooth_functions`.
    """

    problem: Problem
    smooth: Array

    @property
    def stride(self) -> int:
        """Blocks from one to the next of those that are enough to find fringes."""
        functions = int(self.problem.functions.shape[1])
        most = self.problem.blocks // (_BLOCKS_OF_FUNCTION * functions)
        return min(max(most, 1), CONTINUATION_STRIDE)

    @classmethod
    def of(cls, blocks: BlockAmplitudes, basis: ShapeBasis) -> "_Level":
        return cls(_problem_of(blocks, basis), smooth_functions(blocks.x_m, blocks.y_m))

    def every(self, stride: int) -> "_Level":
        """Return the same for every `stride`-th block."""
        return _Level(self.problem.every(stride), np.ascontiguousarray(self.smooth[::stride]))


def _best_start(
    few: _Level, level: _Level, block_amplitudes: BlockAmplitudes, basis: ShapeBasis
) -> Displacements | None:
    """Return what some of the blocks show, from the best of several starts; None if nothing."""
    whole, first = few.problem, replace(level.problem, others=())
    signal = np.mean(np.abs(block_amplitudes.value) ** 2, axis=0)

    def mostly_explained(found: Displacements) -> bool:
        relative = relative_misfit(found.misfit, signal)
        return bool(np.mean(relative < _EXPLAINED) > _MOST_EXPLAINED)

    def refined(rough: Displacements, other: Displacements | None = None) -> Displacements:
        found = _refined(few, rough, other)
        return _with_steady_light(few, found) if mostly_explained(found) else found

    best: Displacements | None = None
    costs: list[float] = []
    for number, start in enumerate(starts_of(first, block_amplitudes, basis), 1):
        search = continued(first, block_amplitudes, basis, start)
        rough = None if search is None else _from_search(few, level, search)
        cost = np.inf if rough is None else _unlikelihood(whole, rough)
        # A guess that was the best of its set is the same start again.
        if rough is not None and cost not in costs:
            if best is None:
                best = refined(rough)
            elif agree(whole, best.amplitude_rad, rough.amplitude_rad):
                if in_other_fringes(whole, best.amplitude_rad, rough.amplitude_rad).size:
                    best = refined(best, rough)
                break
            elif cost < min(costs):
                best = min(best, refined(rough, best), key=lambda each: _unlikelihood(whole, each))
        costs.append(cost)
        mostly = best is not None and mostly_explained(best)
        if (best and mostly and _in_order(best)) or number >= (
            _MOST_STARTS if mostly else _FEW_STARTS
        ):
            break
    return best


def _in_order(found: Displacements) -> bool:
    """Whether no hologram is far from its noise, or of another brightness than it should be."""
    wrong = with_wrong_gain(found.gain, found.gain_nepers).size
    return bool(np.all(found.reached)) and not wrong


def _of_all_blocks(level: _Level, found: Displacements) -> Displacements:
    """Go on with all blocks from displacements that some of them show."""
    solved = np.flatnonzero(np.isfinite(found.misfit))
    whole = replace(level.problem, gain_nepers=found.gain_nepers)
    problem, weight = whole.some(solved), 1 / np.maximum(found.misfit[solved], 1)
    a, gain = found.amplitude_rad[solved], found.gain[solved]
    field = _field_of(problem, a, gain, weight)
    change = found.change or FieldChange(0.0, 0.0)
    at = with_field(problem, Solution(a, gain, field), weight, change)
    sweep = Sweep(problem, problem.exact(), level.smooth, change, common=False)
    at, step = settled(sweep, at, _MOST_TURNS)
    return _displacements_of(whole, solved, at, step, change)


def _field_of(problem: Problem, a: ComplexArray, gain: Array, weight: Array) -> Complex64Array:
    """Return the object field (n,) that amplitudes, gains and weights of all holograms give."""
    first = replace(problem, others=())
    return block_object_field(first, np.arange(len(gain)), a, gain, weight)


def _unlikelihood(whole: Problem, found: Displacements) -> float:
    change, own = found.change or FieldChange(0.0, 0.0), middle(whole, found.solution)
    at = found.amplitude_rad, found.gain, found.object_field
    return unlikelihood(own, *at, change, found.misfit)


def _problem_of(blocks: BlockAmplitudes, basis: ShapeBasis) -> Problem:
    problem = Problem.of(
        blocks.value, basis.functions, BesselTable(), blocks.others, blocks.recording_rank
    )
    slopes = spread_slopes(blocks.x_m, blocks.y_m, blocks.size_m, basis.functions)
    return replace(problem, slopes=slopes)


def _from_search(few: _Level, level: _Level, search: Continuation) -> Displacements:
    """Refine a little what a continuation has found: enough to compare it with others."""
    at = _every(search.solution, level.stride)
    if search.explained.mean() > _ENOUGH:
        return _finished(few, at, search.solved, _QUICK_TURNS)
    # With the converged object field, more holograms can be solved.
    better = _finished(few, at, search.best_explained, _QUICK_TURNS)
    a, gain, weight = better.amplitude_rad, better.gain, 1 / np.maximum(better.misfit, 1)
    field = _field_of(level.problem, a, gain, weight)
    search.continue_from(Solution(a, gain, field), better.misfit)
    at = _every(search.solution, level.stride)
    return _finished(few, at, search.solved, _QUICK_TURNS)


def _every(at: Solution, stride: int) -> Solution:
    return replace(at, object_field=at.object_field[::stride])


def _refined(
    few: _Level, rough: Displacements, other: Displacements | None = None
) -> Displacements:
    """Minimise from a solution; where another one differs, the better of both is taken."""
    solved = np.isfinite(rough.misfit)
    theirs = None if other is None else other.amplitude_rad
    return _finished(few, rough.solution, solved, _MOST_TURNS, rough.change, theirs)


def explained_amplitudes(
    block_amplitudes: BlockAmplitudes, basis: ShapeBasis, found: Displacements
) -> ComplexArray:
    """Return the block amplitudes (k, n) that displacements explain, for light in even blocks."""
    problem = _problem_of(block_amplitudes, basis)
    u, v = problem.bessel_vectors(found.amplitude_rad)
    lit = np.exp(found.gain)[:, None] * found.object_field
    explained: ComplexArray = lit * (u + 1j * v + mean_bend(problem, found.amplitude_rad))
    return explained


def refit_displacements(
    block_amplitudes: BlockAmplitudes,
    basis: ShapeBasis,
    before: Displacements,
    expected_rad: Sequence[ComplexArray],
    off: NDArray[np.bool_],
    common_mode_shift: Array,
) -> Displacements:
    """Fit a sweep again from expected amplitudes.

    Holograms that are not explained are tried in the light that all others show, in the expected
    shape and any size, and from their neighbours. The smooth factor of the object field stays
    where the common-mode error has put it, unless all holograms are solved again.

    Parameters
    ----------
    block_amplitudes : BlockAmplitudes
    basis : ShapeBasis
    before : Displacements
    expected_rad : sequence of (k, j) complex
        Expected amplitudes, up to a phase of each hologram. If all holograms are solved again, the
        last of those that explain a hologram equally well is used.
    off : (k,) bool
        Holograms that are solved from there, because they are not explained so far.
    common_mode_shift : (k, q) float
        Common-mode error of the displacements, as the modal fit found it (see
        `fitting.holograms.object_field.CommonModeError`).

    Raises
    ------
    FitError
        If no hologram can be explained.
    """
    level = _Level.of(block_amplitudes, basis)
    whole = replace(level.problem, gain_nepers=before.gain_nepers)
    object_field = before.object_field * field_factor(level.smooth, common_mode_shift)
    changes = (before.common_mode.response @ common_mode_shift[..., None])[..., 0]
    size = before.amplitude_rad.shape[1]
    a = before.amplitude_rad + changes[:, :size] + 1j * changes[:, size:]
    at = replace(before.solution, amplitude=a, object_field=object_field)
    solved = np.isfinite(before.misfit)
    bad = np.flatnonzero(off | ~solved)
    all_again = len(bad) == len(solved)
    if not all_again:
        alone = field_of_others(whole, at, bad, before.misfit, before.change)
        at, better = tried_again(whole, alone, bad, expected_rad)
        solved[better] = True
    else:
        at, solved = all_from_expected(whole, at, expected_rad, enough(block_amplitudes))
    if not solved.any():
        raise FitError(
            f"none of {len(solved)} holograms agrees with the other run; measure it again, or fit "
            "it alone"
        )
    level = replace(level, problem=whole)
    return _finished(level, at, solved, _MOST_TURNS, before.change, common=all_again)


def _finished(
    level: _Level,
    at: Solution,
    solved: NDArray[np.bool_],
    most_turns: int,
    change: FieldChange | None = None,
    other: ComplexArray | None = None,
    *,
    common: bool = True,
) -> Displacements:
    """Minimise over object field and amplitudes of the solved holograms in turns.

    Without `change`, the object field is first taken to be the same in all of them. `other` (k, j)
    are amplitudes of another solution: where they are in other fringes, both are tried.
    """
    whole, steps = level.problem, np.flatnonzero(solved)
    problem = whole.some(steps)
    at = _some(at, steps)
    sweep = Sweep(problem, problem.exact(), level.smooth, change, common)
    at, step = settled(sweep, at, most_turns)
    for _ in range(1 if most_turns == _QUICK_TURNS else _MOST_CHANGES):
        before, now = sweep.change, _change_of(problem, at, step)
        scatter_nepers = gain_scatter(sweep.problem, at.gain, step.linear.normal.matrix)
        sweep = sweep.with_gains(scatter_nepers, now)
        at, step = settled(sweep, at, most_turns)
        if before is not None and same_change(before, now):
            break
    if most_turns > _QUICK_TURNS:
        theirs = None if other is None else other[steps]
        at, step = in_right_fringes(sweep, at, step, _MOST_TURNS, theirs)
    whole = replace(whole, gain_nepers=sweep.problem.gain_nepers)
    return _displacements_of(whole, steps, at, step, now)


def _with_steady_light(few: _Level, found: Displacements) -> Displacements:
    """Try light as steady as that of most holograms first; return the likelier of both.

    In a wrong fringe near the first maximum of J₁, a hologram needs another brightness. Holograms
    of which some are in wrong fringes seem to scatter in brightness, and stay there with this
    scatter. The median deviation is the scatter of most, whatever a few need.
    """
    solved = np.flatnonzero(np.isfinite(found.misfit))
    scatter_of_most = float(median_abs_deviation(found.gain[solved], scale="normal"))
    usual_nepers = max(scatter_of_most, LEAST_GAIN_NEPERS)
    wrong = with_wrong_gain(found.gain[solved], usual_nepers)
    if not wrong.size and found.gain_nepers < _LIKE_MOST * usual_nepers:
        return found
    problem = replace(few.problem, gain_nepers=found.gain_nepers).some(solved)
    at = _some(found.solution, solved)
    change = found.change or FieldChange(0.0, 0.0)
    sweep = Sweep(problem, problem.exact(), few.smooth, change)
    steady = sweep.with_gains(usual_nepers, change)
    tried, step = in_right_fringes(steady, *settled(steady, at, _MOST_TURNS), _MOST_TURNS)
    scatter_nepers = gain_scatter(steady.problem, tried.gain, step.linear.normal.matrix)
    change = _change_of(steady.problem, tried, step)
    there = steady.with_gains(scatter_nepers, change)
    tried, step = in_right_fringes(there, *settled(there, tried, _MOST_TURNS), _MOST_TURNS)
    if whole_cost(sweep.problem, at) <= whole_cost(there.problem, tried):
        return found
    whole = replace(few.problem, gain_nepers=scatter_nepers)
    return _displacements_of(whole, solved, tried, step, change)


def _some(at: Solution, steps: IndexArray) -> Solution:
    """Return amplitudes, gains and object field of some of the holograms."""
    field = at.object_field if at.object_field.ndim == 1 else at.object_field[steps]
    variance = None if at.field_variance is None else at.field_variance[steps]
    return Solution(at.amplitude[steps], at.gain[steps], field, variance, at.positions)


def _change_of(problem: Problem, at: Solution, step: FieldStep) -> FieldChange:
    """Find how much the object field changes, from the explained holograms."""
    misfit = step.linear.normal.misfit / problem.seen
    signal = np.mean(np.square(problem.real) + np.square(problem.imaginary), axis=1)
    explained = np.ones(len(misfit), bool)
    explained[unexplained(relative_misfit(misfit, signal), problem.seen)] = False
    if not explained.any():
        explained[:] = True
    # Across fringes, light that is not in the middle of its block would look like other light.
    own = middle(problem, at)
    return found_change(own, at.amplitude, at.gain, at.object_field, explained)


def _displacements_of(
    whole: Problem, solved: IndexArray, at: Solution, step: FieldStep, change: FieldChange
) -> Displacements:
    """Collect the displacements of the solved holograms; the others have no information."""
    end, size, holograms = step.linear.normal, at.amplitude.shape[1], len(whole.real)
    of_these = end.misfit / whole.seen[solved]
    # Marginalise over the gains of the holograms.
    coupling, known = end.matrix[:, :-1, -1:], end.matrix[:, -1, -1] + whole.half_gain_precision
    marginal = end.matrix[:, :-1, :-1] - coupling @ coupling.swapaxes(1, 2) / known[:, None, None]
    amplitude: ComplexArray = np.zeros((holograms, size), complex)
    information = np.zeros((holograms, 2 * size, 2 * size))
    misfit, gain = np.full(holograms, np.inf), np.zeros(holograms)
    amplitude[solved], gain[solved], misfit[solved] = at.amplitude, at.gain, of_these
    # Noise of variance 1 has half of it in either part.
    information[solved] = 2 * marginal / np.maximum(of_these, 1)[:, None, None]
    weight = np.zeros(holograms)
    weight[solved] = 1 / np.maximum(of_these, 1)
    nearest = np.abs(np.arange(holograms)[:, None] - solved).argmin(axis=1)
    field = at.object_field[nearest]
    own = middle(whole, Solution(amplitude, gain, field, positions=at.positions))
    everywhere = field_estimate(own, amplitude, gain, field, change, weight)
    small = response_of_small(whole.functions, step.linear.smooth, at.object_field)
    return Displacements(
        amplitude_rad=amplitude,
        information=information,
        common_mode=replace(step.common_mode.among(holograms, solved), small=small),
        recording_rank=whole.recording_rank,
        misfit=misfit,
        gain=gain,
        gain_nepers=whole.gain_nepers,
        object_field=everywhere.mean,
        field_variance=everywhere.variance,
        change=change,
        reached=misfit < FAR,
        positions=at.positions,
    )
