"""Rounds of the modal fit, and the optima at which they end.

A round minimises the cost with a given scatter of the displacements, and estimates the scatter for
which the residuals are as expected. The ripple of the drive is found between rounds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import softmax

from fitting.holograms.solved_sweep import Displacements
from fitting.modal.drive.prior import (
    FoundRipple,
    KnownMagnitude,
    found_ripple,
)
from fitting.modal.expected.prior import Prior
from fitting.modal.field_drift import FieldDrift, SharedError, found_walk, shared_error
from fitting.modal.losses import connected, resonances, with_loss_parameters
from fitting.modal.model import (
    CONNECTING,
    LOSS_PARAMETERS,
    Model,
    Stage,
    State,
    drive_prior_at,
    terms,
    with_gain,
)
from fitting.modal.noise import Data, Noise, balanced, data_of, inflated, sharing_holograms
from fitting.modal.normal_equations import Equations, Evaluation, equations, evaluate
from fitting.modal.optimiser import inverse, log_determinant, minimise_cost, without_drive
from fitting.modal.posterior import Posterior, ResonantDisplacements
from holography.arrays import Array, IndexArray

# Stage of the last rounds.
LAST = Stage(0.015, 0.7, 0.02, 1.0, 12)
# Holograms with one discrepancy before the first residuals are known: wrong shapes leave residuals
# as far as a mode is seen, two widths at half power of a loss factor of 0.03, in steps of 25 cents.
FIRST_SHARING = 4.0
# Most turns in which the ripple of the drive is found; they end when no frequency and no loss moves
# by more than this fraction of its standard error.
_MOST_RIPPLES, _SETTLED = 8, 0.2
# Mixings of shapes that count as much as what is expected of them. Chosen: few of several hundred.
_EXPECTED = 4.0
# Step of a derivative in standard errors: small enough to be linear, and far above rounding.
_STEP = 1e-3
# The normal distribution function of z is the logistic function of this times z, within 0.01
# (G. Camilli 1994, Journal of Educational and Behavioral Statistics 19:293).
_PROBIT = 1.702


@dataclass(frozen=True)
class Given:
    """What the rounds of a fit have in common.

    Attributes
    ----------
    displacements : Displacements
    drift : FieldDrift
    noise : Noise
    prior : Prior
    """

    displacements: Displacements
    drift: FieldDrift
    noise: Noise
    prior: Prior


@dataclass(frozen=True)
class Scatter:
    """How far displacements scatter around the model, and shapes around those expected.

    Attributes
    ----------
    discrepancy : float
        See `fitting.modal.model.Stage`.
    walk : float
        See `fitting.modal.field_drift.shared_error`.
    sharing : float
        Number of neighbouring holograms that have one discrepancy.
    mixing : float
        Factor on the prior standard deviations of the mixing of shapes (decision 0083).
    """

    discrepancy: float
    walk: float
    sharing: float = 1.0
    mixing: float = 1.0


@dataclass(frozen=True)
class Round:
    """Result of one round of the fit.

    Attributes
    ----------
    model : Model
        With what connects the modes of the start.
    prior : Prior
    state : State
    here : Equations
    data : Data
        What the cost was that of.
    covariance : (q, q) float
        Covariance of all parameters except the drive.
    log_evidence : float
        Log of the evidence, but for a constant that rounds with the same displacements and the same
        scatter share.
    log_likelihood : (k,) float
        What the residuals of each hologram add to it.
    whitened_residual : (k, 2j) float
        Residuals along the noise's directions, in standard deviations.
    misfit : float
        Sum of their squares, divided by the degrees of freedom.
    scatter, next_scatter : Scatter
        Scatter that was used, and the one that the residuals give.
    common_mode_shift : (k, q) float
        Common-mode error of every hologram.
    drift : FieldDrift
        How it follows from parameters.
    noise : Noise
        Noise with the variance of outliers increased.
    """

    model: Model
    prior: Prior
    state: State
    here: Equations
    data: Data
    covariance: Array
    log_evidence: float
    log_likelihood: Array
    whitened_residual: Array
    misfit: float
    scatter: Scatter
    next_scatter: Scatter
    common_mode_shift: Array
    drift: FieldDrift
    noise: Noise


def one_round(
    model: Model,
    given: Given,
    state: State,
    scatter: Scatter,
    iterations: int = LAST.iterations,
) -> Round:
    """Minimise the cost, and estimate the scatter for which residuals are as expected."""
    model = connected(model, state)
    displacements, drift, noise = given.displacements, given.drift, given.noise
    prior = _with_mixing(given.prior, len(model.active), scatter.mixing)
    shared = shared_at(model, given, state, scatter.walk)
    weighing = noise.deviation(scatter.discrepancy, scatter.sharing)
    data = data_of(displacements.amplitude_rad, shared, noise, weighing)
    state = minimise_cost(model, data, prior, fixed(prior, state), iterations)
    at = evaluate(model, data, prior, with_gain(model, state))
    state, here = at.state, equations(model, data, prior, at)
    alone, root, _ = without_drive(here, 0.0)
    covariance = inverse(alone)
    # A hologram without a solution says nothing, and leaves nothing.
    shown = int(np.count_nonzero(np.any(displacements.information, axis=(1, 2))))
    numbers = 2 * shown * (data.amplitude.shape[1] - 1)
    freedoms = numbers - _effective_parameters(prior, data, covariance)
    weighed = data.whitened_residual(at.terms.amplitude, state.shared)
    left = weighed * weighing
    whitened_residual = left / noise.deviation(scatter.discrepancy)
    first = len(covariance) - len(shared.precision)
    walk = found_walk(drift, state.shared, covariance[first:, first:], scatter.walk)
    return Round(
        model=model,
        prior=prior,
        state=state,
        here=here,
        data=data,
        covariance=covariance,
        log_evidence=_log_evidence(at, prior, float(np.sum(np.log(weighing))), alone, root),
        log_likelihood=-np.sum(0.5 * weighed**2 + np.log(weighing), axis=1),
        whitened_residual=whitened_residual,
        misfit=float(np.sum(whitened_residual**2)) / freedoms,
        scatter=scatter,
        next_scatter=replace(
            scatter,
            discrepancy=balanced(inflated(noise, whitened_residual), left, freedoms),
            walk=walk,
            # Holograms that share a discrepancy must not outweigh what is known of the drive.
            sharing=sharing_holograms(
                noise, whitened_residual, state.log_drive, scatter.discrepancy
            ),
            mixing=_found_mixing(given.prior, prior, len(model.active), state, covariance),
        ),
        common_mode_shift=drift.shift(state.shared)[:, LOSS_PARAMETERS:],
        drift=drift,
        noise=inflated(noise, whitened_residual),
    )


def _with_mixing(prior: Prior, count: int, factor: float) -> Prior:
    """Multiply the prior standard deviations of the mixing of shapes into `count` modes."""
    precision = prior.precision.copy()
    precision[count:, :count] /= factor**2
    ties = replace(prior.ties, precision=prior.ties.precision / factor**2)
    return replace(prior, precision=precision, ties=ties)


def _found_mixing(
    expected: Prior, used: Prior, count: int, state: State, covariance: Array
) -> float:
    """Return the factor on what is expected of mixings for which they are as large as they are.

    The evidence is largest where mixings have the mean square of their prior, of those that data
    determine (D. J. C. MacKay 1992, Neural Computation 4:415). What is expected counts as much as a
    few.

    Parameters
    ----------
    expected, used : Prior
        What was expected of the mixing of shapes into `count` modes, and what a round had.
    count : int
    state : State
    covariance : (q, q) float
        Posterior covariance of all free parameters, and more.
    """
    mixes = np.zeros(used.free.shape, dtype=bool)
    mixes[count:, :count] = used.free[count:, :count]
    determined = np.count_nonzero(mixes) - used.share(covariance, mixes)
    square = expected.cost(np.where(mixes, state.x, expected.centre))
    return float(np.sqrt((square + _EXPECTED) / (determined + _EXPECTED)))


def in_rounds(
    model: Model,
    given: Given,
    state: State,
    scatter: Scatter,
    count: int,
    iterations: int = LAST.iterations,
) -> tuple[Round, Given]:
    """Go through some rounds, each with the scatter and the outliers of the one before.

    Parameters
    ----------
    model : Model
    given : Given
    state : State
        Start.
    scatter : Scatter
        Of the first round.
    count : int
        Number of rounds, at least 1.
    iterations : int, optional
        Largest number of Levenberg-Marquardt steps in each.

    Returns
    -------
    Round
        The last one.
    Given
        With the outliers of that.
    """
    for _ in range(count):
        end = one_round(model, given, state, scatter, iterations)
        state, given, scatter = end.state, replace(given, noise=end.noise), end.next_scatter
    return end, given


def shared_at(model: Model, given: Given, state: State, walk: float) -> SharedError:
    """Return the error that displacements share, where they respond as those of a state would."""
    measured, error = given.displacements.amplitude_rad, given.displacements.common_mode
    modelled, size = terms(model, state).amplitude, measured.shape[1]
    shift = given.drift.shift(state.shared)[:, LOSS_PARAMETERS:]
    at_model = error.responding_at(modelled, measured)
    moved = (at_model.response @ shift[..., None])[..., 0]
    expected = modelled - moved[:, :size] - 1j * moved[:, size:]
    at_state = error.responding_at(expected, measured)
    return shared_error(with_loss_parameters(at_state), given.drift, walk)


def _log_evidence(
    at: Evaluation, prior: Prior, log_deviation: float, matrix: Array, drive_root: Array
) -> float:
    """Return the log evidence by Laplace's method, for the equations of `without_drive`.

    `log_deviation` is that of all data, summed as they are weighed.
    """
    known = log_determinant(matrix) + 2 * float(np.sum(np.log(np.diag(drive_root))))
    volumes = at.drive_prior.log_volume + prior.log_volume - known
    return 0.5 * (volumes - at.cost) - log_deviation


@dataclass(frozen=True)
class Optimum:
    """One optimum of the fit.

    Attributes
    ----------
    model : Model
    end : Round
    log_evidence : float
    logs : (2a,) float
        Log frequencies and log loss factors of the active modes.
    slopes : (2a, 2a + 3) float
        See `fitting.modal.losses.Resonances`.
    covariance : (2a, 2a) float
        Their covariance, with that of the drive's ripple.
    magnitude_covariance : (k, k) float
        Covariance of the drive's log magnitude, with that of its ripple.
    factor : float
        Factor on all variances.
    """

    model: Model
    end: Round
    log_evidence: float
    logs: Array
    slopes: Array
    covariance: Array
    magnitude_covariance: Array
    factor: float

    @classmethod
    def of(cls, end: Round, found: FoundRipple | None = None) -> "Optimum":
        """Collect an optimum from the last round, and the ripple that it had."""
        # χ² of a round is not exactly as expected.
        model, factor = end.model, end.misfit
        own, found_at = among_parameters(model, end.prior), resonances(model, end.state)
        slopes = found_at.slopes
        covariance = factor * slopes @ end.covariance[np.ix_(own, own)] @ slopes.T
        log_evidence = end.log_evidence + model.line_weight
        posterior = Posterior.of(end.here, end.covariance, 1.0)
        magnitude_covariance = factor * posterior.log_magnitude
        if found is not None:
            moved, louder = posterior.with_ripple(model, end.state)
            by_size = slopes @ moved[own]
            covariance = covariance + by_size @ found.covariance @ by_size.T
            magnitude_covariance += louder @ found.covariance @ louder.T
            log_evidence += found.log_weight
        logs = found_at.logs
        return cls(model, end, log_evidence, logs, slopes, covariance, magnitude_covariance, factor)


def among_parameters(model: Model, prior: Prior) -> IndexArray:
    """Return where that is among all parameters by which resonances have `Optimum.slopes`."""
    powers, first = model.powers.shape[1], np.count_nonzero(prior.free)
    own = prior.positions[: len(model.active), 2 * powers : 2 * powers + 2].T.ravel()
    return np.concatenate([own, first + np.arange(CONNECTING)])


@dataclass(frozen=True)
class Influence:
    """How r parameters follow what was measured, to first order.

    Attributes
    ----------
    amplitudes : (r, k, 2j) float
        ... the amplitudes of each hologram (real, then imaginary parts).
    light : (r, k, q) float
        ... the common-mode error of each hologram.
    """

    amplitudes: Array
    light: Array


def influence(at: Optimum, resonant: ResonantDisplacements) -> Influence:
    """Return how resonances and displacements follow what was measured.

    They are log frequencies, log loss factors and logs of the amplitudes at resonance.
    """
    model, end = at.model, at.end
    which, size = among_parameters(model, end.prior), len(end.covariance)
    posterior, state, free = Posterior.of(end.here, end.covariance, 1.0), end.state, end.prior.free
    by_parameters = np.concatenate([np.eye(size)[which], resonant.log_by_parameters])
    by_drive = np.concatenate([np.zeros((len(which), 2 * len(model.hz))), resonant.log_by_drive])
    along, driven = posterior.moved_by(by_parameters, by_drive)
    error = np.sqrt(np.sum(along * by_parameters, axis=1) + np.sum(driven * by_drive, axis=1))
    own, shared = np.split(along / error[:, None], [np.count_nonzero(free)], axis=1)
    magnitude, phase = np.split(driven / error[:, None], 2, axis=1)

    def residual(r: int, step: float) -> Array:
        x = state.x.copy()
        x[free] += step * own[r]
        moved = replace(
            state,
            x=x,
            log_drive=state.log_drive + step * (magnitude[r] + 1j * phase[r]),
            shared=state.shared + step * shared[r],
        )
        return end.data.whitened_residual(terms(model, moved).amplitude, moved.shared)

    slopes = np.stack([residual(r, -_STEP) - residual(r, _STEP) for r in range(len(error))])
    # The covariance is the inverse of half the Gauss-Newton Hessian.
    scaled = (slopes * (error / (2 * _STEP))[:, None, None])[:, :, None]

    def of_logs(by_each: Array) -> Array:
        parameters, displacements = np.split(by_each[:, :, 0], [len(which)])
        return np.concatenate([np.tensordot(at.slopes, parameters, axes=1), displacements])

    return Influence(of_logs(scaled @ end.data.root), of_logs(scaled @ end.data.response))


def with_ripple(model: Model, given: Given, state: State, scatter: Scatter) -> Optimum:
    """Find the ripple of the drive and fit with it, in turns, from the ripple of a model.

    Every optimum has the same scatter: only then can their evidence be compared.
    """
    end = one_round(model, given, state, scatter)
    here = Optimum.of(end)
    for _ in range(_MOST_RIPPLES):
        found, before = _found_ripple(model, end), here
        model = replace(model, ripple=found.ripple)
        end = one_round(model, given, end.state, scatter)
        here = Optimum.of(end, found)
        moved = np.abs(here.logs - before.logs) / np.sqrt(np.diag(here.covariance))
        if np.all(moved < _SETTLED):
            break
    return here


def likeliest(optima: Sequence[Optimum]) -> Optimum:
    """Return the optimum with the highest evidence."""
    return max(optima, key=lambda each: each.log_evidence)


def probabilities(optima: Sequence[Optimum]) -> Array:
    """Return the probability of each optimum (n,), all with the same scatter.

    The difference of two evidences is a sum over holograms whose errors are not quite as the model
    says, and has a standard error of its own (Q. H. Vuong 1989, Econometrica 57:307), here with the
    correlation of neighbours (W. K. Newey & K. D. West 1987, Econometrica 55:703). Where that is
    large, an optimum with more evidence is only somewhat more probable than another one.
    """
    best = likeliest(optima)
    logits = []
    for each in optima:
        gain = each.end.log_likelihood - best.end.log_likelihood
        error = _error_of_sum(gain, round(best.end.scatter.sharing))
        less = each.log_evidence - best.log_evidence
        logits.append(less * min(1.0, _PROBIT / max(error, _PROBIT)))
    return np.asarray(softmax(logits))


def _error_of_sum(values: Array, lags: int) -> float:
    """Return the standard error of the sum of values (k,) that are correlated up to some lags."""
    off, lags = values - np.mean(values), min(lags, len(values) - 1)
    products = [float(off[lag:] @ off[: len(off) - lag]) for lag in range(lags + 1)]
    more = sum((1 - lag / (lags + 1)) * products[lag] for lag in range(1, lags + 1))
    return float(np.sqrt(max(products[0] + 2 * more, 0.0)))


def _found_ripple(model: Model, end: "Round") -> FoundRipple:
    """Find the ripple of the drive after a round."""
    magnitude, prior = end.state.log_drive.real - model.log_volts, drive_prior_at(model, end.state)
    covariance = Posterior.of(end.here, end.covariance, 1.0).log_magnitude
    known = KnownMagnitude.of(magnitude, covariance, prior)
    return found_ripple(model.ripple, known, end.state.gain, model.drive_dof)


def fixed(prior: Prior, state: State) -> State:
    """Set fixed parameters to their prior values."""
    return replace(state, x=np.where(prior.free, state.x, prior.centre))


def _effective_parameters(prior: Prior, data: Data, covariance: Array) -> float:
    """Return the effective number of parameters: those that the prior determines count in part."""
    own = np.count_nonzero(prior.free)
    known = prior.share(covariance, prior.free)
    shared = np.sum(data.precision * covariance[own:, own:])
    return float(len(covariance) - known - shared)
