"""One joint model of a whole sweep: shared modes, each with its frequency, loss and shape.

The displacement of hologram k, in coordinates j of few functions, is

    a_kj = d_k Σ_m h_m(f_k) p_m(f_k) T_mj,    h_m(f) = 1 / (1 + iη_m − (f/f_m)^(2 − γ_m))

with the known exponents γ_m of cane that stiffens with frequency, the shared eigenfrequencies f_m
and loss factors η_m, shapes ``T_mj = Σ_n (δ_mn + E_mn) S_nj`` near those S of the finite elements,
participations p_m(f), complex and smooth, and the drive d_k: its phase is free, since nobody knows
that of a hologram; its magnitude follows the volts, smoothly but for lines of the air. A hologram
therefore tells by the balance of its modes as much as by its strength how near each of them is to
its resonance.

All is found by one damped least squares against the amplitudes of `fitting.holograms.displacement`
and their information. Shapes are allowed to differ from those of the finite elements as
perturbations let them: the more, the closer two modes are. Displacements may all be off together,
as far as light and vibration cannot be told apart (see `fitting.holograms.object_field`). What
amplitudes are off beyond their noise, because no model is perfect, is estimated from what is left
and added to the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.errors import FitError
from fitting.holograms.displacement import Displacements
from fitting.holograms.shape_basis import ShapeBasis
from fitting.modal.modal_fit import ModalFit
from fitting.modal.model import (
    KNOWN_LINES,
    LOSS,
    TAIL_TERMS,
    UNKNOWN_LINES,
    Model,
    Prior,
    State,
    terms,
    with_gain,
)
from fitting.modal.noise import (
    Noise,
    alike,
    balanced,
    data_of,
    inflated,
    noise_of,
)
from fitting.modal.normal_equations import (
    Data,
    Equations,
    equations,
)
from fitting.modal.optimiser import improve, without_drive

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

# Participations are polynomials of log frequency of this degree.
_DEGREE = 4
# Prior of a loss factor: within a factor of 1.5.
_LOSS_SPREAD = 0.4
# Shapes mix as if stiffness and mass were off by this share; no two more than that.
_PERTURBATION, _MOST_MIXING, _LEAST_MIXING = 0.08, 0.5, 5e-3
# Participations are expected to be within 3 times of what the stage before found.
_SCALE = 3.0
_LEAST_SCALE = 3e-3
# What rounding may take off the smallest eigenvalues of a matrix of units.
_ROUNDING = 1e-11
# How often it is estimated what amplitudes are off beyond their noise.
_ROUNDS = 3
# ... and how often if the modes are known.
_AGAIN = 2


@dataclass(frozen=True)
class _Stage:
    """One round of the fit: freedoms grow from round to round.

    Attributes
    ----------
    discrepancy : float
        Standard deviation of what either part of each amplitude may be off, as a share of the root
        mean square of its hologram's.
    decay : float
        Of the prior of participations, from each power of log frequency to the next.
    detuning : float
        Prior standard deviation of frequencies, a share.
    mixing : float
        Factor on the prior of the shapes' mixing.
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
    """Prior of a stage; `scale` (m,) are the participations expected."""
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
    """Prior standard deviation (a, m) of how much of each mode's shape another may take up."""
    hz = model.reference_hz.copy()
    hz[model.active] = centre_hz
    squares = hz**2
    apart = np.abs(squares[model.active, None] - squares)
    near = np.sqrt(squares[model.active, None] * squares) / np.maximum(apart, 1e-9)
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
    lines: float = UNKNOWN_LINES,
) -> ModalFit:
    """Fit the joint model of a sweep.

    Parameters
    ----------
    displacements : Displacements
        Of its k holograms.
    basis : ShapeBasis
    drive_hz, volts : (k,) float
        If the drive is known better than by its volts, that.
    start_hz : dict
        Where the search for each mode begins, by name: all modes of the basis with a resonance
        within the sweep, seen or not.
    known : ModalFit, optional
        Of the same sweep, to begin with.
    most_off : int, optional
        If more holograms are off the fit ends early: good enough to tell what they should show.
    lines : float, optional
        How much the drive may stand out of what it is expected to be, see
        `fitting.modal.model.Model`.

    Returns
    -------
    ModalFit
    """
    active = np.array([m for m, name in enumerate(basis.names) if name in start_hz])
    centre_hz = np.array([start_hz[basis.names[m]] for m in active])
    spread = np.log(drive_hz / np.sqrt(drive_hz[0] * drive_hz[-1]))
    powers = np.polynomial.chebyshev.chebvander(spread / spread[-1], _DEGREE)
    shifts = np.log(centre_hz / basis.hz[active])
    reference_hz = basis.hz * np.exp(np.median(shifts))
    reference_hz[active] = centre_hz
    model = Model(
        drive_hz, np.log(volts), lines, powers, basis.shapes, reference_hz, basis.stiffening, active
    )
    noise = noise_of(displacements)
    if known is None:
        state = _staged(model, displacements, noise, centre_hz)
        rounds, discrepancy = _ROUNDS, _LAST.discrepancy
    else:
        state = _again(known.state, known, displacements)
        rounds, discrepancy = _AGAIN, known.discrepancy
    prior, together = _prior(model, _LAST, centre_hz, _scale(model, state)), 1.0
    for _ in range(rounds):
        end = _round(model, displacements, noise, prior, state, (discrepancy, together))
        state, noise, discrepancy = end.state, end.noise, end.next_discrepancy
        if lines == KNOWN_LINES:
            # What is known of the drive is not to be outweighed by what counts twice.
            together = alike(noise, end.apart, state.log_drive)
        if most_off is not None and np.count_nonzero(_off(displacements, noise)) > most_off:
            break
    return _finish(model, displacements, basis.names, end)


def _staged(model: Model, displacements: Displacements, noise: Noise, centre_hz: Array) -> State:
    """Let freedoms grow from stage to stage."""
    state, scale = _begin(model, displacements)
    for stage in _STAGES:
        prior = _prior(model, stage, centre_hz, scale)
        data = data_of(displacements, noise, stage.discrepancy)
        state = improve(model, data, prior, _fixed(prior, state), stage.iterations)
        scale = _scale(model, state)
    return state


def _again(state: State, known: ModalFit, displacements: Displacements) -> State:
    """Begin with modes that are known: only the drive of every hologram is to be found."""
    unit = known.amplitude_rad / known.drive[:, None]
    drive = np.sum(unit.conj() * displacements.amplitude_rad, axis=1)
    drive = np.where(np.abs(drive) > 0, drive / np.sum(np.abs(unit) ** 2, axis=1), known.drive)
    return replace(state, log_drive=np.log(drive), together=np.zeros_like(state.together))


def _fixed(prior: Prior, state: State) -> State:
    """Put parameters that are not free where they are expected."""
    return replace(state, x=np.where(prior.free, state.x, prior.centre))


def _scale(model: Model, state: State) -> Array:
    """Root of the mean square (m,) of the participations."""
    p = terms(model, state).participation
    scale: Array = np.maximum(np.sqrt(np.mean(np.abs(p) ** 2, axis=0)), _LEAST_SCALE)
    return scale


def _begin(model: Model, displacements: Displacements) -> tuple[State, Array]:
    """Constant participations for which every hologram is most nearly a multiple of the model."""
    told = np.any(displacements.amplitude_rad, axis=1)
    amplitude, information = displacements.amplitude_rad[told], displacements.information[told]
    size, modes = amplitude.shape[1], len(model.reference)
    real, cross, imaginary = (
        information[:, :size, :size],
        information[:, size:, :size] - information[:, :size, size:],
        information[:, size:, size:],
    )
    hermitian = 0.5 * (real + imaginary) + 0.5j * cross
    ratio = (model.hz[told, None] / model.reference_hz) ** (2 - model.stiffening)
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
    # Of holograms that tell nothing, as loud as their neighbours.
    log_drive = np.interp(np.log(model.hz), np.log(model.hz[told]), np.log(np.abs(drive))) + 0j
    log_drive[told] = np.log(drive)
    together = np.zeros(len(displacements.shared.precision))
    state = State(_constant(model, p), log_drive, together)
    return state, np.maximum(np.abs(p), _LEAST_SCALE)


def _constant(model: Model, p: Complex) -> Array:
    """Parameters (v, p) of constant participations, the loss expected, and shapes as they are."""
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
    """Where the last round has come.

    Attributes
    ----------
    prior : Prior
    state : State
    here : Equations
    covariance : (q, q) float
        Of all parameters but the drive.
    apart : (k, 2j) float
        What is left, in deviations along the noise's directions.
    misfit : float
        Its mean square, by freedom.
    discrepancy, next_discrepancy : float
        That it was found with, and what is left of.
    noise : Noise
        As it is known now.
    """

    prior: Prior
    state: State
    here: Equations
    covariance: Array
    apart: Array
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
    """Improve, and estimate the discrepancy that makes what is left as large as it should be.

    `off` is the discrepancy, and how many holograms tell as much as one would by itself: beside
    what is known of the drive, so many count as one.
    """
    discrepancy, together = off
    data = data_of(displacements, noise, discrepancy)
    start = _fixed(prior, state)
    state = improve(model, data.weighing(1 / together), prior, start, _LAST.iterations)
    state = with_gain(model, state)
    here = equations(model, data, prior, state)
    covariance = _inverse(without_drive(here, 0.0, np.float64)[0])
    freedoms = 2 * data.amplitude.size - 2 * len(model.hz) - _told(prior, data, covariance)
    apart = data.apart(terms(model, state).amplitude, state.together)
    left = apart * noise.deviation(discrepancy)
    return _Round(
        prior=prior,
        state=state,
        here=here,
        covariance=covariance,
        apart=apart,
        misfit=float(np.sum(apart**2)) / freedoms,
        discrepancy=discrepancy,
        next_discrepancy=balanced(inflated(noise, apart), left, freedoms),
        noise=inflated(noise, apart),
    )


def _finish(
    model: Model, displacements: Displacements, names: Sequence[str], end: _Round
) -> ModalFit:
    """Tell modes and their errors."""
    prior, state, now = end.prior, end.state, terms(model, end.state)
    # The discrepancy of the last round left somewhat more or less than it should.
    factor = end.misfit * alike(end.noise, end.apart, state.log_drive)
    # Drive and participations have a common factor, which may be anything: of the latter only what
    # they are beside a given drive counts.
    beside_drive = factor * _inverse(end.here.matrix)
    count, powers = len(model.active), model.powers.shape[1]
    spread = np.zeros_like(state.x)
    deviations = np.sqrt(factor * np.diag(end.covariance))
    spread[prior.free] = deviations[: np.count_nonzero(prior.free)]
    own_hz = np.exp(state.x[:count, 2 * powers])
    number = np.full(prior.centre.shape, -1)
    number[prior.free] = np.arange(np.count_nonzero(prior.free))
    told = np.concatenate([number[:count, 2 * powers], number[:count, 2 * powers + 1]])
    mixes = prior.free[count:, :count]
    nearest = np.abs(np.log(model.hz[:, None] / own_hz)).argmin(axis=0)
    return ModalFit(
        names=tuple(names[m] for m in model.active),
        hz=own_hz,
        error_cents=spread[:count, 2 * powers] * 1200 / np.log(2),
        loss_factor=now.loss[model.active],
        loss_error=spread[:count, 2 * powers + 1],
        covariance=factor * end.covariance[np.ix_(told, told)],
        shapes=now.shapes[model.active],
        mixing=np.where(mixes, state.x[count:, :count], 0.0),
        mixing_error=np.where(mixes, spread[count:, :count], 0.0),
        mixing_spread=np.where(mixes, _spread(prior)[count:, :count], 0.0),
        participation=now.participation[nearest, model.active],
        participation_error=_participation_error(model, prior, beside_drive, nearest),
        participations=now.participation[:, model.active],
        drive=np.exp(state.log_drive),
        amplitude_rad=now.amplitude,
        modal_rad=now.modal[:, model.active],
        misfit=end.misfit,
        discrepancy=end.discrepancy,
        together=state.together,
        off=_off(displacements, end.noise),
        state=state,
    )


def _spread(prior: Prior) -> Array:
    """Standard deviations (v, p) that parameters were expected to have; 0 where they are fixed."""
    spread: Array = np.zeros(prior.precision.shape)
    spread[prior.free] = prior.precision[prior.free] ** -0.5
    return spread


def _off(displacements: Displacements, noise: Noise) -> NDArray[np.bool_]:
    """Which holograms (k,) show something else, or nothing."""
    off: NDArray[np.bool_] = (noise.inflation > 1) | ~np.any(displacements.information, axis=(1, 2))
    return off


def _inverse(matrix: Array) -> Array:
    """Inverse of a positive matrix of parameters of very different sizes.

    Raises
    ------
    FitError
        If rounding has left none of it.
    """
    unit = 1 / np.sqrt(np.diag(matrix))
    scaled = unit[:, None] * matrix * unit + _ROUNDING * np.eye(len(unit))
    try:
        root = linalg.cholesky(scaled, lower=True)
    except (np.linalg.LinAlgError, ValueError):
        raise FitError(
            "the holograms do not tell the modes of this reed apart; look at the contact sheet "
            "that acquire report writes, or count fringes: --method picture"
        ) from None
    (solve,) = linalg.get_blas_funcs(("trsm",), (root,))
    half = solve(1.0, root, np.diag(unit), lower=1)
    inverse: Array = half.T @ half
    return inverse


def _told(prior: Prior, data: Data, covariance: Array) -> float:
    """How many parameters the data tell: those that prior knowledge holds count in part."""
    known = np.concatenate([prior.precision[prior.free], np.diag(data.precision)])
    return float(len(known) - np.sum(known * np.diag(covariance)))


def _participation_error(
    model: Model, prior: Prior, covariance: Array, nearest: NDArray[np.intp]
) -> Array:
    """Standard errors (a,) of participations at the modes' own holograms."""
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
