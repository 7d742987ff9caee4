"""Something that no effect explains: any numbers of any blocks may be off, in no known way.

Of each block it is asked how much likelier its numbers are if something unknown moves them, alike
in a mode, a band, a time, in all of these or in one alone, or each by itself, or ever more with
time, by any of several sizes. What is unknown moves one block, or a few.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.estimation import posterior_covariance, residual_covariance
from diagnosis.inference.problem import InferenceProblem, group_noise_gain, noise_inflation_gain
from diagnosis.observable_groups import ObservableGroup

Array = NDArray[np.floating[Any]]

# Unknown things have any of these sizes, in standard deviations of the numbers that they move.
_SIZES = (2.0, 5.0, 15.0, 50.0, 150.0, 500.0)
_KINDS = ("each", "quantity", "mode", "band", "time", "drift")
_ONE_ALONE = "mode", "band", "time"
# Of so many modes, bands or times, of all quantities of a block, one may be moved alone.
_FEWEST_OTHERS = 3
# Fewer times tell no drift.
_LEAST_TIMES = 4
# Probability that something unknown moves one block, two, three.
_BLOCKS = (0.6, 0.25, 0.15)


@dataclass(frozen=True)
class _Left:
    """What a candidate leaves of d campaigns, and what takes part of it up.

    Attributes
    ----------
    residuals : (n, d) float
        In units of their noise.
    slopes : (n, q) float
        Of all that is free, in units of priors.
    deviation : (n,) float
        Of the noise, in units of the block's.
    """

    residuals: Array
    slopes: Array
    deviation: Array

    def of(self, piece: slice) -> tuple[Array, Array]:
        """Residuals (k, d) of a block, and their covariance (k, k)."""
        return self.residuals[piece], residual_covariance(self.slopes, piece)

    def beside(self, columns: Array) -> "_Left":
        """What is left once columns (n, c) are free as well, of priors of variance 1."""
        slopes = np.hstack([self.slopes, columns])
        # At an optimum, slopes pull as hard as priors do: only new columns are not at theirs.
        pull = np.zeros((slopes.shape[1], self.residuals.shape[1]))
        pull[self.slopes.shape[1] :] = columns.T @ self.residuals
        return _Left(
            self.residuals - slopes @ posterior_covariance(slopes) @ pull, slopes, self.deviation
        )


def group_discrepancies(
    problem: InferenceProblem, candidate: Candidate, residuals: Array | None = None
) -> dict[str, Array]:
    """Log Bayes factors of something unknown in each block beside a candidate, by the block's name.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
    residuals : (n, d) float, optional
        What the candidate leaves of d campaigns; of the one that it was fitted to if not given.

    Returns
    -------
    dict of (d,) float
    """
    left = _Left(
        candidate.estimate.residuals[:, None] if residuals is None else residuals,
        candidate.free_jacobian,
        candidate.deviation,
    )
    return {
        block.name: _factor(left, problem.slices[block.name], block) for block in problem.groups
    }


def log_bayes_any_group(factors: Mapping[str, Array]) -> Array:
    """Log Bayes factors (d,) of something unknown that moves any one block."""
    total: Array = logsumexp(np.stack(list(factors.values())), axis=0) - np.log(len(factors))
    return total


def log_bayes_any_unknown(problem: InferenceProblem, candidate: Candidate) -> float:
    """Log Bayes factor of something unknown that moves any one block, or a few together."""
    left = _Left(
        candidate.estimate.residuals[:, None], candidate.free_jacobian, candidate.deviation
    )
    count, gained = len(problem.groups), 0.0
    logs, still = [], list(problem.groups)
    for number, share in enumerate(_BLOCKS[:count], 1):
        tried = [_with_unknown(problem, left, block) for block in still]
        prior = np.log(share) - np.log(comb(count, number))
        logs.append(float(prior + gained + logsumexp([factor for factor, _ in tried])))
        best = int(np.argmax([factor for factor, _ in tried]))
        if tried[best][0] <= 0:
            break
        # What is moved has its columns from now on.
        gained += tried[best][0]
        left = tried[best][1]
        del still[best]
    return float(logsumexp(logs))


def _with_unknown(
    problem: InferenceProblem, left: _Left, block: ObservableGroup
) -> tuple[float, _Left]:
    """Log Bayes factor of something unknown in a block, and what is left beside it."""
    piece = problem.slices[block.name]
    found = [(float(gain[0]), moved) for gain, moved in _gains(left, piece, block)]
    _, moved = max(found, key=lambda way: way[0])
    columns = np.zeros((len(left.residuals), moved.shape[1]))
    columns[piece] = moved
    after = left.beside(columns)
    # Of the twin it is known that its noise may be larger: less so where less is left.
    usual = noise_inflation_gain(problem, left.residuals[:, 0]) - noise_inflation_gain(
        problem, after.residuals[:, 0]
    )
    gains = [gain for gain, _ in found]
    return float(logsumexp(gains) - np.log(len(gains))) - usual, after


def _factor(left: _Left, piece: slice, block: ObservableGroup) -> Array:
    own, _ = left.of(piece)
    gains = [gain for gain, _ in _gains(left, piece, block)]
    # Of the twin it is known that its noise may be larger.
    usual = np.array([group_noise_gain(chi2, len(own)) for chi2 in np.sum(own**2, axis=0).tolist()])
    factor: Array = logsumexp(gains, axis=0) - np.log(len(gains)) - usual
    return factor


def _gains(left: _Left, piece: slice, block: ObservableGroup) -> Iterator[tuple[Array, Array]]:
    """Yield what log evidence (d,) gains by each kind of something unknown, and each size.

    With each what it moves (k, c), in units of the noise.
    """
    own, told = left.of(piece)
    for kind in _KINDS:
        table = _table(block, kind)
        if table is None:
            continue
        table = table / left.deviation[piece][:, None]
        pull, known = table.T @ own, table.T @ told @ table
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
    """Gain (c, d) of what moves along each of c directions, of which so much is known (c,)."""
    grown = 1 + size**2 * np.maximum(known, 0)[:, None]
    gained: Array = 0.5 * (size**2 * along / grown - np.log(grown))
    return gained


def _table(block: ObservableGroup, kind: str) -> Array | None:
    """Columns (n, c) along which something unknown may move a block, whitened."""
    if kind == "each":
        return np.eye(len(block.values))
    moved = _drifting(block) if kind == "drift" else _alike(block, kind)
    if moved is None:
        return None
    deviation = np.sqrt(1 / np.diag(np.linalg.inv(block.covariance)))
    table: Array = block.whitening @ (deviation[:, None] * moved)
    return table


def _alike(block: ObservableGroup, kind: str) -> Array | None:
    """Columns (n, c) of ones, where a quantity has one mode, band or time."""
    labels = [f"{place.quantity} {getattr(place, kind)}" for place in block.coordinates]
    names = sorted(set(labels))
    if len(names) in (1, len(labels)) and kind != "quantity":
        return None
    return np.array([[label == name for name in names] for label in labels], dtype=float)


def _drifting(block: ObservableGroup) -> Array | None:
    """Columns (n, c) along which a quantity moves in step with time."""
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
