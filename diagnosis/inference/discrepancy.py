"""Discrepancies: something unknown that shifts numbers of any group of observables.

For each group, the evidence is computed that something unknown shifts its numbers: equally within
a mode, a band or a time, in all of these or in one alone; each number by itself; or as a drift.
Several sizes are tried. Something unknown shifts one group or a few.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from scipy.special import logsumexp

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import ObservableGroup
from holography.arrays import Array

# Sizes of a discrepancy that are tried, in standard deviations of the numbers.
_SIZES = (2.0, 5.0, 15.0, 50.0, 150.0, 500.0)
_KINDS = ("each", "quantity", "mode", "band", "time", "drift")
_ONE_ALONE = "mode", "band", "time"
# A single mode, band or time is tried alone if a group has at least this many.
_FEWEST_OTHERS = 3
# Fewer times do not determine a drift.
_LEAST_TIMES = 4
# Probability that something unknown shifts one group, two, three.
_BLOCKS = (0.6, 0.25, 0.15)


@dataclass(frozen=True)
class _Left:
    """What a candidate leaves of d campaigns.

    Attributes
    ----------
    left : (n, d) float
        In units of the noise, before nuisances are fitted.
    precision : (n, n) float
        Inverse covariance of these.
    """

    left: Array
    precision: Array

    def along(self, columns: Array) -> tuple[Array, Array]:
        """Return pull (c, d) and information (c, c) along columns (n, c)."""
        across = self.precision @ columns
        return -across.T @ self.left, columns.T @ across

    def with_columns(self, columns: Array) -> "_Left":
        """Return the same with columns (n, c) of unknown amounts, of standard deviation 1."""
        across = self.precision @ columns
        known = np.eye(columns.shape[1]) + columns.T @ across
        return replace(self, precision=self.precision - across @ np.linalg.solve(known, across.T))


def group_discrepancies(
    problem: InferenceProblem, candidate: Candidate, left: Array | None = None
) -> dict[str, Array]:
    """Return log Bayes factors of something unknown in each group, given a candidate.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
    left : (n, d) float, optional
        What it leaves of d campaigns, in units of the noise; by default of the measured one.

    Returns
    -------
    dict of (d,) float
    """
    measured = candidate.model.left[:, None] if left is None else left
    state = _Left(measured, candidate.weighed.precision)
    found = {}
    for number, block in enumerate(problem.groups):
        gains = [gain for gain, _ in _gains(problem, candidate, state, number)]
        found[block.name] = np.asarray(logsumexp(gains, axis=0) - np.log(len(gains)))
    return found


def log_bayes_any_group(factors: Mapping[str, Array]) -> Array:
    """Return log Bayes factors (d,) of something unknown that shifts any one group."""
    total: Array = logsumexp(np.stack(list(factors.values())), axis=0) - np.log(len(factors))
    return total


def log_bayes_any_unknown(problem: InferenceProblem, candidate: Candidate) -> float:
    """Return the log Bayes factor of something unknown that shifts one group or a few."""
    state = _Left(candidate.model.left[:, None], candidate.weighed.precision)
    count, gained = len(problem.groups), 0.0
    logs, still = [], list(range(count))
    for number, share in enumerate(_BLOCKS[:count], 1):
        tried = [_with_unknown(problem, candidate, state, block) for block in still]
        prior = np.log(share) - np.log(comb(count, number))
        logs.append(float(prior + gained + logsumexp([factor for factor, _ in tried])))
        best = int(np.argmax([factor for factor, _ in tried]))
        if tried[best][0] <= 0:
            break
        # A shifted group keeps its columns from here on.
        gained += tried[best][0]
        state = tried[best][1]
        del still[best]
    return float(logsumexp(logs))


def _with_unknown(
    problem: InferenceProblem, candidate: Candidate, state: _Left, number: int
) -> tuple[float, _Left]:
    """Return the log Bayes factor of something unknown in a group, and what it leaves."""
    found = [
        (float(gain[0]), columns) for gain, columns in _gains(problem, candidate, state, number)
    ]
    _, columns = max(found, key=lambda way: way[0])
    factor = float(logsumexp([gain for gain, _ in found]) - np.log(len(found)))
    return factor, state.with_columns(columns)


def _gains(
    problem: InferenceProblem, candidate: Candidate, state: _Left, number: int
) -> Iterator[tuple[Array, Array]]:
    """Yield the gain of log evidence (d,) and the columns (n, c) of each discrepancy."""
    block = problem.groups[number]
    piece = problem.slices[block.name]
    covariance = problem.covariance(number, candidate.weighed.scales)
    deviation = np.sqrt(1 / np.diag(np.linalg.inv(covariance)))
    for kind in _KINDS:
        pattern = _pattern(block, kind)
        if pattern is None:
            continue
        table = np.zeros((len(state.left), pattern.shape[1]))
        table[piece] = block.noise_whitening @ (deviation[:, None] * pattern)
        pull, known = state.along(table)
        values, vectors = np.linalg.eigh(known)
        for size in _SIZES:
            together = _gained((vectors.T @ pull) ** 2, values, size)
            yield np.sum(together, axis=0), size * table
        if kind in _ONE_ALONE and len(pull) >= _FEWEST_OTHERS:
            for size in _SIZES:
                alone = _gained(pull**2, np.diag(known), size)
                gain: Array = logsumexp(alone, axis=0) - np.log(len(alone))
                yield gain, size * table[:, [int(np.argmax(alone[:, 0]))]]


def _gained(along: Array, known: Array, size: float) -> Array:
    """Return the gain (c, d) of a shift along c directions with information `known` (c,)."""
    grown = 1 + size**2 * np.maximum(known, 0)[:, None]
    gained: Array = 0.5 * (size**2 * along / grown - np.log(grown))
    return gained


def _pattern(block: ObservableGroup, kind: str) -> Array | None:
    """Return columns (k, c) along which something unknown may shift the numbers of a group."""
    if kind == "each":
        return np.eye(len(block.values))
    return _drifting(block) if kind == "drift" else _alike(block, kind)


def _alike(block: ObservableGroup, kind: str) -> Array | None:
    """Return columns (n, c) of ones where a quantity has one mode, band or time."""
    labels = [f"{place.quantity} {getattr(place, kind)}" for place in block.coordinates]
    names = sorted(set(labels))
    if len(names) in (1, len(labels)) and kind != "quantity":
        return None
    return np.array([[label == name for name in names] for label in labels], dtype=float)


def _drifting(block: ObservableGroup) -> Array | None:
    """Return columns (n, c) along which a quantity drifts with time."""
    columns = []
    for quantity in dict.fromkeys(place.quantity for place in block.coordinates):
        own = np.array([place.quantity == quantity for place in block.coordinates])
        times = [place.time for place in block.coordinates if place.quantity == quantity]
        order = list(dict.fromkeys(times))
        if len(order) < _LEAST_TIMES:
            continue
        steps = np.array([order.index(time) for time in times], dtype=float)
        columns.append(np.zeros(len(own)))
        columns[-1][own] = (steps - steps.mean()) / steps.std()
    return np.stack(columns, axis=1) if columns else None
