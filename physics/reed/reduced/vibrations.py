"""Modes of a reed, each with cane and air of its own frequency.

The coordinates are condensed at two frequencies: the lowest modes of the middle cane are kept, the
others follow them. In what is left every mode is followed from the moduli of one frequency to those
of its own, by Newton's method for its frequency, Davidson's correction of its shape and inverse
iteration. Some modes are too close for that, or two end as one: those that are missing are found by
their number n instead, as the frequency at which the n-th mode with its moduli is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.reed.reduced.dynamics import (
    Coordinates,
    Dynamics,
    State,
    coordinates_of,
    dynamics_of,
)
from physics.reed.reduced.reed import ReducedReed

# Modes of the middle cane up to this multiple of the highest frequency keep their inertia. Chosen:
# with 1.5, 2, 2.5 and 3 modes of 25 canes of the box are 0.7, 0.17, 0.16 and 0.12 cents off before
# they are refined, and 4e-3, 2e-4, 7e-5 and 2e-5 cents afterwards.
_INERT = 2.5
# This many of them, the lowest of each part, are also kept as they are with moduli of low
# frequencies. Chosen: with 3, 6, 12 and 18 modes are 2.3, 2.1, 0.16 and 0.08 cents off before they
# are refined.
_SOFTER = 12
# Frequencies of the moduli at which the coordinates are condensed, over the highest: the modes that
# are followed begin with those of the first.
_PIVOTS = (0.6, 0.12)
# Modes are sought up to this multiple of the highest frequency: in all coordinates they are lower,
# by less than a cent.
_MARGIN = 1.02
# Newton's method stops below this change, and inverse iteration, which needs a start as near as
# that, below the second. Neither takes more steps than this; usual are four and one.
_NEAR_CENTS, _SETTLED_CENTS = 0.1, 1e-4
_MOST_STEPS, _MOST_INVERSE, _MOST_COUNTS = 12, 4, 40
# Corrections of shapes in all coordinates, but not along modes closer than this in ω². Chosen: with
# 2 and 0.1 derivatives are those of differences to a thousandth.
_REFINEMENTS, _CLOSE = 2, 0.1
# A correction that is a larger fraction of a shape than this comes from modes too close for it.
# Chosen: first-order corrections beyond a half do not converge.
_MOST_CORRECTION = 0.5
# Two found shapes are one mode if they are as similar as this. Different modes, with the moduli of
# different frequencies, are similar to 0.01 at most.
_SAME_SHAPE = 0.3
# A mode's answer follows the frequency whose moduli it has by a share within these limits (half of
# the exponent of growth), and two frequencies are the same if they differ by less than this.
_SHARES, _SAME = (-0.5, 0.5), 1e-9
# Modes are counted up to this share below a frequency: more than the error of a settled one.
_DISTINCT = 1e-6
_NO_STIFFNESS = "a mode has no stiffness left: thickness, moduli or clamp are of no reed"


@dataclass(frozen=True)
class Group:
    """Modes of parts of a reed that are solved for together.

    Attributes
    ----------
    coordinates : Coordinates
    dynamics : Dynamics
        In c coordinates, the strips held by unit springs.
    hz : (m,) float
    vectors : (c, m) float
        Modes of unit mass.
    """

    coordinates: Coordinates
    dynamics: Dynamics
    hz: Array
    vectors: Array


@dataclass(frozen=True)
class Vibrations:
    """Modes of a reed in a state.

    Attributes
    ----------
    reed : ReducedReed
    state : State
    hz : (m,) float
        Ascending.
    coordinates : (s, m) float
        Shapes in the coordinates of all parts, of unit mass: over half the reed if it is its own
        mirror image, the air included.
    groups : tuple of Group
    order : tuple of (k,) int
        Which of the m modes those of each group are.
    """

    reed: ReducedReed
    state: State
    hz: Array
    coordinates: Array
    groups: tuple[Group, ...]
    order: tuple[Array, ...]


def vibrations(reed: ReducedReed, state: State, highest_hz: float) -> Vibrations:
    """Modes of a reed up to a frequency.

    Parameters
    ----------
    reed : ReducedReed
    state : State
    highest_hz : float

    Raises
    ------
    ImpossibleReedError
        If moduli grow too fast with frequency for modes to settle, or a change leaves no reed.
    """
    groups = [
        _solved(coordinates, dynamics_of(reed, state, coordinates), highest_hz)
        for coordinates in coordinates_of(reed, state.change, _INERT * highest_hz)
    ]
    return together(reed, state, groups)


def together(reed: ReducedReed, state: State, groups: Sequence[Group]) -> Vibrations:
    """Return the modes of all groups of a reed, in the order of their frequencies."""
    size = len(reed.mass)
    hz = np.concatenate([group.hz for group in groups])
    found = [group.coordinates.everywhere_of(group.vectors, size) for group in groups]
    order = np.argsort(hz, kind="stable")
    ranks = np.argsort(order)
    ends = np.cumsum([len(group.hz) for group in groups])[:-1]
    return Vibrations(
        reed,
        state,
        hz[order],
        np.hstack(found)[:, order],
        tuple(groups),
        tuple(np.split(ranks, ends)),
    )


def _solved(coordinates: Coordinates, full: Dynamics, highest_hz: float) -> Group:
    pivots_hz = highest_hz * np.array(_PIVOTS)
    try:
        condensed = _condensing(full, coordinates, pivots_hz)
        K, M = _stiffness_and_mass(condensed.small, pivots_hz[:1])
        eigenvalues, vectors = linalg.eigh(K[0], M[0])
    except np.linalg.LinAlgError:
        raise ImpossibleReedError(_NO_STIFFNESS) from None
    if np.any(eigenvalues[:1] <= 0):
        raise ImpossibleReedError(_NO_STIFFNESS)
    hz, own = _modes(condensed.small, eigenvalues, vectors, _MARGIN * highest_hz)
    if not len(hz):
        return Group(coordinates, full, hz, condensed.shapes @ own)
    hz, modes = _refined(condensed, full, vectors, hz, own)
    kept = np.flatnonzero(hz < highest_hz)
    kept = kept[np.argsort(hz[kept])]
    return Group(coordinates, full, hz[kept], modes[:, kept])


@dataclass(frozen=True)
class _Condensed:
    """Coordinates of which some follow the others.

    Attributes
    ----------
    shapes : (c, n) float
        Unit values of the low coordinates, the others following as at a first frequency; then, for
        the very lowest, the difference to how they follow at a second.
    others : (c,) bool
        Which coordinates follow.
    root : tuple
        Cholesky's of their dynamic stiffness at the first frequency.
    small : Dynamics
        In the n shapes.
    """

    shapes: Array
    others: NDArray[np.bool_]
    root: tuple[Array, bool]
    small: Dynamics


def _condensing(full: Dynamics, coordinates: Coordinates, pivots_hz: Array) -> _Condensed:
    """Condense at two frequencies.

    Raises
    ------
    LinAlgError
        If the coordinates that follow have no stiffness left.
    """
    size, low = full.matrices.shape[-1], coordinates.low
    softer = coordinates.lowest(_SOFTER)
    others = np.ones(size, dtype=bool)
    others[low] = False
    first, second = np.tensordot(full.amounts(pivots_hz)[0], full.matrices, axes=1)
    root = linalg.cho_factor(first[others][:, others], check_finite=False)
    following = -linalg.cho_solve(root, first[others][:, low], check_finite=False)
    at_second = linalg.cho_factor(second[others][:, others], check_finite=False)
    softly = -linalg.cho_solve(at_second, second[others][:, low[softer]], check_finite=False)
    shapes = np.zeros((size, len(low) + len(softer)))
    shapes[low, np.arange(len(low))] = 1.0
    shapes[others] = np.hstack([following, softly - following[:, softer]])
    matrices = np.matmul(shapes.T, np.matmul(full.matrices, shapes))
    small = Dynamics(matrices, full.table, full.air, full.air_fraction)
    return _Condensed(shapes, others, root, small)


def _refined(
    condensed: _Condensed, full: Dynamics, vectors: Array, hz: Array, own: Array
) -> tuple[Array, Array]:
    """Frequencies (m,) and modes (c, m) of unit mass in all coordinates, from vectors (n, m).

    At the first frequency the shapes and the coordinates that follow are orthogonal in the dynamic
    stiffness, so that its inverse is nearly that of either block.
    """
    small = condensed.small
    diagonals = np.einsum("lk,ilk->ik", vectors, np.matmul(small.matrices, vectors))
    x = condensed.shapes @ own
    for step in range(_REFINEMENTS + 1):
        amounts, slopes = full.amounts(hz)
        products = np.matmul(full.matrices, x)
        forms = np.einsum("cm,icm->mi", x, products)
        moved = np.sum(amounts * forms, axis=1) / np.sum(slopes * forms, axis=1)
        hz = hz * np.exp(-moved)
        if step == _REFINEMENTS:
            break
        residual = np.einsum("mi,icm->cm", amounts - moved[:, None] * slopes, products)
        gaps = (amounts @ diagonals).T
        # Not along modes that are as close: among them the vectors are exact.
        scale = (2 * np.pi * hz) ** 2
        gaps = np.where(np.abs(gaps) < _CLOSE * scale, np.inf, gaps)
        x = x - condensed.shapes @ (vectors @ (vectors.T @ (condensed.shapes.T @ residual) / gaps))
        x[condensed.others] -= linalg.cho_solve(
            condensed.root, residual[condensed.others], check_finite=False
        )
    return hz, x / np.sqrt(mass_forms(full, hz, x))


def _stiffness_and_mass(dynamics: Dynamics, hz: Array) -> tuple[Array, Array]:
    """Stiffness and mass (m, n, n) with what holds at frequencies (m,)."""
    amounts, _ = dynamics.amounts(hz)
    stiff = np.where(dynamics.elastic, amounts, 0.0)
    inert = (stiff - amounts) / (2 * np.pi * hz[:, None]) ** 2
    return (
        np.tensordot(stiff, dynamics.matrices, axes=1),
        np.tensordot(inert, dynamics.matrices, axes=1),
    )


def _modes(
    dynamics: Dynamics, eigenvalues: Array, vectors: Array, below_hz: float
) -> tuple[Array, Array]:
    """Frequencies (m,) and vectors (n, m) of modes with moduli of their own frequency.

    Two modes that exchange their order, or their shapes, between the moduli of one frequency and
    their own may end as one. What is found is therefore counted, and what is missing is sought by
    its number.

    Parameters
    ----------
    dynamics : Dynamics
    eigenvalues, vectors : (n,) and (n, n) float
        With the moduli of one frequency.
    below_hz : float
        Modes up to here are sought, and all of them are found.
    """
    # Shapes of unit energy: what hardly yields has tiny numbers that rounding would bury.
    unit = vectors / np.sqrt(eigenvalues)
    (count,) = _numbers(dynamics, unit, np.array([below_hz])).tolist()
    if not count:
        return np.zeros(0), vectors[:, :0]
    hz, w, near = _followed(dynamics, eigenvalues, vectors, count)
    hz, w, done = settled(dynamics, hz, w)
    good = done & near & (hz < below_hz) & ~same_shapes(dynamics, hz, w)
    if not good.all():
        hz, w = hz[good], w[:, good]
        missing = set(range(count)) - set(_ranks(dynamics, unit, hz))
        for number in sorted(missing):
            start_hz = float(np.sqrt(eigenvalues[number])) / (2 * np.pi)
            found_hz, vector = _counted(dynamics, number, start_hz)
            hz, w = np.append(hz, found_hz), np.column_stack([w, vector])
    return hz, w / np.sqrt(mass_forms(dynamics, hz, w))


def _numbers(dynamics: Dynamics, shapes: Array, hz: Array) -> NDArray[np.int_]:
    """How many modes lie below frequencies (m,): Z(ω) has as many negative eigenvalues.

    Parameters
    ----------
    dynamics : Dynamics
    shapes : (n, n) float
        In which Z is taken.
    hz : (m,) float
    """
    Z = np.tensordot(dynamics.amounts(hz)[0], dynamics.matrices, axes=1)
    return np.asarray(np.count_nonzero(np.linalg.eigvalsh(shapes.T @ Z @ shapes) < 0, axis=1))


def _ranks(dynamics: Dynamics, shapes: Array, hz: Array) -> list[int]:
    """Numbers of modes at frequencies (m,), which need not be all modes, in ascending order."""
    ranks: list[int] = []
    for below in _numbers(dynamics, shapes, np.sort(hz) * (1 - _DISTINCT)).tolist():
        # Of two modes that are closer than that, the second is the next.
        ranks.append(max(below, ranks[-1] + 1) if ranks else below)
    return ranks


def _followed(
    dynamics: Dynamics, eigenvalues: Array, vectors: Array, count: int
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Frequencies (m,) and vectors (n, m), nearly, and which of them are near."""
    w, log_hz = vectors[:, :count].copy(), 0.5 * np.log(eigenvalues[:count]) - np.log(2 * np.pi)
    own, close = np.arange(count), np.zeros(count, dtype=bool)
    diagonals = np.einsum("lk,ilk->ik", vectors, np.matmul(dynamics.matrices, vectors))
    for step in range(_MOST_STEPS):
        amounts, slopes = dynamics.amounts(np.exp(log_hz))
        products = np.matmul(dynamics.matrices, w)
        forms = np.einsum("lm,ilm->mi", w, products)
        moved = np.sum(amounts * forms, axis=1) / np.sum(slopes * forms, axis=1)
        moved[close] = 0.0
        log_hz = log_hz - moved
        done = np.abs(moved) < _NEAR_CENTS * np.log(2) / 1200
        if step and done.all():
            break
        residual = np.einsum("mi,ilm->lm", amounts - moved[:, None] * slopes, products)
        gaps = (amounts @ diagonals).T
        gaps[own, own] = np.inf
        correction = vectors.T @ residual / gaps
        close |= ~(np.abs(correction).max(axis=0) < _MOST_CORRECTION)
        correction[:, close] = 0.0
        w -= vectors @ correction
    return np.exp(log_hz), w, done & ~close


def settled(dynamics: Dynamics, hz: Array, w: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Frequencies (m,), vectors (n, m) and which have settled, by inverse iteration.

    Errors of shapes fall by their cube: derivatives need shapes that are as exact as frequencies.
    """
    done = np.zeros(len(hz), dtype=bool)
    for _ in range(_MOST_INVERSE):
        amounts, slopes = dynamics.amounts(hz)
        loads = np.einsum("mi,ilm->ml", slopes, np.matmul(dynamics.matrices, w))
        Z = np.tensordot(amounts, dynamics.matrices, axes=1)
        moved = np.linalg.solve(Z + _SAME * _diagonal(Z), loads[..., None])[..., 0].T
        w = moved / np.abs(moved).max(axis=0)
        products = np.matmul(dynamics.matrices, w)
        forms = np.einsum("lm,ilm->mi", w, products)
        step = np.sum(amounts * forms, axis=1) / np.sum(slopes * forms, axis=1)
        hz = hz * np.exp(-step)
        done = np.abs(step) < _SETTLED_CENTS * np.log(2) / 1200
        if done.all():
            break
    return hz, w, done


def _diagonal(matrices: Array) -> Array:
    """Diagonal matrices (m, n, n) with the magnitudes of diagonals: no mode is hit exactly."""
    return np.asarray(
        np.abs(np.einsum("mii->mi", matrices))[..., None] * np.eye(matrices.shape[-1])
    )


def same_shapes(dynamics: Dynamics, hz: Array, w: Array) -> NDArray[np.bool_]:
    """Which shapes (n, m) are also those of another mode."""
    similarity = np.abs(w.T @ _stiffness_and_mass(dynamics, hz[:1])[1][0] @ w)
    size = np.sqrt(np.diag(similarity))
    similarity /= np.multiply.outer(size, size)
    np.fill_diagonal(similarity, 0.0)
    return np.asarray(similarity.max(axis=0) > _SAME_SHAPE)


def mass_forms(dynamics: Dynamics, hz: Array, w: Array) -> Array:
    """Mass (m,) of vectors (n, m), each with the air of its frequency."""
    amounts, _ = dynamics.amounts(hz)
    inert = np.where(dynamics.elastic, 0.0, -amounts) / (2 * np.pi * hz[:, None]) ** 2
    masses = np.flatnonzero(~dynamics.elastic)
    forms = np.einsum("lm,ilm->mi", w, np.matmul(dynamics.matrices[masses], w))
    return np.asarray(np.sum(inert[:, masses] * forms, axis=1))


def _counted(dynamics: Dynamics, number: int, start_hz: float) -> tuple[float, Array]:
    """Frequency and vector (n,) of a mode, settled by its number."""
    # With the moduli of `asked`, the mode is at `answered`.
    asked, hz = start_hz, _by_number(dynamics, number, start_hz)[0]
    answered = hz
    for _ in range(_MOST_COUNTS):
        found, vector = _by_number(dynamics, number, hz)
        if abs(1200 * np.log2(found / hz)) < _SETTLED_CENTS:
            return found, vector
        step = hz - asked if abs(hz - asked) > _SAME * hz else np.inf
        share = float(np.clip((found - answered) / step, *_SHARES))
        asked, answered, hz = hz, found, hz + (found - hz) / (1 - share)
    raise ImpossibleReedError(
        "modes do not settle: the moduli of this cane grow too fast with frequency"
    )


def _by_number(dynamics: Dynamics, number: int, hz: float) -> tuple[float, Array]:
    """Eigenfrequency of a number and its vector (n,) with what holds at a frequency."""
    K, M = _stiffness_and_mass(dynamics, np.array([hz]))
    try:
        values, vectors = linalg.eigh(K[0], M[0], subset_by_index=(number, number))
    except np.linalg.LinAlgError:
        raise ImpossibleReedError(_NO_STIFFNESS) from None
    if values[0] <= 0:
        raise ImpossibleReedError(_NO_STIFFNESS)
    return float(np.sqrt(values[0])) / (2 * np.pi), vectors[:, 0]
