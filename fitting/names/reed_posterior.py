"""Which plausible reed has the modes that a sweep shows: parameters, and which mode is which.

The parameters are those of `physics.plausible.reeds`, normal with unit variance. Frequencies and
shapes of a reed's modes follow them. Whatever a reed has that the model lacks shifts and couples
its modes by some cents; these shifts are Student's, and their scale is estimated, as is the scatter
of each shape. A measured mode is one of the reed's, or none of them: then the fit has mistaken
something else for a mode. Least-squares fits and the assignment of modes take turns.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats
from scipy.special import expit

from fitting.modal.model import UNKNOWN_DRIVE_DOF
from fitting.names.likelihood import (
    SIMILAR,
    NameData,
    are_close,
    log_likelihood,
    own_shifts,
    shape_residual,
    shape_scatter,
    shape_weights,
    similarities_of,
    strength_ratios,
    whitened,
)
from fitting.names.measured import MeasuredModes
from fitting.names.prediction import Prediction, predict
from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.plausible.reeds import NearbyReeds, PlausibleReeds

_CENT = float(np.log(2) / 1200)
# Prior probability that a measured mode is none of the reed's. Chosen: a fit whose stated errors
# were true would have fewer, and one whose modes are often wrong would be of no use.
_SPURIOUS = 0.01
# Scale of the shifts of modes in cents: what the reduced reed is off at least (decision 0024), and
# the scatter of reeds around a model without disorder (`fitting.fringes.start_frequencies`).
_SHIFT_CENTS = (3.0, 60.0)
# A shape is that of a mode of the reed from this MAC on.
_LEAST_MAC = 0.5
# Degrees of freedom of shifts: as of the drive, normal but for a few.
_DOF = UNKNOWN_DRIVE_DOF
# Scatter of shapes in the assignment of modes, first while the reed is hardly known. Chosen: the
# MAC of a shape with that of a reed of middling cane is then mostly above 0.9.
_ASSIGNING = (0.3, 0.1)
# Least number and change of steps and turns; changes are in standard deviations of the prior.
_MOST_STEPS, _TURNS, _SETTLED = 40, 30, 0.05
# A step takes no parameter farther than this. Chosen: while modes are assigned wrongly, the best
# reed may be an impossible one; after the first step a reed is known to a part of this.
_REACH = 2.0
# Precision and number of evaluations of one fit, which the next linearisation follows.
_PRECISE, _MOST_FITTED = 1e-4, 40
# Start of the search for a reed in which two modes have exchanged their characters, as a fraction
# of the exchange: just beyond the crossing.
_BEYOND = 0.6
_IMPROBABLE = 1e9


@dataclass(frozen=True)
class ReedPosterior:
    """The reed of a sweep, as far as its modes tell.

    Attributes
    ----------
    measured : MeasuredModes
        The a modes of the sweep.
    nearby : NearbyReeds
        Linearised at the mean.
    visible : (j, s) float
        Coordinates in the `ShapeBasis` of what is seen of each coordinate of the reed.
    seen : (j, m) float
        Those of the modes of `nearby`.
    mean, covariance : (p,) and (p, p) float
    log_evidence : float
        Up to a constant that all have in common.
    mode : (a,) int
        Number of the reed's mode, in order of frequency, that each measured mode is; -1 if none.
    outside : (a,) float
        Probability that the resonance of that mode is outside the sweep, by all other modes.
    spurious : (a,) float
        Probability that a measured mode is none of the reed's.
    shift_cents : float
        Scale of the shifts of modes.
    """

    measured: MeasuredModes
    nearby: NearbyReeds
    visible: Array
    seen: Array
    mean: Array
    covariance: Array
    log_evidence: float
    mode: NDArray[np.intp]
    outside: Array
    spurious: Array
    shift_cents: float


@dataclass(frozen=True)
class _Question:
    """What is asked: reeds, how they are seen, and the ends of the sweep in ln f."""

    reeds: PlausibleReeds
    visible: Array
    ends: tuple[float, float]

    @property
    def range_ln_hz(self) -> float:
        """Range of the sweep: what is no mode may be anywhere in it."""
        return self.ends[1] - self.ends[0]


@dataclass(frozen=True)
class _Shifts:
    """Prior variance (c,) of each shift in cents², and the scale of all shifts."""

    variance: Array
    cents: float

    @classmethod
    def first(cls, reeds: PlausibleReeds) -> "_Shifts":
        count = reeds.shifts.stop - reeds.shifts.start
        return cls(np.full(count, _SHIFT_CENTS[1] ** 2), _SHIFT_CENTS[1])

    def prior(self, reeds: PlausibleReeds) -> Array:
        """Return the prior variance (p,) of all parameters."""
        variance = np.ones(len(reeds.names))
        variance[reeds.shifts] = self.variance
        return variance


@dataclass(frozen=True)
class _Fit:
    """A reed that is fitted to data.

    Attributes
    ----------
    here : Prediction
    data : NameData
    shifts : _Shifts
    covariance : (p, p) float
    odds : (a,) float
        Log odds that each measured mode is spurious; of one that was taken out, before that.
    moved : float
        Farthest move of a parameter in the last step, but for shifts.
    """

    here: Prediction
    data: NameData
    shifts: _Shifts
    covariance: Array
    odds: Array
    moved: float


def reed_posterior(
    reeds: PlausibleReeds, visible: Array, measured: MeasuredModes, ends_hz: tuple[float, float]
) -> tuple[ReedPosterior, ...]:
    """Find the reeds whose modes are those of a sweep.

    Parameters
    ----------
    reeds : PlausibleReeds
    visible : (j, s) float
        Coordinates in the `ShapeBasis` of what is seen of each coordinate of the reed.
    measured : MeasuredModes
    ends_hz : (float, float)
        First and last drive frequency of the sweep.

    Returns
    -------
    tuple of ReedPosterior
        The first, and reeds in which a pair of modes has exchanged its characters.

    Raises
    ------
    ImpossibleReedError
        If no reed that is possible has these modes.
    """
    question = _Question(reeds, visible, (float(np.log(ends_hz[0])), float(np.log(ends_hz[1]))))
    fit = _first(question, measured)
    assigned, held = {fit.data.mode.tobytes()}, False
    for step in range(_MOST_STEPS):
        before = mode = fit.data.mode
        if not held:
            mode = _assigned(question, fit, _ASSIGNING[min(step, 1)])
            # Turns that go round: a mode belongs to the reed that is fitted without it, and not to
            # the one that is fitted with it. Kept, its odds tell.
            held = not np.array_equal(mode, before) and mode.tobytes() in assigned
            mode = max(mode, before, key=_count) if held else mode
            assigned.add(mode.tobytes())
        data = replace(fit.data, mode=mode)
        if step:
            data = replace(data, scatter=shape_scatter(fit.here, data))
            data = replace(data, weight=shape_weights(fit.here, data))
        fit = _refitted(question, replace(fit, data=data))
        if not np.array_equal(data.mode, before) or fit.moved > _SETTLED:
            continue
        worst = int(np.argmax(np.where(fit.data.counts, fit.odds, -np.inf)))
        if not fit.data.counts.any() or fit.odds[worst] <= 0:
            break
        real = fit.data.real & (np.arange(len(before)) != worst)
        fit = replace(fit, data=replace(fit.data, real=real))
    fits = _comparable(question, [fit, *_exchanged(question, fit)])
    return tuple(_result(question, each) for each in fits)


def _first(question: _Question, measured: MeasuredModes) -> _Fit:
    """Start with the reed that the frequencies alone suggest, to first order from the middle.

    Modes of that reed may have another order than in the middle. Where two of them cross on the
    way, frequencies and shapes together would hold it back.
    """
    reeds, count = question.reeds, len(measured.index)
    shifts, middle = _Shifts.first(reeds), np.zeros(len(reeds.names))
    prior = shifts.prior(reeds)
    fit = _Fit(
        here=predict(reeds, question.visible, middle),
        data=NameData(
            measured,
            mode=np.full(count, -1),
            real=np.ones(count, dtype=bool),
            scatter=np.full(count, _ASSIGNING[0]),
            weight=np.ones(count),
        ),
        shifts=shifts,
        covariance=np.diag(prior),
        odds=np.full(count, np.inf),
        moved=np.inf,
    )
    data = replace(fit.data, mode=_assigned(question, fit, _ASSIGNING[0]))
    frequencies = slice(np.count_nonzero(data.counts))
    residual, jacobian = whitened(fit.here, data)
    best, covariance = _updated(fit.here, residual[frequencies], jacobian[frequencies], prior)
    best[reeds.shifts] = 0.0
    return replace(fit, here=_towards(question, middle, best), covariance=covariance)


def _result(question: _Question, fit: _Fit) -> ReedPosterior:
    here, outside = fit.here, _outside(question, fit)
    return ReedPosterior(
        measured=fit.data.measured,
        nearby=here.nearby,
        visible=question.visible,
        seen=here.seen,
        mean=here.parameters,
        covariance=fit.covariance,
        log_evidence=_log_evidence(question.reeds, fit),
        mode=fit.data.mode,
        outside=outside,
        # A fit that looks for a mode in a sweep that does not contain it finds something else.
        spurious=expit(fit.odds + np.log1p(outside / _SPURIOUS)),
        shift_cents=fit.shifts.cents,
    )


def _refitted(question: _Question, fit: _Fit) -> _Fit:
    """Fit the parameters, and the scale of the shifts."""
    reeds = question.reeds
    data = replace(fit.data, ratios=strength_ratios(reeds, fit.here, fit.data))
    shifts = _scaled(reeds, fit.here, data)
    prior = shifts.prior(reeds)
    best = _fitted(fit.here, data, prior)
    here = _towards(question, fit.here.parameters, best)
    parameters = here.parameters
    moved = float(np.abs(parameters - fit.here.parameters)[: reeds.shifts.start].max())
    _, covariance = _updated(here, *whitened(here, data), prior)
    # How far the best reed is from there is not known either.
    covariance += np.outer(best - parameters, best - parameters)
    odds = np.where(data.real, _spurious_odds(question, here, data, shifts.cents), fit.odds)
    return _Fit(here, data, shifts, covariance, odds, moved)


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


def _towards(question: _Question, before: Array, best: Array) -> Prediction:
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
            if reach < _SETTLED:
                raise
            reach /= 2


def _updated(
    here: Prediction, residual: Array, jacobian: Array, prior: Array
) -> tuple[Array, Array]:
    """Return mean (p,) and covariance (p, p) of the parameters, linearised."""
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.diag(1 / prior))
    return covariance @ (jacobian.T @ (jacobian @ here.parameters - residual)), covariance


def _scaled(reeds: PlausibleReeds, here: Prediction, data: NameData) -> _Shifts:
    """Estimate scale and variances of Student's shifts by expectation and maximisation."""
    shifts, terms = _Shifts.first(reeds), whitened(here, data)
    own = own_shifts(reeds, here)[data.mode[data.counts]]
    for _ in range(_TURNS):
        mean, covariance = _updated(here, *terms, shifts.prior(reeds))
        second = mean[reeds.shifts] ** 2 + np.diag(covariance)[reeds.shifts]
        variance, before = (_DOF * shifts.cents**2 + second) / (_DOF + 1), shifts.cents
        weighted = float(np.mean(second[own] / variance[own])) if len(own) else 1.0
        cents = float(np.clip(before * np.sqrt(weighted), *_SHIFT_CENTS))
        shifts = _Shifts(variance, cents)
        if abs(cents - before) < _SETTLED * cents:
            break
    return shifts


def _spurious_odds(question: _Question, here: Prediction, data: NameData, cents: float) -> Array:
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
    density = stats.t.logpdf(shift, _DOF, scale=cents) - np.log(_CENT)
    answer = np.full(len(mode), np.inf)
    answer[found] = np.log(_SPURIOUS / question.range_ln_hz) - np.log1p(-_SPURIOUS) - density
    answer[similarities_of(here, data) < _LEAST_MAC] = np.inf
    return answer


def _outside(question: _Question, fit: _Fit) -> Array:
    """Return the probability (a,) that the mode which each is has its resonance off the sweep.

    By the other modes, and its shape: its own frequency does not count.
    """
    reeds, here, data = question.reeds, fit.here, fit.data
    residual, jacobian = whitened(here, data)
    frequencies, answer = np.cumsum(data.counts) - 1, np.zeros(len(data.mode))
    for a in np.flatnonzero(data.mode >= 0).tolist():
        m, weight = int(data.mode[a]), np.ones(len(residual))
        if data.counts[a]:
            weight[frequencies[a]] = 0.0
        prior = fit.shifts.prior(reeds)
        # Its own shift is as usual.
        prior[reeds.shifts.start + own_shifts(reeds, here)[m]] = fit.shifts.cents**2
        kept = weight[:, None] * jacobian
        mean, covariance = _updated(here, weight * residual, kept, prior)
        slope = here.by_ln_hz[m]
        expected = float(here.ln_hz[m] + slope @ (mean - here.parameters))
        below, above = (np.array(question.ends) - expected) / np.sqrt(slope @ covariance @ slope)
        answer[a] = stats.norm.cdf(below) + stats.norm.sf(above)
    return answer


def _assigned(question: _Question, fit: _Fit, scatter: float) -> NDArray[np.intp]:
    """Return the number of the reed's mode that each measured mode is; -1 if none.

    The most probable assignment of all modes together, without their correlations.
    """
    here, measured = fit.here, fit.data.measured
    count, modes = len(measured.index), len(here.ln_hz)
    cost = np.full((count, modes + count), _IMPROBABLE)
    follow = np.einsum("mp,pq,mq->m", here.by_ln_hz, fit.covariance, here.by_ln_hz)
    for a in range(count):
        variance = follow + measured.error[a] ** 2 + (_SHIFT_CENTS[0] * _CENT) ** 2
        square = (measured.ln_hz[a] - here.ln_hz) ** 2
        cost[a, :modes] = 0.5 * (square / variance + np.log(2 * np.pi * variance))
        cost[a, :modes] += [
            0.5 * shape_residual(here, measured, a, m, scatter).cost for m in range(modes)
        ]
        # A shape of unit length in any direction, anywhere in the sweep.
        other = measured.variance[a] + scatter**2 + 1 / len(measured.variance[a])
        seen = measured.directions[a] @ measured.shape[a]
        cost[a, modes + a] = np.log(question.range_ln_hz / _SPURIOUS)
        cost[a, modes + a] += 0.5 * float(np.sum(seen**2 / other + np.log(other)))
    rows, columns = optimize.linear_sum_assignment(cost)
    answer = np.full(count, -1)
    answer[rows] = np.where(columns < modes, columns, -1)
    return answer


def _count(mode: NDArray[np.intp]) -> int:
    """Return how many measured modes are modes of the reed."""
    return int(np.count_nonzero(mode >= 0))


def _exchanged(question: _Question, fit: _Fit) -> list[_Fit]:
    """Fit reeds in which two close modes of similar shape have exchanged their characters.

    The frequencies and shapes of such a pair say little of which of them is which.
    """
    reeds, here, answer = question.reeds, fit.here, []
    own, level = own_shifts(reeds, here), here.ln_levels
    for lower, upper in combinations(np.sort(fit.data.mode[fit.data.counts]).tolist(), 2):
        one, other = int(own[lower]), int(own[upper])
        mac = float(here.shape[lower] @ here.shape[upper]) ** 2
        if not are_close(reeds, one, other) or mac < SIMILAR:
            continue
        apart = _BEYOND * float(level[other] - level[one]) / _CENT
        parameters = here.parameters.copy()
        parameters[reeds.shifts.start + np.array([one, other])] += np.array([apart, -apart])
        tried = replace(fit, here=predict(reeds, question.visible, parameters))
        for _ in range(_MOST_STEPS):
            # With the scatter of the other reed at first: a shape that is bad has no say otherwise.
            tried = _refitted(question, tried)
            scatter = shape_scatter(tried.here, tried.data)
            tried = replace(tried, data=replace(tried.data, scatter=scatter))
            if tried.moved < _SETTLED:
                break
        answer.append(tried)
    return answer


def _comparable(question: _Question, fits: list[_Fit]) -> list[_Fit]:
    """Give coordinates of shapes the same weights in all fits: those of the least scatter.

    A shape that a reed does not have leaves residuals that are correlated, too.
    """
    if len(fits) == 1:
        return fits
    weights = np.stack([shape_weights(fit.here, fit.data) for fit in fits])
    best = np.argmin([fit.data.scatter for fit in fits], axis=0)
    common = weights[best, np.arange(weights.shape[1])]
    return [
        _refitted(question, replace(fit, data=replace(fit.data, weight=common))) for fit in fits
    ]


def _log_evidence(reeds: PlausibleReeds, fit: _Fit) -> float:
    """Return the log of the evidence of a fit by Laplace's method, up to a constant."""
    shift = fit.here.parameters[reeds.shifts]
    answer = -0.5 * float(np.sum(fit.here.parameters[: reeds.shifts.start] ** 2))
    answer += float(np.sum(stats.t.logpdf(shift, _DOF, scale=fit.shifts.cents)))
    answer += log_likelihood(fit.here, fit.data)
    return answer + 0.5 * float(np.linalg.slogdet(fit.covariance)[1])
