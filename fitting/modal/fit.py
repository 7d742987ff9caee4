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
`fitting.holograms.object_field`). The discrepancy of the model is estimated from the residuals and
added to the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.errors import FitError
from fitting.holograms.displacement import Displacements
from fitting.holograms.shape_basis import ShapeBasis
from fitting.modal.drive_prior import drive_covariance
from fitting.modal.modal_fit import ModalFit
from fitting.modal.model import (
    KNOWN_DRIVE_DOF,
    LOSS,
    TAIL_TERMS,
    UNKNOWN_DRIVE_DOF,
    Model,
    Prior,
    State,
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
    equations,
)
from fitting.modal.optimiser import minimise_cost, without_drive
from holography.arrays import Array, ComplexArray

# Participations are polynomials of log frequency of this degree.
_DEGREE = 4
# Prior of a loss factor: within a factor of 1.5.
_LOSS_SPREAD = 0.4
# Shapes mix as if stiffness and mass were wrong by this fraction; largest and least coefficient.
_PERTURBATION, _MOST_MIXING, _LEAST_MIXING = 0.08, 0.5, 5e-3
# Prior of participations: within 3 times the value of the stage before.
_SCALE = 3.0
_LEAST_SCALE = 3e-3
# Added to the diagonal of a matrix of unit diagonal: more than its rounding.
_ROUNDING = 1e-11
# How often the discrepancy is estimated.
_ROUNDS = 3
# ... and how often if the modes are known from another fit.
_AGAIN = 2


@dataclass(frozen=True)
class _Stage:
    """Priors of one stage of the fit; they widen from stage to stage.

    Attributes
    ----------
    discrepancy : float
        Standard deviation of the discrepancy of the real or imaginary part of an amplitude, as a
        fraction of the hologram's rms amplitude.
    decay : float
        Ratio of the prior standard deviations of successive polynomial degrees of a participation.
    detuning : float
        Prior standard deviation of log frequencies.
    mixing : float
        Factor on the prior of the mixing of shapes.
    iterations : int
    """

    discrepancy: float
    decay: float
    detuning: float
    mixing: float
    iterations: int


_STAGES = (
    _Stage(0.3, 0.05, 0.01, 0.05, 1),
    _Stage(0.1, 0.3, 0.01, 0.3, 1),
    _Stage(0.03, 0.5, 0.01, 1.0, 1),
)
_LAST = _Stage(0.015, 0.7, 0.02, 1.0, 4)


def _prior(model: Model, stage: _Stage, centre_hz: Array, scale: Array) -> Prior:
    """Return the prior of a stage; `scale` (m,) is the expected size of participations."""
    count, powers = len(model.active), model.powers.shape[1]
    centre = np.zeros((count + len(model.reference), model.slots))
    spread = np.zeros_like(centre)
    degrees = stage.decay ** np.arange(powers)
    degrees[0] = _SCALE
    for part in (0, powers):
        spread[:count, part : part + powers] = scale[model.active, None] * degrees
    centre[:count, 2 * powers] = np.log(centre_hz)
    spread[:count, 2 * powers] = stage.detuning
    centre[:count, 2 * powers + 1], spread[:count, 2 * powers + 1] = np.log(LOSS), _LOSS_SPREAD
    mixing = stage.mixing * _mixing(model, centre_hz)
    spread[count:, :count] = np.where(_LEAST_MIXING * stage.mixing < mixing.T, mixing.T, 0)
    for part in (count, count + TAIL_TERMS):
        tail = scale[model.passive, None] * degrees[:TAIL_TERMS]
        spread[count + model.passive, part : part + TAIL_TERMS] = tail
    with np.errstate(divide="ignore"):
        return Prior(centre, spread**-2.0)


def _mixing(model: Model, centre_hz: Array) -> Array:
    """Return the prior standard deviation (a, m) of the mixing of each shape into a mode."""
    hz = model.reference_hz.copy()
    hz[model.active] = centre_hz
    squares = hz**2
    whitened_residual = np.abs(squares[model.active, None] - squares)
    near = np.sqrt(squares[model.active, None] * squares) / np.maximum(whitened_residual, 1e-9)
    mixing: Array = np.minimum(_PERTURBATION * near, _MOST_MIXING)
    mixing[np.arange(len(model.active)), model.active] = 0
    return mixing


def fit_modes(
    displacements: Displacements,
    basis: ShapeBasis,
    drive_hz: Array,
    volts: Array,
    start_hz: dict[str, float],
    known: ModalFit | None = None,
    most_off: int | None = None,
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
    most_off : int, optional
        If more holograms are outliers, the fit ends early: it is good enough to predict them.
    drive_dof : float, optional
        Degrees of freedom of the drive's prior, see `fitting.modal.model.Model`.

    Returns
    -------
    ModalFit
    """
    model, centre_hz = _model(basis, drive_hz, volts, start_hz, drive_dof)
    noise = noise_of(displacements)
    if known is None:
        state = _staged(model, displacements, noise, centre_hz)
        rounds, discrepancy = _ROUNDS, _LAST.discrepancy
    else:
        state = _again(known.state, known, displacements)
        rounds, discrepancy = _AGAIN, known.discrepancy
    prior, correlated = _prior(model, _LAST, centre_hz, _scale(model, state)), 1.0
    for _ in range(rounds):
        end = _round(model, displacements, noise, prior, state, (discrepancy, correlated))
        state, noise, discrepancy = end.state, end.noise, end.next_discrepancy
        if drive_dof == KNOWN_DRIVE_DOF:
            # Correlated holograms must not outweigh the known drive.
            correlated = correlated_holograms(noise, end.whitened_residual, state.log_drive)
        if most_off is not None and np.count_nonzero(_off(displacements, noise)) > most_off:
            break
    return _finish(model, displacements, basis.names, end)


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
        drive_covariance(drive_hz),
        powers,
        basis.shapes,
        reference_hz,
        basis.stiffening,
        active,
    )
    return model, centre_hz


def _staged(model: Model, displacements: Displacements, noise: Noise, centre_hz: Array) -> State:
    """Fit with priors that widen from stage to stage."""
    state, scale = _begin(model, displacements)
    for stage in _STAGES:
        prior = _prior(model, stage, centre_hz, scale)
        data = data_of(displacements, noise, stage.discrepancy)
        state = minimise_cost(model, data, prior, _fixed(prior, state), stage.iterations)
        scale = _scale(model, state)
    return state


def _again(state: State, known: ModalFit, displacements: Displacements) -> State:
    """Start from known modes: only the drive of every hologram is fitted to the displacements."""
    unit = known.amplitude_rad / known.drive[:, None]
    drive = np.sum(unit.conj() * displacements.amplitude_rad, axis=1)
    drive = np.where(np.abs(drive) > 0, drive / np.sum(np.abs(unit) ** 2, axis=1), known.drive)
    return replace(
        state, log_drive=np.log(drive), common_mode_shift=np.zeros_like(state.common_mode_shift)
    )


def _fixed(prior: Prior, state: State) -> State:
    """Set fixed parameters to their prior values."""
    return replace(state, x=np.where(prior.free, state.x, prior.centre))


def _scale(model: Model, state: State) -> Array:
    """Return the rms participation (m,) of each mode."""
    p = terms(model, state).participation
    scale: Array = np.maximum(np.sqrt(np.mean(np.abs(p) ** 2, axis=0)), _LEAST_SCALE)
    return scale


def _begin(model: Model, displacements: Displacements) -> tuple[State, Array]:
    """Find the constant participations for which holograms are most nearly multiples of a model."""
    known = np.any(displacements.amplitude_rad, axis=1)
    amplitude, information = displacements.amplitude_rad[known], displacements.information[known]
    size, modes = amplitude.shape[1], len(model.reference)
    real, cross, imaginary = (
        information[:, :size, :size],
        information[:, size:, :size] - information[:, :size, size:],
        information[:, size:, size:],
    )
    hermitian = 0.5 * (real + imaginary) + 0.5j * cross
    ratio = (model.hz[known, None] / model.reference_hz) ** (2 - model.stiffening)
    columns = (1 / (1 + 1j * LOSS - ratio))[:, None, :] * model.reference.T
    seen = hermitian @ columns
    force = np.einsum("kij,kj->ki", hermitian, amplitude)
    power = np.einsum("ki,ki->k", amplitude.conj(), force).real
    along = np.einsum("kim,ki->km", columns.conj(), force)
    whole = np.einsum("kim,kin,k->mn", columns.conj(), seen, 1 / power, optimize=True)
    explained = np.einsum("km,kn,k->mn", along, along.conj(), 1 / power**2, optimize=True)
    weak = 1e-5 * np.trace(whole).real / modes * np.eye(modes)
    p = linalg.eigh(whole - explained, whole + weak)[1][:, 0]
    p = p / np.abs(p).max()
    expected = columns @ p
    drive = np.einsum("ki,ki->k", expected.conj(), amplitude)
    drive = drive / np.sum(np.abs(expected) ** 2, axis=1)
    # Holograms without information get the drive of their neighbours.
    log_drive = np.interp(np.log(model.hz), np.log(model.hz[known]), np.log(np.abs(drive))) + 0j
    log_drive[known] = np.log(drive)
    common_mode_shift = np.zeros(len(displacements.common_mode.precision))
    state = State(_constant(model, p), log_drive, common_mode_shift)
    return state, np.maximum(np.abs(p), _LEAST_SCALE)


def _constant(model: Model, p: ComplexArray) -> Array:
    """Return parameters (v, p): constant participations, expected loss factors, no mixing."""
    count, powers = len(model.active), model.powers.shape[1]
    x = np.zeros((count + len(model.reference), model.slots))
    x[:count, 0], x[:count, powers] = p[model.active].real, p[model.active].imag
    x[:count, 2 * powers] = np.log(model.reference_hz[model.active])
    x[:count, 2 * powers + 1] = np.log(LOSS)
    rest = p[model.passive]
    x[count + model.passive, count] = rest.real
    x[count + model.passive, count + TAIL_TERMS] = rest.imag
    return x


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
    whitened_residual : (k, 2j) float
        Residuals along the noise's directions, in standard deviations.
    misfit : float
        Sum of their squares, divided by the degrees of freedom.
    discrepancy, next_discrepancy : float
        Discrepancy that was used, and the one that the residuals give.
    noise : Noise
        Noise with the variance of outliers increased.
    """

    prior: Prior
    state: State
    here: Equations
    covariance: Array
    whitened_residual: Array
    misfit: float
    discrepancy: float
    next_discrepancy: float
    noise: Noise


def _round(
    model: Model,
    displacements: Displacements,
    noise: Noise,
    prior: Prior,
    state: State,
    off: tuple[float, float],
) -> _Round:
    """Minimise the cost, and estimate the discrepancy for which χ² is as expected.

    `off` is the discrepancy, and the number of holograms that count as one independent hologram.
    """
    discrepancy, correlated = off
    data = data_of(displacements, noise, discrepancy)
    start = _fixed(prior, state)
    state = minimise_cost(model, data.weighing(1 / correlated), prior, start, _LAST.iterations)
    state = with_gain(model, state)
    here = equations(model, data, prior, state)
    covariance = _inverse(without_drive(here, 0.0, np.float64)[0])
    freedoms = (
        2 * data.amplitude.size - 2 * len(model.hz) - _effective_parameters(prior, data, covariance)
    )
    whitened_residual = data.whitened_residual(
        terms(model, state).amplitude, state.common_mode_shift
    )
    left = whitened_residual * noise.deviation(discrepancy)
    return _Round(
        prior=prior,
        state=state,
        here=here,
        covariance=covariance,
        whitened_residual=whitened_residual,
        misfit=float(np.sum(whitened_residual**2)) / freedoms,
        discrepancy=discrepancy,
        next_discrepancy=balanced(inflated(noise, whitened_residual), left, freedoms),
        noise=inflated(noise, whitened_residual),
    )


def _finish(
    model: Model, displacements: Displacements, names: Sequence[str], end: _Round
) -> ModalFit:
    """Return modes and standard errors."""
    prior, state, now = end.prior, end.state, terms(model, end.state)
    # χ² of the last round is not exactly as expected, and neighbouring residuals are correlated.
    factor = end.misfit * correlated_holograms(end.noise, end.whitened_residual, state.log_drive)
    # Drive and participations have an undetermined common factor: the errors of participations are
    # those for a given drive.
    given_drive = factor * _inverse(end.here.matrix)
    count, powers = len(model.active), model.powers.shape[1]
    spread = np.zeros_like(state.x)
    deviations = np.sqrt(factor * np.diag(end.covariance))
    spread[prior.free] = deviations[: np.count_nonzero(prior.free)]
    own_hz = np.exp(state.x[:count, 2 * powers])
    number = np.full(prior.centre.shape, -1)
    number[prior.free] = np.arange(np.count_nonzero(prior.free))
    own = np.concatenate([number[:count, 2 * powers], number[:count, 2 * powers + 1]])
    mixes = prior.free[count:, :count]
    nearest = np.abs(np.log(model.hz[:, None] / own_hz)).argmin(axis=0)
    return ModalFit(
        names=tuple(names[m] for m in model.active),
        hz=own_hz,
        error_cents=spread[:count, 2 * powers] * 1200 / np.log(2),
        loss_factor=now.loss[model.active],
        loss_error=spread[:count, 2 * powers + 1],
        covariance=factor * end.covariance[np.ix_(own, own)],
        shapes=now.shapes[model.active],
        mixing=np.where(mixes, state.x[count:, :count], 0.0),
        mixing_error=np.where(mixes, spread[count:, :count], 0.0),
        mixing_spread=np.where(mixes, _spread(prior)[count:, :count], 0.0),
        participation=now.participation[nearest, model.active],
        participation_error=_participation_error(model, prior, given_drive, nearest),
        participations=now.participation[:, model.active],
        drive=np.exp(state.log_drive),
        amplitude_rad=now.amplitude,
        modal_rad=now.modal[:, model.active],
        misfit=end.misfit,
        discrepancy=end.discrepancy,
        common_mode_shift=state.common_mode_shift,
        off=_off(displacements, end.noise),
        state=state,
    )


def _spread(prior: Prior) -> Array:
    """Return the prior standard deviations (v, p) of all parameters; 0 where they are fixed."""
    spread: Array = np.zeros(prior.precision.shape)
    spread[prior.free] = prior.precision[prior.free] ** -0.5
    return spread


def _off(displacements: Displacements, noise: Noise) -> NDArray[np.bool_]:
    """Mask (k,) of holograms that are outliers or have no information."""
    off: NDArray[np.bool_] = (noise.inflation > 1) | ~np.any(displacements.information, axis=(1, 2))
    return off


def _inverse(matrix: Array) -> Array:
    """Invert a positive definite matrix of parameters of very different sizes.

    Raises
    ------
    FitError
        If the matrix is not positive definite because of rounding.
    """
    unit = 1 / np.sqrt(np.diag(matrix))
    scaled = unit[:, None] * matrix * unit + _ROUNDING * np.eye(len(unit))
    try:
        root = linalg.cholesky(scaled, lower=True)
    except (np.linalg.LinAlgError, ValueError):
        raise FitError(
            "the holograms cannot separate the modes of this reed; look at the contact sheet "
            "that acquire report writes, or count fringes: --method picture"
        ) from None
    (solve,) = linalg.get_blas_funcs(("trsm",), (root,))
    half = solve(1.0, root, np.diag(unit), lower=1)
    inverse: Array = half.T @ half
    return inverse


def _effective_parameters(prior: Prior, data: Data, covariance: Array) -> float:
    """Return the effective number of parameters: those that the prior determines count in part."""
    known = np.concatenate([prior.precision[prior.free], np.diag(data.precision)])
    return float(len(known) - np.sum(known * np.diag(covariance)))


def _participation_error(
    model: Model, prior: Prior, covariance: Array, nearest: NDArray[np.intp]
) -> Array:
    """Return standard errors (a,) of participations at the holograms nearest to the modes."""
    number = np.full(prior.centre.shape, -1)
    number[prior.free] = np.arange(np.count_nonzero(prior.free))
    powers, errors = model.powers.shape[1], []
    for a, k in enumerate(nearest):
        variance = 0.0
        for part in (0, powers):
            which = number[a, part : part + powers]
            at = model.powers[k]
            variance += float(at @ covariance[np.ix_(which, which)] @ at)
        errors.append(np.sqrt(variance))
    return np.array(errors)
