"""One joint model of a whole sweep: shared modes, each with its frequency, loss and shape.

The displacement of hologram k, in coordinates j of few functions, is

    a_kj = d_k Σ_m h_m(f_k) p_m(f_k) T_mj,    h_m(f) = 1 / (1 + iη_m − (f/f_m)²)

with the shared eigenfrequencies f_m and loss factors η_m, shapes ``T_mj = Σ_n (δ_mn + E_mn) S_nj``
near those S of the finite elements, participations p_m(f), complex and smooth, and the drive d_k:
its phase is free, since nobody knows that of a hologram; its magnitude follows the volts, smoothly
but for lines of the air. A hologram therefore tells by the balance of its modes as much as by its
strength how near each of them is to its resonance.

All is found by one damped least squares against the amplitudes of `fitting.displacement` and their
information. Shapes are allowed to differ from those of the finite elements as perturbations let
them: the more, the closer two modes are. What amplitudes are off beyond their noise, because no
model is perfect, is estimated from what is left and added to the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.displacement import Displacements
from fitting.shapes import ShapeBasis

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

# Participations are polynomials of log frequency of this degree; those of modes beyond the sweep,
# of which only the tail shows, of degree 1.
_DEGREE = 4
_TAIL_TERMS = 2
# Prior of a loss factor: that of dry cane, within a factor of 1.5.
_LOSS, _LOSS_SPREAD = 0.03, 0.4
# Shapes mix as if stiffness and mass were off by this share; no two more than that.
_PERTURBATION, _MOST_MIXING, _LEAST_MIXING = 0.08, 0.5, 5e-3
# The drive's magnitude, in nepers: standard deviation of the second difference of its smooth part
# from step to step, and freedoms of Student's distribution, which lets lines stand out.
_BEND, _FREEDOMS, _BEND_TURNS = 0.01, 4.0, 8
# What holograms may be brighter or darker besides, at first and as estimated.
_GAIN, _GAIN_RANGE = 0.01, (3e-3, 0.2)
# Participations are expected to be within 3 times of what the stage before found.
_SCALE = 3.0
_LEAST_SCALE = 3e-3
# A share of information so small that only what the data do not tell at all is held by it.
_WEAK = 1e-4
_LEAST_GAIN = 2e-3
_MOST_DAMPING = 1e8
# What amplitudes may be off beyond their noise, as a share of the hologram's.
_DISCREPANCY = (1e-3, 0.1)


@dataclass(frozen=True)
class _Stage:
    """One round of the fit: freedoms grow from round to round.

    Attributes
    ----------
    discrepancy : float
        Share of a hologram's amplitude that the model may be off.
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
    _Stage(0.1, 0.05, 0.01, 0.05, 6),
    _Stage(0.05, 0.3, 0.01, 0.3, 6),
    _Stage(0.02, 0.5, 0.01, 1.0, 6),
    _Stage(0.01, 0.7, 0.01, 1.0, 6),
)
_LAST = _Stage(0.005, 0.7, 0.02, 1.0, 12)


@dataclass(frozen=True)
class ModalFit:
    """Modes of a sweep.

    Attributes
    ----------
    names : tuple of str
        Of the a modes whose resonance lies in the sweep.
    hz, loss_factor : (a,) float
        Eigenfrequencies and loss factors.
    error_cents, loss_error : (a,) float
        Standard errors; of the loss factor, relative.
    shapes : (a, j) float
        Coordinates of the shapes in the `ShapeBasis`.
    participation : (a,) complex
        At the mode's own frequency, per unit of drive.
    participation_error : (a,) float
        Standard error of its magnitude, beside a given drive.
    drive : (k,) complex
        Of every hologram; the phase is arbitrary.
    amplitude_rad : (k, j) complex
        As the model has it.
    modal_rad : (k, a) complex
        Largest deflection of every mode in every hologram.
    misfit : float
        Mean square of what is left, in units of noise and discrepancy.
    discrepancy : float
        See `_Stage`, as estimated.
    """

    names: tuple[str, ...]
    hz: Array
    error_cents: Array
    loss_factor: Array
    loss_error: Array
    shapes: Array
    participation: Complex
    participation_error: Array
    drive: Complex
    amplitude_rad: Complex
    modal_rad: Complex
    misfit: float
    discrepancy: float


@dataclass(frozen=True)
class _Model:
    """What is known before the fit.

    Parameters of one vector of coordinates stand together. Vectors are the shapes of the a active
    modes, then those S of all m modes. Of an active mode's: participation (real, imaginary parts),
    log frequency, log loss. Of the others: the mixing E into each active mode, and participations
    of a mode beyond the sweep.

    Attributes
    ----------
    hz : (k,) float
    log_volts : (k,) float
    powers : (k, n) float
        Chebyshev polynomials of log frequency.
    reference : (m, j) float
        Shapes S.
    reference_hz : (m,) float
    active : (a,) int
    """

    hz: Array
    log_volts: Array
    powers: Array
    reference: Array
    reference_hz: Array
    active: NDArray[np.intp]

    @property
    def slots(self) -> int:
        """Most parameters of one vector."""
        return int(max(2 * self.powers.shape[1] + 2, len(self.active) + 2 * _TAIL_TERMS))

    @property
    def passive(self) -> NDArray[np.intp]:
        """Modes beyond the sweep."""
        return np.setdiff1d(np.arange(len(self.reference)), self.active)


@dataclass(frozen=True)
class _State:
    """Parameters (v, p) of the vectors, the log (complex) of the drive (k,), the holograms' gain.

    The last is the standard deviation of what they are brighter or darker by chance, in nepers.
    """

    x: Array
    log_drive: Complex
    gain: float = _GAIN


@dataclass(frozen=True)
class _Terms:
    """What follows from a state.

    Attributes
    ----------
    resonance, participation : (k, m) complex
        h and p.
    shapes : (m, j) float
        T.
    loss : (m,) float
    ratio : (k, m) float
        (f/f_m)².
    amplitude : (k, j) complex
    """

    resonance: Complex
    participation: Complex
    shapes: Array
    loss: Array
    ratio: Array
    amplitude: Complex


def _terms(model: _Model, state: _State) -> _Terms:
    x, active, passive = state.x, model.active, model.passive
    count, powers = len(active), model.powers.shape[1]
    hz, loss = model.reference_hz.copy(), np.full(len(model.reference), _LOSS)
    hz[active] = np.exp(x[:count, 2 * powers])
    loss[active] = np.exp(x[:count, 2 * powers + 1])
    p = np.zeros((len(hz), powers), complex)
    p[active] = x[:count, :powers] + 1j * x[:count, powers : 2 * powers]
    tail = x[count + passive, count : count + 2 * _TAIL_TERMS]
    p[passive, :_TAIL_TERMS] = tail[:, :_TAIL_TERMS] + 1j * tail[:, _TAIL_TERMS:]
    shapes = model.reference.copy()
    shapes[active] += x[count:, :count].T @ model.reference
    ratio = (model.hz[:, None] / hz) ** 2
    resonance: Complex = 1 / (1 + 1j * loss - ratio)
    participation: Complex = model.powers.astype(complex) @ p.T
    amplitude = np.exp(state.log_drive)[:, None] * ((resonance * participation) @ shapes)
    return _Terms(resonance, participation, shapes, loss, ratio, amplitude)


def _scalars(model: _Model, state: _State, terms: _Terms) -> Complex:
    """Derivatives by all parameters, without the vectors that they multiply: (k, v, p)."""
    active, passive, count = model.active, model.passive, len(model.active)
    powers = model.powers.shape[1]
    drive = np.exp(state.log_drive)[:, None]
    h, p = drive * terms.resonance, terms.participation
    s = np.zeros((len(model.hz), count + len(model.reference), model.slots), complex)
    own = h[:, active, None] * model.powers[:, None, :]
    s[:, :count, :powers], s[:, :count, powers : 2 * powers] = own, 1j * own
    steep = h[:, active] * terms.resonance[:, active] * p[:, active]
    s[:, :count, 2 * powers] = -2 * terms.ratio[:, active] * steep
    s[:, :count, 2 * powers + 1] = -1j * terms.loss[active] * steep
    s[:, count:, :count] = (h * p)[:, None, active]
    tail = h[:, passive, None] * model.powers[:, None, :_TAIL_TERMS]
    s[:, count + passive, count : count + _TAIL_TERMS] = tail
    s[:, count + passive, count + _TAIL_TERMS : count + 2 * _TAIL_TERMS] = 1j * tail
    return s


@dataclass(frozen=True)
class _Prior:
    """Centre and precision (v, p) of every parameter; infinite precision fixes it."""

    centre: Array
    precision: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which parameters (v, p) are any."""
        return np.isfinite(self.precision)

    def cost(self, x: Array) -> float:
        """Twice the negative log of the prior."""
        free = self.free
        return float(np.sum(self.precision[free] * (x - self.centre)[free] ** 2))


def _prior(model: _Model, stage: _Stage, centre_hz: Array, scale: Array) -> _Prior:
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
    centre[:count, 2 * powers + 1], spread[:count, 2 * powers + 1] = np.log(_LOSS), _LOSS_SPREAD
    mixing = stage.mixing * _mixing(model, centre_hz)
    spread[count:, :count] = np.where(_LEAST_MIXING * stage.mixing < mixing.T, mixing.T, 0)
    for part in (count, count + _TAIL_TERMS):
        tail = scale[model.passive, None] * degrees[:_TAIL_TERMS]
        spread[count + model.passive, part : part + _TAIL_TERMS] = tail
    with np.errstate(divide="ignore"):
        return _Prior(centre, spread**-2.0)


def _mixing(model: _Model, centre_hz: Array) -> Array:
    """Prior standard deviation (a, m) of how much of each mode's shape another may take up."""
    hz = model.reference_hz.copy()
    hz[model.active] = centre_hz
    squares = hz**2
    apart = np.abs(squares[model.active, None] - squares)
    near = np.sqrt(squares[model.active, None] * squares) / np.maximum(apart, 1e-9)
    mixing: Array = np.minimum(_PERTURBATION * near, _MOST_MIXING)
    mixing[np.arange(len(model.active)), model.active] = 0
    return mixing


@dataclass(frozen=True)
class _Bend:
    """What is expected of the drive's magnitude: cost, gradient (k,) and curvature (k, k).

    Attributes
    ----------
    gain : (k,) float
        What is left of the log magnitude beside its smooth part and lines.
    """

    cost: float
    gradient: Array
    curvature: Array
    gain: Array


def _bend(model: _Model, state: _State) -> _Bend:
    """Divide the drive's magnitude into a smooth part, with lines, and the gain of holograms."""
    count = len(model.hz)
    second = np.diff(np.eye(count), n=2, axis=0) / _BEND
    magnitude = state.log_drive.real - model.log_volts
    known = np.eye(count) / state.gain**2
    smooth = magnitude
    for _ in range(_BEND_TURNS):
        weight = (_FREEDOMS + 1) / (_FREEDOMS + (second @ smooth) ** 2)
        stiff = second.T @ (weight[:, None] * second)
        smooth = linalg.solve(stiff + known, magnitude / state.gain**2, assume_a="pos")
    gain = magnitude - smooth
    bent = np.sum(np.log1p((second @ smooth) ** 2 / _FREEDOMS))
    cost = (_FREEDOMS + 1) * bent + np.sum(gain**2) / state.gain**2
    # Whatever the magnitude becomes, the smooth part follows it.
    curvature = stiff @ linalg.solve(stiff + known, known, assume_a="pos")
    return _Bend(float(cost), -gain / state.gain**2, 0.5 * (curvature + curvature.T), gain)


def _with_gain(model: _Model, state: _State) -> _State:
    """Estimate by how much holograms are brighter or darker than the smooth drive makes them."""
    gain = _bend(model, state).gain
    spread = float(np.median(np.abs(gain))) / 0.6745
    # The smooth part follows what it can: what is left is a little less than there is.
    return replace(state, gain=float(np.clip(1.1 * spread, *_GAIN_RANGE)))


def _parts(complex_rows: Complex) -> Array:
    """Real, then imaginary parts: (k, j) → (k, 2, j)."""
    return np.stack([complex_rows.real, complex_rows.imag], axis=1)


@dataclass(frozen=True)
class _Data:
    """Amplitudes (k, j) complex and their information (k, 2, j, 2, j)."""

    amplitude: Complex
    information: Array

    def misfits(self, amplitude: Complex) -> Array:
        """Squared distance (k,) of every hologram from what a model says."""
        apart = _parts(self.amplitude - amplitude)
        misfits: Array = np.einsum(
            "kci,kcidj,kdj->k", apart, self.information, apart, optimize=True
        )
        return misfits


@dataclass(frozen=True)
class _Equations:
    """Normal equations of all parameters (q, those that are free) and the drive (2k).

    Attributes
    ----------
    matrix : (q, q) float
    gradient : (q,) float
    coupling : (q, 2k) float
    drive_matrix : (2k, 2k) float
    drive_gradient : (2k,) float
    """

    matrix: Array
    gradient: Array
    coupling: Array
    drive_matrix: Array
    drive_gradient: Array


def _equations(model: _Model, data: _Data, prior: _Prior, state: _State) -> _Equations:
    terms, free = _terms(model, state), prior.free
    vectors = np.concatenate([terms.shapes[model.active], model.reference])
    s = _scalars(model, state, terms)
    scalars = np.stack([s.real, s.imag], axis=1)
    # What the model is made of, seen through the information: (k, 2, v, 2, j).
    seen = np.einsum("vi,kcidj->kcvdj", vectors, data.information, optimize=True)
    matrix = _matrix(scalars, seen @ vectors.T)[np.ix_(free.ravel(), free.ravel())]
    apart = _parts(data.amplitude - terms.amplitude)
    pull = np.einsum("kcvdj,kdj->kcv", seen, apart, optimize=True)
    offset = prior.precision[free] * (state.x - prior.centre)[free]
    gradient = np.einsum("kcvp,kcv->vp", scalars, pull)[free] - offset
    # By log magnitude and phase of the drive: the amplitude itself, and that turned by 90°.
    local = np.stack([_parts(terms.amplitude), _parts(1j * terms.amplitude)], axis=-1)
    felt = np.einsum("kcvdj,kdjl->kcvl", seen, local, optimize=True)
    coupling = np.einsum("kcvp,kcvl->vplk", scalars, felt, optimize=True)[free]
    pressed = np.einsum("kcidj,kdjl->kcil", data.information, local, optimize=True)
    count, bend = len(model.hz), _bend(model, state)
    drive = np.einsum("kcil,kcim->lkm", local, pressed)
    drive_matrix = np.zeros((2 * count, 2 * count))
    k = np.arange(count)
    for row in range(2):
        for column in range(2):
            drive_matrix[row * count + k, column * count + k] = drive[row, :, column]
    drive_matrix[:count, :count] += bend.curvature
    drive_gradient = np.einsum("kcil,kci->lk", pressed, apart)
    drive_gradient[0] += bend.gradient
    return _Equations(
        matrix + np.diag(prior.precision[free]),
        gradient,
        coupling.reshape(len(gradient), -1),
        drive_matrix,
        drive_gradient.ravel(),
    )


def _matrix(scalars: Array, products: Array) -> Array:
    """Normal matrix (v·p, v·p) from scalars (k, 2, v, p) and products (k, 2, v, 2, v) of vectors.

    Vector by vector: parameters of one vector share its products with all others.
    """
    holograms, _, vectors, slots = scalars.shape
    right = scalars.transpose(2, 0, 1, 3).reshape(vectors, 2 * holograms, slots)
    matrix = np.empty((vectors, slots, vectors, slots))
    for v in range(vectors):
        left = np.einsum("kcp,kcwd->wpkd", scalars[:, :, v], products[:, :, v].swapaxes(2, 3))
        matrix[v] = np.matmul(left.reshape(vectors, slots, -1), right).transpose(1, 0, 2)
    return matrix.reshape(vectors * slots, -1)


def _reduced(equations: _Equations, damping: float) -> tuple[Array, Array, Any]:
    """Matrix and gradient without the drive, and the factors of the drive's matrix."""
    diagonal = np.diag(equations.drive_matrix)
    factors = linalg.cho_factor(equations.drive_matrix + np.diag(damping * diagonal + 1e-9))
    solved = linalg.cho_solve(factors, equations.coupling.T)
    matrix = equations.matrix - equations.coupling @ solved
    gradient = equations.gradient - solved.T @ equations.drive_gradient
    return matrix, gradient, factors


def _improve(model: _Model, data: _Data, prior: _Prior, state: _State, iterations: int) -> _State:
    """Levenberg and Marquardt until nothing is gained."""

    def cost(tried: _State) -> float:
        misfit = float(data.misfits(_terms(model, tried).amplitude).sum())
        return misfit + prior.cost(tried.x) + _bend(model, tried).cost

    best, damping = cost(state), 1e-3
    for _ in range(iterations):
        equations = _equations(model, data, prior, state)
        while True:
            tried = _moved(equations, prior, state, damping)
            reached = cost(tried)
            if reached < best:
                break
            damping = max(8 * damping, 1e-6)
            if damping > _MOST_DAMPING:
                return state
        gain, best, state = best - reached, reached, tried
        damping = max(damping / 5, 1e-9)
        if gain < _LEAST_GAIN * best:
            break
    return state


def _moved(equations: _Equations, prior: _Prior, state: _State, damping: float) -> _State:
    matrix, gradient, factors = _reduced(equations, damping)
    damped = matrix + np.diag(damping * np.diag(equations.matrix))
    move = linalg.solve(damped, gradient, assume_a="pos")
    drive = linalg.cho_solve(
        factors, equations.drive_gradient - equations.coupling.T @ move
    ).reshape(2, -1)
    # A step of the drive by more than e is no small one.
    drive = np.clip(drive, -1, 1)
    x = state.x.copy()
    x[prior.free] += move
    return replace(state, x=x, log_drive=state.log_drive + drive[0] + 1j * drive[1])


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
        Of its k holograms.
    basis : ShapeBasis
    drive_hz, volts : (k,) float
    start_hz : dict
        Where the search for each mode begins, by name: all modes of the basis with a resonance
        within the sweep, seen or not.

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
    model = _Model(drive_hz, np.log(volts), powers, basis.shapes, reference_hz, active)
    noise = np.linalg.inv(displacements.information + _WEAK * np.eye(2 * basis.shapes.shape[1]))
    state, scale = _begin(model, displacements.amplitude_rad, displacements.information)
    for stage in _STAGES:
        prior = _prior(model, stage, centre_hz, scale)
        data = _data(displacements.amplitude_rad, noise, stage.discrepancy)
        state = _improve(model, data, prior, _fixed(prior, state), stage.iterations)
        state, scale = _with_gain(model, state), _scale(model, state)
    return _finish(model, displacements.amplitude_rad, noise, centre_hz, state, basis.names)


def _fixed(prior: _Prior, state: _State) -> _State:
    """Put parameters that are not free where they are expected."""
    return replace(state, x=np.where(prior.free, state.x, prior.centre))


def _scale(model: _Model, state: _State) -> Array:
    """Root of the mean square (m,) of the participations."""
    p = _terms(model, state).participation
    scale: Array = np.maximum(np.sqrt(np.mean(np.abs(p) ** 2, axis=0)), _LEAST_SCALE)
    return scale


def _data(amplitude: Complex, noise: Array, discrepancy: float) -> _Data:
    """Information of amplitudes whose model is off by a share of each hologram's."""
    size = amplitude.shape[1]
    power = np.mean(np.abs(amplitude) ** 2, axis=1)
    off = (8 * discrepancy**2 * power)[:, None, None] * np.eye(2 * size)
    return _Data(amplitude, np.linalg.inv(noise + off).reshape(-1, 2, size, 2, size))


def _begin(model: _Model, amplitude: Complex, information: Array) -> tuple[_State, Array]:
    """Constant participations for which every hologram is most nearly a multiple of the model."""
    size, modes = amplitude.shape[1], len(model.reference)
    real, cross, imaginary = (
        information[:, :size, :size],
        information[:, size:, :size] - information[:, :size, size:],
        information[:, size:, size:],
    )
    hermitian = 0.5 * (real + imaginary) + 0.5j * cross
    ratio = (model.hz[:, None] / model.reference_hz) ** 2
    columns = (1 / (1 + 1j * _LOSS - ratio))[:, None, :] * model.reference.T
    seen = hermitian @ columns
    force = np.einsum("kij,kj->ki", hermitian, amplitude)
    power = np.einsum("ki,ki->k", amplitude.conj(), force).real
    along = np.einsum("kim,ki->km", columns.conj(), force)
    whole = np.einsum("kim,kin,k->mn", columns.conj(), seen, 1 / power, optimize=True)
    told = np.einsum("km,kn,k->mn", along, along.conj(), 1 / power**2, optimize=True)
    weak = 1e-5 * np.trace(whole).real / modes * np.eye(modes)
    p = linalg.eigh(whole - told, whole + weak)[1][:, 0]
    p = p / np.abs(p).max()
    expected = columns @ p
    drive = np.einsum("ki,ki->k", expected.conj(), amplitude)
    drive = drive / np.sum(np.abs(expected) ** 2, axis=1)
    return _State(_constant(model, p), np.log(drive)), np.maximum(np.abs(p), _LEAST_SCALE)


def _constant(model: _Model, p: Complex) -> Array:
    """Parameters (v, p) of constant participations, the loss expected, and shapes as they are."""
    count, powers = len(model.active), model.powers.shape[1]
    x = np.zeros((count + len(model.reference), model.slots))
    x[:count, 0], x[:count, powers] = p[model.active].real, p[model.active].imag
    x[:count, 2 * powers] = np.log(model.reference_hz[model.active])
    x[:count, 2 * powers + 1] = np.log(_LOSS)
    rest = p[model.passive]
    x[count + model.passive, count] = rest.real
    x[count + model.passive, count + _TAIL_TERMS] = rest.imag
    return x


def _finish(
    model: _Model,
    amplitude: Complex,
    noise: Array,
    centre_hz: Array,
    state: _State,
    names: Sequence[str],
) -> ModalFit:
    """Last rounds, with the discrepancy that makes what is left as large as it should be."""
    discrepancy, scale = _LAST.discrepancy, _scale(model, state)
    prior = _prior(model, _LAST, centre_hz, scale)
    for _ in range(2):
        data = _data(amplitude, noise, discrepancy)
        state = _improve(model, data, prior, _fixed(prior, state), _LAST.iterations)
        state = _with_gain(model, state)
        terms = _terms(model, state)
        freedoms = 2 * amplitude.size - 2 * len(amplitude) - np.count_nonzero(prior.free)
        misfit = float(data.misfits(terms.amplitude).sum()) / freedoms
        used, discrepancy = (
            discrepancy,
            float(np.clip(discrepancy * np.sqrt(misfit), *_DISCREPANCY)),
        )
    equations = _equations(model, data, prior, state)
    matrix, _, _ = _reduced(equations, 0.0)
    # Drive and participations have a common factor, which may be anything: of the latter only what
    # they are beside a given drive counts.
    beside_drive = np.linalg.inv(equations.matrix) * max(misfit, 1)
    count, powers = len(model.active), model.powers.shape[1]
    covariance = np.linalg.inv(matrix) * max(misfit, 1)
    spread = np.zeros_like(state.x)
    spread[prior.free] = np.sqrt(np.diag(covariance))
    own_hz = np.exp(state.x[:count, 2 * powers])
    modal = np.exp(state.log_drive)[:, None] * (terms.resonance * terms.participation)
    nearest = np.abs(np.log(model.hz[:, None] / own_hz)).argmin(axis=0)
    return ModalFit(
        names=tuple(names[m] for m in model.active),
        hz=own_hz,
        error_cents=spread[:count, 2 * powers] * 1200 / np.log(2),
        loss_factor=terms.loss[model.active],
        loss_error=spread[:count, 2 * powers + 1],
        shapes=terms.shapes[model.active],
        participation=terms.participation[nearest, model.active],
        participation_error=_participation_error(model, prior, beside_drive, nearest),
        drive=np.exp(state.log_drive),
        amplitude_rad=terms.amplitude,
        modal_rad=modal[:, model.active],
        misfit=misfit,
        discrepancy=used,
    )


def _participation_error(
    model: _Model, prior: _Prior, covariance: Array, nearest: NDArray[np.intp]
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
