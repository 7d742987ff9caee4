"""Solve single holograms again that neighbours in frequency explain better than their own solution.

A hologram that fell into a wrong fringe keeps a misfit above that of the noise, also after object
field and amplitudes have converged. By then its neighbours are solved, and the vibration between
them changes little: it is tried again from each of them and from their mean, in several sizes.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fitting.holograms.alternating_minimisation import Solution, cost
from fitting.holograms.problem import Problem
from fitting.holograms.right_fringes.failed_trials import FailedTrials
from fitting.holograms.right_fringes.trials import (
    SIZES,
    field_at,
    same_fringe,
    solved_from,
)
from holography.arrays import ComplexArray, IndexArray

# Least gain in log likelihood of another solution: odds of 150 to 1.
LEAST_GAIN = 5.0
# Sizes relative to what is expected by modes, whose frequency and loss may be off by half their
# width: five times less to more. Of a displacement of 20 rad, the steps are half a fringe. The
# best of those that are better than their neighbours are starts.
_SCANNED, _STARTS = np.geomspace(0.2, 5.0, 41), 3


def tried_again(
    problem: Problem,
    at: Solution,
    bad: IndexArray,
    others: Sequence[ComplexArray] = (),
    failed: FailedTrials | None = None,
) -> tuple[Solution, IndexArray]:
    """Solve the unexplained holograms from their neighbours; return which are explained better.

    What was in a wrong fringe may have led its neighbours there: they are tried, too.

    Parameters
    ----------
    problem : Problem
        Of the holograms of the solution, in order of frequency.
    at : Solution
    bad : (b,) int
        Numbers of the unexplained holograms.
    others : sequence of (k, j) complex
        Amplitudes of other solutions, from which they are tried as well, in any size.
    failed : FailedTrials, optional
        Trials that are not repeated: those that fail are added.
    """
    known = failed or FailedTrials()
    amplitude, gain, better = at.amplitude.copy(), at.gain.copy(), list[int]()
    so_far = cost(problem, at)
    good = np.ones(len(gain), bool)
    good[bad] = False
    queue, tried = deque(bad.tolist()), set[int]()
    while queue and good.any():
        number = queue.popleft()
        tried.add(number)
        near = good.copy()
        near[number] = False
        starts = np.concatenate(
            [
                _starts(amplitude, number, np.flatnonzero(near)),
                *(_likely_sizes(problem, at, number, other[number]) for other in others),
            ]
        )
        if known.has_hologram(number, starts):
            continue
        steps = np.full(len(starts), number)
        found, louder, left = solved_from(problem.some(steps), at, steps, starts)
        best = int(np.argmin(left))
        is_better = so_far[number] - left[best] > LEAST_GAIN
        misled = is_better and not same_fringe(amplitude[number], found[best])
        if not misled:
            known.add_hologram(number, starts)
        if is_better:
            amplitude[number], gain[number], good[number] = found[best], louder[best], True
            better.append(number)
            if misled:
                neighbours = {number - 1, number + 1} & set(range(len(gain)))
                queue.extend(sorted(neighbours - tried - set(queue)))
    return replace(at, amplitude=amplitude, gain=gain), np.array(better, np.intp)


def _likely_sizes(
    problem: Problem, at: Solution, number: int, expected: ComplexArray
) -> ComplexArray:
    """Return amplitudes (s, j) along an expected one (j,), and itself, of the likeliest sizes."""
    steps = np.full(len(_SCANNED), number)
    few, field, variance = problem.some(steps), *field_at(at, steps)
    a = few.turned(field, np.arange(len(steps)), _SCANNED[:, None] * expected)
    left = cost(few, Solution(a, np.zeros(len(steps)), field, variance))
    padded = np.pad(left, 1, constant_values=np.inf)
    dips = np.flatnonzero((left <= padded[:-2]) & (left <= padded[2:]))
    best = dips[np.argsort(left[dips])[:_STARTS]]
    return np.concatenate([expected[None], a[best]])


def _starts(amplitude: ComplexArray, number: int, good: IndexArray) -> ComplexArray:
    """Return trial amplitudes (s, j) of a hologram from the nearest explained ones."""
    below, above = good[good < number][-1:], good[good > number][:1]
    sources = [amplitude[k] for k in (*below, *above)]
    if len(sources) == 2:
        overlap = np.vdot(sources[1], sources[0])
        turn = overlap / max(float(np.abs(overlap)), 1e-12)
        sources.append(0.5 * (sources[0] + turn * sources[1]))
    sources.append(amplitude[number])
    return np.concatenate([size * np.array(sources) for size in SIZES])
