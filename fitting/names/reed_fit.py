"""Least-squares fit of a plausible reed to modes of a sweep, which are assigned to its own.

Parameters are normal with unit variance, but for shifts and couplings of modes: these are
Student's, of a scale that is estimated. It gives the odds that a mode is none of the reed's.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import optimize, stats

from fitting.modal.model import DRIVE_DOF
from fitting.names.likelihood import (
    NameData,
    own_shifts,
    similarities_of,
    strength_ratios,
    whitened,
)
from fitting.names.prediction import Prediction, predict
from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.plausible.reeds import PlausibleReeds

SPURIOUS = 0.01
"""Prior probability that a measured mode is none of the reed's. Chosen: a fit whose stated errors
were true would have fewer, and one whose modes are often wrong would be of no use."""
SHIFT_CENTS = (3.0, 60.0)
"""Scale of the shifts of modes in cents: what the reduced reed is off at least (decision 0024), and
the scatter of reeds around a model without disorder (`fitting.fringes.start_frequencies`)."""
DOF = DRIVE_DOF
"""Degrees of freedom of shifts: as of the drive, normal but for a few."""
SETTLED = 0.05
"""Least change of a step, in standard deviations of the prior."""
_CENT = float(np.log(2) / 1200)
# A shape is that of a mode of the reed from this MAC on.
_LEAST_MAC = 0.5
# Most turns in which the scale of the shifts is found.
_TURNS = 30
# A step takes no parameter farther than this. Chosen: while modes are assigned wrongly, the best
# reed may be an impossible one; after the first step a reed is known to a part of this.
_REACH = 2.0
# Precision and number of evaluations of one fit, which the next linearisation follows.
_PRECISE, _MOST_FITTED = 1e-4, 40


@dataclass(frozen=True)
class Question:
    """What is asked: reeds, how they are seen, and the ends of the sweep in ln f.

    Attributes
    ----------
    reeds : PlausibleReeds
    visible : (j, s) float
        Coordinates in the `ShapeBasis` of what is seen of each coordinate of the reed.
    ends : (float, float)
        Logarithms of the first and last drive frequency (Hz).
    """

    reeds: PlausibleReeds
    visible: Array
    ends: tuple[float, float]

    @property
    def range_ln_hz(self) -> float:
        """Range of the sweep: what is no mode may be anywhere in it."""
        return self.ends[1] - self.ends[0]


@dataclass(frozen=True)
class Shifts:
    """Prior variance (c,) of each shift in cents², and the scale of all shifts."""

    variance: Array
    cents: float

    @classmethod
    def first(cls, reeds: PlausibleReeds) -> "Shifts":
        """Return those of a reed that is hardly known."""
        count = reeds.shifts.stop - reeds.shifts.start
        return cls(np.full(count, SHIFT_CENTS[1] ** 2), SHIFT_CENTS[1])

    def prior(self, reeds: PlausibleReeds) -> Array:
        """Return the prior variance (p,) of all parameters."""
        variance = np.ones(len(reeds.names))
        variance[reeds.shifts] = self.variance
        return variance


@dataclass(frozen=True)
class Fit:
    """A reed that is fitted to data.

    Attributes
    ----------
    here : Prediction
    data : NameData
    shifts : Shifts
    covariance : (p, p) float
    odds : (a,) float
        Log odds that each measured mode is spurious; of one that was taken out, before that.
    moved : float
        Farthest move of a parameter in the last step, but for shifts.
    """

    here: Prediction
    data: NameData
    shifts: Shifts
    covariance: Array
    odds: Array
    moved: float


def refitted(question: Question, fit: Fit) -> Fit:
    """Fit the parameters, and the scale of the shifts."""
    reeds = question.reeds
    data = replace(fit.data, ratios=strength_ratios(reeds, fit.here, fit.data))
    shifts = _scaled(reeds, fit.here, data)
    prior = shifts.prior(reeds)
    best = _fitted(fit.here, data, prior)
    here = towards(question, fit.here.parameters, best)
    parameters = here.parameters
    number = fit.here.nearby.numbers_in(here.nearby, parameters)
    data = replace(data, mode=np.where(data.mode >= 0, number[data.mode], -1))
    moved = float(np.abs(parameters - fit.here.parameters)[: reeds.shifts.start].max())
    _, covariance = updated(here, *whitened(here, data), prior)
    # How far the best reed is from there is not known either.
    covariance += np.outer(best - parameters, best - parameters)
    odds = np.where(data.real, _spurious_odds(question, here, data, shifts.cents), fit.odds)
    return Fit(here, data, shifts, covariance, odds, moved)


def _fitted(here: Prediction, data: NameData, prior: Array) -> Array:
    """Return the most probable parameters (p,) among the reeds near one."""
    unit = np.sqrt(prior)

    @lru_cache(maxsize=2)
    def terms(x: bytes) -> tuple[Array, Array]:
        scaled = np.frombuffer(x)
        left, slope = whitened(here.at(scaled * unit), data)
        return (
            np.concatenate([scaled, left]),
            np.concatenate([np.eye(len(unit)), slope * unit]),
        )

    def residual(x: Array) -> Array:
        return terms(x.tobytes())[0]

    def jacobian(x: Array) -> Array:
        return terms(x.tobytes())[1]

    found = optimize.least_squares(
        residual,
        here.parameters / unit,
        jac=jacobian,
        method="lm",
        ftol=_PRECISE,
        xtol=_PRECISE,
        max_nfev=_MOST_FITTED,
    )
    return np.asarray(found.x * unit)


def towards(question: Question, before: Array, best: Array) -> Prediction:
    """Predict the modes of a possible reed on the way from parameters (p,) to better ones.

    Raises
    ------
    ImpossibleReedError
        If there is none.
    """
    reeds = question.reeds
    farthest = float(np.abs(best - before)[: reeds.shifts.start].max())
    reach = min(_REACH, farthest)
    while True:
        step = (best - before) * (reach / farthest if farthest else 1.0)
        try:
            return predict(reeds, question.visible, before + step)
        except ImpossibleReedError:
            if reach < SETTLED:
                raise
            reach /= 2


def updated(
    here: Prediction, residual: Array, jacobian: Array, prior: Array
) -> tuple[Array, Array]:
    """Return mean (p,) and covariance (p, p) of the parameters, linearised."""
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.diag(1 / prior))
    return covariance @ (jacobian.T @ (jacobian @ here.parameters - residual)), covariance


def _scaled(reeds: PlausibleReeds, here: Prediction, data: NameData) -> Shifts:
    """Estimate scale and variances of Student's shifts by expectation and maximisation."""
    shifts, terms = Shifts.first(reeds), whitened(here, data)
    own = own_shifts(reeds, here)[data.mode[data.counts]]
    for _ in range(_TURNS):
        mean, covariance = updated(here, *terms, shifts.prior(reeds))
        second = mean[reeds.shifts] ** 2 + np.diag(covariance)[reeds.shifts]
        variance, before = (DOF * shifts.cents**2 + second) / (DOF + 1), shifts.cents
        weighted = float(np.mean(second[own] / variance[own])) if len(own) else 1.0
        cents = float(np.clip(before * np.sqrt(weighted), *SHIFT_CENTS))
        shifts = Shifts(variance, cents)
        if abs(cents - before) < SETTLED * cents:
            break
    return shifts


def _spurious_odds(question: Question, here: Prediction, data: NameData, cents: float) -> Array:
    """Return the log odds (a,) that each mode is spurious: how improbable its shift is.

    A spurious mode may be anywhere in the sweep. A shape that no mode of the reed has is of none.
    The shift includes what the reed leaves of the frequency: past a mode of another symmetry, where
    modes change their order, a fit does not come.
    """
    reeds, found = question.reeds, data.mode >= 0
    mode = data.mode
    own = own_shifts(reeds, here)[mode[found]]
    left = data.measured.ln_hz[found] - here.ln_hz[mode[found]]
    shift = here.parameters[reeds.shifts][own]
    shift = shift + left / here.by_ln_hz[mode[found], reeds.shifts.start + own]
    density = stats.t.logpdf(shift, DOF, scale=cents) - np.log(_CENT)
    answer = np.full(len(mode), np.inf)
    answer[found] = np.log(SPURIOUS / question.range_ln_hz) - np.log1p(-SPURIOUS) - density
    answer[similarities_of(here, data) < _LEAST_MAC] = np.inf
    return answer
