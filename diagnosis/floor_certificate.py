"""Floor certificate: whether repeated numbers scatter as their errors say.

A group of observables has replicates where numbers differ in their time only: the same quantity of
the same mode, band, region and level in several sweeps or acquisitions. What is left of them after
a fit is noise and disorder. Each hypothesis has a factor on the noise of each group (decision
0052): a group that scatters more counts less, and this says which one and why.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg
from scipy.stats import chi2

from diagnosis.inference.candidates import Candidate
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import MEASURED, ObservableGroup
from holography.arrays import Array

# More scatter than chance makes in one of a hundred campaigns. Chosen, as in predictive checks.
_CHANCE = 0.01
# Standard deviations of the log of a factor on the noise beyond which a group is not trusted.
# Chosen: two, as for a 95 % interval.
_UNUSUAL = 2.0


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
    factor : float
        By which the noise was increased in the fit.
    """

    group: str
    count: int
    replicates: int
    scatter: float
    chance: float
    factor: float

    @property
    def trusted(self) -> bool:
        """Whether replicates scatter as errors say, and errors did not have to be increased."""
        return self.chance >= _CHANCE and math.log(self.factor) <= _UNUSUAL * MEASURED


def floor_certificate(problem: InferenceProblem, candidate: Candidate) -> tuple[Floor, ...]:
    """Return for each group how its replicates scatter around a fitted model.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
        What is named, or the model without effects.
    """
    factors = np.exp(candidate.weighed.scales.noise)
    floors = []
    for group, factor in zip(problem.groups, factors.tolist(), strict=True):
        piece = problem.slices[group.name]
        # An effect may deviate from its form: that is no scatter.
        left = np.linalg.solve(group.whitening, candidate.estimate.residuals[piece])
        contrasts = _contrasts(group)
        if not len(contrasts):
            floors.append(Floor(group.name, len(left), 0, np.nan, 1.0, factor))
            continue
        root = linalg.cholesky(contrasts @ group.covariance @ contrasts.T, lower=True)
        seen = linalg.solve_triangular(root, contrasts @ left, lower=True)
        squares, count = float(seen @ seen), len(seen)
        floors.append(
            Floor(
                group=group.name,
                count=len(left),
                replicates=count,
                scatter=float(np.sqrt(squares / count)),
                chance=float(chi2.sf(squares, count)),
                factor=factor,
            )
        )
    return tuple(floors)


def _contrasts(group: ObservableGroup) -> Array:
    """Return orthonormal rows (r, n): differences between numbers that differ in time only."""
    sets: dict[object, list[int]] = {}
    for number, place in enumerate(group.coordinates):
        if place.time:
            sets.setdefault(replace(place, time=""), []).append(number)
    rows = [np.zeros((0, len(group.values)))]
    for numbers in sets.values():
        if len(numbers) > 1:
            own = np.zeros((len(numbers) - 1, len(group.values)))
            own[:, numbers] = linalg.helmert(len(numbers))
            rows.append(own)
    return np.concatenate(rows)
