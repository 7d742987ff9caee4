"""Minimise over object field and displacements of all solved holograms of a sweep.

On the way, the scatter of gains and the change of the object field are found, and holograms in
wrong fringes are moved into the right ones.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

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
    FEWEST_GAINS,
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
    renewal_of,
    same_change,
)
from fitting.holograms.continuation import CONTINUATION_STRIDE
from fitting.holograms.object_field import (
    CommonModeError,
    FieldStep,
    response_of_small,
    smooth_functions,
)
from fitting.holograms.problem import Problem
from fitting.holograms.right_fringes.retries import in_right_fringes, relative_misfit, unexplained
from fitting.holograms.right_fringes.trials import (
    in_other_fringes,
    same_fringe,
    with_fringes,
    with_wrong_gain,
)
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.within_blocks import spread_slopes
from holography.arrays import Array, Complex64Array, ComplexArray, IndexArray

# Most turns of the alternating minimisation, and of one whose result is refined later.
_MOST_TURNS, _QUICK_TURNS = 30, 2
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


@dataclass(frozen=True)
class Level:
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
    def of(cls, blocks: BlockAmplitudes, basis: ShapeBasis) -> "Level":
        """Return the problem with all blocks of a sweep."""
        return cls(problem_of(blocks, basis), smooth_functions(blocks.x_m, blocks.y_m))

    def every(self, stride: int) -> "Level":
        """Return the same for every `stride`-th block."""
        return Level(self.problem.every(stride), np.ascontiguousarray(self.smooth[::stride]))


def problem_of(blocks: BlockAmplitudes, basis: ShapeBasis) -> Problem:
    """Return the problem of all holograms of a sweep."""
    problem = Problem.of(
        blocks.value, basis.functions, BesselTable(), blocks.others, blocks.recording_rank
    )
    slopes = spread_slopes(blocks.x_m, blocks.y_m, blocks.size_m, blocks.spread, basis.functions)
    return replace(problem, slopes=slopes, independent_fraction=blocks.independent_fraction)


def with_all_blocks(level: Level, found: Displacements) -> Displacements:
    """Go on with all blocks from displacements that some of them show."""
    solved = np.flatnonzero(np.isfinite(found.misfit))
    whole = replace(level.problem, gain_nepers=found.gain_nepers)
    problem, weight = whole.some(solved), 1 / np.maximum(found.misfit[solved], 1)
    a, gain = found.amplitude_rad[solved], found.gain[solved]
    field = object_field_of(problem, a, gain, weight)
    change = found.change or FieldChange(0.0, 0.0)
    at = with_field(problem, Solution(a, gain, field), weight, change)
    sweep = Sweep(problem, problem.exact(), level.smooth, change, common=False)
    at, step = settled(sweep, at, _MOST_TURNS)
    return displacements_of(whole, solved, at, step, change)


def object_field_of(
    problem: Problem, a: ComplexArray, gain: Array, weight: Array
) -> Complex64Array:
    """Return the object field (n,) that amplitudes, gains and weights of all holograms give."""
    first = replace(problem, others=())
    return block_object_field(first, np.arange(len(gain)), a, gain, weight)


def finished(
    level: Level,
    at: Solution,
    solved: NDArray[np.bool_],
    change: FieldChange | None = None,
    other: ComplexArray | None = None,
    *,
    common: bool = True,
    quick: bool = False,
) -> Displacements:
    """Minimise over object field and amplitudes of the solved holograms in turns.

    Without `change`, the object field is first taken to be the same in all of them. `other` (k, j)
    are amplitudes of another solution: where they are in other fringes, both are tried. A quick
    result is enough to compare it with others.
    """
    most_turns = _QUICK_TURNS if quick else _MOST_TURNS
    whole, steps = level.problem, np.flatnonzero(solved)
    problem = whole.some(steps)
    at = _some(at, steps)
    sweep = Sweep(problem, problem.exact(), level.smooth, change, common)
    at, step = settled(sweep, at, most_turns)
    sweep, now, at, step = _with_scatter(sweep, at, step, most_turns)
    theirs = None if other is None else other[steps]
    for _ in range(0 if quick else _MOST_CHANGES):
        before = at.amplitude
        at, step = in_right_fringes(sweep, at, step, most_turns, theirs)
        if np.all(same_fringe(before, at.amplitude)):
            break
        # What was in wrong fringes had other gains, and bent the light.
        sweep, now, at, step = _with_scatter(sweep, at, step, most_turns)
    whole = replace(whole, gain_nepers=sweep.problem.gain_nepers)
    return displacements_of(whole, steps, at, step, now)


def _with_scatter(
    sweep: Sweep, at: Solution, step: FieldStep, most_turns: int
) -> tuple[Sweep, FieldChange, Solution, FieldStep]:
    """Find how much gains scatter and the object field changes, and minimise with it, in turns."""
    for _ in range(1 if most_turns == _QUICK_TURNS else _MOST_CHANGES):
        before, now = sweep.change, _change_of(sweep.problem, at, step)
        scatter_nepers = gain_scatter(sweep.problem, at.gain, step.linear.normal.matrix)
        sweep = sweep.with_gains(scatter_nepers, now)
        at, step = settled(sweep, at, most_turns)
        if before is not None and same_change(before, now):
            break
    return sweep, now, at, step


def with_steady_light(few: Level, found: Displacements) -> Displacements:
    """Try light as steady as that of most holograms first; return the likelier of both.

    In a wrong fringe near the first maximum of J₁, a hologram needs another brightness. Holograms
    of which some are in wrong fringes seem to scatter in brightness, and stay there with this
    scatter. The median deviation is the scatter of most, whatever a few need; holograms without
    fringes do not determine their brightness.
    """
    solved = np.flatnonzero(np.isfinite(found.misfit))
    problem = replace(few.problem, gain_nepers=found.gain_nepers).some(solved)
    at = _some(found.solution, solved)
    seen = at.gain[with_fringes(problem, at.amplitude)]
    if len(seen) < FEWEST_GAINS:
        return found
    scatter_of_most = float(median_abs_deviation(seen, scale="normal"))
    usual_nepers = max(scatter_of_most, LEAST_GAIN_NEPERS)
    steady_enough = found.gain_nepers < _LIKE_MOST * usual_nepers
    if steady_enough and not with_wrong_gain(seen, usual_nepers).size:
        return found
    change = found.change or FieldChange(0.0, 0.0)
    sweep = Sweep(problem, problem.exact(), few.smooth, change)
    steady = sweep.with_gains(usual_nepers, change)
    tried, step = in_right_fringes(steady, *settled(steady, at, _MOST_TURNS), _MOST_TURNS)
    if steady_enough and not in_other_fringes(problem, at.amplitude, tried.amplitude).size:
        # The odd gains are no sign of wrong fringes.
        return found
    scatter_nepers = gain_scatter(steady.problem, tried.gain, step.linear.normal.matrix)
    change = _change_of(steady.problem, tried, step)
    there = steady.with_gains(scatter_nepers, change)
    tried, step = in_right_fringes(there, *settled(there, tried, _MOST_TURNS), _MOST_TURNS)
    if whole_cost(sweep.problem, at) <= whole_cost(there.problem, tried):
        return found
    whole = replace(few.problem, gain_nepers=scatter_nepers)
    return displacements_of(whole, solved, tried, step, change)


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


def displacements_of(
    whole: Problem, solved: IndexArray, at: Solution, step: FieldStep, change: FieldChange
) -> Displacements:
    """Collect the displacements of the solved holograms; the others have no information."""
    end, size, holograms = step.linear.normal, at.amplitude.shape[1], len(whole.real)
    of_these = end.misfit / whole.seen[solved]
    # Noise of variance 1 has half of it in either part.
    scale = whole.independent_fraction / np.maximum(of_these, 1)
    # Marginalise over the gains of the holograms, whose prior is not scaled.
    coupling, known = end.matrix[:, :-1, -1:], end.matrix[:, -1, -1]
    known = known + whole.half_gain_precision / scale
    marginal = end.matrix[:, :-1, :-1] - coupling @ coupling.swapaxes(1, 2) / known[:, None, None]
    amplitude: ComplexArray = np.zeros((holograms, size), complex)
    information = np.zeros((holograms, 2 * size, 2 * size))
    misfit, gain = np.full(holograms, np.inf), np.zeros(holograms)
    amplitude[solved], gain[solved], misfit[solved] = at.amplitude, at.gain, of_these
    information[solved] = 2 * marginal * scale[:, None, None]
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
        common_mode=replace(
            step.common_mode.counting(whole.independent_fraction).among(holograms, solved),
            small=small,
            renewal=renewal_of(step.linear.smooth, change.walk, whole.independent_fraction),
        ),
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
