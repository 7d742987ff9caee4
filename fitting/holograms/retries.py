"""Solve holograms again that their neighbours in frequency explain better than their own solution.

A hologram that fell into a wrong fringe keeps a misfit above that of the noise, also after object
field and amplitudes have converged. By then its neighbours are solved, and the vibration between
them changes little: it is tried again from each of them and from their mean, in several sizes.

A group of neighbours in wrong fringes may have bent the object field between them until they leave
no more misfit than noise. Only modes show then that they are wrong, and only a field without them
shows what is right (decision 0035).
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

from fitting.holograms.alternating_minimisation import (
    FAR,
    Solution,
    Sweep,
    cost,
    middle,
    settled,
    weighed,
    with_field,
)
from fitting.holograms.amplitudes import FINAL_RAD, fit_amplitudes
from fitting.holograms.changing_field import FieldChange
from fitting.holograms.continuation import ITERATIONS, SAME_FRINGE_RATIO
from fitting.holograms.linearisation import rows
from fitting.holograms.object_field import FieldStep
from fitting.holograms.problem import MOST_GAIN, Problem
from holography.arrays import Array, Complex64Array, ComplexArray, IndexArray

# A hologram is tried again if its misfit exceeds the median by this many standard deviations of the
# scatter of all: in a sweep of 184 holograms, noise alone exceeds it once in 5 million sweeps.
_DEVIATIONS = 6.0
# Sizes relative to the start: between two holograms 25 cents apart, at a resonance of quality 50,
# the response may differ by two thirds.
_SIZES = (1.0, 1.3, 0.77, 1.7, 0.6)
# Sizes relative to what is expected by modes, whose frequency and loss may be off by half their
# width: five times less to more. Of a displacement of 20 rad, the steps are half a fringe. The
# best of those that are better than their neighbours are starts.
_SCANNED, _STARTS = np.geomspace(0.2, 5.0, 41), 3
# Displacements that differ by less than this part are in the same fringe: the factor that light and
# displacements share is a tenth (decision 0028), and the next fringe is π rad away, a third of the
# largest displacements with which a sweep is begun (10 rad).
SAME_FRINGE = 0.2
# ... by which two starts may differ: each may be off by that tenth, in opposite directions. Chosen:
# halfway from there to the next fringe.
_SAME_START = 0.26
# ... and trials that have led to the same solution: a part that is small next to the noise of most.
_SAME_SOLUTION = 0.01
# Part of the holograms with fringes in which two starts that agree may differ: chosen.
_MOST_DIFFER = 0.2
# Least gain in log likelihood of another solution: odds of 150 to 1.
_LEAST_GAIN = 5.0
# Levenberg-Marquardt steps of each trial.
_ITERATIONS = 12
# How often noise and the change within blocks are found for a trial.
_ROUNDS = 3
# Of the first maximum of J₁.
_FIRST_MAXIMUM_RAD = 1.84
# How often holograms in a wrong fringe are solved again.
_MOST_RETRIES = 8
# A gain that is farther off is tried again: chance makes one in 16,000 so.
_MOST_DEVIATIONS = 4.0
# Alternating steps after which a group in other fringes must be explained better. Chosen: a bound
# of the time; a group that needs more of them stays where it is.
_GROUP_TURNS = 4
# Largest factor of a displacement from one hologram to the next: that of `_SIZES`.
_STEEPEST = 1.7


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


def tried_again(
    problem: Problem, at: Solution, bad: IndexArray, others: Sequence[ComplexArray] = ()
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
    """
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
        steps = np.full(len(starts), number)
        found, louder, left = _solved(problem.some(steps), at, steps, starts)
        best = int(np.argmin(left))
        if so_far[number] - left[best] > _LEAST_GAIN:
            misled = not same_fringe(amplitude[number], found[best])
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
    few, field, variance = problem.some(steps), *_field_at(at, steps)
    a = few.turned(field, np.arange(len(steps)), _SCANNED[:, None] * expected)
    left = cost(few, Solution(a, np.zeros(len(steps)), field, variance))
    padded = np.pad(left, 1, constant_values=np.inf)
    dips = np.flatnonzero((left <= padded[:-2]) & (left <= padded[2:]))
    best = dips[np.argsort(left[dips])[:_STARTS]]
    return np.concatenate([expected[None], a[best]])


def _field_at(at: Solution, steps: IndexArray) -> tuple[Complex64Array, NDArray[np.float32] | None]:
    """Return the object field (s, n) of holograms, and its variance."""
    field = np.broadcast_to(rows(at.object_field, steps), (len(steps), at.object_field.shape[-1]))
    return field, None if at.field_variance is None else at.field_variance[steps]


def _solved(
    few: Problem, at: Solution, steps: IndexArray, starts: ComplexArray
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
    """
    a, gain = (
        few.turned(_field_at(at, steps)[0], np.arange(len(steps)), starts),
        np.zeros(len(steps), float),
    )
    weak = FINAL_RAD**-2 * np.eye(starts.shape[1])
    positions = None
    for turn in range(_ROUNDS):
        field, variance = _field_at(at, steps)
        there = Solution(a, gain, field, variance, positions)
        trial = weighed(middle(few, there), there)
        each = np.arange(len(steps))
        a, gain, left = fit_amplitudes(trial, field, each, (a, gain), _ITERATIONS, weak)
        gain = np.clip(gain, -MOST_GAIN, MOST_GAIN)
        # Far from a solution, the change within a block means nothing.
        positions = at.positions
        if not turn:
            own = _distinct(a, left)
            few, steps, a, gain = few.some(own), steps[own], a[own], gain[own]
    field, variance = _field_at(at, steps)
    return a, gain, cost(few, Solution(a, gain, field, variance, positions))


def _distinct(a: ComplexArray, left: Array) -> IndexArray:
    """Return which of the amplitudes (s, j) are different, of equal ones that with least `left`."""
    own = list[int]()
    for number in np.argsort(left):
        if not np.any(same_fringe(a[own], a[number], _SAME_SOLUTION)):
            own.append(int(number))
    return np.array(own, np.intp)


def _starts(amplitude: ComplexArray, number: int, good: IndexArray) -> ComplexArray:
    """Return trial amplitudes (s, j) of a hologram from the nearest explained ones."""
    below, above = good[good < number][-1:], good[good > number][:1]
    sources = [amplitude[k] for k in (*below, *above)]
    if len(sources) == 2:
        overlap = np.vdot(sources[1], sources[0])
        turn = overlap / max(float(np.abs(overlap)), 1e-12)
        sources.append(0.5 * (sources[0] + turn * sources[1]))
    sources.append(amplitude[number])
    return np.concatenate([size * np.array(sources) for size in _SIZES])


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
    sweep: Sweep, at: Solution, step: FieldStep, most_turns: int, other: ComplexArray | None = None
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
    hopeless, gain_nepers = np.zeros(0, np.intp), sweep.problem.gain_nepers
    for _ in range(_MOST_RETRIES):
        off = np.union1d(_misfitting(sweep, step), with_wrong_gain(at.gain, gain_nepers))
        if other is not None:
            off = np.union1d(off, in_other_fringes(sweep.problem, at.amplitude, other))
        off = np.setdiff1d(off, hopeless)
        before = at.amplitude
        at, better = tried_again(sweep.problem, at, off, () if other is None else (other,))
        if better.size:
            # What is better in the same fringe comes to rest with the light.
            elsewhere = better[~same_fringe(before[better], at.amplitude[better])]
            hopeless = np.union1d(hopeless, np.setdiff1d(off, elsewhere))
            at, step = settled(sweep, at, most_turns)
            continue
        together = _group_in_other_fringes(sweep, at, step, most_turns)
        if together is None:
            break
        at, step = together
    return at, step


def _misfitting(sweep: Sweep, step: FieldStep) -> IndexArray:
    seen = sweep.problem.seen
    return unexplained(step.linear.normal.misfit / seen, seen)


def with_wrong_gain(gain: Array, gain_nepers: float) -> IndexArray:
    """Return the holograms whose log gains (k,) are too large for their scatter, in nepers."""
    return np.flatnonzero(np.abs(gain) > _MOST_DEVIATIONS * gain_nepers)


def _group_in_other_fringes(
    sweep: Sweep, at: Solution, step: FieldStep, most_turns: int
) -> tuple[Solution, FieldStep] | None:
    """Move a group of holograms into other fringes together; None if none is explained better.

    In light that a whole group has bent, each of its holograms alone is explained best in its wrong
    fringe. Only their gains show it, or a break between them and their neighbours, and only with
    all of them in the right fringes is the light right, too.
    """
    problem = sweep.problem
    weight = 1 / np.maximum(step.linear.normal.misfit / problem.seen, 1)
    costs = float(np.sum(cost(problem, at)))
    for group, along in _suspects(problem, at):
        there = followed(problem, at, group, along)
        if there is not None:
            there = with_field(middle(problem, there), there, weight, sweep.change)
            there, theirs = settled(sweep, there, min(most_turns, _GROUP_TURNS))
            if costs - float(np.sum(cost(problem, there))) > _LEAST_GAIN:
                return there, theirs
    return None


def _suspects(problem: Problem, at: Solution) -> Iterator[tuple[IndexArray, int]]:
    """Yield groups of holograms that may be in wrong fringes, with where to follow them: ±1."""
    wrong = with_wrong_gain(at.gain, problem.gain_nepers)
    # Neighbours, but for one between them at most, belong together.
    for group in np.split(wrong, np.flatnonzero(np.diff(wrong) > 2) + 1):
        if group.size:
            yield from ((group, -1), (group, 1))
    # Which side of a break is right, and how far the other one goes, is not known.
    for first in breaks(problem, at.amplitude):
        yield from ((np.array([first + 1]), 1), (np.array([first]), -1))


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
    """Return the part (k,) of amplitudes (k, j) that is no combination of two others (k, j)."""
    axes, _ = np.linalg.qr(np.stack([former, before], axis=-1))
    left = a - (axes @ (axes.conj().swapaxes(-1, -2) @ a[..., None]))[..., 0]
    part: Array = np.linalg.norm(left, axis=-1) / np.maximum(np.linalg.norm(a, axis=-1), 1e-6)
    return part


def followed(problem: Problem, at: Solution, group: IndexArray, along: int) -> Solution | None:
    """Follow displacements from outside a group through it; None if they stay in their fringes.

    Near a resonance the reciprocal of a displacement is a linear function of frequency: two
    holograms predict the size of the next one, whose shape is a combination of theirs. The solution
    nearest to the prediction is taken, whether or not another one explains the hologram better. It
    ends behind the group, where it meets the solution that is there.

    Parameters
    ----------
    problem : Problem
        Of the holograms of the solution, in order of frequency.
    at : Solution
    group : (g,) int
        Numbers of the holograms, ascending.
    along : int
        1 to follow upwards in frequency, -1 downwards.
    """
    found = replace(at, amplitude=at.amplitude.copy(), gain=at.gain.copy())
    last, count = group[-1] if along > 0 else group[0], len(at.gain)
    number, moved = (group[0] if along > 0 else group[-1]), False
    while 0 <= number - 2 * along < count and 0 <= number < count:
        near = _nearest(problem, found, number, along)
        if near is None:
            break
        same = bool(same_fringe(at.amplitude[number], near[0]))
        if same and (number - last) * along > 0:
            break
        if not same:
            found.amplitude[number], found.gain[number] = near
            moved = True
        number += along
    return found if moved else None


def _nearest(
    problem: Problem, at: Solution, number: int, along: int
) -> tuple[ComplexArray, float] | None:
    """Return amplitudes (j,) and log gain of a hologram near what two before it predict."""
    before, former = (at.amplitude[number - back * along] for back in (1, 2))
    size, earlier = (max(float(np.linalg.norm(each)), 1e-6) for each in (before, former))
    expected = 1 / np.clip(2 / size - 1 / earlier, 1 / (_STEEPEST * size), _STEEPEST / size)
    sizes = np.concatenate([np.array(_SIZES) * expected / size, [1.0]])
    starts = np.concatenate([sizes[:, None] * before, at.amplitude[number][None]])
    steps = np.full(len(starts), number)
    found, louder, left = _solved(problem.some(steps), at, steps, starts)
    larger = np.log(np.maximum(np.linalg.norm(found, axis=1), 1e-6) / expected)
    older, newer = (np.broadcast_to(each, found.shape) for each in (former, before))
    apart = np.hypot(larger, _beyond(older, newer, found))
    apart[~(left <= FAR * problem.seen[number])] = np.inf
    best = int(np.argmin(apart))
    return (found[best], float(louder[best])) if np.isfinite(apart[best]) else None
