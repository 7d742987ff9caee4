"""Solve one hologram from several starts, and tell in which fringes solutions are."""

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.alternating_minimisation import Solution, cost, middle, weighed
from fitting.holograms.amplitudes import FINAL_RAD, fit_amplitudes
from fitting.holograms.linearisation import rows
from fitting.holograms.problem import MOST_GAIN, Problem
from holography.arrays import Array, Complex64Array, ComplexArray, IndexArray

# Sizes relative to the start: between two holograms 25 cents apart, at a resonance of quality 50,
# the response may differ by two thirds.
SIZES = (1.0, 1.3, 0.77, 1.7, 0.6)
# Displacements that differ by less than this part are in the same fringe: the factor that light and
# displacements share is a tenth (decision 0028), and the next fringe is π rad away, a third of the
# largest displacements with which a sweep is begun (10 rad).
SAME_FRINGE = 0.2
# ... by which two starts may differ: each may be off by that tenth, in opposite directions. Chosen:
# halfway from there to the next fringe.
_SAME_START = 0.26
# ... and trials that have led to the same solution: a part that is small next to the noise of most.
SAME_SOLUTION = 0.01
# Part of the holograms with fringes in which two starts that agree may differ: chosen.
_MOST_DIFFER = 0.2
# Levenberg-Marquardt steps of each trial.
_ITERATIONS = 12
# How often noise and the change within blocks are found for a trial.
_ROUNDS = 3
# Of the first maximum of J₁.
_FIRST_MAXIMUM_RAD = 1.84
# A gain that is farther off is tried again: chance makes one in 16,000 so.
_MOST_DEVIATIONS = 4.0


def same_fringe(
    one: ComplexArray, other: ComplexArray, most: float = SAME_FRINGE
) -> NDArray[np.bool_]:
    """Whether amplitudes (..., j) differ by a phase, and else at most by this part."""
    square, other_square = (np.sum(np.abs(each) ** 2, axis=-1) for each in (one, other))
    apart = square + other_square - 2 * np.abs(np.sum(one.conj() * other, axis=-1))
    return np.asarray(apart <= most**2 * square)


def in_other_fringes(problem: Problem, one: ComplexArray, other: ComplexArray) -> IndexArray:
    """Return the holograms with fringes of which amplitudes (k, j) of two starts differ.

    What light and displacements share differs from start to start. Below the first maximum of J₁,
    two solutions differ by the brightness of the object field alone.
    """
    same = same_fringe(one, other, _SAME_START)
    return np.flatnonzero(with_fringes(problem, one, other) & ~same)


def agree(problem: Problem, one: ComplexArray, other: ComplexArray) -> bool:
    """Whether two starts end in the same fringes at most holograms that have any.

    Where they differ, one of them has lost its way.
    """
    fringes = np.count_nonzero(with_fringes(problem, one, other))
    return bool(in_other_fringes(problem, one, other).size <= _MOST_DIFFER * fringes)


def with_fringes(problem: Problem, *solutions: ComplexArray) -> NDArray[np.bool_]:
    """Mask (k,) of the holograms with displacements beyond the first maximum of J₁."""
    largest = [np.hypot(*problem.displacement(a)).max(axis=1) for a in solutions]
    beyond: NDArray[np.bool_] = np.max(largest, axis=0) > _FIRST_MAXIMUM_RAD
    return beyond


def with_wrong_gain(gain: Array, gain_nepers: float) -> IndexArray:
    """Return the holograms whose log gains (k,) are too large for their scatter, in nepers."""
    return np.flatnonzero(np.abs(gain) > _MOST_DEVIATIONS * gain_nepers)


def field_at(at: Solution, steps: IndexArray) -> tuple[Complex64Array, NDArray[np.float32] | None]:
    """Return the object field (s, n) of holograms, and its variance."""
    field = np.broadcast_to(rows(at.object_field, steps), (len(steps), at.object_field.shape[-1]))
    return field, None if at.field_variance is None else at.field_variance[steps]


def solved_from(
    few: Problem,
    at: Solution,
    steps: IndexArray,
    starts: ComplexArray,
    same: float = SAME_SOLUTION,
    most: int | None = None,
) -> tuple[ComplexArray, Array, Array]:
    """Solve a hologram from starts (s, j); return amplitudes, log gains and costs.

    Of starts that lead to the same solution, one is followed to the end.

    Parameters
    ----------
    few : Problem
        With the hologram once for each start.
    at : Solution
    steps : (s,) int
        Number of the hologram in the solution, for each start.
    starts : (s, j) complex
    same : float
        Part by which solutions differ that are the same.
    most : int, optional
        Number of solutions that are followed to the end, the better ones.
    """
    a, gain = (
        few.turned(field_at(at, steps)[0], np.arange(len(steps)), starts),
        np.zeros(len(steps), float),
    )
    weak = FINAL_RAD**-2 * np.eye(starts.shape[1])
    positions = None
    for turn in range(_ROUNDS):
        field, variance = field_at(at, steps)
        there = Solution(a, gain, field, variance, positions)
        trial = weighed(middle(few, there), there)
        each = np.arange(len(steps))
        a, gain, left = fit_amplitudes(trial, field, each, (a, gain), _ITERATIONS, weak)
        gain = np.clip(gain, -MOST_GAIN, MOST_GAIN)
        # Far from a solution, the change within a block means nothing.
        positions = at.positions
        if not turn:
            own = distinct(a, left, same)[:most]
            few, steps, a, gain = few.some(own), steps[own], a[own], gain[own]
    field, variance = field_at(at, steps)
    return a, gain, cost(few, Solution(a, gain, field, variance, positions))


def distinct(a: ComplexArray, left: Array, most: float) -> IndexArray:
    """Return which of the amplitudes (s, j) are different, of equal ones that with least `left`.

    Equal ones differ at most by a part `most`; those with less `left` come first.
    """
    own = list[int]()
    for number in np.argsort(left):
        if not np.any(same_fringe(a[own], a[number], most)):
            own.append(int(number))
    return np.array(own, np.intp)
