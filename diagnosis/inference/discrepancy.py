"""Discrepancies: something unknown that shifts numbers of any group of observables.

For each group, the evidence is computed that something unknown shifts its numbers: equally within
a mode, a band of frequencies, a region, a level or a time, in all of these or in one alone; each
number by itself; or smoothly with time or frequency. Several sizes are tried. Something unknown
shifts one group or a few.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from scipy.special import logsumexp

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.linear_model import LinearModel, Weighed, log_width, weighed_at
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import BANDS, Coordinates, ObservableGroup
from holography.arrays import Array

# Sizes of a discrepancy that are tried, in standard deviations of the numbers.
_SIZES = (2.0, 5.0, 15.0, 50.0, 150.0, 500.0)
_PLACES = "mode", "band", "region", "level", "time"
# ... and smooth ones: along time, and along frequency by bands.
_SMOOTH = "drift", "slope"
_KINDS = ("each", "quantity", *_PLACES, *_SMOOTH)
# A single one of these is tried alone if a group has at least this many.
_FEWEST_OTHERS = 3
# Fewer times do not determine a drift, nor fewer bands a slope.
_LEAST_PLACES = 4
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
    covariance : (k, k) float
        Of the numbers of one group, by noise and by its own nuisances.
    """

    left: Array
    precision: Array
    covariance: Array

    def along(self, columns: Array) -> tuple[Array, Array]:
        """Return pull (c, d) and information (c, c) along columns (n, c)."""
        across = self.precision @ columns
        return -across.T @ self.left, columns.T @ across


def group_discrepancies(problem: InferenceProblem, candidate: Candidate) -> dict[str, float]:
    """Return log Bayes factors of something unknown in each group, given a candidate."""
    left = candidate.model.left[:, None]
    return {
        block.name: float(_factor(problem, candidate, candidate.model, left, number)[0][0])
        for number, block in enumerate(problem.groups)
    }


def discrepancies_of(
    problem: InferenceProblem, candidate: Candidate, left: Array
) -> dict[str, Array]:
    """Return the same for several campaigns, with noise and nuisances of usual size.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
    left : (n, d) float
        What it leaves of d campaigns, in units of the noise, before nuisances are fitted.

    Returns
    -------
    dict of (d,) float
    """
    model = candidate.model
    usual = weighed_at(model, model.usual)
    found = {}
    for number, block in enumerate(problem.groups):
        state = _Left(left, usual.precision, problem.covariance(number, model.usual))
        gains = [gain for gain, _ in _gains(problem, state, number)]
        found[block.name] = np.asarray(logsumexp(gains, axis=0) - np.log(len(gains)))
    return found


def log_bayes_any_group(factors: Mapping[str, Array]) -> Array:
    """Return log Bayes factors (d,) of something unknown that shifts any one group."""
    total: Array = logsumexp(np.stack(list(factors.values())), axis=0) - np.log(len(factors))
    return total


def log_bayes_any_unknown(problem: InferenceProblem, candidate: Candidate) -> float:
    """Return the log Bayes factor of something unknown that shifts one group or a few."""
    model, left = candidate.model, candidate.model.left[:, None]
    count, gained = len(problem.groups), 0.0
    logs, still = [], list(range(count))
    for number, share in enumerate(_BLOCKS[:count], 1):
        tried = [_factor(problem, candidate, model, left, block) for block in still]
        factors = [float(factor[0]) for factor, _ in tried]
        prior = np.log(share) - np.log(comb(count, number))
        logs.append(float(prior + gained + logsumexp(factors)))
        best = int(np.argmax(factors))
        if factors[best] <= 0:
            break
        # A shifted group keeps its columns from here on.
        gained += factors[best]
        model = model.with_columns(tried[best][1])
        del still[best]
    return float(logsumexp(logs))


def _factor(
    problem: InferenceProblem, candidate: Candidate, model: LinearModel, left: Array, number: int
) -> tuple[Array, Array]:
    """Return log Bayes factors (d,) of something unknown in a group, and its columns (n, c).

    What is unknown may be the reason why errors of the group seem large: it is tried with the
    scales as they are without it, and with the usual ones.
    """
    fitted = candidate.weighed.scales
    usual = problem.usual_errors(number, fitted)
    before, after = weighed_at(model, fitted), weighed_at(model, usual)
    gains, columns = [], []
    for here in (before, after):
        scales = here.scales
        state = _Left(left, here.precision, problem.covariance(number, scales))
        found = list(_gains(problem, state, number))
        _, explains = max(found, key=lambda one: one[0][0])
        more = 0.0 if here is before else _change(model, before, after, explains)
        gains += [gain + more for gain, _ in found]
        columns += [table for _, table in found]
    best = int(np.argmax([gain[0] for gain in gains]))
    each = np.stack(gains).reshape(2, -1, left.shape[1]).max(axis=0)
    return np.asarray(logsumexp(each, axis=0) - np.log(len(each))), columns[best]


def _change(model: LinearModel, before: Weighed, after: Weighed, columns: Array) -> float:
    """Return what usual scales change in the log evidence of a model with something unknown.

    Parameters
    ----------
    model : LinearModel
        Without it.
    before, after : Weighed
        The same with the likeliest scales, and with usual ones.
    columns : (n, c) float
        Of something unknown: how uncertain scales are depends on what it explains.
    """
    explained = model.with_columns(columns)
    width = log_width(explained, weighed_at(explained, after.scales)) - log_width(model, before)
    return after.log_evidence - before.log_evidence + width


def _gains(problem: InferenceProblem, state: _Left, number: int) -> Iterator[tuple[Array, Array]]:
    """Yield the gain of log evidence (d,) and the columns (n, c) of each discrepancy."""
    block = problem.groups[number]
    piece = problem.slices[block.name]
    deviation = np.sqrt(1 / np.diag(np.linalg.inv(state.covariance)))
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
        if kind in _PLACES and len(pull) >= _FEWEST_OTHERS:
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
    return _smooth(block, kind) if kind in _SMOOTH else _alike(block, kind)


def _alike(block: ObservableGroup, kind: str) -> Array | None:
    """Return columns (n, c) of ones where a quantity has one mode, band, region, level or time."""
    labels = [f"{place.quantity} {getattr(place, kind)}" for place in block.coordinates]
    names = sorted(set(labels))
    if len(names) in (1, len(labels)) and kind != "quantity":
        return None
    return np.array([[label == name for name in names] for label in labels], dtype=float)


def _smooth(block: ObservableGroup, kind: str) -> Array | None:
    """Return columns (n, c) along which a quantity drifts with time, or grows with frequency."""
    columns = []
    for quantity in dict.fromkeys(place.quantity for place in block.coordinates):
        own = np.array([place.quantity == quantity for place in block.coordinates])
        here = [place for place in block.coordinates if place.quantity == quantity]
        order = _ranks([place.time for place in here]) if kind == "drift" else _bands(here)
        if len(set(order)) < _LEAST_PLACES:
            continue
        steps = np.array(order, dtype=float)
        columns.append(np.zeros(len(own)))
        columns[-1][own] = (steps - steps.mean()) / steps.std()
    return np.stack(columns, axis=1) if columns else None


def _ranks(times: Sequence[str]) -> list[int]:
    """Return the rank of each time, in the order in which they come."""
    order = list(dict.fromkeys(times))
    return [order.index(time) for time in times]


def _bands(places: Sequence[Coordinates]) -> list[int]:
    """Return the number of each place's band; all the same where one has none."""
    known = all(place.band in BANDS for place in places)
    return [BANDS.index(place.band) if known else 0 for place in places]
