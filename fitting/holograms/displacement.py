"""Fit the complex displacement of the whole reed in every hologram to its block amplitudes.

The amplitudes of a block are ``A c_k F(u_k)`` (see `fitting.holograms.block_amplitudes`). The
object field A is unknown and the same in all holograms, c_k is the phase of a hologram, and
``u_k = Σ_j a_kj Φ_j`` is the complex phase amplitude, a sum of few functions Φ. Object field and
amplitudes are fitted by alternating minimisation from the start that
`fitting.holograms.continuation` finds. The phase of a hologram is part of its amplitudes, because
``F(u e^{iθ}) = F(u) e^{iθ}``.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FitError
from fitting.holograms.alternating_minimisation import Solution, middle
from fitting.holograms.amplitudes import FEWEST_GAINS
from fitting.holograms.block_amplitudes import BlockAmplitudes
from fitting.holograms.changing_field import FieldChange, unlikelihood
from fitting.holograms.continuation import Continuation, continued, enough, starts_of
from fitting.holograms.object_field import field_factor
from fitting.holograms.problem import GAIN_NEPERS, Problem
from fitting.holograms.right_fringes.retries import (
    all_from_expected,
    field_of_others,
    relative_misfit,
)
from fitting.holograms.right_fringes.single_holograms import tried_again
from fitting.holograms.right_fringes.trials import (
    agree,
    in_other_fringes,
    with_fringes,
    with_wrong_gain,
)
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import (
    Displacements,
    Level,
    finished,
    object_field_of,
    problem_of,
    with_all_blocks,
    with_steady_light,
)
from fitting.holograms.within_blocks import mean_bend
from holography.arrays import Array, ComplexArray

# Most starts of the continuation while the best explains less than most of the sweep, and while it
# leaves single holograms unexplained: all displacements may then be too small by a factor.
_FEW_STARTS, _MOST_STARTS = 3, 10
_MOST_EXPLAINED, _EXPLAINED = 0.8, 2.0
# Holograms with odd gains that may stay in a sweep. Chosen: as many as outliers of the modal fit.
_FEW_WRONG = 2
# Smaller vibrations that are tried, as a fraction. Chosen: a step of the search. What gains cost at
# most, in nats: half of a χ² of seven, 3.5 ± 1.9, and three standard deviations more.
_LESS, _MOST_NATS = 0.5, 9.0
# If a smaller fraction of the holograms is explained, the continuation is repeated with the
# converged object field.
_ENOUGH = 0.95


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
    level = Level.of(block_amplitudes, basis)
    few = level.every(level.stride)
    best = _best_start(few, level, block_amplitudes, basis)
    if best is None:
        raise FitError(
            f"hardly any of {len(block_amplitudes.drive_hz)} holograms can be explained as "
            "vibrations of this reed: none shows any light, or there are too many fringes; begin "
            "with less volts"
        )
    best = _with_less_vibration(few, best)
    return best if level.stride == 1 else with_all_blocks(level, best)


def _best_start(
    few: Level, level: Level, block_amplitudes: BlockAmplitudes, basis: ShapeBasis
) -> Displacements | None:
    """Return what some of the blocks show, from the best of several starts; None if nothing."""
    whole, first = few.problem, replace(level.problem, others=())
    signal = np.mean(np.abs(block_amplitudes.value) ** 2, axis=0)

    def mostly_explained(found: Displacements) -> bool:
        relative = relative_misfit(found.misfit, signal)
        return bool(np.mean(relative < _EXPLAINED) > _MOST_EXPLAINED)

    def refined(rough: Displacements, other: Displacements | None = None) -> Displacements:
        found = _refined(few, rough, other)
        return with_steady_light(few, found) if mostly_explained(found) else found

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
        if (best and mostly and _in_order(whole, best)) or number >= (
            _MOST_STARTS if mostly else _FEW_STARTS
        ):
            break
    return best


def _with_less_vibration(few: Level, found: Displacements) -> Displacements:
    """Try smaller vibrations in brighter light if gains are improbable and few show fringes.

    Below the first maximum of J₁ both explain nearly the same, and alternating minimisation hardly
    moves from one to the other. Too much vibration makes the holograms at resonances too dark, and
    gains make up for it (decision 0109).
    """
    whole = few.problem
    while (
        0.5 * np.sum((found.gain / found.gain_nepers) ** 2) > _MOST_NATS
        and np.count_nonzero(with_fringes(whole, found.amplitude_rad)) < FEWEST_GAINS
    ):
        # Both are minimised as often.
        same, smaller = _minimised_from(few, found, 1.0), _minimised_from(few, found, _LESS)
        if _unlikelihood(whole, smaller) >= _unlikelihood(whole, same):
            break
        found = smaller
    return found


def _minimised_from(few: Level, found: Displacements, factor: float) -> Displacements:
    """Minimise again from displacements times a factor, without gains."""
    a, gain = factor * found.amplitude_rad, np.zeros_like(found.gain)
    field = object_field_of(few.problem, a, gain, 1 / np.maximum(found.misfit, 1))
    return finished(few, Solution(a, gain, field), np.isfinite(found.misfit), found.change)


def _in_order(whole: Problem, found: Displacements) -> bool:
    """Whether no hologram is far from its noise, and few have another brightness than they should.

    At the peak of a resonance, displacements differ within blocks, and their holograms seem darker.
    The brightness of ordinary benches scatters by a tenth of its limit (`gain_scatter` of
    `physics.parameters.disorder`). Where fringes show that it scatters up to this limit, wrong
    fringes may explain the whole sweep.
    """
    wrong = with_wrong_gain(found.gain, found.gain_nepers).size
    shown = np.count_nonzero(with_fringes(whole, found.amplitude_rad)) >= FEWEST_GAINS
    steady = found.gain_nepers < GAIN_NEPERS or not shown
    return bool(np.all(found.reached)) and wrong <= _FEW_WRONG and steady


def _unlikelihood(whole: Problem, found: Displacements) -> float:
    change, own = found.change or FieldChange(0.0, 0.0), middle(whole, found.solution)
    at = found.amplitude_rad, found.gain, found.object_field
    return unlikelihood(own, *at, change, found.misfit)


def _from_search(few: Level, level: Level, search: Continuation) -> Displacements:
    """Refine a little what a continuation has found: enough to compare it with others."""
    at = search.solution.every(level.stride)
    if search.explained.mean() > _ENOUGH:
        return finished(few, at, search.solved, quick=True)
    # With the converged object field, more holograms can be solved.
    better = finished(few, at, search.best_explained, quick=True)
    a, gain, weight = better.amplitude_rad, better.gain, 1 / np.maximum(better.misfit, 1)
    field = object_field_of(level.problem, a, gain, weight)
    search.continue_from(Solution(a, gain, field), better.misfit)
    at = search.solution.every(level.stride)
    return finished(few, at, search.solved, quick=True)


def _refined(few: Level, rough: Displacements, other: Displacements | None = None) -> Displacements:
    """Minimise from a solution; where another one differs, the better of both is taken.

    Holograms without a solution are tried from their neighbours, which are in the right fringes by
    then.
    """
    solved = np.isfinite(rough.misfit)
    theirs = None if other is None else other.amplitude_rad
    found = finished(few, rough.solution, solved, rough.change, theirs)
    whole = replace(few.problem, gain_nepers=found.gain_nepers)
    at, better = tried_again(whole, found.solution, np.flatnonzero(~solved))
    if not better.size:
        return found
    solved[better] = True
    return finished(few, at, solved, found.change)


def explained_amplitudes(
    block_amplitudes: BlockAmplitudes, basis: ShapeBasis, found: Displacements
) -> ComplexArray:
    """Return the block amplitudes (k, n) that displacements explain, for light in even blocks."""
    problem = problem_of(block_amplitudes, basis)
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
    level = Level.of(block_amplitudes, basis)
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
    return finished(level, at, solved, before.change, common=all_again)
