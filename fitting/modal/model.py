"""The joint model of a sweep: constants, parameters, predicted amplitudes and priors.

The displacement of hologram k, in coordinates j of few functions, is

    a_kj = d_k Σ_m h_m(f_k) p_m(f_k) T_mj,    h_m(f) = 1 / (1 + iη_m − (f/f_m)^(2 − γ_m))

with the exponent γ_m by which cane stiffens with frequency, and shapes
``T_mj = Σ_n (δ_mn + E_mn) S_nj`` near those S of the finite elements (see `fitting.modal.fit`).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

from fitting.modal.drive.prior import FIRST_GAIN, DrivePrior, Ripple, drive_prior, found_gain
from holography.arrays import Array, ComplexArray
from physics.parameters.chamber import Chamber

# Modes beyond the sweep show only their tails: their participations have two coefficients.
TAIL_TERMS = 2
# Number of parameters by which modes are out of phase.
OUT_OF_PHASE = 3
# Loss factor of dry cane.
LOSS = 0.03
# Degrees of freedom of the drive's Student distributions, which admit excitation peaks.
DRIVE_DOF = 4.0
# Prior of a loss factor: within a factor of 1.5.
_LOSS_SPREAD = 0.4
# Shapes mix as if stiffness and mass were wrong by this fraction; largest and least coefficient.
# Chosen: only a start. How much they mix is found in each fit (decision 0083).
_PERTURBATION, _MOST_MIXING, _LEAST_MIXING = 0.08, 0.5, 5e-3
# Prior of participations: within 3 times the value of the stage before.
_SCALE = 3.0
# How fast participations change with frequency (decision 0057): distance from the tip over which a
# mode takes up pressure, half the window under the reed; the speed of sound; and what cavities and
# leaks add in any degree, chosen.
_CHAMBER = Chamber()
_REACH_M, _SOUND_M_S, _OTHER = 0.5 * _CHAMBER.length_m, _CHAMBER.sound_speed_m_s, 0.03


@dataclass(frozen=True)
class Model:
    """Constants of the joint model.

    The parameters are stored in rows, one for each vector of coordinates that they multiply: first
    the shapes of the a active modes, then the shapes S of all m modes. The row of an active mode
    contains its participation (real, then imaginary parts), log frequency and log loss factor. The
    row of a shape S contains its mixing E into each active mode, and the participations of a mode
    beyond the sweep.

    Attributes
    ----------
    hz : (k,) float
        Drive frequencies.
    log_volts : (k,) float
        Log of the expected magnitude of the drive, up to a smooth factor.
    drive_dof : float
        Of the scatter of single holograms around a smooth drive, `DRIVE_DOF`.
    ripple : Ripple
        Prior of the drive's smooth log magnitude.
    powers : (k, n) float
        Chebyshev polynomials of frequency.
    reference : (m, j) float
        Shapes S.
    reference_hz : (m,) float
        Expected eigenfrequencies.
    stiffening : (m,) float
        See `fitting.holograms.shape_basis.ShapeBasis`.
    active : (a,) int
        Modes whose resonance lies in the sweep.
    loss_mixing : (2, m, m) float
        Of shear and of the clamp, see `fitting.modal.out_of_phase`.
    sound : (k, m, m) float
        See `fitting.modal.out_of_phase.sound_between_modes`.
    line_weight : float
        Log weight of the lines that are expected of the drive, see
        `fitting.acoustics.poles.DriveLines`.
    """

    hz: Array
    log_volts: Array
    drive_dof: float
    ripple: Ripple
    powers: Array
    reference: Array
    reference_hz: Array
    stiffening: Array
    active: NDArray[np.intp]
    loss_mixing: Array
    sound: Array
    line_weight: float = 0.0

    @property
    def slots(self) -> int:
        """Length of a row of parameters."""
        return int(max(2 * self.powers.shape[1] + 2, len(self.active) + 2 * TAIL_TERMS))

    @property
    def passive(self) -> NDArray[np.intp]:
        """Modes beyond the sweep."""
        return np.setdiff1d(np.arange(len(self.reference)), self.active)


@dataclass(frozen=True)
class State:
    """Values of all parameters.

    Attributes
    ----------
    x : (v, p) float
        Parameters, one row for each vector (see `Model`).
    log_drive : (k,) complex
    shared : (p,) float
        What all holograms share: differences of loss factors, and sound relative to that of a free
        plate (see `fitting.modal.out_of_phase`), then parameters of the common-mode error.
    scatter : (k,) float
        Of single holograms around a smooth log magnitude of the drive.
    gain : float
        Standard deviation of the scatter of single holograms around a smooth drive, in nepers.
    """

    x: Array
    log_drive: ComplexArray
    shared: Array
    scatter: Array
    gain: float = FIRST_GAIN

    @property
    def out_of_phase(self) -> Array:
        """Differences of loss factors, and sound relative to that of a free plate (3,)."""
        return self.shared[:OUT_OF_PHASE]


@dataclass(frozen=True)
class Terms:
    """Quantities that the model predicts for a state.

    Attributes
    ----------
    resonance, participation : (k, m) complex
        h and p of the model's equation.
    shapes : (m, j) float
        T.
    loss : (m,) float
    ratio : (k, m) float
        (f/f_m)^(2 − γ_m).
    modal : (k, m) complex
        Largest deflections d h p, in phase.
    out_of_phase : (3, k, m) complex
        What shear, clamp and sound add to them, for a difference of 1 of the loss factors, and for
        the sound of a free plate.
    """

    resonance: ComplexArray
    participation: ComplexArray
    shapes: Array
    loss: Array
    ratio: Array
    modal: ComplexArray
    out_of_phase: ComplexArray

    def moved(self, state: State) -> ComplexArray:
        """Return the largest deflections (k, m) with what is out of phase."""
        return self.modal + np.tensordot(state.out_of_phase, self.out_of_phase, axes=1)

    def amplitude(self, state: State) -> ComplexArray:
        """Return the displacements (k, j)."""
        found: ComplexArray = self.moved(state) @ self.shapes
        return found


def terms(model: Model, state: State) -> Terms:
    """Evaluate the model for a state."""
    x, active, passive = state.x, model.active, model.passive
    count, powers = len(active), model.powers.shape[1]
    hz, loss = model.reference_hz.copy(), np.full(len(model.reference), LOSS)
    hz[active] = np.exp(x[:count, 2 * powers])
    loss[active] = np.exp(x[:count, 2 * powers + 1])
    p = np.zeros((len(hz), powers), complex)
    p[active] = x[:count, :powers] + 1j * x[:count, powers : 2 * powers]
    tail = x[count + passive, count : count + 2 * TAIL_TERMS]
    p[passive, :TAIL_TERMS] = tail[:, :TAIL_TERMS] + 1j * tail[:, TAIL_TERMS:]
    shapes = model.reference.copy()
    shapes[active] += x[count:, :count].T @ model.reference
    ratio = (model.hz[:, None] / hz) ** (2 - model.stiffening)
    resonance: ComplexArray = 1 / (1 + 1j * loss - ratio)
    participation: ComplexArray = model.powers.astype(complex) @ p.T
    modal = np.exp(state.log_drive)[:, None] * (resonance * participation)
    sent = resonance * (model.sound @ modal[..., None])[..., 0]
    out_of_phase = 1j * np.concatenate([modal @ model.loss_mixing, -sent[None]])
    return Terms(resonance, participation, shapes, loss, ratio, modal, out_of_phase)


def by_logs(model: Model, terms: Terms) -> tuple[ComplexArray, ComplexArray]:
    """Return derivatives (k, a) of the active resonances by log frequency and log loss factor."""
    active = model.active
    steep = terms.resonance[:, active] ** 2
    exponent = 2 - model.stiffening[active]
    return -exponent * terms.ratio[:, active] * steep, -1j * terms.loss[active] * steep


def scalars(model: Model, state: State, terms: Terms) -> ComplexArray:
    """Return derivatives (k, v, p) by all parameters, without the vectors that they multiply.

    They are those of a model in phase.
    """
    active, passive, count = model.active, model.passive, len(model.active)
    powers = model.powers.shape[1]
    drive = np.exp(state.log_drive)[:, None]
    h, p = drive * terms.resonance, terms.participation
    s = np.zeros((len(model.hz), count + len(model.reference), model.slots), complex)
    own = h[:, active, None] * model.powers[:, None, :]
    s[:, :count, :powers], s[:, :count, powers : 2 * powers] = own, 1j * own
    for slot, slope in enumerate(by_logs(model, terms), start=2 * powers):
        s[:, :count, slot] = drive * slope * p[:, active]
    s[:, count:, :count] = terms.moved(state)[:, None, active]
    tail = h[:, passive, None] * model.powers[:, None, :TAIL_TERMS]
    s[:, count + passive, count : count + TAIL_TERMS] = tail
    s[:, count + passive, count + TAIL_TERMS : count + 2 * TAIL_TERMS] = 1j * tail
    return s


def slopes(model: Model, state: State, terms: Terms, pull: ComplexArray) -> Array:
    """Return the slopes (v, p) by all parameters under forces on the amplitudes.

    The forces (k, j) are those on the real parts, less i times those on the imaginary parts. A mode
    moves others out of phase, so that forces on these act on it, too.
    """
    active, count = model.active, len(model.active)
    powers = model.powers.shape[1]
    on_active, on_shapes = pull @ terms.shapes[active].T, pull @ model.reference.T
    on_modes = on_shapes.copy()
    on_modes[:, active] = on_active
    *losses, sound = state.out_of_phase
    mixing = np.tensordot(losses, model.loss_mixing, axes=1)
    sounding = ((terms.resonance * on_modes)[:, None] @ model.sound)[:, 0]
    on_modes = on_modes + 1j * (on_modes @ mixing.T - sound * sounding)
    on_vectors = np.concatenate([on_modes[:, active], on_modes], axis=1)
    # Matrix products: einsum itself takes several times as long.
    by_vector = scalars(model, state, terms).transpose(1, 2, 0)
    found: Array = (by_vector @ on_vectors.T[..., None])[..., 0].real
    found[count:, :count] = (on_shapes.T @ terms.moved(state)[:, active]).real
    for slot, by_others in enumerate(by_sound_of_others(model, state, terms), 2 * powers):
        found[:count, slot] += np.sum((by_others * on_active).real, axis=0)
    return found


def moving_others(model: Model, state: State, terms: Terms) -> ComplexArray:
    """Return the displacement (k, m, j) of each mode, with what it moves out of phase."""
    *losses, sound = state.out_of_phase
    by_sound = terms.resonance[:, :, None] * model.sound
    by_loss = np.tensordot(losses, model.loss_mixing, axes=1) @ terms.shapes
    others = by_loss - sound * by_sound.swapaxes(1, 2) @ terms.shapes
    found: ComplexArray = terms.shapes + 1j * others
    return found


def by_sound_of_others(
    model: Model, state: State, terms: Terms
) -> tuple[ComplexArray, ComplexArray]:
    """Return derivatives (k, a) by log frequency and log loss factor, by the sound of others.

    The sound that others send moves a mode by its resonance.
    """
    sent = (model.sound[:, model.active] @ terms.modal[..., None])[..., 0]
    by_hz, by_loss = by_logs(model, terms)
    factor = -1j * state.out_of_phase[-1] * sent
    return factor * by_hz, factor * by_loss


@dataclass(frozen=True)
class Prior:
    """Centre and precision (v, p) of every parameter; infinite precision fixes it."""

    centre: Array
    precision: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """Mask (v, p) of the parameters that are not fixed."""
        return np.isfinite(self.precision)

    @property
    def log_volume(self) -> float:
        """Twice the log of the density's factor, but for a constant."""
        return float(np.sum(np.log(self.precision[self.free])))

    def cost(self, x: Array) -> float:
        """Return twice the negative log of the prior density, but for its factor."""
        free = self.free
        return float(np.sum(self.precision[free] * (x - self.centre)[free] ** 2))


@dataclass(frozen=True)
class Stage:
    """Widths of the priors of one stage of a fit.

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


def stage_prior(model: Model, stage: Stage, centre_hz: Array, scale: Array) -> Prior:
    """Return the prior of a stage; `scale` (m,) is the expected size of participations."""
    count, powers = len(model.active), model.powers.shape[1]
    centre = np.zeros((count + len(model.reference), model.slots))
    spread = _participation_spread(model, stage, scale)
    centre[:count, 2 * powers] = np.log(centre_hz)
    spread[:count, 2 * powers] = stage.detuning
    centre[:count, 2 * powers + 1], spread[:count, 2 * powers + 1] = np.log(LOSS), _LOSS_SPREAD
    mixing = stage.mixing * _mixing(model, centre_hz)
    spread[count:, :count] = np.where(_LEAST_MIXING * stage.mixing < mixing.T, mixing.T, 0)
    with np.errstate(divide="ignore"):
        return Prior(centre, spread**-2.0)


def rescaled(prior: Prior, model: Model, stage: Stage, scale: Array) -> Prior:
    """Return the prior for another expected size of participations (m,)."""
    spread = _participation_spread(model, stage, scale)
    other = spread > 0
    precision = prior.precision.copy()
    precision[other] = spread[other] ** -2.0
    return replace(prior, precision=precision)


def _participation_spread(model: Model, stage: Stage, scale: Array) -> Array:
    """Return the prior standard deviations (v, p) of participations; 0 for other parameters."""
    count, powers = len(model.active), model.powers.shape[1]
    spread = np.zeros((count + len(model.reference), model.slots))
    degrees = _degrees(model.hz, stage.decay, powers)
    for part in (0, powers):
        spread[:count, part : part + powers] = scale[model.active, None] * degrees
    for part in (count, count + TAIL_TERMS):
        tail = scale[model.passive, None] * degrees[:TAIL_TERMS]
        spread[count + model.passive, part : part + TAIL_TERMS] = tail
    return spread


def _degrees(hz: Array, decay: float, terms: int) -> Array:
    """Return the prior standard deviations of Chebyshev coefficients of a participation.

    From one end of the sweep to the other, the phase of a wave at a distance changes by 2κ. Its
    coefficients then are 2 J_d(κ) (the Jacobi-Anger expansion, DLMF 10.12), which fall fast from
    the degree κ on. Each is at most `decay` to the power of its degree.
    """
    degree = np.arange(terms)
    phase = np.pi * _REACH_M * (hz[-1] - hz[0]) / _SOUND_M_S
    wave = np.where(degree > phase, np.hypot(2 * jv(degree, phase), _OTHER), np.inf)
    spread: Array = np.minimum(decay**degree, wave)
    spread[0] = _SCALE
    return spread


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


def drive_prior_at(model: Model, state: State) -> DrivePrior:
    """Return the prior of the drive's log magnitude at a state."""
    magnitude = state.log_drive.real - model.log_volts
    return drive_prior(
        magnitude, model.ripple.covariance, state.scatter, state.gain, model.drive_dof
    )


def with_gain(model: Model, state: State) -> State:
    """Estimate the scatter of single holograms around a smooth drive."""
    magnitude = state.log_drive.real - model.log_volts
    smooth, dof = model.ripple.covariance, model.drive_dof
    gain = found_gain(magnitude, smooth, state.scatter, state.gain, dof)
    scatter = drive_prior(magnitude, smooth, state.scatter, gain, dof).scatter
    return replace(state, gain=gain, scatter=scatter)
