"""Which plausible reed has the modes that a sweep shows: parameters, and which mode is which.

The parameters are those of `physics.plausible.reeds`, normal with unit variance. Frequencies and
shapes of a reed's modes follow them. Whatever a reed has that the model lacks shifts and couples
its modes by some cents; these shifts are Student's, and their scale is estimated, as is the scatter
of each shape. A measured mode is one of the reed's, or none of them: then the fit has mistaken
something else for a mode. Least-squares fits and the assignment of modes take turns.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats
from scipy.special import expit

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
    whitened,
)
from fitting.names.measured import MeasuredModes
from fitting.names.prediction import predict
from fitting.names.reed_fit import (
    DOF,
    SETTLED,
    SHIFT_CENTS,
    SPURIOUS,
    Fit,
    Question,
    Shifts,
    refitted,
    towards,
    updated,
)
from fitting.paper.constants import H4_MISFIT_CENTS
from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.plausible.nearby import NearbyReeds
from physics.plausible.reeds import PlausibleReeds

_CENT = float(np.log(2) / 1200)
# Scatter of shapes in the assignment of modes, first while the reed is hardly known. Chosen: the
# MAC of a shape with that of a reed of middling cane is then mostly above 0.9.
_ASSIGNING = (0.3, 0.1)
_MOST_STEPS = 40
# A reed whose own shifts are larger than this multiple of the least is looked for from elsewhere,
# too. Chosen: a model leaves some cents, and modes that are mistaken for others tens of them.
_USUAL_SHIFTS = 2.0
# ... in clamps that yield by this many standard deviations less or more. Chosen: there X1 and L1
# are on either side of their crossing.
_OTHER_CLAMPS = (-1.5, 1.5)
# Start of the search for a reed in which two modes have exchanged their characters, as a fraction
# of the exchange: just beyond the crossing.
_BEYOND = 0.6
_IMPROBABLE = 1e9
# Modes that correlate well have a MAC of 0.9 and more (Ewins, Modal Testing, 2nd ed., 2000).
_LEAST_SIMILARITY = 0.9


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
        Number of the reed's mode, as in `nearby`, that each measured mode is; -1 if none.
    outside : (a,) float
        Probability that the resonance of that mode is outside the sweep, by all other modes.
    spurious : (a,) float
        Probability that a measured mode is none of the reed's.
    similarity : (a,) float
        MAC of each measured shape and that of the reed's mode, without what errors of the measured
        shape take from it; 0 if it is none of the reed's.
    shift_cents : float
        Scale of the shifts of modes.
    free_moduli : ReedPosterior, optional
        The same with parameters of reeds whose moduli may leave hypothesis H4.
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
    similarity: Array
    shift_cents: float
    free_moduli: "ReedPosterior | None" = None

    @property
    def is_plausible(self) -> bool:
        """Whether frequencies or shapes, at least, are those of a reed of this kind.

        55 reeds leave a hypothesis that knows three components of their cane by 30.4 cents (paper,
        Table 4a); here thickness, clamp and air are known as well.
        """
        usual = self.shift_cents <= H4_MISFIT_CENTS
        return usual or float(self.similarity.mean()) >= _LEAST_SIMILARITY


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
    question = Question(reeds, visible, (float(np.log(ends_hz[0])), float(np.log(ends_hz[1]))))
    first = _first(question, measured)
    fit = _confirmed(question, first, _searched(question, first))
    fits = _comparable(question, [fit, *_exchanged(question, fit)])
    return tuple(
        replace(_result(question, each), free_moduli=_with_free_moduli(question, each))
        for each in fits
    )


def _searched(question: Question, fit: Fit) -> Fit:
    """Fit a reed and assign modes, in turns, and take out modes that are spurious."""
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
        fit = refitted(question, replace(fit, data=data))
        if not np.array_equal(data.mode, before) or fit.moved > SETTLED:
            continue
        worst = int(np.argmax(np.where(fit.data.counts, fit.odds, -np.inf)))
        if not fit.data.counts.any() or fit.odds[worst] <= 0:
            break
        real = fit.data.real & (np.arange(len(before)) != worst)
        fit = replace(fit, data=replace(fit.data, real=real))
    return fit


def _confirmed(question: Question, first: Fit, fit: Fit) -> Fit:
    """Search from elsewhere too unless a search has explained all modes; return the likeliest end.

    Elsewhere is where it has ended, with the modes that it has left out: the reed that it has found
    on the way may have them. And it is in clamps that yield hardly, and much: in these, other modes
    are close to one another, and may have been mistaken for each other.

    Parameters
    ----------
    question : Question
    first, fit : Fit
        Start and end of the search.
    """
    usual = fit.shifts.cents < _USUAL_SHIFTS * SHIFT_CENTS[0]
    if usual and np.all(fit.data.mode >= 0) and fit.data.real.all():
        return fit
    real, ends = np.ones_like(fit.data.real), [fit]
    # A search that leaves all possible reeds ends nowhere.
    with suppress(ImpossibleReedError):
        ends.append(_searched(question, replace(fit, data=replace(fit.data, real=real))))
    for deviations in _OTHER_CLAMPS:
        parameters = first.here.parameters.copy()
        parameters[question.reeds.clamp] = deviations
        with suppress(ImpossibleReedError):
            there = towards(question, first.here.parameters, parameters)
            ends.append(_searched(question, replace(first, here=there)))
    ends = _comparable(question, ends)
    return max(ends, key=lambda end: _log_evidence(question.reeds, end))


def _first(question: Question, measured: MeasuredModes) -> Fit:
    """Start with the reed that the frequencies alone suggest, to first order from the middle.

    Modes of that reed may have another order than in the middle. Where two of them cross on the
    way, frequencies and shapes together would hold it back.
    """
    reeds, count = question.reeds, len(measured.index)
    shifts, middle = Shifts.first(reeds), np.zeros(len(reeds.names))
    prior = shifts.prior(reeds)
    fit = Fit(
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
    best, covariance = updated(fit.here, residual[frequencies], jacobian[frequencies], prior)
    best[reeds.shifts] = 0.0
    return replace(fit, here=towards(question, middle, best), covariance=covariance)


def _result(question: Question, fit: Fit) -> ReedPosterior:
    here, outside = fit.here, _outside(question, fit)
    # Shapes have unit length, and no error along themselves.
    noise = np.sum(fit.data.measured.variance, axis=1)
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
        spurious=expit(fit.odds + np.log1p(outside / SPURIOUS)),
        similarity=np.where(fit.data.mode >= 0, similarities_of(here, fit.data) + noise, 0.0),
        shift_cents=fit.shifts.cents,
    )


def _outside(question: Question, fit: Fit) -> Array:
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
        mean, covariance = updated(here, weight * residual, kept, prior)
        slope = here.by_ln_hz[m]
        expected = float(here.ln_hz[m] + slope @ (mean - here.parameters))
        below, above = (np.array(question.ends) - expected) / np.sqrt(slope @ covariance @ slope)
        answer[a] = stats.norm.cdf(below) + stats.norm.sf(above)
    return answer


def _assigned(question: Question, fit: Fit, scatter: float) -> NDArray[np.intp]:
    """Return the number of the reed's mode that each measured mode is; -1 if none.

    The most probable assignment of all modes together, without their correlations.
    """
    here, measured = fit.here, fit.data.measured
    count, modes = len(measured.index), len(here.ln_hz)
    cost = np.full((count, modes + count), _IMPROBABLE)
    follow = np.einsum("mp,pq,mq->m", here.by_ln_hz, fit.covariance, here.by_ln_hz)
    for a in range(count):
        variance = follow + measured.error[a] ** 2 + (SHIFT_CENTS[0] * _CENT) ** 2
        square = (measured.ln_hz[a] - here.ln_hz) ** 2
        cost[a, :modes] = 0.5 * (square / variance + np.log(2 * np.pi * variance))
        cost[a, :modes] += [
            0.5 * shape_residual(here, measured, a, m, scatter).cost for m in range(modes)
        ]
        # A shape of unit length in any direction, anywhere in the sweep.
        other = measured.variance[a] + scatter**2 + 1 / len(measured.variance[a])
        seen = measured.directions[a] @ measured.shape[a]
        cost[a, modes + a] = np.log(question.range_ln_hz / SPURIOUS)
        cost[a, modes + a] += 0.5 * float(np.sum(seen**2 / other + np.log(other)))
    rows, columns = optimize.linear_sum_assignment(cost)
    answer = np.full(count, -1)
    answer[rows] = np.where(columns < modes, columns, -1)
    return answer


def _count(mode: NDArray[np.intp]) -> int:
    """Return how many measured modes are modes of the reed."""
    return int(np.count_nonzero(mode >= 0))


def _exchanged(question: Question, fit: Fit) -> list[Fit]:
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
        # There need not be a reed in which they have.
        with suppress(ImpossibleReedError):
            tried = replace(fit, here=predict(reeds, question.visible, parameters))
            answer.append(_settled(question, tried))
    return answer


def _settled(question: Question, fit: Fit) -> Fit:
    """Fit the reed of the same modes until it comes to rest.

    It has the scatter of the other reed at first: a shape that is bad has no say otherwise.
    """
    for _ in range(_MOST_STEPS):
        fit = refitted(question, fit)
        fit = replace(fit, data=replace(fit.data, scatter=shape_scatter(fit.here, fit.data)))
        if fit.moved < SETTLED:
            break
    return fit


def _comparable(question: Question, fits: list[Fit]) -> list[Fit]:
    """Give coordinates of shapes the same weights in all fits: those of the least scatter.

    A shape that a reed does not have leaves residuals that are correlated, too.
    """
    if len(fits) == 1:
        return fits
    first, *others = fits
    weights = np.stack([shape_weights(fit.here, fit.data) for fit in fits])
    best = np.argmin([fit.data.scatter for fit in fits], axis=0)
    common = weights[best, np.arange(weights.shape[1])]
    again = [refitted(question, replace(first, data=replace(first.data, weight=common)))]
    for other in others:
        with suppress(ImpossibleReedError):
            again.append(
                refitted(question, replace(other, data=replace(other.data, weight=common)))
            )
    return again


def _with_free_moduli(question: Question, fit: Fit) -> ReedPosterior | None:
    """Fit again with free moduli, the same modes and the same scatter of shapes.

    None if no such reed is possible.
    """
    free = replace(question, reeds=question.reeds.with_free_moduli())
    parameters = np.zeros(len(free.reeds.names))
    parameters[np.isin(free.reeds.names, question.reeds.names)] = fit.here.parameters
    with suppress(ImpossibleReedError):
        fit = replace(fit, here=predict(free.reeds, free.visible, parameters))
        for _ in range(_MOST_STEPS):
            fit = refitted(free, fit)
            if fit.moved < SETTLED:
                break
        return _result(free, fit)
    return None


def _log_evidence(reeds: PlausibleReeds, fit: Fit) -> float:
    """Return the log of the evidence of a fit by Laplace's method, up to a constant."""
    shift = fit.here.parameters[reeds.shifts]
    answer = -0.5 * float(np.sum(fit.here.parameters[: reeds.shifts.start] ** 2))
    answer += float(np.sum(stats.t.logpdf(shift, DOF, scale=fit.shifts.cents)))
    answer += log_likelihood(fit.here, fit.data)
    return answer + 0.5 * float(np.linalg.slogdet(fit.covariance)[1])
