"""Predictive checks: signs that the cause is not in the catalogue, each compared with chance.

Campaigns are drawn from the candidate that is named, with noise, nuisances and the form of its
effects, and evaluated as the measured one is. And groups of observables that refute an effect: it
would show in them alone, and does not (decision 0093).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnosis.effect_notes import notes_of
from diagnosis.inference.candidates import Candidate
from diagnosis.inference.discrepancy import discrepancies_of, log_bayes_any_group
from diagnosis.inference.linear_model import (
    BY_ITSELF,
    FORMS,
    KNOWN,
    MOST_FORM_DEVIATIONS,
    TOGETHER,
)
from diagnosis.inference.problem import InferenceProblem, with_effects
from diagnosis.inference.similarity import DETECTION_SIGMA
from holography.arrays import Array

_DRAWS = 1000
# Degrees of freedom of Student's distribution: errors of fits have longer tails than a Gaussian.
_FREEDOMS = 5
# A check is significant if chance makes as much in a smaller fraction of campaigns.
_SELDOM = 0.01
# A group of observables refutes an effect that it would detect if it sees less than this share of
# it, by this many standard errors. Chosen: an effect that is four times smaller in one observable
# than in the others is not the catalogue's.
_LEAST_SHARE, _SURELY = 0.25, 3.0


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


@dataclass(frozen=True)
class Refutation:
    """A group of observables in which an effect would show, and does not.

    Attributes
    ----------
    effect, group : str
    share : float
        Of what the effect would change there, the part that was measured.
    error : float
        Standard error of the share.
    """

    effect: str
    group: str
    share: float
    error: float


def refutations(problem: InferenceProblem, candidate: Candidate) -> tuple[Refutation, ...]:
    """Return which groups of observables refute which effects of a candidate.

    Each group is taken by itself, with errors of usual size: a fit with an effect that does not
    show makes them larger. Nuisances are as uncertain as they are before anything is measured.

    Parameters
    ----------
    problem : InferenceProblem
    candidate : Candidate
        Sizes of its effects are as fitted to all groups together.
    """
    model = candidate.model
    formed = len(model.family_freedom) + TOGETHER
    # Columns of effects and of their form come after those of the nuisances.
    first = np.arange(len(model.family)) < len(problem.nuisances)
    chosen = first | ((model.family != KNOWN) & (model.family != formed))
    left, moved_by = _moved_by_each(problem, candidate)
    found = []
    for number, (group, rows) in enumerate(problem.slices.items()):
        scales = problem.usual_errors(number, candidate.weighed.scales)
        own = model.slopes[rows][:, chosen]
        covariance = (own * model.prior_variance(scales)[chosen]) @ own.T + np.eye(len(own))
        for name, moved in moved_by.items():
            seen = np.linalg.solve(covariance, moved[rows])
            known_by = float(moved[rows] @ seen)
            if known_by < DETECTION_SIGMA**2:
                continue
            share, error = 1 - float(left[rows] @ seen) / known_by, known_by**-0.5
            if share + _SURELY * error < _LEAST_SHARE:
                found.append(Refutation(name, group, share, error))
    return tuple(found)


def _moved_by_each(
    problem: InferenceProblem, candidate: Candidate
) -> tuple[Array, dict[str, Array]]:
    """Return what a candidate leaves (n,) with all nuisances at 0, and what each effect changes.

    In units of the noise.
    """
    nuisances, sizes = candidate.nuisances, candidate.sizes
    bare = problem.parameters(nuisances)
    whole = problem.residuals(with_effects(bare, candidate.effects, sizes))
    counts = [len(located.sizes) for located in candidate.effects]
    own = np.split(sizes, np.cumsum(counts)[:-1])
    moved = {}
    for number, located in enumerate(candidate.effects):
        others = [each for k, each in enumerate(candidate.effects) if k != number]
        left = np.concatenate([np.zeros(0), *(s for k, s in enumerate(own) if k != number)])
        without = problem.residuals(with_effects(bare, others, left))
        moved[located.effect.id] = problem.to_noise(whole - without)
    slopes = candidate.estimate.jacobian[:, : len(nuisances)] * candidate.deviation[:, None]
    return problem.to_noise(whole - slopes @ nuisances), moved


def _sign(name: str, words: str, values: Array) -> PredictiveCheck:
    """Compare the first value with the others, which are drawn."""
    chance = (1 + np.count_nonzero(values[1:] >= values[0])) / len(values)
    return PredictiveCheck(name, words, float(values[0]), float(chance))


def _with_drawn(candidate: Candidate, rng: np.random.Generator) -> Array:
    """Return what is left (n, 1 + d) of the measured campaign, and of campaigns drawn for it.

    Each is drawn with scales of noise and nuisances of its own, as they may be before anything is
    measured. In units of the noise, before nuisances are fitted.
    """
    model = candidate.model
    louder = np.abs(
        model.noise_freedom[:, None] * rng.standard_normal((len(model.noise_freedom), _DRAWS))
    )
    wider = rng.standard_normal((len(model.family_freedom), _DRAWS))
    wider[FORMS] = np.clip(wider[FORMS], -MOST_FORM_DEVIATIONS, MOST_FORM_DEVIATIONS)
    wider *= model.family_freedom[:, None]
    scale = np.ones((len(model.family), _DRAWS))
    scaled = model.family >= 0
    scale[scaled] = np.exp(wider[model.family[scaled]])
    noise = np.sqrt(1 - 2 / _FREEDOMS) * rng.standard_t(_FREEDOMS, (len(model.left), _DRAWS))
    noise *= np.sqrt(
        np.exp(2 * louder[model.group]) + np.exp(2 * wider[BY_ITSELF]) * model.form[:, None]
    )
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
