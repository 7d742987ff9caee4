"""Other sidebands of the same vibrations, beside the first.

The phasors of sideband n are ``A c F_n(u)`` with the same light A and displacement u and
``F_n(u) = J_n(|u|) (u/|u|)^n``. The phase of c is free, and its magnitude nearly: both are found
for each hologram, and what they may be is taken off what its phasors tell of displacement.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.bessel import SidebandTable
from fitting.holograms.block_amplitudes import OtherPhasors
from fitting.holograms.linearisation import (
    Local,
    fill_matrix,
    gradient,
)

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]
Steps = NDArray[np.intp]

# Below this direction and J_n/φ of a displacement are of no matter: F_n is flat there, or n is 1.
_STILL_RAD = 1e-6
# A hologram that is dark tells nothing of its brightness: it lies between these.
_DARKEST, _BRIGHTEST = 0.8, 1.25
# What a dark hologram is told of brightness and phase, so that nothing is divided by zero.
_TOLD = 1e-6


@dataclass(frozen=True)
class Sideband:
    """Phasors of another sideband.

    Attributes
    ----------
    order : int
    real, imaginary : (k, n) float
    present : (k,) float
        1 where there is a hologram, 0 where there is none.
    table : SidebandTable
    """

    order: int
    real: Array
    imaginary: Array
    present: Array
    table: SidebandTable

    @classmethod
    def of(cls, phasors: OtherPhasors, dtype: Any) -> "Sideband":
        """Of phasors, as precise as a type."""
        real, imaginary = (
            np.ascontiguousarray(part.T.astype(dtype))
            for part in (phasors.value.real, phasors.value.imag)
        )
        table = SidebandTable(phasors.order)
        return cls(phasors.order, real, imaginary, phasors.present.astype(float), table)

    def every(self, stride: int) -> "Sideband":
        """Return the same for some of the blocks."""
        real, imaginary = (
            np.ascontiguousarray(part[:, ::stride]) for part in (self.real, self.imaginary)
        )
        return Sideband(self.order, real, imaginary, self.present, self.table)

    def some(self, steps: Steps) -> "Sideband":
        """Return the same for some of the holograms."""
        return Sideband(
            self.order, self.real[steps], self.imaginary[steps], self.present[steps], self.table
        )

    def exact(self) -> "Sideband":
        """Return the same in double precision."""
        real, imaginary = self.real.astype(float), self.imaginary.astype(float)
        return Sideband(self.order, real, imaginary, self.present, self.table)


@dataclass(frozen=True)
class Beside:
    """What another sideband tells of some holograms (s,), brightness and phase left free.

    Attributes
    ----------
    here : Local
        Phasors, already turned by the phase found.
    present : (s,) float
        See `Sideband`.
    of_gain, of_phase : (s, 2j) float
        Products of amplitudes with log brightness and phase.
    known : (s,) float
        What is told of either: the power of the phasors.
    misfit : (s,) float
        0 where there is no hologram, and so are gradient and matrix.
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


def beside(
    side: Sideband,
    functions: Array,
    pairs: Array,
    light: Complex,
    steps: Steps,
    displacement: tuple[Array, Array],
) -> Beside:
    """Linearise phasors of another sideband around displacements: real, imaginary parts (s, n)."""
    here = _local(side, light, steps, displacement)
    size = functions.shape[1]
    whole = np.empty((len(steps), 2 * size + 1, 2 * size + 1))
    fill_matrix(whole, here, functions, pairs)
    square = (here.gain**2).astype(float)
    turning = (here.vu * here.u - here.uu * here.v, here.vv * here.u - here.uv * here.v)
    of_phase = square * np.concatenate([(here.power * t) @ functions for t in turning], axis=1)
    of_gain, known = whole[:, :-1, -1], whole[:, -1, -1] + _TOLD
    free = of_gain[:, :, None] * of_gain[:, None] + of_phase[:, :, None] * of_phase[:, None]
    present = side.present[steps]
    return Beside(
        here=here,
        present=present,
        of_gain=of_gain,
        of_phase=of_phase,
        known=known,
        misfit=here.misfit * present,
        gradient=gradient(here, functions)[:, :-1] * present[:, None],
        matrix=(whole[:, :-1, :-1] - free / known[:, None, None]) * present[:, None, None],
    )


def misfit_beside(
    side: Sideband, light: Complex, steps: Steps, displacement: tuple[Array, Array]
) -> Array:
    """Squares (s,) of what holograms leave of another sideband; 0 where there is none."""
    left: Array = _local(side, light, steps, displacement).misfit * side.present[steps]
    return left


def phasors(side: Sideband, displacement: tuple[Array, Array]) -> Complex:
    """F_n(u) of displacements: real, imaginary parts (s, n)."""
    p, q = displacement
    phi = np.sqrt(p * p + q * q)
    value, _ = side.table(phi.astype(np.float32, copy=False))
    found: Complex = value * _direction(phi, p, q) ** side.order
    return found


def brightness(side: Sideband, shown: Complex, light: Complex, steps: Steps) -> Complex:
    """Brightness and phase c (s,) of holograms whose phasors should be A F_n (s, n)."""
    lit = light * shown
    overlap = np.sum(lit.real * side.real[steps] + lit.imag * side.imaginary[steps], axis=1)
    turned = np.sum(lit.real * side.imaginary[steps] - lit.imag * side.real[steps], axis=1)
    power = np.sum(lit.real**2 + lit.imag**2, axis=1) + _TOLD
    c = (overlap + 1j * turned) / power
    found: Complex = np.clip(np.abs(c), _DARKEST, _BRIGHTEST) * np.exp(1j * np.angle(c))
    return found


def _direction(phi: Array, p: Array, q: Array) -> Complex:
    """Displacements over their magnitude; 1 where there is none."""
    moving = phi > _STILL_RAD
    safe = np.where(moving, phi, 1)
    direction: Complex = np.where(moving, p, 1) / safe + 1j * (np.where(moving, q, 0) / safe)
    return direction


def _local(
    side: Sideband, light: Complex, steps: Steps, displacement: tuple[Array, Array]
) -> Local:
    p, q = displacement
    n, dtype = side.order, p.dtype
    phi = np.sqrt(p * p + q * q)
    value, slope = (t.astype(dtype, copy=False) for t in side.table(phi.astype(np.float32)))
    direction = _direction(phi, p, q)
    turn = direction**n
    # J_n/φ, where that is not flat.
    over = n * np.divide(value, phi, out=np.zeros_like(phi), where=phi > _STILL_RAD)
    along, across = direction.real, direction.imag
    by_p, by_q = (
        turn * (slope * along - 1j * over * across),
        turn * (slope * across + 1j * over * along),
    )
    shown = value * turn
    c = brightness(side, shown, light, steps)
    factor = np.abs(c).astype(dtype)[:, None]
    seen = (side.real[steps] + 1j * side.imaginary[steps]) * np.exp(-1j * np.angle(c))[:, None]
    lit = light.astype(shown.dtype)
    left = seen.astype(shown.dtype) - factor * (lit * shown)
    misfit = np.sum(left.real**2 + left.imag**2, axis=1)
    left = lit.conj() * left
    return Local(
        shown.real, shown.imag,
        by_p.real, by_p.imag, by_q.real, by_q.imag,
        left.real, left.imag,
        lit.real**2 + lit.imag**2,
        factor,
        misfit.astype(float),
    )  # fmt: skip
