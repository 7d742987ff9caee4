"""Explained fraction: how much of a gap an effect closes, on numbers that the fit has not seen.

Numbers are left out in groups, such as all of a mode or all of a sweep, and predicted by the rest:
exactly, in the model that is linear around the fit, with all that numbers have in common. The gap
is the mean square of what is left there, in units of how well it could be predicted, over the 1
that a right model would leave.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.stats import chi2

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.linear_model import TOGETHER, weighed_at
from diagnosis.inference.problem import InferenceProblem
from holography.arrays import Array
from physics.sized_effect import SizedEffect

# Chosen: quantiles of 5 and 95 % come out within 2 % of the width.
_DRAWS = 2000
# A gap that chance makes more often than this is not resolvable. Chosen, as for a significant test.
_CHANCE = 0.01
# Standard deviation of sizes, in their scales: the largest strength is two of these.
_ANY_SIZE = 2.0


@dataclass(frozen=True)
class ExplainedFraction:
    """Fraction of a gap that an effect closes.

    Attributes
    ----------
    before, after, floor : float
        Mean square residual in units of errors of data and prediction: of the model without and
        with the effect, and of a right model.
    fraction, low, high : float
        (before − after) / (before − floor), and its 95 % interval; NaN if the gap is not
        resolvable.
    """

    before: float
    after: float
    floor: float
    fraction: float
    low: float
    high: float


def explained_fraction(
    problem: InferenceProblem,
    null: Candidate,
    candidate: Candidate,
    groups: Sequence[str],
    seed: int = 0,
) -> ExplainedFraction:
    """Return the fraction of the gap that a candidate closes, on groups that are left out.

    Parameters
    ----------
    problem : InferenceProblem
    null, candidate : Candidate
    groups : sequence of str
        Name of each number's group; numbers whose group is empty are never left out.
    seed : int
        Of the bootstrap over groups.
    """
    names = sorted({name for name in groups if name})
    if not names:
        return ExplainedFraction(*[np.nan] * 6)
    labels = np.array(groups)
    each = [_Predicted.of(problem, one) for one in (null, candidate)]
    rows = np.array(
        [
            (*(one.square(labels == name) for one in each), np.count_nonzero(labels == name))
            for name in names
        ]
    )
    rng = np.random.default_rng(seed)
    count = len(names)
    drawn = rng.multinomial(count, np.full(count, 1 / count), size=_DRAWS) if count > 1 else None
    sums = rows.sum(axis=0)
    before, after, floor = float(sums[0] / sums[2]), float(sums[1] / sums[2]), 1.0
    if chi2.sf(sums[0], sums[2]) > _CHANCE:
        return ExplainedFraction(before, after, floor, np.nan, np.nan, np.nan)
    kappa = (before - after) / (before - floor)
    if drawn is None:
        return ExplainedFraction(before, after, floor, kappa, np.nan, np.nan)
    b, a, f = (drawn @ rows).T
    open_gap = b > f
    low, high = (
        np.percentile((b[open_gap] - a[open_gap]) / (b[open_gap] - f[open_gap]), [2.5, 97.5])
        if np.count_nonzero(open_gap) > _DRAWS // 2
        else (np.nan, np.nan)
    )
    return ExplainedFraction(before, after, floor, kappa, float(low), float(high))


@dataclass(frozen=True)
class KnownGap:
    """How much of the gap the known effects of a bench explain in a campaign.

    Attributes
    ----------
    effects : tuple of SizedEffect
    foreseen : bool
        Whether the bench file had them before the campaign was measured, so that the campaign was
        not used to find them.
    explained : ExplainedFraction
        Without and with them, on numbers left out of the fit.
    in_units : tuple of GapInUnits
    """

    effects: tuple[SizedEffect, ...]
    foreseen: bool
    explained: ExplainedFraction
    in_units: tuple["GapInUnits", ...]


# Familiar quantities: name and factor from the unit of the group, by the quantity of coordinates.
_KNOWN: Final = {
    "frequency, cents": ("resonances, cents", 1.0),
    "loss, %": ("Q, %", 1.0),
    "force": ("response, dB", 20 / np.log(10)),
    "drive": ("drive, dB", 20 / np.log(10)),
    "amplitude over volts": ("level, dB", 20 / np.log(10)),
}


@dataclass(frozen=True)
class GapInUnits:
    """A gap in a familiar unit.

    Attributes
    ----------
    quantity : str
    before, after : float
        Root mean square residual of the fitted model without and with the effects.
    error : float
        Root mean square uncertainty.
    """

    quantity: str
    before: float
    after: float
    error: float


def gaps_in_units(
    problem: InferenceProblem, null: Candidate, candidate: Candidate
) -> list[GapInUnits]:
    """Return gaps in cents, per cent of Q, dB, and 1 - MAC, as far as they were measured."""
    squares: dict[str, list[tuple[float, float, float]]] = {}
    for block in problem.groups:
        piece, lower = problem.slices[block.name], np.linalg.inv(block.whitening)
        both = [lower @ each.whitened_residual[piece] for each in (null, candidate)]
        for place, before, after, variance in zip(
            block.coordinates, *both, np.diag(block.covariance), strict=True
        ):
            known = _KNOWN.get(place.quantity)
            if known:
                row = np.array([before**2, after**2, variance]) * known[1] ** 2
                squares.setdefault(known[0], []).append(tuple(row.tolist()))
            elif place.quantity.startswith("share of"):
                squares.setdefault("shapes, 1 - MAC", []).append((before**2, after**2, variance))
    found = []
    for name, rows in squares.items():
        # Fractions of other shapes add up to 1 - MAC; other gaps are means.
        of_shapes = name.startswith("shapes")
        mean = np.sum(rows, axis=0) if of_shapes else np.sqrt(np.mean(rows, axis=0))
        found.append(GapInUnits(name, *(float(value) for value in mean)))
    return found


@dataclass(frozen=True)
class _Predicted:
    """What all numbers say of each other around the fit of a candidate.

    Attributes
    ----------
    precision : (n, n) float
        Inverse covariance of the numbers, with noise and nuisances of usual size and effects of
        any size. The form of effects is no excuse here.
    pull : (n,) float
        This times what the model is off by.
    """

    precision: Array
    pull: Array

    @classmethod
    def of(cls, problem: InferenceProblem, candidate: Candidate) -> "_Predicted":
        """Compute it, in the units of the numbers."""
        model, sizes = candidate.model, candidate.slopes
        own = model.family != len(model.family_freedom) + TOGETHER
        bare = replace(
            model,
            slopes=model.slopes[:, own],
            family=model.family[own],
            form=np.zeros_like(model.form),
        )
        precision = weighed_at(bare, bare.usual).precision
        along = precision @ sizes
        known = sizes.T @ along + np.eye(sizes.shape[1]) / _ANY_SIZE**2
        precision = precision - along @ np.linalg.solve(known, along.T)
        units = linalg.block_diag(*(group.noise_whitening for group in problem.groups))
        return cls(units.T @ precision @ units, units.T @ precision @ model.left)

    def square(self, chosen: NDArray[np.bool_]) -> float:
        """Return the squared error of numbers (n,) predicted by all others, by its covariance."""
        at = np.flatnonzero(chosen)
        pull = self.pull[at]
        return float(pull @ np.linalg.solve(self.precision[np.ix_(at, at)], pull))
