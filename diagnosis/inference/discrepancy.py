"""Discrepancies: something unknown that shifts numbers of any group of observables.

For each group, the evidence is computed that something unknown shifts its numbers: equally within
a mode, a band or a time, in all of these or in one alone; each number by itself; or as a drift.
Several sizes are tried. Something unknown shifts one group or a few.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import comb

import numpy as np
from scipy.special import logsumexp

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.estimation import posterior_covariance, residual_covariance
from diagnosis.inference.problem import InferenceProblem, group_noise_gain, noise_inflation_gain
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
    """Residuals of a candidate on d campaigns, and the Jacobian that absorbs part of them.

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
        """Return the residuals (k, d) of a group, and their covariance (k, k)."""
        return self.residuals[piece], residual_covariance(self.slopes, piece)

    def with_columns(self, columns: Array) -> "_Left":
        """Return the residuals after columns (n, c) with unit priors have been fitted too."""
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
    """Return log Bayes factors of something unknown in each group, given a candidate.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
    residuals : (n, d) float, optional
        Residuals on d campaigns; by default those of the fit.

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
    """Return log Bayes factors (d,) of something unknown that shifts any one group."""
    total: Array = logsumexp(np.stack(list(factors.values())), axis=0) - np.log(len(factors))
    return total


def log_bayes_any_unknown(problem: InferenceProblem, candidate: Candidate) -> float:
    """Return the log Bayes factor of something unknown that shifts one group or a few."""
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
        # A shifted group keeps its columns from here on.
        gained += tried[best][0]
        left = tried[best][1]
        del still[best]
    return float(logsumexp(logs))


def _with_unknown(
    problem: InferenceProblem, left: _Left, block: ObservableGroup
) -> tuple[float, _Left]:
    """Return the log Bayes factor of something unknown in a group, and what it leaves."""
    piece = problem.slices[block.name]
    found = [(float(gain[0]), moved) for gain, moved in _gains(left, piece, block)]
    _, moved = max(found, key=lambda way: way[0])
    columns = np.zeros((len(left.residuals), moved.shape[1]))
    columns[piece] = moved
    after = left.with_columns(columns)
    # Larger noise is part of the model already: it explains less where less is left.
    usual = noise_inflation_gain(problem, left.residuals[:, 0]) - noise_inflation_gain(
        problem, after.residuals[:, 0]
    )
    gains = [gain for gain, _ in found]
    return float(logsumexp(gains) - np.log(len(gains))) - usual, after


def _factor(left: _Left, piece: slice, block: ObservableGroup) -> Array:
    own, _ = left.of(piece)
    gains = [gain for gain, _ in _gains(left, piece, block)]
    # Larger noise is part of the model already.
    usual = np.array([group_noise_gain(chi2, len(own)) for chi2 in np.sum(own**2, axis=0).tolist()])
    factor: Array = logsumexp(gains, axis=0) - np.log(len(gains)) - usual
    return factor


def _gains(left: _Left, piece: slice, block: ObservableGroup) -> Iterator[tuple[Array, Array]]:
    """Yield the gain of log evidence (d,) and the columns (k, c) of each discrepancy."""
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
    """Return the gain (c, d) of a shift along c directions with information `known` (c,)."""
    grown = 1 + size**2 * np.maximum(known, 0)[:, None]
    gained: Array = 0.5 * (size**2 * along / grown - np.log(grown))
    return gained


def _table(block: ObservableGroup, kind: str) -> Array | None:
    """Return whitened columns (n, c) along which something unknown may shift a group."""
    if kind == "each":
        return np.eye(len(block.values))
    moved = _drifting(block) if kind == "drift" else _alike(block, kind)
    if moved is None:
        return None
    deviation = np.sqrt(1 / np.diag(np.linalg.inv(block.covariance)))
    table: Array = block.whitening @ (deviation[:, None] * moved)
    return table


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
