"""The joint model of a sweep: constants, parameters, predicted amplitudes and priors.

The displacement of hologram k, in coordinates j of few functions, is

    a_kj = d_k Σ_mn T_mj Z_mn(f_k)⁻¹ p_n(f_k),    Z_mn(f) = δ_mn z_m(f) + i B_mn(f)
    z_m(f) = 1 + iη_m − (f/f_m)^(2 − γ_m)

with the exponent γ_m by which cane stiffens with frequency, shapes
``T_mj = Σ_n (δ_mn + E_mn) S_nj`` near those S of the finite elements (see `fitting.modal.fit`), and
losses B that connect modes (see `fitting.modal.losses`).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

from fitting.modal.drive.prior import FIRST_GAIN, DrivePrior, Ripple, drive_prior, found_gain
from fitting.modal.expected.prior import Prior, Ties
from holography.arrays import Array, ComplexArray
from physics.parameters.chamber import Chamber
from physics.reed.reduced.dynamics import PIVOT_HZ

# Modes beyond the sweep show only their tails: their participations have two coefficients.
TAIL_TERMS = 2
# Number of parameters of what modes lose: the first three connect them, the last one is an exponent
# of frequency.
LOSS_PARAMETERS, CONNECTING = 5, 3
GROWTH = LOSS_PARAMETERS - 1
# Loss factor of dry cane.
LOSS = 0.03
# Degrees of freedom of the drive's Student distributions, which admit excitation peaks.
DRIVE_DOF = 4.0
# Prior of a loss factor around what cane, clamp and sound lose, in the logarithm. What this leaves
# out is strain across the fibre: T4 has a third of its energy there, and wood loses up to twice as
# much as along it (Labonnote et al., Wood Sci. Technol. 47, 1033, 2013). Half of that.
_LOSS_SPREAD = 0.15
# No mode is expected to lose less than this. Chosen: a tenth of dry cane.
_LEAST_LOSS = 0.1 * LOSS
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
class Forms:
    """How losses and sound connect shapes S of unit elastic energy.

    Attributes
    ----------
    shares : (2, m, m) float
        Part of the energy between each two that belongs to shear, and what a clamp takes of it.
    sound : (k, m, m) float
        Work of the sound of one on another one, in a radian.
    scale : (m,) float
        Amplitude of each, relative to S.
    """

    shares: Array
    sound: Array
    scale: Array


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
    forms : Forms
        How losses and sound connect the shapes S.
    losses : (2, m, m) float
        B of `fitting.modal.losses` between the modes, of shear and of the clamp.
    sound : (k, m, m) float
        The same of sound.
    own_losses : (3, m) float
        B of shear, of the clamp and of sound at the resonance, between a mode and itself.
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
    forms: Forms
    losses: Array
    sound: Array
    own_losses: Array
    line_weight: float = 0.0

    @property
    def slots(self) -> int:
        """Length of a row of parameters."""
        return int(max(2 * self.powers.shape[1] + 2, len(self.active) + 2 * TAIL_TERMS))

    def nearest(self, hz: Array) -> NDArray[np.intp]:
        """Return the holograms (n,) whose drive is nearest to some frequencies (n,)."""
        found: NDArray[np.intp] = np.abs(np.log(self.hz[:, None] / hz)).argmin(axis=0)
        return found

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
        What all holograms share: what modes lose (see `fitting.modal.losses`), then
        parameters of the common-mode error.
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
    def loss_parameters(self) -> Array:
        """What modes lose (5,), see `fitting.modal.losses`."""
        return self.shared[:LOSS_PARAMETERS]


@dataclass(frozen=True)
class Terms:
    """Quantities that the model predicts for a state.

    Attributes
    ----------
    participation : (k, m) complex
        p of the model's equation.
    shapes : (m, j) float
        T.
    loss : (m,) float
    ratio : (k, m) float
        (f/f_m)^(2 − γ_m).
    dynamic : (k, m, m) complex
        Dynamic stiffness Z, relative to the static one.
    modal : (k, m) complex
        Largest deflections d Z⁻¹ p.
    """

    participation: ComplexArray
    shapes: Array
    loss: Array
    ratio: Array
    dynamic: ComplexArray
    modal: ComplexArray

    @property
    def alone(self) -> ComplexArray:
        """Dynamic stiffness (k, m) of each mode alone."""
        found: ComplexArray = np.diagonal(self.dynamic, axis1=1, axis2=2)
        return found

    @property
    def amplitude(self) -> ComplexArray:
        """Displacements (k, j)."""
        found: ComplexArray = self.modal @ self.shapes
        return found

    def received(self, state: State) -> ComplexArray:
        """Return participations (k, m) with what other modes add to them."""
        found: ComplexArray = self.alone * self.modal / np.exp(state.log_drive)[:, None]
        return found

    def moved_by_forces(self) -> ComplexArray:
        """Return the displacement (k, m, j) by a unit force on each mode."""
        return np.asarray(np.linalg.solve(self.dynamic.swapaxes(1, 2), self.shapes[None]))

    def on_forces(self, pull: ComplexArray) -> ComplexArray:
        """Return what forces (k, j) on the amplitudes do along unit forces on the modes (k, m)."""
        on_modes = (pull @ self.shapes.T)[..., None]
        found: ComplexArray = np.linalg.solve(self.dynamic.swapaxes(1, 2), on_modes)[..., 0]
        return found


def own_resonances(model: Model, state: State) -> tuple[Array, Array]:
    """Return frequencies (m,) in Hz and loss factors (m,) of modes that nothing connects."""
    count, first = len(model.active), 2 * model.powers.shape[1]
    hz, loss = model.reference_hz.copy(), np.full(len(model.reference), LOSS)
    hz[model.active] = np.exp(state.x[:count, first])
    loss[model.active] = np.exp(state.x[:count, first + 1])
    return hz, loss


def terms(model: Model, state: State) -> Terms:
    """Evaluate the model for a state."""
    x, active, passive = state.x, model.active, model.passive
    count, powers = len(active), model.powers.shape[1]
    hz, loss = own_resonances(model, state)
    p = np.zeros((len(hz), powers), complex)
    p[active] = x[:count, :powers] + 1j * x[:count, powers : 2 * powers]
    tail = x[count + passive, count : count + 2 * TAIL_TERMS]
    p[passive, :TAIL_TERMS] = tail[:, :TAIL_TERMS] + 1j * tail[:, TAIL_TERMS:]
    shapes = model.reference.copy()
    shapes[active] += x[count:, :count].T @ model.reference
    ratio = (model.hz[:, None] / hz) ** (2 - model.stiffening)
    participation: ComplexArray = model.powers.astype(complex) @ p.T
    *losses, sound = state.loss_parameters[:CONNECTING]
    dynamic = 1j * (np.tensordot(losses, model.losses, axes=1) + sound * model.sound)
    own = np.arange(len(hz))
    dynamic[:, own, own] += 1 + 1j * loss - ratio
    forces = np.exp(state.log_drive)[:, None] * participation
    modal = np.linalg.solve(dynamic, forces[..., None])[..., 0]
    return Terms(participation, shapes, loss, ratio, dynamic, modal)


def forces_by_logs(model: Model, terms: Terms) -> tuple[ComplexArray, ComplexArray]:
    """Return the forces (k, a) that do what log frequencies and log loss factors do."""
    active = model.active
    exponent, moved = 2 - model.stiffening[active], terms.modal[:, active]
    return -exponent * terms.ratio[:, active] * moved, -1j * terms.loss[active] * moved


def forces_by_losses(model: Model, terms: Terms) -> ComplexArray:
    """Return the forces (5, k, m) that do what a unit of each number of losses does."""
    found = np.zeros((LOSS_PARAMETERS, *terms.modal.shape), complex)
    found[: CONNECTING - 1] = -1j * terms.modal @ model.losses.swapaxes(1, 2)
    found[CONNECTING - 1] = -1j * (model.sound @ terms.modal[..., None])[..., 0]
    return found


def scalars(model: Model, state: State, terms: Terms) -> ComplexArray:
    """Return derivatives (k, v, p) by all parameters, without the vectors that they multiply.

    Those of participations and logarithms multiply the displacement by a unit force on the mode,
    those of mixings the shape S.
    """
    active, passive, count = model.active, model.passive, len(model.active)
    powers = model.powers.shape[1]
    drive = np.exp(state.log_drive)[:, None]
    s = np.zeros((len(model.hz), count + len(model.reference), model.slots), complex)
    own, tail = drive * model.powers, drive * model.powers[:, :TAIL_TERMS]
    s[:, :count, :powers], s[:, :count, powers : 2 * powers] = own[:, None], 1j * own[:, None]
    for slot, force in enumerate(forces_by_logs(model, terms), start=2 * powers):
        s[:, :count, slot] = force
    s[:, count:, :count] = terms.modal[:, None, active]
    s[:, count + passive, count : count + TAIL_TERMS] = tail[:, None]
    s[:, count + passive, count + TAIL_TERMS : count + 2 * TAIL_TERMS] = 1j * tail[:, None]
    return s


def slopes(model: Model, state: State, terms: Terms, pull: ComplexArray) -> tuple[Array, Array]:
    """Return the slopes by all parameters under forces on the amplitudes.

    The forces (k, j) are those on the real parts, less i times those on the imaginary parts.

    Returns
    -------
    by_parameters : (v, p) float
    by_losses : (5, k) float
        By the numbers of losses, for each hologram.
    """
    active, count = model.active, len(model.active)
    on_shapes, on_forces = pull @ model.reference.T, terms.on_forces(pull)
    on_vectors = np.concatenate([on_forces[:, active], on_forces], axis=1)
    # Matrix products: einsum itself takes several times as long.
    by_vector = scalars(model, state, terms).transpose(1, 2, 0)
    found: Array = (by_vector @ on_vectors.T[..., None])[..., 0].real
    found[count:, :count] = (on_shapes.T @ terms.modal[:, active]).real
    by_losses = np.sum(forces_by_losses(model, terms) * on_forces, axis=2).real
    return found, by_losses


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


@dataclass(frozen=True)
class ExpectedLoss:
    """What modes are expected to lose.

    Attributes
    ----------
    prior : Prior
        Expects this of the log loss factors.
    slots : (2, a) int
        Places of these among the parameters.
    slopes : (a, 5) float
        Derivatives of what is expected by the numbers of losses.
    """

    prior: Prior
    slots: NDArray[np.intp]
    slopes: Array

    @property
    def precision(self) -> Array:
        """Precision (a,) of the log loss factors."""
        found: Array = self.prior.precision[tuple(self.slots)]
        return found


def expected_loss(model: Model, prior: Prior, state: State) -> ExpectedLoss:
    """Expect of modes what cane, clamp and sound lose together.

    The loss factors of cane and clamp grow with a power of frequency.
    """
    active, count = model.active, len(model.active)
    shear, clamp, sound = model.own_losses[:, active]
    by_shear, by_clamp, by_sound, cane, growth = state.loss_parameters
    log_hz = np.log(model.reference_hz[active] / PIVOT_HZ)
    grown = np.exp(growth * log_hz)
    solid = grown * (cane + by_shear * shear + by_clamp * clamp)
    loss = solid + by_sound * sound
    columns = [grown * shear, grown * clamp, sound, grown, solid * log_hz]
    slopes = np.where(loss[:, None] > _LEAST_LOSS, np.stack(columns, axis=1), 0)
    loss = np.maximum(loss, _LEAST_LOSS)
    slots = np.stack([np.arange(count), np.full(count, 2 * model.powers.shape[1] + 1)])
    centre = prior.centre.copy()
    centre[tuple(slots)] = np.log(loss)
    return ExpectedLoss(replace(prior, centre=centre), slots, slopes / loss[:, None])


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
        return Prior(centre, spread**-2.0, _ties(model, stage, spread))


def _ties(model: Model, stage: Stage, spread: Array) -> Ties:
    """Tie the mixings of each two modes of the sweep into each other.

    Modes are orthogonal in the mass, but for what mass differs by. Of shapes of unit mass, each two
    contain as much of each other, with opposite signs.
    """
    count, active = len(model.active), model.active
    one, other = np.triu_indices(count, 1)
    # In the row of a shape, the mixing into a mode.
    at = np.array([[count + active[other], count + active[one]], [one, other]])
    free = np.all(spread[tuple(at)] > 0, axis=0)
    # Of shapes of unit elastic energy; times its frequency, of unit mass.
    largest = (model.forms.scale * model.reference_hz)[active]
    ratio = largest[one] / largest[other]
    weights = np.stack([ratio, 1 / ratio])[:, free]
    return Ties(at[:, :, free], weights, (stage.mixing * _PERTURBATION) ** -2.0)


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
