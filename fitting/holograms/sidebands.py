"""Normal equations of further sidebands of the same vibrations.

The block amplitudes of sideband n are ``A c F_n(u)`` with the object field A and displacement u of
the first sideband and ``F_n(u) = J_n(|u|) (u/|u|)^n``. The phase of c is free, and its magnitude
nearly so. Both are fitted for each hologram and eliminated from its normal equations.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fitting.holograms.bessel import SidebandTable
from fitting.holograms.block_amplitudes import SidebandAmplitudes
from fitting.holograms.linearisation import (
    Local,
    fill_matrix,
    gradient,
    rows,
)
from holography.arrays import Array, ComplexArray, IndexArray

# Below this the direction of a displacement and J_n/φ do not matter: F_n is flat there, or n is 1.
_STILL_RAD = 1e-6
# Limits of |c|: a dark hologram does not determine its brightness.
_DARKEST, _BRIGHTEST = 0.8, 1.25
# Added to the power of a hologram, so that a dark one does not divide by zero.
_LEAST_POWER = 1e-6


@dataclass(frozen=True)
class OtherSideband:
    """Block amplitudes of another sideband.

    Attributes
    ----------
    order : int
    real, imaginary : (k, n) float
    present : (k,) float
        1 where there is a hologram, else 0.
    table : SidebandTable
    weight : (k, n) float, optional
        See `fitting.holograms.problem.Problem`.
    """

    order: int
    real: Array
    imaginary: Array
    present: Array
    table: SidebandTable
    weight: Array | None = None

    @classmethod
    def of(cls, block_amplitudes: SidebandAmplitudes, dtype: Any) -> "OtherSideband":
        """Convert block amplitudes to a floating-point type."""
        real, imaginary = (
            np.ascontiguousarray(part.T.astype(dtype))
            for part in (block_amplitudes.value.real, block_amplitudes.value.imag)
        )
        table = SidebandTable(block_amplitudes.order)
        return cls(
            block_amplitudes.order, real, imaginary, block_amplitudes.present.astype(float), table
        )

    def every(self, stride: int) -> "OtherSideband":
        """Return the same for every `stride`-th block."""
        real, imaginary = (
            np.ascontiguousarray(part[:, ::stride]) for part in (self.real, self.imaginary)
        )
        weight = None if self.weight is None else np.ascontiguousarray(self.weight[:, ::stride])
        return OtherSideband(self.order, real, imaginary, self.present, self.table, weight)

    def some(self, steps: IndexArray) -> "OtherSideband":
        """Return the same for some of the holograms."""
        return OtherSideband(
            self.order,
            self.real[steps],
            self.imaginary[steps],
            self.present[steps],
            self.table,
            None if self.weight is None else self.weight[steps],
        )

    def exact(self) -> "OtherSideband":
        """Return the same in double precision."""
        real, imaginary = self.real.astype(float), self.imaginary.astype(float)
        weight = None if self.weight is None else self.weight.astype(float)
        return OtherSideband(self.order, real, imaginary, self.present, self.table, weight)

    def weighed(self, steps: IndexArray, values: Array) -> Array:
        """Multiply values (s, n) of holograms (s,) by their inverse variance."""
        return values if self.weight is None else values * self.weight[steps]


@dataclass(frozen=True)
class SidebandEquations:
    """Normal equations of s holograms of a sideband, after elimination of brightness and phase.

    Attributes
    ----------
    here : Local
        Linearised block amplitudes, turned by the fitted phase.
    present : (s,) float
        See `OtherSideband`.
    of_gain, of_phase : (s, 2j) float
        Elements of the normal matrix between amplitudes and log brightness or phase.
    known : (s,) float
        Diagonal element of log brightness and of phase: the power of the block amplitudes.
    misfit : (s,) float
        0 where there is no hologram; so are gradient and matrix.
    gradient : (s, 2j) float
    matrix : (s, 2j, 2j) float
    """

    here: Local
    present: Array
    of_gain: Array
    of_phase: Array
    known: Array
    misfit: Array
    gradient: Array
    matrix: Array


def sideband_equations(
    side: OtherSideband,
    functions: Array,
    pairs: Array,
    object_field: ComplexArray,
    steps: IndexArray,
    displacement: tuple[Array, Array],
) -> SidebandEquations:
    """Linearise another sideband at displacements with real and imaginary parts (s, n)."""
    here = _local(side, object_field, steps, displacement)
    size = functions.shape[1]
    whole = np.empty((len(steps), 2 * size + 1, 2 * size + 1))
    fill_matrix(whole, here, functions, pairs)
    square = (here.gain**2).astype(float)
    turning = (here.vu * here.u - here.uu * here.v, here.vv * here.u - here.uv * here.v)
    of_phase = square * np.concatenate([(here.power * t) @ functions for t in turning], axis=1)
    of_gain, known = whole[:, :-1, -1], whole[:, -1, -1] + _LEAST_POWER
    free = of_gain[:, :, None] * of_gain[:, None] + of_phase[:, :, None] * of_phase[:, None]
    present = side.present[steps]
    return SidebandEquations(
        here=here,
        present=present,
        of_gain=of_gain,
        of_phase=of_phase,
        known=known,
        misfit=here.misfit * present,
        gradient=gradient(here, functions)[:, :-1] * present[:, None],
        matrix=(whole[:, :-1, :-1] - free / known[:, None, None]) * present[:, None, None],
    )


def sideband_misfit(
    side: OtherSideband,
    object_field: ComplexArray,
    steps: IndexArray,
    displacement: tuple[Array, Array],
) -> Array:
    """Return squared residuals (s,) of another sideband; 0 where it has no hologram."""
    left: Array = _local(side, object_field, steps, displacement).misfit * side.present[steps]
    return left


def sideband_values(side: OtherSideband, displacement: tuple[Array, Array]) -> ComplexArray:
    """Return F_n(u) (s, n) for displacements with real and imaginary parts (s, n)."""
    p, q = displacement
    phi = np.sqrt(p * p + q * q)
    value, _ = side.table(phi.astype(np.float32, copy=False))
    found: ComplexArray = value * _direction(phi, p, q) ** side.order
    return found


def brightness(
    side: OtherSideband, shown: ComplexArray, object_field: ComplexArray, steps: IndexArray
) -> ComplexArray:
    """Fit the factors c (s,) of holograms whose block amplitudes are c A F_n (s, n)."""
    lit = rows(object_field, steps) * shown
    along = lit.real * side.real[steps] + lit.imag * side.imaginary[steps]
    across = lit.real * side.imaginary[steps] - lit.imag * side.real[steps]
    overlap, turned = (np.sum(side.weighed(steps, part), axis=1) for part in (along, across))
    power = np.sum(side.weighed(steps, lit.real**2 + lit.imag**2), axis=1) + _LEAST_POWER
    c = (overlap + 1j * turned) / power
    found: ComplexArray = np.clip(np.abs(c), _DARKEST, _BRIGHTEST) * np.exp(1j * np.angle(c))
    return found


def _direction(phi: Array, p: Array, q: Array) -> ComplexArray:
    """Return displacements divided by their magnitude; 1 where that is 0."""
    moving = phi > _STILL_RAD
    safe = np.where(moving, phi, 1)
    direction: ComplexArray = np.where(moving, p, 1) / safe + 1j * (np.where(moving, q, 0) / safe)
    return direction


def _local(
    side: OtherSideband,
    object_field: ComplexArray,
    steps: IndexArray,
    displacement: tuple[Array, Array],
) -> Local:
    p, q = displacement
    n, dtype = side.order, p.dtype
    phi = np.sqrt(p * p + q * q)
    value, slope = (t.astype(dtype, copy=False) for t in side.table(phi.astype(np.float32)))
    direction = _direction(phi, p, q)
    turn = direction**n
    # J_n/φ, where F_n is not flat.
    over = n * np.divide(value, phi, out=np.zeros_like(phi), where=phi > _STILL_RAD)
    along, across = direction.real, direction.imag
    by_p, by_q = (
        turn * (slope * along - 1j * over * across),
        turn * (slope * across + 1j * over * along),
    )
    shown = value * turn
    c = brightness(side, shown, object_field, steps)
    factor = np.abs(c).astype(dtype)[:, None]
    seen = (side.real[steps] + 1j * side.imaginary[steps]) * np.exp(-1j * np.angle(c))[:, None]
    lit = rows(object_field, steps).astype(shown.dtype)
    left = seen.astype(shown.dtype) - factor * (lit * shown)
    misfit = np.sum(side.weighed(steps, left.real**2 + left.imag**2), axis=1)
    left = lit.conj() * left
    return Local(
        shown.real, shown.imag,
        by_p.real, by_p.imag, by_q.real, by_q.imag,
        side.weighed(steps, left.real), side.weighed(steps, left.imag),
        side.weighed(steps, lit.real**2 + lit.imag**2),
        factor,
        misfit.astype(float),
    )  # fmt: skip
