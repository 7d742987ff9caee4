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
`fitting.holograms.object_field`); it drifts slowly. Modes are a little out of phase (see
`fitting.modal.losses`). The discrepancy of the model is estimated from the residuals and
added to the noise, and the ripple of the drive and its lines from the drive that was found.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements
from fitting.modal.drive.prior import HELD_LEVEL, DriveForm, quiet_ripple
from fitting.modal.expected.prior import Prior
from fitting.modal.field_drift import (
    FieldDrift,
    covariance_by_other_changes,
    magnitude_error,
)
from fitting.modal.first_state import FIRST_SCATTER, at_level, participation_scale, staged
from fitting.modal.losses import connected_by, expected_shared, forms_of, shared_drift
from fitting.modal.modal_fit import ModalFit
from fitting.modal.model import DRIVE_DOF, LOSS_PARAMETERS, Model, State, stage_prior, terms
from fitting.modal.noise import Noise, noise_of
from fitting.modal.optimiser import inverse
from fitting.modal.posterior import (
    Posterior,
    ResonantDisplacements,
    participations,
    resonant_displacements,
)
from fitting.modal.rounds import (
    LAST,
    Given,
    Influence,
    Optimum,
    Round,
    Scatter,
    in_rounds,
    influence,
    likeliest,
    one_round,
    probabilities,
)
from fitting.modal.search import IMPROBABLE, ROUNDS, searched
from holography.arrays import Array

# Participations are polynomials of frequency of this degree: the shape of the pressure on the reed
# changes with the length of chamber and reed in wavelengths. What waves from 1 to 20 kHz have of a
# higher degree is below the noise of displacements (decisions 0045 and 0057).
_DEGREE = 6
# How often the discrepancy is estimated if the modes are known from another fit.
_AGAIN = 2
# Optima below this probability do not count for displacements. Chosen: they move a mean by a
# hundredth of what they differ by.
_LEAST_WEIGHT = 0.01
# Levenberg-Marquardt steps in a round of a rough fit. With 4, and 1 in a stage, rough fits of two
# sweeps took a fifth less time, and one of them left 3 outliers in place of none.
_ROUGH_STEPS = 6


def fit_modes(
    displacements: Displacements,
    basis: ShapeBasis,
    drive_hz: Array,
    volts: Array,
    start_hz: dict[str, float],
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

    Returns
    -------
    ModalFit
    """
    model, centre_hz = _model(basis, drive_hz, volts, start_hz)
    model, given, state = _begun(model, displacements, shared_drift(displacements), centre_hz)
    end, given = in_rounds(model, given, state, FIRST_SCATTER, ROUNDS)
    optima = searched(model, given, end.state, end.next_scatter, centre_hz).optima
    return _finish(displacements, basis.names, optima)


def fit_roughly(
    displacements: Displacements,
    basis: ShapeBasis,
    drive_hz: Array,
    volts: Array,
    start_hz: dict[str, float],
    known: ModalFit | None = None,
) -> ModalFit:
    """Fit the joint model of a sweep, but for the ripple and the lines of the drive.

    It predicts displacements well enough for a better fit of these.

    Parameters
    ----------
    displacements, basis, drive_hz, volts, start_hz
        See `fit_modes`.
    known : ModalFit, optional
        Start of the fit.

    Returns
    -------
    ModalFit
    """
    model, centre_hz = _model(basis, drive_hz, volts, start_hz)
    drift = shared_drift(displacements)
    if known is None:
        model, given, state = _begun(model, displacements, drift, centre_hz)
        rounds, scatter = ROUNDS, FIRST_SCATTER
    else:
        model, given, state = _again(model, known, displacements, drift, centre_hz)
        rounds, scatter = _AGAIN, _scatter_of(known)
    end, _ = in_rounds(model, given, state, scatter, rounds, _ROUGH_STEPS)
    return _finish(displacements, basis.names, [Optimum.of(end)])


def fit_modes_with_known_drive(
    displacements: Displacements,
    basis: ShapeBasis,
    drive_hz: Array,
    start_hz: dict[str, float],
    known: ModalFit,
) -> ModalFit:
    """Fit the joint model of a sweep whose drive has a form that another fit has found.

    The form is where a drive ripples, and how much, and its lines; the drive itself is fitted
    again (decision 0051).

    Parameters
    ----------
    displacements : Displacements
        Displacements of the k holograms.
    basis : ShapeBasis
    drive_hz : (k,) float
        Drive frequencies.
    start_hz : dict
        See `fit_modes`.
    known : ModalFit
        Start of the fit. Its drive, and the forms of this, are those expected of this sweep.

    Returns
    -------
    ModalFit
    """
    models = []
    for form in known.drive_forms:
        bare, centre_hz = _model(basis, drive_hz, np.exp(form.log_magnitude), start_hz)
        models.append(replace(bare, ripple=form.ripple, line_weight=form.log_probability))
    drift = shared_drift(displacements)
    model, given, state = _again(models[0], known, displacements, drift, centre_hz)
    end, given = in_rounds(model, given, state, _scatter_of(known), _AGAIN - 1)
    state, scatter = end.state, end.next_scatter
    levelled = [at_level(each, state) for each in models]
    optima = [Optimum.of(one_round(each, given, state, scatter)) for each in levelled]
    return _finish(displacements, basis.names, optima)


def _model(
    basis: ShapeBasis, drive_hz: Array, volts: Array, start_hz: dict[str, float]
) -> tuple[Model, Array]:
    """Set up the model; also return the start frequencies (a,) of the active modes."""
    active = np.array([m for m, name in enumerate(basis.names) if name in start_hz])
    centre_hz = np.array([start_hz[basis.names[m]] for m in active])
    middle_hz = 0.5 * (drive_hz[0] + drive_hz[-1])
    spread = (drive_hz - middle_hz) / (drive_hz[-1] - middle_hz)
    powers = np.polynomial.chebyshev.chebvander(spread, _DEGREE)
    shifts = np.log(centre_hz / basis.hz[active])
    reference_hz = basis.hz * np.exp(np.median(shifts))
    reference_hz[active] = centre_hz
    count = len(reference_hz)
    model = Model(
        drive_hz,
        np.log(volts),
        DRIVE_DOF,
        quiet_ripple(drive_hz, HELD_LEVEL),
        powers,
        basis.shapes,
        reference_hz,
        basis.stiffening,
        active,
        forms_of(basis, reference_hz, drive_hz),
        np.zeros((2, count, count)),
        np.zeros((len(drive_hz), count, count)),
        np.zeros((3, count)),
    )
    return connected_by(model, np.eye(count)), centre_hz


def _begun(
    model: Model, displacements: Displacements, drift: FieldDrift, centre_hz: Array
) -> tuple[Model, Given, State]:
    """Start from the displacements alone."""
    noise = noise_of(displacements)
    model, state = staged(model, displacements, noise, drift, centre_hz)
    return model, Given(displacements, drift, noise, _last_prior(model, state, centre_hz)), state


def _again(
    model: Model, known: ModalFit, displacements: Displacements, drift: FieldDrift, centre_hz: Array
) -> tuple[Model, Given, State]:
    """Start from known modes: only the drive of every hologram is fitted to the displacements.

    What modes lose belongs to these modes; other parameters of the light do not.
    """
    noise = noise_of(displacements)
    unit = known.amplitude_rad / known.drive[:, None]
    drive = np.sum(unit.conj() * displacements.amplitude_rad, axis=1)
    drive = np.where(np.abs(drive) > 0, drive / np.sum(np.abs(unit) ** 2, axis=1), known.drive)
    shared = expected_shared(drift)
    shared[:LOSS_PARAMETERS] = known.state.loss_parameters
    state = replace(known.state, log_drive=np.log(drive), shared=shared)
    model = at_level(model, state)
    return model, Given(displacements, drift, noise, _last_prior(model, state, centre_hz)), state


def _last_prior(model: Model, state: State, centre_hz: Array) -> Prior:
    return stage_prior(model, LAST, centre_hz, participation_scale(model, state))


def _scatter_of(known: ModalFit) -> Scatter:
    """Return the scatter to start from, if modes are known."""
    return replace(
        FIRST_SCATTER,
        discrepancy=known.discrepancy,
        walk=known.field_walk,
        mixing=known.mixing_factor,
    )


def _finish(
    displacements: Displacements, names: Sequence[str], optima: Sequence[Optimum]
) -> ModalFit:
    """Return modes and standard errors.

    Frequencies, losses, displacements and their errors are averages over all optima, by their
    probability; all else is that of the best.
    """
    best = likeliest(optima)
    weights = probabilities(optima)
    logs, covariance = _mixture(weights, [(each.logs, each.covariance) for each in optima])
    magnitudes = [(each.end.state.log_drive.real, each.magnitude_covariance) for each in optima]
    model, end, factor = best.model, best.end, best.factor
    prior, state, now = end.prior, end.state, terms(model, end.state)
    posterior, count = Posterior.of(end.here, end.covariance, factor), len(model.active)
    shared, off = posterior.shared(len(state.shared)), _off(displacements, end.noise)
    # The first values are no error of the light.
    of_light = end.drift.covariance(shared)[:, LOSS_PARAMETERS:, LOSS_PARAMETERS:]
    alone = resonant_displacements(model, prior, state, now, posterior, off)
    follow, resonant = influence(best, alone), _as_others(displacements, optima, weights, alone)
    spread = _in_rows(prior, np.sqrt(factor * np.diag(end.covariance)))
    (own_hz, own_loss), mixes = np.exp(logs.reshape(2, -1)), prior.free[count:, :count]
    # Drive and participations have an undetermined common factor: the errors of participations are
    # those for a given drive.
    given_drive = factor * inverse(end.here.matrix)
    at_resonance = participations(model, prior, state, given_drive, own_hz)
    error_cents, loss_error = np.sqrt(np.diag(covariance)).reshape(2, -1)
    return ModalFit(
        names=tuple(names[m] for m in model.active),
        hz=own_hz,
        error_cents=error_cents * 1200 / np.log(2),
        loss_factor=own_loss,
        loss_error=loss_error,
        covariance=covariance,
        influence=follow.amplitudes,
        shapes=now.shapes[model.active],
        mixing=np.where(mixes, state.x[count:, :count], 0.0),
        mixing_error=np.where(mixes, spread[count:, :count], 0.0),
        mixing_spread=prior.spread[count:, :count],
        mixing_factor=end.scatter.mixing,
        participation=at_resonance.received,
        participation_error=at_resonance.received_error,
        by_pressure=at_resonance.by_pressure,
        by_pressure_error=at_resonance.by_pressure_error,
        participations=now.participation[:, model.active],
        drive=np.exp(state.log_drive),
        amplitude_rad=now.amplitude,
        modal_rad=now.modal[:, model.active],
        misfit=end.misfit,
        discrepancy=end.scatter.discrepancy,
        common_mode_shift=end.common_mode_shift,
        field_walk=end.scatter.walk,
        common_mode_covariance=of_light,
        magnitude_error=_magnitude_error(displacements, end, shared),
        resonant=resonant,
        log_drive_covariance=_mixture(weights, magnitudes)[1],
        drive_forms=_drive_forms(optima, weights),
        off=off,
        state=state,
    ).with_errors(_by_other_changes(displacements, end, follow))


def _as_others(
    displacements: Displacements,
    optima: Sequence[Optimum],
    weights: Array,
    best: ResonantDisplacements,
) -> ResonantDisplacements:
    """Return the displacements of the best optimum with the sizes, and errors, of all (n,)."""
    logs = []
    for each, weight in zip(optima, weights, strict=True):
        end, own = each.end, best
        if weight > _LEAST_WEIGHT and each is not likeliest(optima):
            own = resonant_displacements(
                each.model,
                end.prior,
                end.state,
                terms(each.model, end.state),
                Posterior.of(end.here, end.covariance, each.factor),
                _off(displacements, end.noise),
            )
        logs.append(np.log(np.linalg.norm(own.amplitude_rad, axis=1)))
    mean = weights @ np.array(logs)
    factor = np.exp(mean - np.log(np.linalg.norm(best.amplitude_rad, axis=1)))
    sized = replace(
        best,
        amplitude_rad=factor[:, None] * best.amplitude_rad,
        covariance=factor[:, None, None] ** 2 * best.covariance,
    )
    return sized.with_errors(weights @ (np.array(logs) - mean) ** 2)


def _by_other_changes(displacements: Displacements, end: Round, follow: Influence) -> Array:
    """Return the covariance (3a, 3a) of logs by changes of light that the fit does not follow."""
    renewal, ranks = displacements.common_mode.renewal, displacements.recording_rank
    if renewal is None:
        return np.zeros((len(follow.light),) * 2)
    walk = end.scatter.walk
    return covariance_by_other_changes(end.drift, ranks, renewal, walk, follow.light)


def _magnitude_error(displacements: Displacements, end: Round, covariance: Array) -> Array:
    """Return the standard error (k,) of the light's magnitude; that of what is shared is given."""
    return magnitude_error(
        end.drift,
        displacements.common_mode,
        displacements.recording_rank,
        end.state.shared,
        covariance,
        end.scatter.walk,
    )


def _mixture(weights: Array, parts: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) of a mixture of distributions with both."""
    mean: Array = np.sum([w * each for w, (each, _) in zip(weights, parts, strict=True)], axis=0)
    spreads = [own + np.outer(each - mean, each - mean) for each, own in parts]
    return mean, np.asarray(np.tensordot(weights, spreads, axes=1))


def _drive_forms(optima: Sequence[Optimum], weights: Array) -> tuple[DriveForm, ...]:
    """Return the explanations of the drive that are not improbable, the best first."""
    best = likeliest(optima)
    order = sorted(zip(optima, weights, strict=True), key=lambda each: each[0] is not best)
    return tuple(
        DriveForm(each.model.log_volts, each.model.ripple, float(np.log(weight)))
        for each, weight in order
        if each is best or weight >= IMPROBABLE
    )


def _in_rows(prior: Prior, of_parameters: Array) -> Array:
    """Return numbers of the free parameters, and of others behind them, in rows (v, p); else 0."""
    rows = np.zeros(prior.precision.shape)
    rows[prior.free] = of_parameters[: np.count_nonzero(prior.free)]
    return rows


def _off(displacements: Displacements, noise: Noise) -> NDArray[np.bool_]:
    """Mask (k,) of holograms that are outliers or have no information."""
    off: NDArray[np.bool_] = (noise.inflation > 1) | ~np.any(displacements.information, axis=(1, 2))
    return off
