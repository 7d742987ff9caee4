"""Floor certificate: whether repeated numbers scatter as their errors say.

A group of observables has replicates where numbers differ in their time only: the same quantity of
the same mode, band, region and level in several sweeps or acquisitions. What is left of them after
a fit is noise and disorder. Before any cause is tried, errors of a group whose replicates scatter
more are made as large as they scatter, unless they follow each other in time as drifts do, or a
single time is off: that is what some causes make (decision 0094). Each hypothesis has a factor on
the noise of each group, too (decision 0052). A group that scatters more counts less, and this says
which one and why.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from scipy import linalg
from scipy.stats import chi2

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.linear_model import GROSS, TOGETHER
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import MEASURED, ObservableGroup, with_noise
from holography.arrays import Array

# More scatter than chance makes in one of a hundred campaigns. Chosen, as in predictive checks.
_CHANCE = 0.01
# Standard deviations of the log of a factor on the noise beyond which a group is not trusted.
# Chosen: two, as for a 95 % interval.
_UNUSUAL = 2.0
# Replicates follow each other in time if no larger share of their permutations is as smooth.
# Chosen: larger errors hide what drifts do. Two of few permutations, an order and its reverse, may
# be more.
_MEMORY = 0.05
# Fewer times than the first number have too few permutations to tell. Of more than the second, the
# third number of permutations is drawn.
_LEAST_TIMES, _MOST_TIMES, _DRAWN, _SEED = 4, 6, 999, 1


@dataclass(frozen=True)
class Floor:
    """How far the errors of one group can be trusted.

    Attributes
    ----------
    group : str
    count : int
        Numbers of the group.
    replicates : int
        Differences between repeated numbers; 0 if nothing was repeated.
    scatter : float
        Root mean square of these, in units of what their errors predict; NaN without replicates.
    chance : float
        Probability of at least as much scatter by chance; 1 without replicates.
    times : int
        At which numbers were repeated.
    even_scatter, even_chance : float
        Least scatter, and largest chance, if the numbers of any one time are left out.
    order_chance : float
        Share of permutations in time in which they are as smooth; NaN if there are too few times.
    factor : float
        By which the noise was increased in the fit.
    inflated : float
        By which it was increased before any cause was tried.
    wrong : tuple of str
        Numbers that are taken to be wrong: what, of which mode, when.
    """

    group: str
    count: int
    replicates: int
    scatter: float
    chance: float
    times: int
    even_scatter: float
    even_chance: float
    order_chance: float
    factor: float
    inflated: float = 1.0
    wrong: tuple[str, ...] = ()

    @property
    def trusted(self) -> bool:
        """Whether replicates scatter as errors say, and errors did not have to be increased."""
        usual = math.log(self.factor) <= _UNUSUAL * MEASURED
        return self.chance >= _CHANCE and usual and self.inflated == 1

    @property
    def too_small(self) -> bool:
        """Whether errors are smaller than the scatter, which no drift and no one time makes."""
        return self.even_chance < _CHANCE and self.in_no_order

    @property
    def in_no_order(self) -> bool:
        """Whether replicates are as smooth in many permutations of their times."""
        few = 2 / math.factorial(min(self.times, _MOST_TIMES))
        return self.order_chance > max(_MEMORY, few) * (1 + 1e-9)


def certified(
    problem: InferenceProblem, null: Candidate
) -> tuple[InferenceProblem, dict[str, float]]:
    """Return the problem with errors as large as replicates scatter, before any cause is tried.

    Parameters
    ----------
    problem : InferenceProblem
    null : Candidate
        Its fit without effects.

    Returns
    -------
    InferenceProblem
        The same if no errors were too small.
    dict of float
        Factors on the noise of the groups of which errors were too small.
    """
    floors = floor_certificate(problem, null)
    factors = {floor.group: floor.even_scatter for floor in floors if floor.too_small}
    if not factors:
        return problem, {}
    groups = [
        with_noise(group, factors[group.name]) if group.name in factors else group
        for group in problem.groups
    ]
    return problem.with_groups(groups), factors


def floor_certificate(
    problem: InferenceProblem, candidate: Candidate, inflated: Mapping[str, float] | None = None
) -> tuple[Floor, ...]:
    """Return for each group how its replicates scatter around a fitted model.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
        What is named, or the model without effects.
    inflated : mapping of float, optional
        Factors of `certified`.
    """
    before, model = inflated or {}, candidate.model
    factors = np.exp(candidate.weighed.scales.noise)
    # An effect may deviate from its form: that is no scatter.
    formed = model.family == len(model.family_freedom) + TOGETHER
    together = problem.from_noise(model.slopes[:, formed] @ candidate.weighed.nuisances[formed])
    whole = candidate.estimate.residuals + together / candidate.deviation
    floors = []
    for group, factor in zip(problem.groups, factors.tolist(), strict=True):
        piece = problem.slices[group.name]
        left = np.linalg.solve(group.whitening, whole[piece])
        scatter, chance, count = _scatter(group, left)
        times = _times(group)
        without = [_scatter(group, left, time) for time in times]
        floors.append(
            Floor(
                group=group.name,
                count=len(left),
                replicates=count,
                scatter=scatter,
                chance=chance,
                times=len(times),
                even_scatter=min((each[0] for each in without), default=scatter),
                even_chance=max((each[1] for each in without), default=chance),
                order_chance=_order_chance(group, left / np.sqrt(np.diag(group.covariance))),
                factor=factor,
                inflated=before.get(group.name, 1.0),
                wrong=_wrong(group, piece, candidate),
            )
        )
    return tuple(floors)


def _wrong(group: ObservableGroup, piece: slice, candidate: Candidate) -> tuple[str, ...]:
    """Return the numbers of a group that are taken to be wrong, given a candidate."""
    model = candidate.model
    columns = model.slopes[piece, model.family == GROSS]
    raw = np.abs(np.linalg.solve(group.noise_whitening, columns[:, columns.any(axis=0)]))
    places = [group.coordinates[number] for number in np.argmax(raw, axis=0).tolist()]
    return tuple(
        " ".join(part for part in (place.quantity, place.mode, place.time) if part)
        for place in places
    )


def _scatter(group: ObservableGroup, left: Array, without: str = "") -> tuple[float, float, int]:
    """Return the scatter of replicates, its chance, and the number of differences.

    Parameters
    ----------
    group : ObservableGroup
    left : (n,) float
        What a fit leaves of its numbers.
    without : str
        Time that is left out, if any.
    """
    contrasts = _contrasts(group, without)
    if not len(contrasts):
        return np.nan, 1.0, 0
    root = linalg.cholesky(contrasts @ group.covariance @ contrasts.T, lower=True)
    seen = linalg.solve_triangular(root, contrasts @ left, lower=True)
    squares, count = float(seen @ seen), len(seen)
    return float(np.sqrt(squares / count)), float(chi2.sf(squares, count)), count


def _replicates(group: ObservableGroup, without: str = "") -> list[Array]:
    """Return means (t, n) at each time of numbers that differ in time only, of all times but one.

    Numbers of one time with the same coordinates are no replicates of each other.
    """
    sets: dict[object, dict[str, list[int]]] = {}
    for number, place in enumerate(group.coordinates):
        if place.time and place.time != without:
            own = sets.setdefault(replace(place, time=""), {})
            own.setdefault(place.time, []).append(number)
    found: list[Array] = []
    for each in sets.values():
        means = np.zeros((len(each), len(group.values)))
        for row, numbers in zip(means, each.values(), strict=True):
            row[numbers] = 1 / len(numbers)
        found.append(means)
    return found


def _order_chance(group: ObservableGroup, left: Array) -> float:
    """Return the share of permutations of times in which replicates are as smooth in time.

    All sets are permuted in the same way: what a sweep is off by, it is off by in all modes.

    Parameters
    ----------
    group : ObservableGroup
    left : (n,) float
        What a fit leaves of its numbers, in standard errors.
    """
    times = _times(group)
    if len(times) < _LEAST_TIMES:
        return np.nan
    sets = _replicates(group)
    table = np.full((len(times), len(sets)), np.nan)
    for column, means in enumerate(sets):
        at = [times.index(group.coordinates[int(np.argmax(row))].time) for row in means]
        table[at, column] = means @ left
    steps = np.array(
        [np.nansum(np.diff(table[order], axis=0) ** 2) for order in _orders(len(times))]
    )
    # Rounding must not part an order from its reverse.
    return float(np.mean(steps <= steps[0] * (1 + 1e-9)))


def _times(group: ObservableGroup) -> list[str]:
    return list(dict.fromkeys(place.time for place in group.coordinates if place.time))


def _orders(count: int) -> list[list[int]]:
    """Return permutations of times, the order in which they are first: all, or some of many."""
    if count <= _MOST_TIMES:
        return [list(order) for order in permutations(range(count))]
    rng = np.random.default_rng(_SEED)
    return [list(range(count)), *(rng.permutation(count).tolist() for _ in range(_DRAWN))]


def _contrasts(group: ObservableGroup, without: str) -> Array:
    """Return rows (r, n): orthonormal differences between numbers that differ in time only."""
    rows = [np.zeros((0, len(group.values)))]
    for means in _replicates(group, without):
        if len(means) > 1:
            rows.append(linalg.helmert(len(means)) @ means)
    return np.concatenate(rows)
