"""Errors by the positions of light within blocks, which are confounded with displacements.

Where in a block its light comes from is decided by speckle (`fitting.holograms.within_blocks`): a
complex position, the same in all holograms of a sweep. Positions are found together with
displacements. But what the positions of all blocks have in common with a change of a mode's shape
is not found at all: displacements follow it. So all holograms in which one mode dominates have
nearly the same error. More of them do not make it smaller, and the information of each does not
show it. A part of a shape in quadrature to its mode then counts as a part of the mode's loss.

Let X be the products of the derivatives by displacements and by positions, I the information of
holograms on displacements for known positions, and Q that on positions for known displacements,
with the prior of positions. Blockwise elimination gives the covariance of all displacements as that
for known positions, I⁻¹, plus ``I⁻¹X (Q − Xᵀ I⁻¹ X)⁻¹ (I⁻¹X)ᵀ``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fitting.holograms.alternating_minimisation import weighed
from fitting.holograms.block_amplitudes import BlockAmplitudes
from fitting.holograms.linearisation import rows, triangle, write_symmetric
from fitting.holograms.problem import Problem
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements, problem_of
from fitting.holograms.within_blocks import slope_terms
from holography.arrays import Array, ComplexArray, IndexArray

# Amplitudes are known to this, rad, where holograms do not determine them.
_LOOSE_RAD = 100.0
# Holograms count that together have this fraction of what all of them say of positions. Chosen:
# errors become half a per cent larger.
_NEARLY_ALL = 0.99
# The variance of positions is found in this number of turns, from this start. Chosen: they decide
# how near it comes to its fixed point.
_TURNS, _START = 8, 0.1
# Conjugate gradients end when no variance grows by more than this fraction; the most steps. Chosen:
# a hundredth of a standard error.
_SETTLED, _MOST_STEPS = 0.02, 50


def covariance_by_positions(
    blocks: BlockAmplitudes, basis: ShapeBasis, displacements: Displacements, influence: Array
) -> Array:
    """Return the covariance (r, r) that unknown positions of light add to numbers of a fit.

    Holograms of other sidebands than the first are left out: they would make it smaller.

    Parameters
    ----------
    blocks : BlockAmplitudes
    basis : ShapeBasis
    displacements : Displacements
    influence : (r, k, 2j) float
        How the numbers follow the amplitudes of holograms (real, then imaginary parts).
    """
    if displacements.positions is None:
        return np.zeros((len(influence), len(influence)))
    problem = problem_of(blocks, basis).exact()
    positions = _Positions.of(problem, displacements, displacements.positions)
    # In single precision, variances of logarithms would vanish.
    size = np.abs(influence).max(axis=(1, 2))
    unit = np.where(size > 0, size, 1.0)
    found = _quadratic(positions, positions.force(influence / unit[:, None, None]))
    return found * unit * unit[:, None]


@dataclass(frozen=True)
class _Positions:
    """What holograms say of positions and of displacements.

    The m unknowns of a block are the real parts of its position along x and y, then the imaginary
    ones.

    Attributes
    ----------
    functions : (n, j) float32
    real, imaginary : (k, m, n) float32
        Products of the derivatives by real, or imaginary, displacement with those by positions.
    covariance : (k, 2j, 2j) float32
        Of amplitudes, if positions were known.
    own : (n, m, m) float32
        Information on the position of each block for known displacements, with its prior.
    telling : (t,) int
        Holograms that say something of positions.
    """

    functions: Array
    real: Array
    imaginary: Array
    covariance: Array
    own: Array
    telling: IndexArray

    @classmethod
    def of(
        cls, problem: Problem, displacements: Displacements, found: ComplexArray
    ) -> "_Positions":
        """Linearise block amplitudes of the first sideband; `found` (n, 2) are their positions."""
        at, a = displacements.solution, displacements.amplitude_rad
        lit = np.exp(at.gain)[:, None] * rows(at.object_field, np.arange(len(a)))
        along = lit * np.asarray(slope_terms(problem, a))
        # Noise of variance 1 has half of it in either part.
        scale = 2 * problem.independent_fraction / np.maximum(displacements.misfit, 1)
        trust = scale[:, None] * np.asarray(weighed(problem, at).weight)
        columns = np.concatenate([along, 1j * along]).swapaxes(0, 1)
        telling = _telling(np.einsum("kmn,kn->k", np.abs(columns) ** 2, trust))
        some = columns[telling]
        pairs = np.einsum("kin,kn,kjn->nij", some.conj(), trust[telling], some, optimize=True).real
        prior = np.eye(pairs.shape[1]) / _variance(found, pairs)
        by_amplitude = _by_amplitude(problem, a, lit)
        pulled = [each.conj() * trust for each in by_amplitude]
        real, imaginary = ((each[:, None] * columns).real for each in pulled)
        covariance = _covariance(problem.functions, by_amplitude, trust)
        return cls(
            _single(problem.functions),
            _single(real),
            _single(imaginary),
            _single(covariance),
            _single(pairs + prior),
            telling,
        )

    def force(self, influence: Array) -> Array:
        """Return how numbers (r,) that follow amplitudes follow positions: (m, n, r)."""
        found = np.zeros((*self.real.shape[1:], len(influence)), np.float32)
        for k, covariance in enumerate(self.covariance):
            self._add(found, k, covariance @ influence[:, k].T.astype(np.float32))
        return found

    def times(self, positions: Array) -> Array:
        """Multiply positions (m, n, r) by the information on them for unknown displacements."""
        followed = np.zeros_like(positions)
        for k in self.telling:
            moved = [
                self.functions.T @ np.sum(part[k][..., None] * positions, axis=0)
                for part in (self.real, self.imaginary)
            ]
            self._add(followed, k, self.covariance[k] @ np.concatenate(moved))
        own: Array = (self.own @ positions.swapaxes(0, 1)).swapaxes(0, 1)
        return own - followed

    def _add(self, found: Array, k: int, amplitude: Array) -> None:
        """Add the products of a hologram's amplitudes (2j, r) with all positions (m, n, r)."""
        for part, half in zip((self.real, self.imaginary), np.split(amplitude, 2), strict=True):
            moved = self.functions @ half
            for products, one in zip(part[k], found, strict=True):
                one += products[:, None] * moved


def _single(values: Array) -> Array:
    found: Array = np.ascontiguousarray(values, np.float32)
    return found


def _telling(said: Array) -> IndexArray:
    """Return the holograms (t,) that have nearly all of what all of them say (k,)."""
    order = np.argsort(said)[::-1]
    together = np.cumsum(said[order])
    enough = int(np.searchsorted(together, _NEARLY_ALL * together[-1]))
    return order[: enough + 1]


def _by_amplitude(
    problem: Problem, a: ComplexArray, lit: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return derivatives (k, n) by real and imaginary displacement."""
    u, v = problem.displacement(a)
    alpha, beta = problem.tensor(u, v)
    shown = u + 1j * v
    return lit * (alpha + beta * u * shown), lit * (1j * alpha + beta * v * shown)


def _covariance(functions: Array, by_amplitude: Sequence[ComplexArray], trust: Array) -> Array:
    """Return the covariance (k, 2j, 2j) of amplitudes for known positions."""
    one, other = triangle(functions.shape[1])
    pairs = functions[:, one] * functions[:, other]
    count, size = len(trust), functions.shape[1]
    information = np.zeros((count, 2 * size, 2 * size))
    for i, left in enumerate(by_amplitude):
        for j, right in enumerate(by_amplitude):
            block = np.empty((count, size, size))
            write_symmetric(block, (trust * (left.conj() * right).real) @ pairs)
            information[:, i * size :, j * size :][:, :size, :size] = block
    return np.linalg.inv(information + _LOOSE_RAD**-2 * np.eye(2 * size))


def _variance(found: ComplexArray, information: Array) -> float:
    """Return the variance of each part of positions from those that were found (n, 2).

    Expectation and maximisation: the mean square of what they may be.
    """
    variance, square = 0.5 * _START, 0.5 * float(np.mean(np.abs(found) ** 2))
    parts = information.shape[1]
    for _ in range(_TURNS):
        unknown = np.linalg.inv(information + np.eye(parts) / variance)
        variance = square + float(np.mean(np.trace(unknown, axis1=1, axis2=2))) / parts
    return variance


def _quadratic(positions: _Positions, force: Array) -> Array:
    """Return forceᵀ times the covariance of positions times force (m, n, r): (r, r).

    By conjugate gradients, all columns at once, preconditioned by each block alone.
    """
    alone, tiny = np.linalg.inv(positions.own), np.finfo(np.float32).tiny

    def eased(left: Array) -> Array:
        found: Array = (alone @ left.swapaxes(0, 1)).swapaxes(0, 1)
        return found

    solved, left, towards = np.zeros_like(force), force, eased(force)
    power, variance = np.sum(left * towards, axis=(0, 1)), np.zeros(force.shape[2])
    for _ in range(_MOST_STEPS):
        pushed = positions.times(towards)
        length = power / np.maximum(np.sum(towards * pushed, axis=(0, 1)), tiny)
        solved, left = solved + length * towards, left - length * pushed
        before, variance = variance, np.sum(force * solved, axis=(0, 1))
        if np.all(variance - before <= _SETTLED * variance):
            break
        step, last = eased(left), power
        power = np.sum(left * step, axis=(0, 1))
        towards = step + power / np.maximum(last, tiny) * towards
    found = np.tensordot(force, solved, axes=((0, 1), (0, 1))).astype(float)
    return np.asarray(0.5 * (found + found.T))
