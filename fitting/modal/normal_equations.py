"""Normal equations of the joint model, for its parameters, the common-mode error and the drive.

A derivative is a real function of frequency, the same for many parameters, times one of few columns
for each hologram: Chebyshev polynomials times the response of a mode, or the real and imaginary
parts of a mode's deflection times a coordinate, from which the derivatives by the mixing of shapes
follow. Products of all derivatives are therefore products of the columns through the information,
a small matrix for each hologram, summed over holograms with the products of these functions as
weights: a few products of matrices. What does not change from state to state is kept with the data.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.holograms.linearisation import triangle
from fitting.modal.drive.prior import DrivePrior
from fitting.modal.expected.prior import Prior
from fitting.modal.field_drift import FieldDrift
from fitting.modal.model import (
    LOSS_PARAMETERS,
    TAIL_TERMS,
    ExpectedLoss,
    Model,
    State,
    Terms,
    drive_prior_at,
    expected_loss,
    forces_by_logs,
    forces_by_losses,
    slopes,
    terms,
)
from fitting.modal.noise import Data
from holography.arrays import Array, ComplexArray


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
class _Group:
    """Own parameters whose derivatives are columns times the same functions of frequency.

    Attributes
    ----------
    rows : slice
        Columns of the group among those of `_Columns`.
    functions : (k, f) float
    positions : (r, f) int
        Positions of the parameters among all; -1 where a parameter is fixed.
    """

    rows: slice
    functions: Array
    positions: NDArray[np.intp]

    @property
    def count(self) -> int:
        """Number of functions."""
        return int(self.functions.shape[1])


@dataclass(frozen=True)
class _Columns:
    """Derivatives of the amplitudes, with their products through the information.

    In this order: own parameters, what modes lose, log magnitude and
    phase of the drive. Of own parameters, all real functions of frequency are left out.

    Attributes
    ----------
    own : slice
    losses : slice
    drive : slice
    seen : (k, c, 2j) float
        Columns times the information.
    products : (k, c, c) float
        Scalar products through the information.
    with_light : (k, c, q) float
        ... with the derivatives by the common-mode error.
    """

    own: slice
    losses: slice
    drive: slice
    seen: Array
    products: Array
    with_light: Array

    def with_shared(self, rows: slice) -> Array:
        """Return products (k, r, s + q) with the derivatives by what holograms share."""
        of_losses = self.products[:, rows, self.losses]
        return np.concatenate([of_losses, self.with_light[:, rows]], axis=2)


def _columns(model: Model, data: Data, at: "Evaluation") -> _Columns:
    state, now, active, passive = at.state, at.terms, model.active, model.passive
    by_force, whole = now.moved_by_forces(), now.amplitude
    driven = np.exp(state.log_drive)[:, None, None] * by_force
    by_log = [each[..., None] * by_force[:, active] for each in forces_by_logs(model, now)]
    both = np.array([1, 1j])[:, None]
    groups = [
        driven[:, active, None] * both,
        np.stack(by_log, axis=2),
        driven[:, passive, None] * both,
        forces_by_losses(model, now).swapaxes(0, 1) @ by_force,
        whole[:, None] * both,
    ]
    count, size = len(whole), whole.shape[1]
    columns = np.concatenate([each.reshape(count, -1, size) for each in groups], axis=1)
    columns = np.concatenate([columns.real, columns.imag], axis=2)
    seen, first = columns @ data.information, columns.shape[1] - LOSS_PARAMETERS - 2
    return _Columns(
        slice(first),
        slice(first, first + LOSS_PARAMETERS),
        slice(first + LOSS_PARAMETERS, None),
        seen,
        seen @ columns.swapaxes(1, 2),
        # The common-mode error moves the amplitudes as if the model moved the other way.
        -columns @ data.pulls,
    )


def _groups(model: Model, number: NDArray[np.intp]) -> list[_Group]:
    """Return the groups of own parameters: participations, logarithms, and tails.

    `number` (v, p) are the positions of the parameters among all; -1 where one is fixed.
    """
    count, powers = len(model.active), model.powers.shape[1]
    active, tails = np.arange(count), count + model.passive
    middle, last = 4 * count, 4 * count + 2 * len(tails)
    return [
        _Group(
            slice(2 * count),
            model.powers,
            number[active, : 2 * powers].reshape(-1, powers),
        ),
        _Group(
            slice(2 * count, middle),
            np.ones((len(model.hz), 1)),
            number[active, 2 * powers : 2 * powers + 2].reshape(-1, 1),
        ),
        _Group(
            slice(middle, last),
            model.powers[:, :TAIL_TERMS],
            number[tails, count : count + 2 * TAIL_TERMS].reshape(-1, TAIL_TERMS),
        ),
    ]


def equations(model: Model, data: Data, prior: Prior, at: "Evaluation") -> Equations:
    """Return the normal equations at a state.

    Along a valley, terms of the products cancel to a part in 10⁷: each derivative must be exact.
    """
    number = prior.positions
    columns, groups = _columns(model, data, at), _groups(model, number)
    mixing = _Mixing.of(model, number, at.terms.modal[:, model.active])
    own = np.concatenate([each.positions.ravel() for each in groups])
    mixed = mixing.positions
    first, drift = int(np.count_nonzero(prior.free)), data.drift
    matrix = np.empty((first + drift.parameters,) * 2)
    coupling = np.empty((len(matrix), 2, len(model.hz)))
    _write(matrix, own, own, _own_with_own(groups, columns))
    with_mixing = _joined(mixing.with_own(each, columns) for each in groups)
    _write(matrix, own, mixed, with_mixing)
    _write(matrix, mixed, own, with_mixing.T)
    _write(matrix, mixed, mixed, mixing.with_mixing(data))
    coupling[first:] = drift.columns(columns.with_shared(columns.drive).transpose(2, 1, 0))
    for rows, with_shared, with_drive in (
        (
            own,
            _joined(_own_with_shared(each, columns, drift) for each in groups),
            _joined(_own_with_drive(each, columns) for each in groups),
        ),
        (mixed, mixing.with_shared(columns, data), mixing.with_drive(columns)),
    ):
        matrix[rows[rows >= 0], first:] = with_shared[rows >= 0]
        coupling[rows[rows >= 0]] = with_drive[rows >= 0]
    matrix[first:, first:] = _shared_with_shared(columns, data) + data.precision
    prior.add_to(matrix)
    expected = at.expected
    losses, by_losses = number[tuple(expected.slots)], slice(first, first + LOSS_PARAMETERS)
    known = expected.precision[:, None] * expected.slopes
    matrix[losses, by_losses] -= known
    matrix[by_losses, by_losses] += expected.slopes.T @ known
    matrix[first:, :first] = matrix[:first, first:].T
    drive = columns.products[:, columns.drive, columns.drive]
    return Equations(
        matrix,
        coupling.reshape(len(matrix), -1),
        _drive_matrix(at.drive_prior.curvature, drive),
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
    expected : ExpectedLoss
    cost : float
        Twice the negative log of the posterior density.
    """

    state: State
    terms: Terms
    residual: Array
    drive_prior: DrivePrior
    expected: ExpectedLoss
    cost: float


def evaluate(model: Model, data: Data, prior: Prior, state: State) -> Evaluation:
    """Compute residuals and cost of a state."""
    now, drive_prior, shared = terms(model, state), drive_prior_at(model, state), state.shared
    residual = data.whitened_residual(now.amplitude, shared)
    expected = expected_loss(model, prior, state)
    known = float(shared @ (data.precision @ shared - 2 * data.pull)) + expected.prior.cost(state.x)
    cost = float(np.sum(residual**2)) + known + drive_prior.cost
    state = replace(state, scatter=drive_prior.scatter)
    return Evaluation(state, now, residual, drive_prior, expected, cost)


def negative_gradient(model: Model, data: Data, prior: Prior, at: Evaluation) -> Array:
    """Return the negative gradient (q + 2k,) of half the cost, in the order of `Equations`.

    This takes a small fraction of the time of `equations`.
    """
    state, now, residual, free = at.state, at.terms, at.residual, prior.free
    force = (residual[:, None, :] @ data.root)[:, 0]
    of_light = -(residual[:, None] @ data.response)[:, 0]
    pull = force[:, : force.shape[1] // 2] - 1j * force[:, force.shape[1] // 2 :]
    of_drive = np.sum(now.amplitude * pull, axis=1)
    of_parameters, of_losses = slopes(model, state, now, pull)
    offset = at.expected.prior.pull(state.x)
    of_shared = data.drift.gathered(np.concatenate([of_losses, of_light.T]))
    of_shared -= data.precision @ state.shared - data.pull
    of_shared[:LOSS_PARAMETERS] += offset[tuple(at.expected.slots)] @ at.expected.slopes
    return np.concatenate(
        [
            of_parameters[free] - offset[free],
            of_shared,
            of_drive.real + at.drive_prior.gradient,
            -of_drive.imag,
        ]
    )


def _write(
    matrix: Array, rows: NDArray[np.intp], others: NDArray[np.intp], products: Array
) -> None:
    """Write products (r, c) to rows and columns; those of negative numbers are left out."""
    kept, also = rows >= 0, others >= 0
    matrix[np.ix_(rows[kept], others[also])] = products[np.ix_(kept, also)]


def _joined(blocks: Iterable[Array]) -> Array:
    return np.concatenate(list(blocks))


def _weighed(weights: Array, products: Array) -> Array:
    """Sum products (k, ...) over holograms with weights (k, w): (w, ...)."""
    found: Array = weights.T @ products.reshape(len(products), -1)
    return np.reshape(found, (weights.shape[1], *products.shape[1:]))


def _both(one: Array, other: Array) -> Array:
    """Return all products (k, f g) of functions (k, f) with others (k, g)."""
    return (one[:, :, None] * other[:, None]).reshape(len(one), -1)


def _own_with_own(groups: Sequence[_Group], columns: _Columns) -> Array:
    """Return the products (p, p) of own parameters."""
    blocks = []
    for one in groups:
        row = []
        for other in groups:
            found = _weighed(
                _both(one.functions, other.functions), columns.products[:, one.rows, other.rows]
            )
            split = found.reshape(one.count, other.count, *found.shape[1:])
            row.append(
                split.transpose(2, 0, 3, 1).reshape(one.positions.size, other.positions.size)
            )
        blocks.append(row)
    return np.block(blocks)


def _own_with_shared(group: _Group, columns: _Columns, drift: FieldDrift) -> Array:
    """Return the products (p, q) of own parameters with what holograms share."""
    light = columns.with_shared(group.rows)
    constant = _weighed(group.functions, light).swapaxes(0, 1)
    nodes = _weighed(_both(group.functions, drift.share), light[:, :, drift.drifting])
    nodes = nodes.reshape(group.count, drift.share.shape[1], *nodes.shape[1:])
    size = group.positions.size
    return np.concatenate(
        [
            constant.reshape(size, drift.constant),
            nodes.transpose(2, 0, 1, 3).reshape(size, drift.parameters - drift.constant),
        ],
        axis=1,
    )


def _own_with_drive(group: _Group, columns: _Columns) -> Array:
    """Return the products (p, 2, k) of own parameters with the drive."""
    along = columns.products[:, group.rows, columns.drive].transpose(1, 2, 0)
    found: Array = along[:, None] * group.functions.T[:, None]
    return found.reshape(group.positions.size, *along.shape[1:])


def _shared_with_shared(columns: _Columns, data: Data) -> Array:
    """Return the products (p, p) of what holograms share."""
    answer: Array = data.common_mode_products.copy()
    of_losses = columns.with_shared(columns.losses).transpose(1, 2, 0)
    answer[:LOSS_PARAMETERS] = data.drift.gathered(of_losses)
    answer[:, :LOSS_PARAMETERS] = answer[:LOSS_PARAMETERS].T
    return answer


@dataclass(frozen=True)
class _Mixing:
    """Derivatives by the mixing coefficients: d h_a p_a S_m.

    Attributes
    ----------
    positions : (m a,) int
        Positions of the parameters among all; -1 where one is fixed.
    shapes : (m, j) float
        Shapes S.
    factors : (2, k, a) float
        Real and imaginary parts of d h_a p_a.
    """

    positions: NDArray[np.intp]
    shapes: Array
    factors: Array

    @classmethod
    def of(cls, model: Model, number: NDArray[np.intp], factors: ComplexArray) -> "_Mixing":
        """Set up the derivatives; `number` (v, p) are positions, `factors` (k, a) d h_a p_a."""
        active = len(model.active)
        positions = number[active:, :active].ravel()
        return cls(positions, model.reference, np.stack([factors.real, factors.imag]))

    def _summed(self, weights: Array, products: Array) -> Array:
        """Sum products (k, r, 2j) with weights (k, w) and factors: (w, m, a, r)."""
        count, rows, size = len(products), products.shape[1], products.shape[2] // 2
        halves = products.reshape(count, rows, 2, size).transpose(2, 0, 3, 1)
        found = sum(
            _weighed(_both(weights, factor), np.ascontiguousarray(half))
            for factor, half in zip(self.factors, halves, strict=True)
        )
        active = self.factors.shape[2]
        split = np.asarray(found).reshape(weights.shape[1], active, size, rows)
        found_by_shape: Array = self.shapes @ split
        return found_by_shape.swapaxes(1, 2)

    def with_own(self, group: _Group, columns: _Columns) -> Array:
        """Return the products (p, m a) with own parameters."""
        found = self._summed(group.functions, columns.seen[:, group.rows])
        return found.transpose(3, 0, 1, 2).reshape(group.positions.size, len(self.positions))

    def with_mixing(self, data: Data) -> Array:
        """Return the products (m a, m a) of all mixing coefficients."""
        active, size = self.factors.shape[2], self.shapes.shape[1]
        pairs = np.array([[_both(one, other) for other in self.factors] for one in self.factors])
        among = data.coordinate_pairs
        packed = pairs.reshape(-1, active**2).T @ among.reshape(-1, among.shape[-1])
        one, other = triangle(size)
        whole = np.empty((size, size, active, active))
        whole[one, other] = packed.reshape(active, active, -1).transpose(2, 0, 1)
        whole[other, one] = whole[one, other].swapaxes(1, 2)
        # From coordinates to shapes, on either side.
        mixed = self.shapes @ (self.shapes @ whole.reshape(size, -1)).reshape(
            len(self.shapes), size, -1
        )
        mixed = mixed.reshape(len(self.shapes), len(self.shapes), active, active)
        return mixed.transpose(0, 2, 1, 3).reshape(len(self.positions), -1)

    def with_shared(self, columns: _Columns, data: Data) -> Array:
        """Return the products (m a, q) with what holograms share."""
        drift, count = data.drift, self.factors.shape[1]
        once = np.ones((count, 1))
        of_losses = self._summed(once, columns.seen[:, columns.losses])[0]
        light = self._summed(once, -data.pulls.swapaxes(1, 2))[0]
        nodes = sum(
            _weighed(_both(factor, drift.share), -half)
            for factor, half in zip(self.factors, data.drifting_pulls.swapaxes(0, 1), strict=True)
        )
        active, size = self.factors.shape[2], self.shapes.shape[1]
        split = np.asarray(nodes).reshape(active, drift.share.shape[1], size, len(drift.drifting))
        moved = (self.shapes @ split).transpose(2, 0, 1, 3)
        constant = np.concatenate([of_losses, light], axis=2)
        rows, split_at = len(self.positions), drift.constant
        return np.concatenate(
            [
                constant.reshape(rows, split_at),
                moved.reshape(rows, drift.parameters - split_at),
            ],
            axis=1,
        )

    def with_drive(self, columns: _Columns) -> Array:
        """Return the products (m a, 2, k) with the drive."""
        along = columns.seen[:, columns.drive]
        count, size = len(along), self.shapes.shape[1]
        by_shape = along.reshape(count, 2, 2, size) @ self.shapes.T
        found: Array = np.einsum("hka,kdhm->madk", self.factors, by_shape)
        return found.reshape(len(self.positions), 2, count)


def _drive_matrix(curvature: Array, own: Array) -> Array:
    """Return the block of the drive from its prior and the products (k, 2, 2) of its columns."""
    count = len(curvature)
    matrix = linalg.block_diag(curvature, np.zeros((count, count)))
    k = np.arange(count)
    for row in range(2):
        for column in range(2):
            matrix[row * count + k, column * count + k] += own[:, row, column]
    return matrix
