"""Move a group of neighbouring holograms into the right fringes together.

In light that a whole group has bent, each of its holograms alone is explained best in its wrong
fringe. Only their gains show it, or breaks between neighbours. From one hologram to the next few
modes change, and near a resonance each of them as a pole does: of all solutions of the holograms
around such a place, those that continue each other best are taken, whether or not others explain
single holograms better (decision 0070).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.alternating_minimisation import (
    FAR,
    Solution,
    Sweep,
    cost,
    middle,
    settled,
    with_field,
)
from fitting.holograms.continuation import CONTINUATION_STRIDE
from fitting.holograms.object_field import FieldStep
from fitting.holograms.problem import Problem
from fitting.holograms.right_fringes.failed_trials import FailedTrials
from fitting.holograms.right_fringes.single_holograms import LEAST_GAIN, tried_again
from fitting.holograms.right_fringes.trials import (
    SAME_FRINGE,
    SIZES,
    distinct,
    same_fringe,
    solved_from,
    with_fringes,
    with_wrong_gain,
)
from holography.arrays import Array, ComplexArray, IndexArray

# Alternating steps after which a group in other fringes must be explained better. Chosen: a bound
# of the time; a group that needs more of them stays where it is.
_GROUP_TURNS = 4
# Holograms on either side of an odd one that may be wrong, too. Chosen: in steps of 25 cents these
# are 150 cents, three half-widths of a resonance with a loss factor of 0.06, where a third is left
# of the response at its peak.
_NEAR = 6
# Largest distance of two odd holograms that may be the edges of one group. Chosen: the largest
# group so far had 15 holograms (decision 0035).
_ONE_GROUP = 16
# Not all blocks are used, but every third at most, and at least this number for each function.
# Chosen: as many as the continuation has on a sensor of 320 by 256 pixels.
_BLOCKS_OF_FUNCTION = 9
# Most solutions of a hologram that are kept, those with the least cost. Chosen: around F1 of a reed
# that moves by 16 rad, the right one was among the first five.
_KEPT = 8
# Fewest holograms of which one can continue others: each is compared with two.
_FEWEST = 3
# Solutions of a hologram that differ by less are one. Chosen: half of what tells fringes apart.
_SAME = SAME_FRINGE / 2


@dataclass(frozen=True)
class _Candidates:
    """Solutions of one hologram, in order of cost.

    Attributes
    ----------
    amplitude : (s, j) complex
    gain : (s,) float
        Log gains.
    """

    amplitude: ComplexArray
    gain: Array


def moved_together(
    sweep: Sweep, at: Solution, step: FieldStep, most_turns: int, failed: FailedTrials
) -> tuple[Solution, FieldStep] | None:
    """Move a group of holograms into other fringes; None if that explains nothing better.

    Parameters
    ----------
    sweep : Sweep
    at : Solution
    step : FieldStep
        Its equations.
    most_turns : int
        Largest number of alternating steps.
    failed : FailedTrials
        Groups that are not tried again: those that fail are added.
    """
    problem = sweep.problem
    weight = 1 / np.maximum(step.linear.normal.misfit / problem.seen, 1)
    costs = cost(problem, at)
    for group in _neighbourhoods(suspects(problem, at), len(at.gain)):
        here = int(group[0]), at.amplitude[group]
        if failed.has_group(*here):
            continue
        start = smoothest(problem, at, group)
        if start is not None:
            start = with_field(middle(problem, start), start, weight, sweep.change)
            there, theirs = _at_rest(sweep, start, costs, min(most_turns, _GROUP_TURNS))
            if _gain(problem, costs, there) > LEAST_GAIN:
                return there, theirs
        failed.add_group(*here)
    return None


def _at_rest(
    sweep: Sweep, start: Solution, costs: Array, most_turns: int
) -> tuple[Solution, FieldStep]:
    """Let light and vibration follow a group that has moved.

    Light that the group had bent changes at once. Holograms at the peak of a resonance may fall
    into other fringes by that: what costs more than before, (k,), is tried again in this light.
    """
    problem = sweep.problem
    there, step = settled(sweep, start, most_turns)
    if _gain(problem, costs, there) > LEAST_GAIN:
        return there, step
    worse = np.flatnonzero(cost(problem, there) - costs > LEAST_GAIN)
    there, better = tried_again(problem, there, worse)
    return settled(sweep, there, most_turns) if better.size else (there, step)


def _gain(problem: Problem, costs: Array, there: Solution) -> float:
    """Return how much less a solution costs than others (k,) together."""
    return float(np.sum(costs) - np.sum(cost(problem, there)))


def suspects(problem: Problem, at: Solution) -> IndexArray:
    """Return the holograms with odd gains, and those on both sides of a break."""
    first = breaks(problem, at.amplitude)
    odd = np.union1d(with_wrong_gain(at.gain, problem.gain_nepers), [*first, *(first + 1)])
    return odd.astype(np.intp)


def _neighbourhoods(odd: IndexArray, count: int) -> Iterator[IndexArray]:
    """Yield the holograms around odd ones, those near each other together."""
    for group in np.split(odd, np.flatnonzero(np.diff(odd) > _ONE_GROUP) + 1):
        if group.size:
            yield np.arange(max(group[0] - _NEAR, 0), min(group[-1] + _NEAR + 1, count))


def breaks(problem: Problem, a: ComplexArray) -> IndexArray:
    """Return the holograms with fringes whose next one continues them in another fringe.

    From one hologram to the next, few modes change: amplitudes (k, j) nearly are combinations of
    any two neighbours. In a break, those on either side are no continuation of the other side.
    """
    onwards, backwards = _beyond(a[:-2], a[1:-1], a[2:]), _beyond(a[2:], a[1:-1], a[:-2])
    broken = np.minimum(onwards[:-1], backwards[1:]) > SAME_FRINGE
    fringes = with_fringes(problem, a)
    return np.flatnonzero(broken & (fringes[1:-2] | fringes[2:-1])) + 1


def _beyond(former: ComplexArray, before: ComplexArray, a: ComplexArray) -> Array:
    """Return the part (...) of amplitudes (..., j) that is no combination of two others."""
    axes, _ = np.linalg.qr(np.stack([former, before], axis=-1))
    left = a - (axes @ (axes.conj().swapaxes(-1, -2) @ a[..., None]))[..., 0]
    part: Array = np.linalg.norm(left, axis=-1) / np.maximum(np.linalg.norm(a, axis=-1), 1e-6)
    return part


def _off_a_pole(before: Array, size: Array, after: Array) -> Array:
    """Return by which factor (nepers) a size cannot be that of a pole with its neighbours.

    The reciprocal of a response near its pole is a linear function of frequency, with complex
    values: the one in the middle is the mean of the others. So its magnitude is between half of the
    difference and half of the sum of theirs.
    """
    one, own, other = (1 / np.maximum(each, 1e-6) for each in (before, size, after))
    least, most = 0.5 * np.abs(one - other), 0.5 * (one + other)
    beyond: Array = np.maximum(np.log(own / most), np.log(np.maximum(least, 1e-12) / own))
    return np.maximum(beyond, 0.0)


def smoothest(problem: Problem, at: Solution, group: IndexArray) -> Solution | None:
    """Return solutions of a group that continue each other best; None if these are what they were.

    Parameters
    ----------
    problem : Problem
        Of the holograms of the solution, in order of frequency.
    at : Solution
    group : (g,) int
        Numbers of consecutive holograms.
    """
    most = problem.blocks // (_BLOCKS_OF_FUNCTION * problem.functions.shape[1])
    stride = min(max(most, 1), CONTINUATION_STRIDE)
    candidates = _candidates(problem.every(stride), at.every(stride), group)
    if len(candidates) < _FEWEST:
        return None
    found = replace(at, amplitude=at.amplitude.copy(), gain=at.gain.copy())
    chosen = _continuous(list(candidates.values()))
    for (number, own), best in zip(candidates.items(), chosen, strict=True):
        found.amplitude[number], found.gain[number] = own.amplitude[best], own.gain[best]
    moved = ~same_fringe(at.amplitude, found.amplitude)
    moved &= with_fringes(problem, at.amplitude, found.amplitude)
    return found if moved.any() else None


def _present(at: Solution, number: int) -> _Candidates:
    return _Candidates(at.amplitude[number][None], at.gain[number][None])


def _candidates(problem: Problem, at: Solution, group: IndexArray) -> dict[int, _Candidates]:
    """Find solutions of every hologram from those of its neighbours, upwards and then downwards.

    Two holograms on either side of the group keep the solutions that they have.
    """
    first, last = max(int(group[0]) - 2, 0), min(int(group[-1]) + 3, len(at.gain))
    found = {number: _present(at, number) for number in range(first, last)}
    for along, numbers in ((1, group), (-1, group[::-1])):
        for number in numbers:
            neighbour = found.get(int(number) - along)
            sources = [found[int(number)].amplitude]
            if neighbour is not None:
                sources += [size * neighbour.amplitude for size in SIZES]
            starts = np.concatenate(sources)
            starts = starts[distinct(starts, np.arange(float(len(starts))), _SAME)]
            found[int(number)] = _solutions(problem, at, int(number), starts)
    return found


def _solutions(problem: Problem, at: Solution, number: int, starts: ComplexArray) -> _Candidates:
    """Solve a hologram from starts (s, j); its own solution is one if nothing explains it."""
    steps = np.full(len(starts), number)
    a, gain, left = solved_from(problem.some(steps), at, steps, starts, _SAME, _KEPT)
    near = left <= FAR * problem.seen[number]
    if not near.any():
        return _present(at, number)
    a, gain, left = a[near], gain[near], left[near]
    own = distinct(a, left, _SAME)
    return _Candidates(a[own], gain[own])


def _continuous(candidates: list[_Candidates]) -> list[int]:
    """Return which candidate of each of at least two holograms continues its neighbours best.

    The path with the least sum of squares is found by dynamic programming over pairs of neighbours.
    """
    least = np.zeros([len(each.gain) for each in candidates[:2]])
    sources: list[NDArray[np.intp]] = []
    for three in zip(candidates, candidates[1:], candidates[2:], strict=False):
        former, before, a = (each.amplitude for each in three)
        shape = len(former), len(before), len(a), a.shape[1]
        one, own, other = (
            np.broadcast_to(former[:, None, None], shape),
            np.broadcast_to(before[None, :, None], shape),
            np.broadcast_to(a[None, None], shape),
        )
        sizes = [np.linalg.norm(each, axis=-1) for each in (one, own, other)]
        apart = _beyond(one, own, other) ** 2 + _beyond(other, own, one) ** 2
        whole = least[:, :, None] + apart + _off_a_pole(*sizes) ** 2
        sources.append(whole.argmin(axis=0))
        least = whole.min(axis=0)
    before_last, last = np.unravel_index(int(least.argmin()), least.shape)
    path = [int(last), int(before_last)]
    for source in reversed(sources):
        path.append(int(source[path[-1], path[-2]]))
    return path[::-1]
