"""Normal equations of the joint model: by its parameters, what all is off together, and the drive.

A derivative is a complex number for each hologram, times one of few vectors of coordinates: shapes
T of the active modes, and S of all. So their products through the information are those of the
vectors, a small matrix for each hologram, times these numbers. Mixing coefficients, which are most
of the parameters, share their numbers: that of mode m into a moves all by ``d h_a p_a S_m``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.modal.model import (
    Bend,
    Model,
    Prior,
    State,
    Terms,
    bend,
    scalars,
    terms,
)
from fitting.parallel.threads import map_threads

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]


# Parameters whose columns, beside all others, still lie in the processor's cache.
_TOGETHER = 40


@dataclass(frozen=True)
class Data:
    """What holograms tell, in units of their errors.

    Attributes
    ----------
    amplitude : (k, j) complex
    root : (k, 2j, 2j) float
        Root of the information of their real, then imaginary parts.
    response : (k, 2j, q) float
        Of amplitudes to what they are off together, times that root.
    precision : (q, q) float
        Inverse covariance of that.
    """

    amplitude: Complex
    root: Array
    response: Array
    precision: Array

    def apart(self, amplitude: Complex, together: Array) -> Array:
        """Distance (k, 2j) of every hologram from what a model says."""
        apart = parts(self.amplitude - amplitude)[..., None]
        return (self.root @ apart)[..., 0] + self.response @ together

    def weighing(self, share: float) -> "Data":
        """Return the same, of which each hologram counts as a share of one."""
        root = np.sqrt(share)
        return Data(self.amplitude, root * self.root, root * self.response, self.precision)

    def single(self) -> "Data":
        """Return the same in single precision: twice as fast, and good enough for a step."""
        return Data(
            self.amplitude,
            self.root.astype(np.float32),
            self.response.astype(np.float32),
            self.precision,
        )


def parts(complex_rows: Complex) -> Array:
    """Real, then imaginary parts: (k, j) → (k, 2j)."""
    return np.concatenate([complex_rows.real, complex_rows.imag], axis=1)


@dataclass(frozen=True)
class Equations:
    """Curvature of half the cost along the parameters: those free, then what all is off together.

    Attributes
    ----------
    matrix : (q, q) float
    coupling : (q, 2k) float
        With log magnitude, then phase of the drive.
    drive_matrix : (2k, 2k) float
    """

    matrix: Array
    coupling: Array
    drive_matrix: Array


@dataclass(frozen=True)
class _Seen:
    """Vectors (their real, then imaginary multiples) and `together` through the information.

    Attributes
    ----------
    columns : (k, 2j, 2v + q) float
        Times the root of the information.
    products : (2v + q, 2v + q, k) float
        Of these.
    """

    columns: Array
    products: Array

    def along(self, drive: Array) -> Array:
        """Products (2, 2v + q, k) with combinations (2, 2v, k) of vectors."""
        by_hologram = np.ascontiguousarray(drive.transpose(2, 0, 1))
        moved = by_hologram @ self.columns[:, :, : drive.shape[1]].swapaxes(1, 2)
        return np.ascontiguousarray((moved @ self.columns).transpose(1, 2, 0))


def _seen(model: Model, data: Data, now: Terms) -> _Seen:
    vectors = np.concatenate([now.shapes[model.active], model.reference]).astype(data.root.dtype)
    real, imaginary = (half @ vectors.T for half in np.split(data.root, 2, axis=2))
    # What all are off together moves the amplitudes as if the model moved the other way.
    columns = np.concatenate([real, imaginary, -data.response], axis=2)
    size = columns.shape[2]
    products = np.empty((size, size, len(columns)), columns.dtype)

    def fill(some: slice) -> None:
        products[:, :, some] = (columns[some].swapaxes(1, 2) @ columns[some]).transpose(1, 2, 0)

    map_threads(fill, len(columns))
    return _Seen(columns, products)


def equations(model: Model, data: Data, prior: Prior, state: State) -> Equations:
    """Linearise the model around a state."""
    now = terms(model, state)
    seen, layout = _seen(model, data, now), _layout(model, prior)
    # As precise as the data are given.
    numbers = np.result_type(data.root, np.complex64)
    by = scalars(model, state, now)[:, layout.own_v, layout.own_p]
    own = np.ascontiguousarray(by.T.astype(numbers))
    # All that mixes into a mode is moved by the same number.
    mixed = np.ascontiguousarray(now.modal[:, model.active].T.astype(numbers))
    drive = _drive(model, now, layout.vectors).astype(data.root.dtype)
    moved = seen.along(drive)
    order = layout.order(len(data.precision))
    matrix = _matrix(layout, seen, own, mixed)[np.ix_(order, order)]
    coupling = _coupling(layout, own, mixed, moved)[order]
    held = linalg.block_diag(np.diag(prior.precision[prior.free]), data.precision)
    return Equations(
        matrix + held,
        coupling.reshape(len(order), -1),
        _drive_matrix(model, state, moved, drive),
    )


@dataclass(frozen=True)
class Place:
    """A state and how good it is.

    Attributes
    ----------
    state : State
    terms : Terms
    left : (k, 2j) float
        See `Data.apart`.
    bent : Bend
    cost : float
        Twice the negative log of the posterior density.
    """

    state: State
    terms: Terms
    left: Array
    bent: Bend
    cost: float


def place(model: Model, data: Data, prior: Prior, state: State) -> Place:
    """Work out how good a state is."""
    now, bent, together = terms(model, state), bend(model, state), state.together
    left = data.apart(now.amplitude, together)
    known = float(together @ data.precision @ together) + prior.cost(state.x)
    return Place(state, now, left, bent, float(np.sum(left**2)) + known + bent.cost)


def downhill(model: Model, data: Data, prior: Prior, at: Place) -> Array:
    """Negative gradient (q + 2k,) of half the cost, in the order of `Equations`, then the drive.

    A fraction of what `equations` costs.
    """
    state, now, left, layout = at.state, at.terms, at.left, _layout(model, prior)
    force = (left[:, None, :] @ data.root)[:, 0]
    real, imaginary = np.split(force, 2, axis=1)
    vectors = np.concatenate([now.shapes[model.active], model.reference])
    pull = np.concatenate([vectors @ real.T, vectors @ imaginary.T])
    own = scalars(model, state, now)[:, layout.own_v, layout.own_p].T
    mixed = now.modal[:, model.active].T
    by_parameters = np.concatenate(
        [
            *_own_and_mixed(layout, pull, own, mixed),
            -np.einsum("kcq,kc->q", data.response, left, optimize=True),
        ]
    )[layout.order(len(data.precision))]
    offset = prior.precision[prior.free] * (state.x - prior.centre)[prior.free]
    drive = _drive(model, now, layout.vectors)
    by_drive = np.einsum("lck,ck->lk", drive, pull)
    by_drive[0] += at.bent.gradient
    return np.concatenate(
        [
            by_parameters - np.concatenate([offset, data.precision @ state.together]),
            by_drive.ravel(),
        ]
    )


@dataclass(frozen=True)
class _Layout:
    """Which parameters are free: of one vector each, and mixing coefficients.

    Attributes
    ----------
    own_v, own_p : (p,) int
        Vectors and slots of the former.
    mix_m, mix_a : (q,) int
        Modes whose shapes are mixed into those of active ones.
    active, vectors : int
        How many there are.
    slots : int
        See `Model.slots`.
    """

    own_v: NDArray[np.intp]
    own_p: NDArray[np.intp]
    mix_m: NDArray[np.intp]
    mix_a: NDArray[np.intp]
    active: int
    vectors: int
    slots: int

    def order(self, together: int) -> NDArray[np.intp]:
        """Sort own, then mixing parameters as they stand in a state; the rest stays behind."""
        vector = np.concatenate([self.own_v, self.mix_m + self.active])
        order = np.argsort(vector * self.slots + np.concatenate([self.own_p, self.mix_a]))
        return np.concatenate([order, len(order) + np.arange(together)])


def _layout(model: Model, prior: Prior) -> _Layout:
    active, free = len(model.active), prior.free
    mixing = np.zeros_like(free)
    mixing[active:, :active] = free[active:, :active]
    own_v, own_p = np.nonzero(free & ~mixing)
    mix_m, mix_a = np.nonzero(mixing[active:, :active])
    return _Layout(own_v, own_p, mix_m, mix_a, active, len(free), model.slots)


def _matrix(layout: _Layout, seen: _Seen, own: Complex, mixed: Complex) -> Array:
    """Products (q, q) of all columns: own, mixing, together."""
    active, vectors = layout.active, layout.vectors
    mix_m, mix_a = layout.mix_m, layout.mix_a
    last = seen.products[2 * vectors :]
    own_own, own_mixed, own_last = _of_own(layout, seen, own, mixed)
    last_mixed = _with_mixed(last, mixed, active, vectors)[:, mix_m, mix_a]
    mixed_mixed = _mixed_with_mixed(seen.products, mixed, active, vectors)[
        mix_m[:, None], mix_a[:, None], mix_m, mix_a
    ]
    return np.block(
        [
            [own_own, own_mixed, own_last],
            [own_mixed.T, mixed_mixed, last_mixed.T],
            [own_last.T, last_mixed, last[:, 2 * vectors :].sum(axis=2)],
        ]
    )


def _own_and_mixed(
    layout: _Layout, pull: Array, own: Complex, mixed: Complex
) -> tuple[Array, Array]:
    """Sums over holograms of columns times what pulls at their vectors (2v, k)."""
    active, vectors, own_v = layout.active, layout.vectors, layout.own_v
    of_mixed = _with_mixed(pull[None], mixed, active, vectors)[0]
    return (
        np.sum(own.real * pull[own_v] + own.imag * pull[own_v + vectors], axis=1),
        of_mixed[layout.mix_m, layout.mix_a],
    )


def _coupling(layout: _Layout, own: Complex, mixed: Complex, moved: Array) -> Array:
    """Products (q, 2, k) of all columns with those of the drive's log magnitude and phase."""
    active, vectors, own_v = layout.active, layout.vectors, layout.own_v
    of_own = [own.real * m[own_v] + own.imag * m[own_v + vectors] for m in moved]
    of_mixed = [_by_mixed(m, mixed, active, vectors)[layout.mix_m, layout.mix_a] for m in moved]
    return np.concatenate(
        [
            np.stack(of_own, axis=1),
            np.stack(of_mixed, axis=1),
            moved[:, 2 * vectors :].swapaxes(0, 1),
        ]
    )


def _of_own(
    layout: _Layout, seen: _Seen, own: Complex, mixed: Complex
) -> tuple[Array, Array, Array]:
    """Products of columns of one vector each with such (p, p), mixing (p, r), together (p, q)."""
    active, vectors, own_v = layout.active, layout.vectors, layout.own_v
    count = len(own_v)
    with_own = np.empty((count, count))
    with_mixed = np.empty((count, len(layout.mix_m)))
    with_last = np.empty((count, len(seen.products) - 2 * vectors))

    def fill(some: slice) -> None:
        # Few at a time: beside all other vectors each is as long as there are holograms.
        real, imaginary = own.real[some, None], own.imag[some, None]
        beside = np.empty((len(real), *seen.products.shape[1:]), seen.products.dtype)
        for row, v in enumerate(own_v[some]):
            np.multiply(real[row], seen.products[v], out=beside[row])
            beside[row] += imaginary[row] * seen.products[v + vectors]
        with_own[some] = _with_own(beside, own_v, own, vectors)
        by_mode = _with_mixed(beside, mixed, active, vectors)
        with_mixed[some] = by_mode[:, layout.mix_m, layout.mix_a]
        with_last[some] = beside[:, 2 * vectors :].sum(axis=2)

    map_threads(fill, count, _TOGETHER)
    return with_own, with_mixed, with_last


def _with_own(beside: Array, own_v: NDArray[np.intp], own: Complex, vectors: int) -> Array:
    """Products (p, p) of columns with those of a vector of its own each."""
    product = np.empty((len(beside), len(own_v)))
    for v in np.unique(own_v):
        of_v = own_v == v
        product[:, of_v] = (
            beside[:, v] @ own.real[of_v].T + beside[:, v + vectors] @ own.imag[of_v].T
        )
    return product


def _with_mixed(beside: Array, mixed: Complex, active: int, vectors: int) -> Array:
    """Products (p, m, a) of columns with all mixing coefficients."""
    real, imaginary = beside[:, active:vectors], beside[:, active + vectors : 2 * vectors]
    product: Array = real @ mixed.real.T + imaginary @ mixed.imag.T
    return product


def _by_mixed(seen: Array, mixed: Complex, active: int, vectors: int) -> Array:
    """What (2v + q, k) has of mixing coefficients: (m, a, k)."""
    real, imaginary = seen[active:vectors, None], seen[active + vectors : 2 * vectors, None]
    found: Array = real * mixed.real + imaginary * mixed.imag
    return found


def _mixed_with_mixed(products: Array, mixed: Complex, active: int, vectors: int) -> Array:
    """Products (m, a, m, a) of all mixing coefficients with each other."""
    halves = slice(active, vectors), slice(active + vectors, 2 * vectors)
    numbers = mixed.real, mixed.imag
    modes = vectors - active
    whole = np.zeros((modes * modes, len(mixed) ** 2))
    for one, by in zip(halves, numbers, strict=True):
        for other, times in zip(halves, numbers, strict=True):
            pairs = (by[:, None] * times).reshape(-1, by.shape[-1])
            whole += products[one, other].reshape(modes * modes, -1) @ pairs.T
    return whole.reshape(modes, modes, len(mixed), len(mixed)).transpose(0, 2, 1, 3)


def _drive(model: Model, now: Terms, vectors: int) -> Array:
    """Derivatives (2, 2v, k) by log magnitude and phase: amplitudes, and these turned by 90°."""
    weight = np.zeros((vectors, len(model.hz)), complex)
    active, passive = model.active, model.passive
    weight[: len(active)] = now.modal[:, active].T
    weight[len(active) + passive] = now.modal[:, passive].T
    return np.stack(
        [
            np.concatenate([weight.real, weight.imag]),
            np.concatenate([-weight.imag, weight.real]),
        ]
    )


def _drive_matrix(model: Model, state: State, moved: Array, drive: Array) -> Array:
    count, bent = len(model.hz), bend(model, state)
    own = np.einsum("lck,mck->lmk", moved[:, : drive.shape[1]], drive)
    matrix = linalg.block_diag(bent.curvature, np.zeros((count, count)))
    k = np.arange(count)
    for row in range(2):
        for column in range(2):
            matrix[row * count + k, column * count + k] += own[row, column]
    return matrix
