"""Fit one joint model to a whole sweep: modes with frequency, loss factor and shape.

The displacement of hologram k, in coordinates j of few functions, is

    a_kj = d_k Σ_m h_m(f_k) p_m(f_k) T_mj,    h_m(f) = 1 / (1 + iη_m − (f/f_m)^(2 − γ_m))

with the known exponents γ_m of cane that stiffens with frequency, eigenfrequencies f_m, loss
factors η_m, shapes ``T_mj = Σ_n (δ_mn + E_mn) S_nj`` near those S of the finite elements, complex
and smooth participations p_m(f), and the drive d_k. The phase of the drive is free, because the
phase of a hologram is unknown. Its magnitude follows the volts smoothly, except at acoustic
resonances. The ratio of the modes in a hologram therefore shows as much as their size how near each
of them is to its resonance.

All parameters are found by one damped least-squares fit to the amplitudes of
`fitting.holograms.displacement` and their information. Shapes may differ from those of the finite
elements as by a perturbation: the more, the closer two modes are in frequency. All displacements
may have a common-mode error, because object field and vibration are partly confounded (see
`fitting.holograms.object_field`); it drifts slowly. The discrepancy of the model is estimated from
the residuals and added to the noise, and the ripple of the drive from the drive that was found.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from fitting.holograms.displacement import Displacements
from fitting.holograms.shape_basis import ShapeBasis
from fitting.modal.drive_prior import (
    HELD_LEVEL,
    FoundRipple,
    KnownMagnitude,
    found_ripple,
    quiet_ripple,
    ripple_around,
    smooth_ripple,
    strong_ripple,
)
from fitting.modal.field_drift import (
    FIRST_WALK,
    FieldDrift,
    SharedError,
    field_drift,
    found_walk,
    shared_error,
)
from fitting.modal.first_state import at_level, first_state, participation_scale
from fitting.modal.modal_fit import ModalFit
from fitting.modal.model import (
    KNOWN_DRIVE_DOF,
    UNKNOWN_DRIVE_DOF,
    Model,
    Prior,
    Stage,
    State,
    drive_prior_at,
    stage_prior,
    terms,
    with_gain,
)
from fitting.modal.noise import (
    Noise,
    balanced,
    correlated_holograms,
    data_of,
    inflated,
    noise_of,
)
from fitting.modal.normal_equations import (
    Data,
    Equations,
    Evaluation,
    equations,
    evaluate,
)
from fitting.modal.optimiser import inverse, minimise_cost, without_drive
from fitting.modal.posterior import Posterior, participation_error, resonant_displacements
from holography.arrays import Array

# Participations are polynomials of log frequency of this degree.
_DEGREE = 4
# How often the discrepancy is estimated, and how often if the modes are known from another fit.
_ROUNDS, _AGAIN = 3, 2
# Most turns in which the ripple of the drive is found; they end when no frequency and no loss moves
# by more than this fraction of its standard error.
_MOST_RIPPLES, _SETTLED = 8, 0.2

_STAGES = (
    Stage(0.3, 0.05, 0.01, 0.05, 1),
    Stage(0.1, 0.3, 0.01, 0.3, 1),
    Stage(0.03, 0.5, 0.01, 1.0, 1),
)
_LAST = Stage(0.015, 0.7, 0.02, 1.0, 12)


def fit_modes(
    displacements: Displacements,
    basis: ShapeBasis,
    drive_hz: Array,
    volts: Array,
    start_hz: dict[str, float],
    known: ModalFit | None = None,
    rough: bool = False,
    drive_dof: float = UNKNOWN_DRIVE_DOF,
) -> ModalFit:
    """Fit the joint model of a sweep.

    Parameters
    ----------
    displacements : Displacements
        Displacements of the k holograms.
    basis : ShapeBasis
    drive_hz, volts : (k,) float
        Drive frequencies, and the expected magnitude of the drive, up to a smooth factor.
    start_hz : dict
        Start frequency of each mode, by name, for all modes of the basis with a resonance within
        the sweep.
    known : ModalFit, optional
        Start of the fit.
    rough : bool, optional
        End before the ripple of the drive is found: the fit predicts displacements well enough for
        a better fit of these.
    drive_dof : float, optional
        Degrees of freedom of the drive's prior, see `fitting.modal.model.Model`.

    Returns
    -------
    ModalFit
    """
    model, centre_hz = _model(basis, drive_hz, volts, start_hz, drive_dof)
    noise = noise_of(displacements)
    drift = field_drift(displacements.common_mode, displacements.recording_rank)
    shared = shared_error(displacements.common_mode, drift, FIRST_WALK)
    if known is None:
        model, state = _staged(model, displacements, noise, shared, centre_hz)
        rounds, scatter = _ROUNDS, _Scatter(_LAST.discrepancy, FIRST_WALK)
    else:
        model, state = _again(model, known, displacements, len(shared.precision))
        rounds, scatter = _AGAIN, _Scatter(known.discrepancy, known.field_walk)
    prior = stage_prior(model, _LAST, centre_hz, participation_scale(model, state))
    for _ in range(rounds):
        same = displacements, drift, noise, prior
        end = _round(model, *same, state, scatter)
        state, noise, scatter = end.state, end.noise, end.next_scatter
    if rough or drive_dof == KNOWN_DRIVE_DOF:
        return _finish(displacements, basis.names, [_Optimum.of(model, end)])
    optima = [
        _with_ripple(replace(model, ripple=ripple), *same, state, scatter)
        for ripple in (smooth_ripple(model.ripple), strong_ripple(model.ripple))
    ]
    return _finish(displacements, basis.names, optima)


def _with_ripple(
    model: Model,
    displacements: Displacements,
    drift: FieldDrift,
    noise: Noise,
    prior: Prior,
    state: State,
    scatter: "_Scatter",
) -> "_Optimum":
    """Find the ripple of the drive and fit with it, in turns, from the ripple of a model.

    Every optimum has the same scatter: only then can their evidence be compared.
    """
    same = displacements, drift, noise, prior
    end = _round(model, *same, state, scatter)
    here = _Optimum.of(model, end)
    for _ in range(_MOST_RIPPLES):
        found, before = _found_ripple(model, end), here
        model = replace(model, ripple=found.ripple)
        end = _round(model, *same, end.state, scatter)
        here = _Optimum.of(model, end, found)
        moved = np.abs(here.logs - before.logs) / np.sqrt(np.diag(here.covariance))
        if np.all(moved < _SETTLED):
            break
    return here


def _found_ripple(model: Model, end: "_Round") -> FoundRipple:
    """Find the ripple of the drive after a round."""
    magnitude, prior = end.state.log_drive.real - model.log_volts, drive_prior_at(model, end.state)
    covariance = Posterior.of(end.here, end.covariance, 1.0).log_magnitude
    known = KnownMagnitude.of(magnitude, covariance, prior)
    return found_ripple(model.ripple, known, end.state.gain, model.drive_dof)


def _model(
    basis: ShapeBasis, drive_hz: Array, volts: Array, start_hz: dict[str, float], drive_dof: float
) -> tuple[Model, Array]:
    """Set up the model; also return the start frequencies (a,) of the active modes."""
    active = np.array([m for m, name in enumerate(basis.names) if name in start_hz])
    centre_hz = np.array([start_hz[basis.names[m]] for m in active])
    spread = np.log(drive_hz / np.sqrt(drive_hz[0] * drive_hz[-1]))
    powers = np.polynomial.chebyshev.chebvander(spread / spread[-1], _DEGREE)
    shifts = np.log(centre_hz / basis.hz[active])
    reference_hz = basis.hz * np.exp(np.median(shifts))
    reference_hz[active] = centre_hz
    model = Model(
        drive_hz,
        np.log(volts),
        drive_dof,
        quiet_ripple(drive_hz, HELD_LEVEL),
        powers,
        basis.shapes,
        reference_hz,
        basis.stiffening,
        active,
    )
    return model, centre_hz


@dataclass(frozen=True)
class _Scatter:
    """How far displacements scatter around the model.

    Attributes
    ----------
    discrepancy : float
        See `fitting.modal.model.Stage`.
    walk : float
        See `fitting.modal.field_drift.shared_error`.
    correlated : float
        Number of holograms that count as one independent hologram.
    """

    discrepancy: float
    walk: float
    correlated: float = 1.0


def _staged(
    model: Model, displacements: Displacements, noise: Noise, shared: SharedError, centre_hz: Array
) -> tuple[Model, State]:
    """Fit with priors that widen from stage to stage."""
    state, scale = first_state(model, displacements, len(shared.precision))
    model = at_level(model, state)
    for stage in _STAGES:
        prior = stage_prior(model, stage, centre_hz, scale)
        data = data_of(displacements.amplitude_rad, shared, noise, stage.discrepancy)
        state = minimise_cost(model, data, prior, _fixed(prior, state), stage.iterations)
        scale = participation_scale(model, state)
    return model, state


def _again(
    model: Model, known: ModalFit, displacements: Displacements, shared: int
) -> tuple[Model, State]:
    """Start from known modes: only the drive of every hologram is fitted to the displacements."""
    if model.drive_dof == KNOWN_DRIVE_DOF:
        model = replace(model, ripple=ripple_around(model.ripple, known.log_drive_covariance))
    unit = known.amplitude_rad / known.drive[:, None]
    drive = np.sum(unit.conj() * displacements.amplitude_rad, axis=1)
    drive = np.where(np.abs(drive) > 0, drive / np.sum(np.abs(unit) ** 2, axis=1), known.drive)
    state = replace(known.state, log_drive=np.log(drive), common_mode_shift=np.zeros(shared))
    return at_level(model, state), state


def _fixed(prior: Prior, state: State) -> State:
    """Set fixed parameters to their prior values."""
    return replace(state, x=np.where(prior.free, state.x, prior.centre))


@dataclass(frozen=True)
class _Round:
    """Result of one round of the fit.

    Attributes
    ----------
    prior : Prior
    state : State
    here : Equations
    covariance : (q, q) float
        Covariance of all parameters except the drive.
    log_evidence : float
        Log of the evidence, but for a constant that rounds with the same data and priors share.
    whitened_residual : (k, 2j) float
        Residuals along the noise's directions, in standard deviations.
    misfit : float
        Sum of their squares, divided by the degrees of freedom.
    scatter, next_scatter : _Scatter
        Scatter that was used, and the one that the residuals give.
    common_mode_shift : (k, q) float
        Common-mode error of every hologram.
    drift : FieldDrift
        How it follows from parameters.
    noise : Noise
        Noise with the variance of outliers increased.
    """

    prior: Prior
    state: State
    here: Equations
    covariance: Array
    log_evidence: float
    whitened_residual: Array
    misfit: float
    scatter: _Scatter
    next_scatter: _Scatter
    common_mode_shift: Array
    drift: FieldDrift
    noise: Noise


def _round(
    model: Model,
    displacements: Displacements,
    drift: FieldDrift,
    noise: Noise,
    prior: Prior,
    state: State,
    scatter: _Scatter,
) -> _Round:
    """Minimise the cost, and estimate the scatter for which residuals are as expected."""
    shared = shared_error(displacements.common_mode, drift, scatter.walk)
    data = data_of(displacements.amplitude_rad, shared, noise, scatter.discrepancy)
    state, weighed = _fixed(prior, state), data.weighing(1 / scatter.correlated)
    state = with_gain(model, minimise_cost(model, weighed, prior, state, _LAST.iterations))
    here = equations(model, weighed, prior, state)
    alone, root, _ = without_drive(here, 0.0, np.float64)
    covariance = inverse(alone)
    freedoms = (
        2 * data.amplitude.size - 2 * len(model.hz) - _effective_parameters(prior, data, covariance)
    )
    whitened_residual = data.whitened_residual(
        terms(model, state).amplitude, state.common_mode_shift
    )
    left = whitened_residual * noise.deviation(scatter.discrepancy)
    first = len(covariance) - len(shared.precision)
    walk = found_walk(drift, state.common_mode_shift, covariance[first:, first:], scatter.walk)
    return _Round(
        prior=prior,
        state=state,
        here=here,
        covariance=covariance,
        log_evidence=_log_evidence(evaluate(model, weighed, prior, state), alone, root),
        whitened_residual=whitened_residual,
        misfit=float(np.sum(whitened_residual**2)) / freedoms,
        scatter=scatter,
        next_scatter=replace(
            scatter,
            discrepancy=balanced(inflated(noise, whitened_residual), left, freedoms),
            walk=walk,
            # Correlated holograms must not outweigh what is known of the drive.
            correlated=correlated_holograms(noise, whitened_residual, state.log_drive),
        ),
        common_mode_shift=drift.shift(state.common_mode_shift),
        drift=drift,
        noise=inflated(noise, whitened_residual),
    )


def _log_evidence(at: Evaluation, matrix: Array, drive_root: Array) -> float:
    """Return the log evidence by Laplace's method, for the equations of `without_drive`."""
    known = float(np.linalg.slogdet(matrix)[1]) + 2 * float(np.sum(np.log(np.diag(drive_root))))
    return 0.5 * (at.drive_prior.log_volume - known - at.cost)


@dataclass(frozen=True)
class _Optimum:
    """One optimum of the fit.

    Attributes
    ----------
    model : Model
    end : _Round
    log_evidence : float
    logs : (2a,) float
        Log frequencies and log loss factors of the active modes.
    covariance : (2a, 2a) float
        Their covariance, with that of the drive's ripple.
    magnitude_covariance : (k, k) float
        Covariance of the drive's log magnitude, with that of its ripple.
    factor : float
        Factor on all variances.
    """

    model: Model
    end: _Round
    log_evidence: float
    logs: Array
    covariance: Array
    magnitude_covariance: Array
    factor: float

    @classmethod
    def of(cls, model: Model, end: _Round, found: FoundRipple | None = None) -> "_Optimum":
        """Collect an optimum from the last round, and the ripple that it had."""
        # χ² of a round is not exactly as expected, and neighbouring residuals are correlated.
        factor = end.misfit * end.next_scatter.correlated / end.scatter.correlated
        count, powers, free = len(model.active), model.powers.shape[1], end.prior.free
        number = np.full(free.shape, -1)
        number[free] = np.arange(np.count_nonzero(free))
        own = number[:count, 2 * powers : 2 * powers + 2].T.ravel()
        covariance, log_evidence = factor * end.covariance[np.ix_(own, own)], end.log_evidence
        posterior = Posterior.of(end.here, end.covariance, 1.0)
        magnitude_covariance = factor * posterior.log_magnitude
        if found is not None:
            moved, louder = posterior.with_ripple(model, end.state)
            covariance = covariance + moved[own] @ found.covariance @ moved[own].T
            magnitude_covariance += louder @ found.covariance @ louder.T
            log_evidence += found.log_weight
        logs = end.state.x[:count, 2 * powers : 2 * powers + 2].T.ravel()
        return cls(model, end, log_evidence, logs, covariance, magnitude_covariance, factor)


def _finish(
    displacements: Displacements, names: Sequence[str], optima: Sequence[_Optimum]
) -> ModalFit:
    """Return modes and standard errors.

    Frequencies, losses and their errors are averages over all optima, by their evidence; all else
    is that of the best.
    """
    best = max(optima, key=lambda each: each.log_evidence)
    weights = softmax([each.log_evidence for each in optima])
    logs, covariance = _mixture(weights, [(each.logs, each.covariance) for each in optima])
    magnitudes = [(each.end.state.log_drive.real, each.magnitude_covariance) for each in optima]
    model, end, factor = best.model, best.end, best.factor
    prior, state, now = end.prior, end.state, terms(model, end.state)
    # Drive and participations have an undetermined common factor: the errors of participations are
    # those for a given drive.
    given_drive = factor * inverse(end.here.matrix)
    posterior = Posterior.of(end.here, end.covariance, factor)
    shared = len(state.common_mode_shift)
    count = len(model.active)
    spread = np.zeros_like(state.x)
    deviations = np.sqrt(factor * np.diag(end.covariance))
    spread[prior.free] = deviations[: np.count_nonzero(prior.free)]
    own_hz, own_loss = np.exp(logs.reshape(2, -1))
    mixes = prior.free[count:, :count]
    nearest = np.abs(np.log(model.hz[:, None] / own_hz)).argmin(axis=0)
    return ModalFit(
        names=tuple(names[m] for m in model.active),
        hz=own_hz,
        error_cents=np.sqrt(np.diag(covariance)[:count]) * 1200 / np.log(2),
        loss_factor=own_loss,
        loss_error=np.sqrt(np.diag(covariance)[count:]),
        covariance=covariance,
        shapes=now.shapes[model.active],
        mixing=np.where(mixes, state.x[count:, :count], 0.0),
        mixing_error=np.where(mixes, spread[count:, :count], 0.0),
        mixing_spread=np.where(mixes, _spread(prior)[count:, :count], 0.0),
        participation=now.participation[nearest, model.active],
        participation_error=participation_error(model, prior, given_drive, nearest),
        participations=now.participation[:, model.active],
        drive=np.exp(state.log_drive),
        amplitude_rad=now.amplitude,
        modal_rad=now.modal[:, model.active],
        misfit=end.misfit,
        discrepancy=end.scatter.discrepancy,
        common_mode_shift=end.common_mode_shift,
        field_walk=end.scatter.walk,
        common_mode_covariance=end.drift.covariance(posterior.common_mode(shared)),
        resonant=resonant_displacements(model, prior, state, now, posterior),
        log_drive_covariance=_mixture(weights, magnitudes)[1],
        off=_off(displacements, end.noise),
        state=state,
    )


def _mixture(weights: Array, parts: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) of a mixture of distributions with both."""
    mean: Array = np.sum([w * each for w, (each, _) in zip(weights, parts, strict=True)], axis=0)
    spreads = [own + np.outer(each - mean, each - mean) for each, own in parts]
    return mean, np.asarray(np.tensordot(weights, spreads, axes=1))


def _spread(prior: Prior) -> Array:
    """Return the prior standard deviations (v, p) of all parameters; 0 where they are fixed."""
    spread: Array = np.zeros(prior.precision.shape)
    spread[prior.free] = prior.precision[prior.free] ** -0.5
    return spread


def _off(displacements: Displacements, noise: Noise) -> NDArray[np.bool_]:
    """Mask (k,) of holograms that are outliers or have no information."""
    off: NDArray[np.bool_] = (noise.inflation > 1) | ~np.any(displacements.information, axis=(1, 2))
    return off


def _effective_parameters(prior: Prior, data: Data, covariance: Array) -> float:
    """Return the effective number of parameters: those that the prior determines count in part."""
    own = prior.precision[prior.free]
    known = np.sum(own * np.diag(covariance)[: len(own)])
    shared = np.sum(data.precision * covariance[len(own) :, len(own) :])
    return float(len(covariance) - known - shared)
