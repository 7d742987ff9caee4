"""Normal equations of the joint model, for its parameters, the common-mode error and the drive.

A derivative is a complex number for each hologram, times one of few vectors of coordinates: the
shapes T of the active modes and S of all modes. Products of derivatives are therefore products of
the vectors through the information, a small matrix for each hologram, times products of these
numbers. Most parameters are mixing coefficients, and many have the same numbers: the derivative by
the mixing of mode m into a is ``d h_a p_a S_m``.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.modal.drive_prior import DrivePrior
from fitting.modal.field_drift import FieldDrift
from fitting.modal.model import (
    OUT_OF_PHASE,
    Model,
    Prior,
    State,
    Terms,
    by_logs,
    drive_prior_at,
    scalars,
    terms,
)
from fitting.parallel.threads import map_threads
from holography.arrays import Array, ComplexArray

# Number of parameters whose products with all columns fit into the processor's cache.
_ROWS_AT_ONCE = 40


@dataclass(frozen=True)
class Data:
    """Amplitudes of all holograms, with the root of their information.

    Attributes
    ----------
    amplitude : (k, j) complex
    root : (k, 2j, 2j) float
        Root of the information on the real, then imaginary parts of the amplitudes.
    response : (k, 2j, q) float
        Derivatives of the amplitudes by the common-mode error of each hologram, times that root.
    drift : FieldDrift
        How this follows from the parameters that all holograms share.
    precision : (p, p) float
        Inverse covariance of these parameters.
    pull : (p,) float
        This times their expectation.
    """

    amplitude: ComplexArray
    root: Array
    response: Array
    drift: FieldDrift
    precision: Array
    pull: Array

    def whitened_residual(self, amplitude: ComplexArray, shared: Array) -> Array:
        """Return the whitened residuals (k, 2j) of amplitudes (k, j) that a model predicts."""
        whitened_residual = self.root @ parts(self.amplitude - amplitude)[..., None]
        shift = self.drift.shift(shared)[:, OUT_OF_PHASE:]
        found: Array = (whitened_residual + self.response @ shift[..., None])[..., 0]
        return found

    @cached_property
    def common_mode_products(self) -> Array:
        """Products (p, p) of the responses to the parameters that all holograms share.

        Those by which modes are out of phase are left 0: they depend on the state.
        """
        rows = OUT_OF_PHASE + self.response.shape[2]
        products = np.zeros((rows, rows, len(self.response)))
        each = self.response.swapaxes(1, 2) @ self.response
        products[OUT_OF_PHASE:, OUT_OF_PHASE:] = each.transpose(1, 2, 0)
        return self.drift.products(products)

    def weighing(self, fraction: float) -> "Data":
        """Return the same data with every hologram weighted by a factor."""
        root = np.sqrt(fraction)
        return replace(self, root=root * self.root, response=root * self.response)


def parts(complex_rows: ComplexArray) -> Array:
    """Concatenate real and imaginary parts: (k, j) → (k, 2j)."""
    return np.concatenate([complex_rows.real, complex_rows.imag], axis=1)


@dataclass(frozen=True)
class Equations:
    """Half the Gauss-Newton Hessian of the cost.

    Attributes
    ----------
    matrix : (q, q) float
        Block of the free parameters, then the common-mode error.
    coupling : (q, 2k) float
        Block between these and the drive: its log magnitude, then its phase.
    drive_matrix : (2k, 2k) float
        Block of the drive.
    """

    matrix: Array
    coupling: Array
    drive_matrix: Array


@dataclass(frozen=True)
class _Seen:
    """Vectors (real, then imaginary multiples) and common-mode responses, whitened.

    Attributes
    ----------
    columns : (k, 2j, 2v + q) float
        Whitened vectors.
    products : (2v + s, 2v + q, k) float
        Scalar products with them of the vectors, and of the responses to the s parameters by which
        modes are out of phase.
    """

    columns: Array
    products: Array

    def along(self, drive: Array) -> Array:
        """Return the products (2, 2v + q, k) with linear combinations (2, 2v, k) of vectors."""
        by_hologram = np.ascontiguousarray(drive.transpose(2, 0, 1))
        moved = by_hologram @ self.columns[:, :, : drive.shape[1]].swapaxes(1, 2)
        return np.ascontiguousarray((moved @ self.columns).transpose(1, 2, 0))


def _seen(model: Model, data: Data, at: "Evaluation") -> _Seen:
    modes, whitened = _moving_others(model, at).swapaxes(1, 2), []
    for factor, half in zip((1, 1j), np.split(data.root, 2, axis=2), strict=True):
        turned = factor * modes
        whitened.append(data.root @ np.concatenate([turned.real, turned.imag], axis=1))
        whitened.append(half @ model.reference.T)
    # The common-mode error moves the amplitudes, which is as if the model moved the other way.
    columns = np.concatenate([*whitened, _out_of_phase(data, at.terms), -data.response], axis=2)
    size, rows = columns.shape[2], columns.shape[2] - data.response.shape[2]
    products = np.empty((rows, size, len(columns)))

    def fill(some: slice) -> None:
        own = columns[some, :, :rows].swapaxes(1, 2)
        products[:, :, some] = (own @ columns[some]).transpose(1, 2, 0)

    map_threads(fill, len(columns))
    return _Seen(columns, products)


def _moving_others(model: Model, at: "Evaluation") -> ComplexArray:
    """Return the displacement (k, a, j) of each active mode, with what it moves out of phase."""
    (*losses, sound), now = at.state.out_of_phase, at.terms
    by_sound = now.resonance[:, :, None] * model.sound[:, :, model.active]
    by_loss = np.tensordot(losses, model.loss_mixing[:, model.active], axes=1) @ now.shapes
    others = by_loss - sound * by_sound.swapaxes(1, 2) @ now.shapes
    found: ComplexArray = now.shapes[model.active] + 1j * others
    return found


def _by_sound_of_others(model: Model, at: "Evaluation") -> tuple[ComplexArray, ComplexArray]:
    """Return derivatives (k, a) by log frequency and log loss factor, by the sound of others.

    The sound that others send moves a mode by its resonance.
    """
    sent = (model.sound[:, model.active] @ at.terms.modal[..., None])[..., 0]
    by_hz, by_loss = by_logs(model, at.terms)
    factor = -1j * at.state.out_of_phase[-1] * sent
    return factor * by_hz, factor * by_loss


def _out_of_phase(data: Data, now: Terms) -> Array:
    """Return the whitened derivatives (k, 2j, 2) by the parameters that modes are out of phase."""
    moved = np.stack([parts(modal @ now.shapes) for modal in now.out_of_phase], axis=2)
    found: Array = data.root @ moved
    return found


def equations(model: Model, data: Data, prior: Prior, at: "Evaluation") -> Equations:
    """Return the normal equations at a state.

    What depends on the square of parameters by which modes are out of phase is left out.
    """
    state, now = at.state, at.terms
    seen, layout = _seen(model, data, at), _layout(model, prior)
    by = scalars(model, state, now)
    by[:, : layout.active, layout.logs] += np.stack(_by_sound_of_others(model, at), axis=2)
    own = np.ascontiguousarray(by[:, layout.own_v, layout.own_p].T)
    # All shapes that mix into a mode have the same factor.
    mixed = np.ascontiguousarray(now.moved(state)[:, model.active].T)
    drive = _drive(model, now.modal, layout.vectors)
    moved = seen.along(drive)
    order = layout.order(len(data.precision))
    matrix = _matrix(layout, seen, own, mixed, data)[np.ix_(order, order)]
    coupling = _coupling(layout, own, mixed, moved, data.drift)[order]
    held = linalg.block_diag(np.diag(prior.precision[prior.free]), data.precision)
    return Equations(
        matrix + held,
        coupling.reshape(len(order), -1),
        _drive_matrix(at.drive_prior.curvature, moved, drive),
    )


@dataclass(frozen=True)
class Evaluation:
    """A state with its residuals and cost.

    Attributes
    ----------
    state : State
    terms : Terms
    residual : (k, 2j) float
        Whitened residuals, see `Data.whitened_residual`.
    drive_prior : DrivePrior
    cost : float
        Twice the negative log of the posterior density.
    """

    state: State
    terms: Terms
    residual: Array
    drive_prior: DrivePrior
    cost: float


def evaluate(model: Model, data: Data, prior: Prior, state: State) -> Evaluation:
    """Compute residuals and cost of a state."""
    now, drive_prior, shared = terms(model, state), drive_prior_at(model, state), state.shared
    residual = data.whitened_residual(now.amplitude(state), shared)
    known = float(shared @ (data.precision @ shared - 2 * data.pull)) + prior.cost(state.x)
    state = replace(state, scatter=drive_prior.scatter)
    return Evaluation(
        state, now, residual, drive_prior, float(np.sum(residual**2)) + known + drive_prior.cost
    )


def negative_gradient(model: Model, data: Data, prior: Prior, at: Evaluation) -> Array:
    """Return the negative gradient (q + 2k,) of half the cost, in the order of `Equations`.

    This takes a small fraction of the time of `equations`.
    """
    state, now, residual, layout = at.state, at.terms, at.residual, _layout(model, prior)
    force = (residual[:, None, :] @ data.root)[:, 0]
    real, imaginary = np.split(force, 2, axis=1)
    vectors = np.concatenate([now.shapes[model.active], model.reference])
    pull = np.concatenate([vectors @ real.T, vectors @ imaginary.T])
    of_shared = np.concatenate(
        [
            (residual[:, None] @ _out_of_phase(data, now))[:, 0],
            -(residual[:, None] @ data.response)[:, 0],
        ],
        axis=1,
    )
    by_parameters = np.concatenate(
        [
            _by_own(model, at, layout, pull),
            _by_mixing(layout, pull, now.moved(state)[:, model.active].T),
            data.drift.gathered(of_shared.T),
        ]
    )[layout.order(len(data.precision))]
    offset = prior.precision[prior.free] * (state.x - prior.centre)[prior.free]
    drawn = data.precision @ state.shared - data.pull
    drive = _drive(model, now.moved(state), layout.vectors)
    by_drive = np.einsum("lck,ck->lk", drive, pull)
    by_drive[0] += at.drive_prior.gradient
    return np.concatenate(
        [
            by_parameters - np.concatenate([offset, drawn]),
            by_drive.ravel(),
        ]
    )


def _by_own(model: Model, at: Evaluation, layout: "_Layout", pull: Array) -> Array:
    """Return the slopes (p,) by own parameters, for forces (2v, k) on all vectors.

    A mode moves others out of phase, so that forces on these act on it, too.
    """
    state, now, active, vectors = at.state, at.terms, model.active, layout.vectors
    own = scalars(model, state, now)[:, layout.own_v, layout.own_p].T
    force = pull[:vectors] - 1j * pull[vectors:]
    on_modes = force[len(active) :].T.copy()
    on_modes[:, active] = force[: len(active)].T
    *losses, sound = state.out_of_phase
    mixing = np.tensordot(losses, model.loss_mixing, axes=1)
    sounding = ((now.resonance * on_modes)[:, None] @ model.sound)[:, 0]
    more = 1j * (on_modes @ mixing.T - sound * sounding).T
    whole = force + np.concatenate([more[active], more])
    slopes: Array = np.sum((own * whole[layout.own_v]).real, axis=1)
    for slot, by_others in enumerate(_by_sound_of_others(model, at), start=layout.logs.start):
        which = np.flatnonzero((layout.own_p == slot) & (layout.own_v < len(active)))
        modes = layout.own_v[which]
        slopes[which] += np.sum((by_others.T * force[: len(active)]).real, axis=1)[modes]
    return slopes


@dataclass(frozen=True)
class _Layout:
    """Positions of the free parameters: own parameters of a vector, and mixing coefficients.

    Attributes
    ----------
    own_v, own_p : (p,) int
        Row and column of the own parameters in a state.
    mix_m, mix_a : (q,) int
        Mode whose shape is mixed, and active mode into which it is mixed.
    active, vectors : int
        Number of active modes, and of vectors.
    slots : int
        See `Model.slots`.
    logs : slice
        Slots of log frequency and log loss factor.
    """

    own_v: NDArray[np.intp]
    own_p: NDArray[np.intp]
    mix_m: NDArray[np.intp]
    mix_a: NDArray[np.intp]
    active: int
    vectors: int
    slots: int
    logs: slice

    def order(self, common_modes: int) -> NDArray[np.intp]:
        """Return the order of a state for own, then mixing parameters; common modes stay last."""
        vector = np.concatenate([self.own_v, self.mix_m + self.active])
        order = np.argsort(vector * self.slots + np.concatenate([self.own_p, self.mix_a]))
        return np.concatenate([order, len(order) + np.arange(common_modes)])


def _layout(model: Model, prior: Prior) -> _Layout:
    active, free = len(model.active), prior.free
    mixing = np.zeros_like(free)
    mixing[active:, :active] = free[active:, :active]
    own_v, own_p = np.nonzero(free & ~mixing)
    mix_m, mix_a = np.nonzero(mixing[active:, :active])
    first = 2 * model.powers.shape[1]
    logs = slice(first, first + 2)
    return _Layout(own_v, own_p, mix_m, mix_a, active, len(free), model.slots, logs)


def _matrix(
    layout: _Layout, seen: _Seen, own: ComplexArray, mixed: ComplexArray, data: Data
) -> Array:
    """Return the products (q, q) of all columns: own, mixing, common mode."""
    active, vectors, drift = layout.active, layout.vectors, data.drift
    mix_m, mix_a = layout.mix_m, layout.mix_a
    last = seen.products[: 2 * vectors, 2 * vectors :].swapaxes(0, 1)
    own_own, own_mixed, own_last = _of_own(layout, seen, own, mixed, drift)
    last_mixed = _last_with_mixed(last, mixed, layout, drift)[:, mix_m, mix_a]
    mixed_mixed = _mixed_with_mixed(seen.products, mixed, active, vectors)[
        mix_m[:, None], mix_a[:, None], mix_m, mix_a
    ]
    return np.block(
        [
            [own_own, own_mixed, own_last],
            [own_mixed.T, mixed_mixed, last_mixed.T],
            [own_last.T, last_mixed, _of_common_mode(seen.products[2 * vectors :], layout, data)],
        ]
    )


def _of_common_mode(out_of_phase: Array, layout: _Layout, data: Data) -> Array:
    """Return the products (p, p) of common-mode columns, for those out of phase (s, 2v + q, k)."""
    answer = data.common_mode_products.copy()
    count = len(out_of_phase)
    answer[:count] = data.drift.gathered(out_of_phase[:, 2 * layout.vectors :])
    answer[:, :count] = answer[:count].T
    return answer


def _by_mixing(layout: _Layout, pull: Array, mixed: ComplexArray) -> Array:
    """Return the slopes by mixing coefficients, for forces (2v, k) on all vectors."""
    found = _with_mixed(pull[None], mixed, layout.active, layout.vectors)[0]
    slopes: Array = found[layout.mix_m, layout.mix_a]
    return slopes


def _last_with_mixed(last: Array, mixed: ComplexArray, layout: _Layout, drift: FieldDrift) -> Array:
    """Return the products (p, m, a) of common-mode columns with those of mixing coefficients."""
    active, vectors = layout.active, layout.vectors
    share, modes = drift.share.T, vectors - active
    by_node = (share[:, None] * mixed).reshape(-1, mixed.shape[1]).astype(mixed.dtype)
    nodes = _with_mixed(last[drift.drifting], by_node, active, vectors)
    nodes = nodes.reshape(len(drift.drifting), modes, len(share), len(mixed)).transpose(2, 0, 1, 3)
    constant = _with_mixed(last, mixed, active, vectors)
    return np.concatenate([constant, nodes.reshape(-1, modes, len(mixed))])


def _coupling(
    layout: _Layout, own: ComplexArray, mixed: ComplexArray, moved: Array, drift: FieldDrift
) -> Array:
    """Return the products (q, 2, k) of all columns with those of the drive."""
    active, vectors, own_v = layout.active, layout.vectors, layout.own_v
    of_own = [own.real * m[own_v] + own.imag * m[own_v + vectors] for m in moved]
    of_mixed = [_by_mixed(m, mixed, active, vectors)[layout.mix_m, layout.mix_a] for m in moved]
    return np.concatenate(
        [
            np.stack(of_own, axis=1),
            np.stack(of_mixed, axis=1),
            drift.columns(moved[:, 2 * vectors :].swapaxes(0, 1)),
        ]
    )


def _of_own(
    layout: _Layout, seen: _Seen, own: ComplexArray, mixed: ComplexArray, drift: FieldDrift
) -> tuple[Array, Array, Array]:
    """Return products of own columns with own (p, p), mixing (p, r), common-mode ones (p, q)."""
    active, vectors, own_v = layout.active, layout.vectors, layout.own_v
    count = len(own_v)
    with_own = np.empty((count, count))
    with_mixed = np.empty((count, len(layout.mix_m)))
    with_last = np.empty((count, drift.parameters))

    def fill(some: slice) -> None:
        # Few rows at a time: each has a number for every vector and hologram.
        real, imaginary = own.real[some, None], own.imag[some, None]
        rows = np.empty((len(real), *seen.products.shape[1:]), seen.products.dtype)
        for row, v in enumerate(own_v[some]):
            np.multiply(real[row], seen.products[v], out=rows[row])
            rows[row] += imaginary[row] * seen.products[v + vectors]
        with_own[some] = _with_own(rows, own_v, own, vectors)
        by_mode = _with_mixed(rows, mixed, active, vectors)
        with_mixed[some] = by_mode[:, layout.mix_m, layout.mix_a]
        with_last[some] = drift.gathered(rows[:, 2 * vectors :])

    map_threads(fill, count, _ROWS_AT_ONCE)
    return with_own, with_mixed, with_last


def _with_own(rows: Array, own_v: NDArray[np.intp], own: ComplexArray, vectors: int) -> Array:
    """Return the products (p, p) of rows with own columns."""
    product = np.empty((len(rows), len(own_v)))
    for v in np.unique(own_v):
        of_v = own_v == v
        product[:, of_v] = rows[:, v] @ own.real[of_v].T + rows[:, v + vectors] @ own.imag[of_v].T
    return product


def _with_mixed(rows: Array, mixed: ComplexArray, active: int, vectors: int) -> Array:
    """Return the products (p, m, a) of rows with the columns of all mixing coefficients."""
    real, imaginary = rows[:, active:vectors], rows[:, active + vectors : 2 * vectors]
    product: Array = real @ mixed.real.T + imaginary @ mixed.imag.T
    return product


def _by_mixed(seen: Array, mixed: ComplexArray, active: int, vectors: int) -> Array:
    """Return the elements (m, a, k) of mixing coefficients in rows (2v + q, k)."""
    real, imaginary = seen[active:vectors, None], seen[active + vectors : 2 * vectors, None]
    found: Array = real * mixed.real + imaginary * mixed.imag
    return found


def _mixed_with_mixed(products: Array, mixed: ComplexArray, active: int, vectors: int) -> Array:
    """Return the products (m, a, m, a) of the columns of all mixing coefficients."""
    halves = slice(active, vectors), slice(active + vectors, 2 * vectors)
    numbers = mixed.real, mixed.imag
    modes = vectors - active
    whole = np.zeros((modes * modes, len(mixed) ** 2))
    for one, by in zip(halves, numbers, strict=True):
        for other, times in zip(halves, numbers, strict=True):
            pairs = (by[:, None] * times).reshape(-1, by.shape[-1])
            whole += products[one, other].reshape(modes * modes, -1) @ pairs.T
    return whole.reshape(modes, modes, len(mixed), len(mixed)).transpose(0, 2, 1, 3)


def _drive(model: Model, modal: ComplexArray, vectors: int) -> Array:
    """Return the derivatives (2, 2v, k) by log magnitude and phase of the drive.

    They are the amplitudes of deflections (k, m), and the amplitudes turned by 90°.
    """
    weight = np.zeros((vectors, len(modal)), complex)
    active, passive = model.active, model.passive
    weight[: len(active)] = modal[:, active].T
    weight[len(active) + passive] = modal[:, passive].T
    return np.stack(
        [
            np.concatenate([weight.real, weight.imag]),
            np.concatenate([-weight.imag, weight.real]),
        ]
    )


def _drive_matrix(curvature: Array, moved: Array, drive: Array) -> Array:
    count = len(curvature)
    own = np.einsum("lck,mck->lmk", moved[:, : drive.shape[1]], drive)
    matrix = linalg.block_diag(curvature, np.zeros((count, count)))
    k = np.arange(count)
    for row in range(2):
        for column in range(2):
            matrix[row * count + k, column * count + k] += own[row, column]
    return matrix
