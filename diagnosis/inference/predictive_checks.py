"""Predictive checks: signs that the cause is not in the catalogue, each compared with chance.

Campaigns are drawn from the candidate that is named, with noise, nuisances and the form of its
effects, and evaluated as the measured one is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnosis.effect_notes import notes_of
from diagnosis.inference.candidates import Candidate
from diagnosis.inference.discrepancy import discrepancies_of, log_bayes_any_group
from diagnosis.inference.linear_model import KNOWN
from diagnosis.inference.problem import InferenceProblem
from holography.arrays import Array

_DRAWS = 1000
# Degrees of freedom of Student's distribution: errors of fits have longer tails than a Gaussian.
_FREEDOMS = 5
# A check is significant if chance makes as much in a smaller fraction of campaigns.
_SELDOM = 0.01


@dataclass(frozen=True)
class PredictiveCheck:
    """One predictive check.

    Attributes
    ----------
    id, description : str
    value : float
    chance : float
        Fraction of drawn campaigns, without anything unknown, in which the value is as large.
    """

    id: str
    description: str
    value: float
    chance: float

    @property
    def significant(self) -> bool:
        """Whether chance does not explain the value."""
        return self.chance < _SELDOM


def predictive_checks(
    problem: InferenceProblem, candidate: Candidate, condition: Sequence[str], seed: int = 0
) -> tuple[PredictiveCheck, ...]:
    """Make all predictive checks of a candidate.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
        What is named; the one without effects if nothing is.
    condition : sequence of str
        Not empty for the numbers of a condition that is left out whole (see `how_far`).
    seed : int
        Of the draws.
    """
    both = _with_drawn(candidate, np.random.default_rng(seed))
    found = [
        _sign("discrepancy", "numbers deviate together in a way that no effect explains",
              log_bayes_any_group(discrepancies_of(problem, candidate, both))),
        _sign("largest", "one number deviates more than any should", _largest(candidate, both)),
    ]  # fmt: skip
    left_out = np.array([bool(name) for name in condition])
    if left_out.any():
        found.append(
            _sign("transfer", "the sweep that was left out is not as predicted",
                  _squares(candidate, both, left_out))
        )  # fmt: skip
    if candidate.effects:
        kept = _kept(problem, candidate)
        if kept.any():
            found.append(_sign("kept", "an observable that the effect must leave alone has changed",
                               _squares(candidate, both, kept)))  # fmt: skip
    return tuple(found)


def _sign(name: str, words: str, values: Array) -> PredictiveCheck:
    """Compare the first value with the others, which are drawn."""
    chance = (1 + np.count_nonzero(values[1:] >= values[0])) / len(values)
    return PredictiveCheck(name, words, float(values[0]), float(chance))


def _with_drawn(candidate: Candidate, rng: np.random.Generator) -> Array:
    """Return what is left (n, 1 + d) of the measured campaign, and of campaigns drawn for it.

    Each is drawn with scales of noise and nuisances of its own, as they may be before anything is
    measured. In units of the noise, before nuisances are fitted.
    """
    model, form = candidate.model, candidate.weighed.form
    louder = np.abs(
        model.noise_freedom[:, None] * rng.standard_normal((len(model.noise_freedom), _DRAWS))
    )
    wider = model.family_freedom[:, None] * rng.standard_normal((len(model.family_freedom), _DRAWS))
    scale = np.ones((len(model.family), _DRAWS))
    scaled = model.family != KNOWN
    scale[scaled] = np.exp(wider[model.family[scaled]])
    noise = np.sqrt(1 - 2 / _FREEDOMS) * rng.standard_t(_FREEDOMS, (len(model.left), _DRAWS))
    noise *= np.sqrt(np.exp(2 * louder[model.group]) + form[:, None])
    left = model.slopes @ (scale * rng.standard_normal(scale.shape)) + noise
    return np.column_stack([model.left, left])


def _largest(candidate: Candidate, left: Array) -> Array:
    """Return the largest deviation (d,) of a number from what all others predict."""
    P = candidate.weighed.precision
    largest: Array = np.abs((P @ left) / np.sqrt(np.diag(P))[:, None]).max(axis=0)
    return largest


def _squares(candidate: Candidate, left: Array, chosen: NDArray[np.bool_]) -> Array:
    """Return the squared deviation (d,) of chosen numbers from what the others predict."""
    P = candidate.weighed.precision
    own = (P @ left)[chosen]
    squares: Array = np.sum(own * np.linalg.solve(P[np.ix_(chosen, chosen)], own), axis=0)
    return squares


def _kept(problem: InferenceProblem, candidate: Candidate) -> NDArray[np.bool_]:
    """Return which numbers all effects of a candidate must leave alone."""
    taps = frozenset.intersection(
        *(notes_of(located.effect).unaffected for located in candidate.effects)
    )
    kept = np.zeros(len(candidate.model.left), dtype=bool)
    for block in problem.groups:
        kept[problem.slices[block.name]] = block.tap in taps
    return kept
