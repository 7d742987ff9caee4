"""Modes of reeds that differ little from a known one, by Newton's method from its modes.

A mode is a shape x and a frequency f at which the dynamic stiffness Z is singular. From the modes
of a known reed those of another one are reached by steps with the bordered inverse of Z at the
known modes. Modes that do not settle so are followed by inverse iteration. The number of modes
below the highest frequency is the number of negative eigenvalues of Z there, and no two modes found
may be equal: else the other reed is not near, and its modes are sought from nothing.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import linear_sum_assignment

from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.reed.reduced.dynamics import Coordinates, Dynamics, State, coordinates_of, dynamics_of
from physics.reed.reduced.reed import ReducedReed
from physics.reed.reduced.vibrations import (
    Group,
    Vibrations,
    mass_forms,
    same_shapes,
    settled,
    together,
    vibrations,
)

# The modes of the known reed are sought up to this multiple of the highest frequency, so that
# those which another reed has below it are among them. Chosen: an octave has some ten modes, and a
# reed whose modes move by more than this is not near.
_BEYOND = 1.1
# Steps end when further ones would change a shape by less than this, as a fraction of its largest
# coordinate; its frequency is then exact to the square. At most this many are taken.
_SETTLED, _MOST_STEPS = 1e-6, 8
# A step must be smaller than this share of the one before.
_LEAST_PROGRESS = 0.8
# A step that is a larger fraction of a shape than this comes from modes too close for it, and is
# not taken. Chosen: as in `physics.reed.reduced.vibrations`.
_MOST_CORRECTION = 0.5
# First order says nothing of modes that it moves by more than this in log frequency. Chosen: an
# octave and a half; reeds that are near have modes within a tenth of that.
_MOST_MOVED = 1.0
# Springs of another clamp move the strips in the same directions, but for this fraction.
_SAME_DIRECTIONS = 1e-8


@dataclass(frozen=True)
class _Known:
    """Modes of one group of the known reed.

    Attributes
    ----------
    group : Group
    inverses : (m, n, n) float
        Of the dynamic stiffness at each mode, for shapes that keep their part along the mode.
    """

    group: Group
    inverses: Array


class NearbyModes:
    """Modes of reeds that differ little from a known one.

    Parameters
    ----------
    reed : ReducedReed
    state : State
        Of the known reed.
    highest_hz : float
        Modes up to here are found.

    Attributes
    ----------
    own : Vibrations
        Modes of the known reed.

    Raises
    ------
    ImpossibleReedError
        If the known reed is physically impossible.
    """

    def __init__(self, reed: ReducedReed, state: State, highest_hz: float) -> None:
        self._reed, self._highest_hz = reed, highest_hz
        found = vibrations(reed, state, _BEYOND * highest_hz)
        self._known = tuple(_known(group) for group in found.groups)
        self.own = self.modes(state) or vibrations(reed, state, highest_hz)

    def modes(self, state: State) -> Vibrations | None:
        """Return the modes of a reed; None if they are not near those of the known one."""
        every = coordinates_of(self._reed, state.change, 0.0)
        known = self._known
        if [own.parts for own in every] != [each.group.coordinates.parts for each in known]:
            return None
        groups = []
        for each, own in zip(known, every, strict=True):
            turned = _turned(each.group.coordinates, own)
            if turned is None:
                return None
            # Which coordinates are low is that of the known reed: it is not needed here.
            full = dynamics_of(self._reed, state, own)
            try:
                group = _followed(each, own, full, turned, self._highest_hz)
            except (np.linalg.LinAlgError, ImpossibleReedError):
                return None
            if group is None:
                return None
            groups.append(group)
        return together(self._reed, state, groups)


def _known(group: Group) -> _Known:
    amounts, slopes = group.dynamics.amounts(group.hz)
    matrices, x = group.dynamics.matrices, group.vectors
    Z = np.tensordot(amounts, matrices, axes=1)
    across = np.einsum("mi,inm->mn", slopes, np.matmul(matrices, x))
    m, n = across.shape
    bordered = np.zeros((m, n + 1, n + 1))
    bordered[:, :n, :n] = Z
    bordered[:, :n, n] = bordered[:, n, :n] = across
    scale = 1 / np.sqrt(np.maximum(np.abs(np.einsum("mnn->mn", bordered)), 1e-300))
    scale[:, n] = 1 / np.sqrt(np.mean(across**2, axis=1))
    balanced = scale[:, :, None] * bordered * scale[:, None, :]
    inverses = scale[:, :, None] * np.linalg.inv(balanced) * scale[:, None, :]
    return _Known(group, inverses[:, :n, :n])


def _turned(known: Coordinates, own: Coordinates) -> Array | None:
    """Return what coordinates of springs (k, k) of the known reed one of another reed is.

    None if the strips of the other one move in other directions.
    """
    if known.strip.shape != own.strip.shape:
        return None
    if not own.strip.size or np.array_equal(known.strip, own.strip):
        return np.eye(own.strip.shape[1])
    turned = np.linalg.lstsq(known.strip, own.strip, rcond=None)[0]
    apart = np.abs(known.strip @ turned - own.strip).max()
    return turned if apart < _SAME_DIRECTIONS * np.abs(own.strip).max() else None


def _followed(
    known: _Known, own: Coordinates, full: Dynamics, turned: Array, highest_hz: float
) -> Group | None:
    """Return the modes below a frequency, in coordinates of springs of their own."""
    held = own.held
    back = np.linalg.inv(turned)

    def to_own(vectors: Array) -> Array:
        return np.vstack([vectors[:held], back @ vectors[held:]])

    begun = _mixed(full, to_own(known.group.vectors), known.group.hz)
    if begun is None:
        return None
    x, hz = begun
    # A first step may be as large as it likes: no step before says how fast steps fall.
    last, done = np.full(len(hz), np.inf), np.zeros(len(hz), dtype=bool)
    stacked = full.matrices.reshape(-1, x.shape[0])
    for _ in range(_MOST_STEPS):
        amounts, slopes = full.amounts(hz)
        products = (stacked @ x).reshape(len(full.matrices), *x.shape)
        forms = np.einsum("cm,icm->mi", x, products)
        moved = np.sum(amounts * forms, axis=1) / np.sum(slopes * forms, axis=1)
        residual = np.einsum("mi,icm->cm", amounts - moved[:, None] * slopes, products)
        residual[held:] = back.T @ residual[held:]
        step = to_own(np.matmul(known.inverses, residual.T[..., None])[..., 0].T)
        size = np.abs(step).max(axis=0) / np.abs(x).max(axis=0)
        ratio = np.where(np.isfinite(last), size / last, _LEAST_PROGRESS)
        taken = ~done & (size < _MOST_CORRECTION) & (ratio <= _LEAST_PROGRESS)
        hz, x = np.where(taken, hz * np.exp(-moved), hz), np.where(taken, x - step, x)
        done |= taken & (size * ratio < _SETTLED * (1 - ratio))
        # One that is not taken is given up, as is one that has settled.
        last = np.where(taken, np.maximum(size, 1e-300), 1e-300)
        if np.all(done | ~taken):
            break
    if not done.all():
        hz[~done], x[:, ~done], done[~done] = settled(full, hz[~done], x[:, ~done])
    return _certain(own, full, hz, x, done, highest_hz)


def _mixed(full: Dynamics, x: Array, hz: Array) -> tuple[Array, Array] | None:
    """Return vectors (n, m) and frequencies (m,) after what known modes exchange, to first order.

    None if to first order a mode would move by more than a reed that is near can.

    Modes that are close move as the eigenvalues of a small matrix, and mix as its eigenvectors do:
    see `physics.reed.reduced.derivatives.predicted_hz`.
    """
    amounts, slopes = full.amounts(hz)
    products = (full.matrices.reshape(-1, len(x)) @ x).reshape(len(full.matrices), *x.shape)
    squares = -np.einsum("cm,mi,icm->m", x, slopes, products, optimize=True)
    if squares.min() <= 0:
        return None
    scale = np.sqrt(squares)
    unit = x / scale
    coupled = unit.T @ np.einsum("mi,icm->cm", amounts, products, optimize=True) / scale
    values, vectors = np.linalg.eigh(np.diag(np.log(hz)) + 0.5 * (coupled + coupled.T))
    if np.abs(values - np.sort(np.log(hz))).max() > _MOST_MOVED:
        return None
    # Each goes on with the inverse of the known mode that it has most of.
    _, order = linear_sum_assignment(np.square(vectors), maximize=True)
    return (unit @ vectors[:, order]) * scale, np.exp(values[order])


def _certain(
    own: Coordinates, full: Dynamics, hz: Array, x: Array, done: Array, highest_hz: float
) -> Group | None:
    """Return the modes below a frequency if they are all of them, each once."""
    below = np.flatnonzero(hz < highest_hz)
    if not done[below].all() or len(below) != modes_below(full, highest_hz):
        return None
    order = below[np.argsort(hz[below], kind="stable")]
    hz, x = hz[order], x[:, order]
    if len(hz) and np.any(same_shapes(full, hz, x)):
        return None
    return Group(own, full, hz, x / np.sqrt(mass_forms(full, hz, x)))


def modes_below(dynamics: Dynamics, hz: float) -> int:
    """Return how many modes lie below a frequency.

    It is the number of negative eigenvalues of the dynamic stiffness, by Sylvester's law that of
    the diagonal blocks of its factors.
    """
    Z = np.tensordot(dynamics.amounts(np.array([hz]))[0][0], dynamics.matrices, axes=1)
    scale = 1 / np.sqrt(np.abs(np.diag(Z)))
    factors, pivots, _ = lapack.dsytrf(scale[:, None] * Z * scale, lower=1)
    # Two rows that share a block have negative pivots; such a block has one eigenvalue of each
    # sign.
    single = pivots > 0
    negative = np.count_nonzero(np.diag(factors)[single] < 0)
    return int(negative) + int(np.count_nonzero(~single)) // 2
