"""Solve holograms in wrong fringes again, single ones and groups.

A group of neighbours in wrong fringes may have bent the object field between them until they leave
no more misfit than noise. Only modes show then that they are wrong, and only a field without them
shows what is right (decision 0035).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

from fitting.holograms.alternating_minimisation import (
    FAR,
    Solution,
    Sweep,
    middle,
    settled,
    weighed,
    with_field,
)
from fitting.holograms.amplitudes import FINAL_RAD, fit_amplitudes
from fitting.holograms.changing_field import FieldChange
from fitting.holograms.continuation import ITERATIONS, SAME_FRINGE_RATIO
from fitting.holograms.object_field import FieldStep
from fitting.holograms.problem import Problem
from fitting.holograms.right_fringes.failed_trials import FailedTrials
from fitting.holograms.right_fringes.groups import moved_together
from fitting.holograms.right_fringes.single_holograms import tried_again
from fitting.holograms.right_fringes.trials import (
    in_other_fringes,
    same_fringe,
    with_wrong_gain,
)
from holography.arrays import Array, ComplexArray, IndexArray

# A hologram is tried again if its misfit exceeds the median by this many standard deviations of the
# scatter of all: in a sweep of 184 holograms, noise alone exceeds it once in 5 million sweeps.
_DEVIATIONS = 6.0
# How often holograms in a wrong fringe are solved again.
_MOST_RETRIES = 8


def relative_misfit(misfit: Array, signal: Array) -> Array:
    """Return misfits (k,) in units of what a hologram of its brightness usually has.

    Speckle that changes from hologram to hologram leaves a residual in proportion to the signal.
    The fraction is the same for all holograms, and half of them have less.

    Parameters
    ----------
    misfit : (k,) float
        Mean square residual of the block amplitudes, in units of the noise.
    signal : (k,) float
        Mean square of the block amplitudes, in the same units.
    """
    known = np.isfinite(misfit)
    if not known.any():
        return misfit
    fraction = max(float(np.median((misfit[known] - 1) / np.maximum(signal[known], 1.0))), 0.0)
    relative: Array = misfit / (1 + fraction * signal)
    return relative


def unexplained(misfit: Array, seen: Array) -> IndexArray:
    """Return the numbers of the holograms with misfits that noise does not explain.

    Parameters
    ----------
    misfit : (k,) float
        See `relative_misfit`; infinite where a hologram has no solution.
    seen : (k,) float
        Number of block amplitudes of each.
    """
    known = np.isfinite(misfit)
    if not known.any():
        return np.arange(len(misfit))
    middle = float(np.median(misfit[known]))
    own = middle / np.sqrt(seen)
    scatter = float(median_abs_deviation(misfit[known], scale="normal"))
    return np.flatnonzero(~(misfit - middle < _DEVIATIONS * np.maximum(own, scatter)))


def field_of_others(
    problem: Problem, at: Solution, off: IndexArray, misfit: Array, change: FieldChange | None
) -> Solution:
    """Return a solution with the object field that all holograms but some give.

    Parameters
    ----------
    problem : Problem
    at : Solution
    off : (b,) int
        Numbers of the holograms that say nothing of the field.
    misfit : (k,) float
        Mean square residual of the block amplitudes, in units of the noise.
    change : FieldChange, optional
        How much the object field changes from hologram to hologram; it is one for all otherwise.
    """
    weight = 1 / np.maximum(misfit, 1)
    weight[off] = 0
    return with_field(middle(problem, at), at, weight, change) if weight.any() else at


def all_from_expected(
    whole: Problem, at: Solution, expected_rad: Sequence[ComplexArray], accepted: Array
) -> tuple[Solution, NDArray[np.bool_]]:
    """Solve all holograms from what is expected; return which have a solution, too.

    Of those that explain a hologram equally well the last is used.
    """
    amplitude, gain = at.amplitude.copy(), at.gain.copy()
    good = np.maximum(FAR, accepted)
    solved = np.zeros(len(good), bool)
    for expected in expected_rad:
        there = replace(at, amplitude=expected)
        tried, louder, found = _from_expected(whole, there, np.arange(len(good)))
        better = found < good
        amplitude[better], gain[better], solved[better] = tried[better], louder[better], True
        equally_good = np.minimum(good, SAME_FRINGE_RATIO * np.maximum(found, 1))
        good = np.where(better, equally_good, good)
    return replace(at, amplitude=amplitude, gain=gain), solved


def _from_expected(
    whole: Problem, expected: Solution, steps: IndexArray
) -> tuple[ComplexArray, Array, Array]:
    """Solve holograms (s,) from expected amplitudes; return amplitudes, log gains and misfits."""
    start = whole.turned(expected.object_field, steps, expected.amplitude[steps])
    a, gain, left = fit_amplitudes(
        weighed(whole, expected),
        expected.object_field,
        steps,
        (start, np.zeros(len(steps))),
        ITERATIONS,
        FINAL_RAD**-2 * np.eye(start.shape[1]),
    )
    return a, gain, left / whole.seen[steps]


def in_right_fringes(
    sweep: Sweep,
    at: Solution,
    step: FieldStep,
    most_turns: int,
    other: ComplexArray | None = None,
) -> tuple[Solution, FieldStep]:
    """Solve holograms in wrong fringes again until nothing is explained better.

    Parameters
    ----------
    sweep : Sweep
    at : Solution
    step : FieldStep
        Its equations.
    most_turns : int
        Largest number of alternating steps after each change.
    other : (k, j) complex, optional
        Amplitudes of another solution: where they are in other fringes, both are tried.
    """
    hopeless, places = np.zeros(0, np.intp), list[ComplexArray]()
    gain_nepers, failed = sweep.problem.gain_nepers, FailedTrials()
    for _ in range(_MOST_RETRIES):
        off = np.union1d(_misfitting(sweep, step), with_wrong_gain(at.gain, gain_nepers))
        if other is not None:
            off = np.union1d(off, in_other_fringes(sweep.problem, at.amplitude, other))
        off = np.setdiff1d(off, hopeless)
        before = at.amplitude
        others = () if other is None else (other,)
        at, better = tried_again(sweep.problem, at, off, others, failed)
        if better.size:
            # What is better in the same fringe follows the light. What moves to where it has been
            # before would move to and fro.
            elsewhere = better[~same_fringe(before[better], at.amplitude[better])]
            new = [~same_fringe(each[elsewhere], at.amplitude[elsewhere]) for each in places]
            moving = elsewhere[np.all(new, axis=0)] if places else elsewhere
            hopeless = np.union1d(hopeless, np.setdiff1d(np.union1d(off, elsewhere), moving))
            places += [before, at.amplitude]
            at, step = settled(sweep, at, most_turns)
            continue
        together = moved_together(sweep, at, step, most_turns, failed)
        if together is None:
            break
        at, step = together
        # What failed in light that the group had bent may not fail in this light.
        failed = FailedTrials()
    return at, step


def _misfitting(sweep: Sweep, step: FieldStep) -> IndexArray:
    seen = sweep.problem.seen
    return unexplained(step.linear.normal.misfit / seen, seen)
