"""Phasors of a sweep as functions of displacement, linearised: what all turns of the fit share.

The phasors of block n in hologram k are ``A_n e^{γ_k} F(u_kn)`` with light A, log gain γ and
``u = Σ_j a_j Φ_j``. In the plane of real and imaginary parts ``F = α u`` and
``dF/du = α 1 + β u uᵀ`` (see `fitting.holograms.bessel`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import OtherPhasors
from fitting.holograms.linearisation import (
    Local,
    fill_matrix,
    gradient,
    triangle,
)
from fitting.holograms.sidebands import (
    Beside,
    Sideband,
    beside,
    misfit_beside,
)
from fitting.parallel.threads import map_threads

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]
Steps = NDArray[np.intp]

# Holograms are nowhere near so much brighter or darker than each other, in nepers.
_MOST_GAIN = 3.0


@dataclass(frozen=True)
class Problem:
    """Phasors, what displacements are made of, and products of these that never change.

    Attributes
    ----------
    real, imaginary : (k, n) float
        Phasors of each hologram.
    functions : (n, j) float
    pairs : (n, j(j+1)/2) float
        Products of two functions.
    bessel : BesselTable
    others : tuple of Sideband
        What else is seen of the same vibrations.
    """

    real: Array
    imaginary: Array
    functions: Array
    pairs: Array
    bessel: BesselTable
    others: tuple[Sideband, ...] = ()

    @classmethod
    def of(
        cls,
        value: Complex,
        functions: Array,
        bessel: BesselTable,
        others: Sequence[OtherPhasors] = (),
    ) -> "Problem":
        """Of phasors (n, k); everything is computed as precisely as the functions are given."""
        one, other = triangle(functions.shape[1])
        real, imaginary = (
            np.ascontiguousarray(part.T.astype(functions.dtype))
            for part in (value.real, value.imag)
        )
        pairs = functions[:, one] * functions[:, other]
        sidebands = tuple(Sideband.of(each, functions.dtype) for each in others)
        return cls(real, imaginary, functions, pairs, bessel, sidebands)

    def every(self, stride: int) -> "Problem":
        """Return the same problem for some of the blocks."""
        # Whole arrays of their own: products with strided ones take several times as long.
        return Problem(
            np.ascontiguousarray(self.real[:, ::stride]),
            np.ascontiguousarray(self.imaginary[:, ::stride]),
            np.ascontiguousarray(self.functions[::stride]),
            np.ascontiguousarray(self.pairs[::stride]),
            self.bessel,
            tuple(each.every(stride) for each in self.others),
        )

    def some(self, steps: Steps) -> "Problem":
        """Return the same problem for some of the holograms."""
        return Problem(
            self.real[steps],
            self.imaginary[steps],
            self.functions,
            self.pairs,
            self.bessel,
            tuple(each.some(steps) for each in self.others),
        )

    def exact(self) -> "Problem":
        """Return the same problem in double precision."""
        real, imaginary, functions, pairs = (
            a.astype(float) for a in (self.real, self.imaginary, self.functions, self.pairs)
        )
        others = tuple(each.exact() for each in self.others)
        return Problem(real, imaginary, functions, pairs, self.bessel, others)

    @property
    def blocks(self) -> int:
        """How many blocks there are."""
        return len(self.functions)

    @property
    def seen(self) -> Array:
        """How many phasors there are of each hologram's vibration (k,)."""
        seen: Array = np.full(len(self.real), float(self.blocks))
        for each in self.others:
            seen += self.blocks * each.present
        return seen

    def phasors(self, a: Complex) -> tuple[Array, Array]:
        """F(u) of amplitudes (s, j) at all blocks: real and imaginary parts (s, n)."""
        u, v = self.displacement(a)
        over, _ = self.tensor(u, v)
        return over * u, over * v

    def turned(self, light: Complex, steps: Steps, a: Complex) -> Complex:
        """Turn amplitudes (s, j) to the phases that holograms (s,) have them in."""
        u, v = self.phasors(a)
        seen = self.real[steps] + 1j * self.imaginary[steps]
        overlap = np.sum((u - 1j * v) * light.conj() * seen, axis=1)
        turned: Complex = a * np.exp(1j * np.angle(overlap))[:, None]
        return turned

    def displacement(self, a: Complex) -> tuple[Array, Array]:
        """Displacements u of amplitudes (s, j) at all blocks: real and imaginary parts (s, n)."""
        real, imaginary = (np.asarray(p, self.functions.dtype) for p in (a.real, a.imag))
        return real @ self.functions.T, imaginary @ self.functions.T

    def tensor(self, u: Array, v: Array) -> tuple[Array, Array]:
        """α and β of displacements with real and imaginary parts u, v."""
        phi = np.sqrt(u * u + v * v)
        over, bend = self.bessel.tensor(phi.astype(np.float32, copy=False))
        return over.astype(phi.dtype, copy=False), bend.astype(phi.dtype, copy=False)


def local(problem: Problem, light: Complex, steps: Steps, a: Complex, gain: Array) -> Local:
    """Phasors of holograms (s,) and their slopes at amplitudes (s, j) and log gains (s,)."""
    p, q = problem.displacement(a)
    over, bend = problem.tensor(p, q)
    u, v = over * p, over * q
    bent = bend * p
    uv = bent * q
    uu = over + bent * p
    vv = over + bend * q * q
    lit_u, lit_v = lit = _parts(light, problem.functions.dtype)
    factor, gone_u, gone_v, misfit = _gone(problem, lit, steps, (u, v), gain)
    return Local(
        u, v, uu, uv, uv, vv,
        lit_u * gone_u + lit_v * gone_v,
        lit_u * gone_v - lit_v * gone_u,
        lit_u * lit_u + lit_v * lit_v,
        factor,
        misfit,
    )  # fmt: skip


def _parts(light: Complex, dtype: np.dtype[Any]) -> tuple[Array, Array]:
    """Real and imaginary parts (n,)."""
    return light.real.astype(dtype), light.imag.astype(dtype)


def _gone(
    problem: Problem,
    lit: tuple[Array, Array],
    steps: Steps,
    shown: tuple[Array, Array],
    gain: Array,
) -> tuple[Array, Array, Array, Array]:
    """What holograms leave where light (n,) shows F(u) (s, n): all by real and imaginary parts.

    Returns
    -------
    factor : (s, 1) float
        Gains, no longer their logs.
    gone_u, gone_v : (s, n) float
    misfit : (s,) float
        Squares of these.
    """
    u, v = shown
    lit_u, lit_v = lit
    # No step of a search, however bold, may overflow.
    factor = np.exp(np.clip(gain, -_MOST_GAIN, _MOST_GAIN)).astype(lit_u.dtype)[:, None]
    gone_u = problem.real[steps] - factor * (lit_u * u - lit_v * v)
    gone_v = problem.imaginary[steps] - factor * (lit_u * v + lit_v * u)
    misfit = np.einsum("sn,sn->s", gone_u, gone_u) + np.einsum("sn,sn->s", gone_v, gone_v)
    return factor, gone_u, gone_v, misfit.astype(float)


def misfits(problem: Problem, light: Complex, steps: Steps, a: Complex, gain: Array) -> Array:
    """Squares (s,) of what holograms leave at amplitudes (s, j) and log gains (s,)."""
    lit = _parts(light, problem.functions.dtype)

    def of(some: slice) -> Array:
        displacement = problem.displacement(a[some])
        over, _ = problem.tensor(*displacement)
        shown = over * displacement[0], over * displacement[1]
        _, _, _, left = _gone(problem, lit, steps[some], shown, gain[some])
        for side in problem.others:
            left = left + misfit_beside(side, light, steps[some], displacement)
        return left

    return np.concatenate([np.zeros(0), *map_threads(of, len(a))])


@dataclass
class Normal:
    """Normal equations of some holograms, by real and imaginary parts of amplitudes and log gain.

    Misfits (s,), gradients (s, 2j + 1), matrices (s, 2j + 1, 2j + 1).
    """

    misfit: Array
    gradient: Array
    matrix: Array

    @classmethod
    def empty(cls, holograms: int, functions: int) -> "Normal":
        """To be filled."""
        size = 2 * functions + 1
        return cls(
            np.empty(holograms), np.empty((holograms, size)), np.empty((holograms, size, size))
        )

    def take_over(self, better: NDArray[np.bool_], other: "Normal") -> None:
        """Replace those of the holograms that are better."""
        self.misfit[better] = other.misfit[better]
        self.gradient[better] = other.gradient[better]
        self.matrix[better] = other.matrix[better]


def normal(problem: Problem, light: Complex, steps: Steps, a: Complex, gain: Array) -> Normal:
    """Linearise the phasors of holograms (s,) around amplitudes (s, j) and log gains (s,)."""
    whole = Normal.empty(len(a), problem.functions.shape[1])

    def fill(some: slice) -> None:
        fill_normal(whole, some, problem, light, steps[some], a[some], gain[some])

    map_threads(fill, len(a))
    return whole


def fill_normal(
    whole: Normal,
    some: slice,
    problem: Problem,
    light: Complex,
    steps: Steps,
    a: Complex,
    gain: Array,
) -> tuple[Local, list[Beside]]:
    """Write some of the equations, of all sidebands, around amplitudes and log gains.

    Parameters
    ----------
    whole : Normal
        Where to.
    some : slice
        Which of its holograms, s of them.
    steps : (s,) int
        Which those are in the problem.
    a : (s, j) complex
    gain : (s,) float

    Returns
    -------
    tuple of Local and list of Beside
        What the equations were made of: the first sideband, and the others.
    """
    functions, pairs = problem.functions, problem.pairs
    here = local(problem, light, steps, a, gain)
    whole.misfit[some] = here.misfit
    whole.gradient[some] = gradient(here, functions)
    fill_matrix(whole.matrix[some], here, functions, pairs)
    others = [
        beside(side, functions, pairs, light, steps, problem.displacement(a))
        for side in problem.others
    ]
    for other in others:
        whole.misfit[some] += other.misfit
        whole.gradient[some, :-1] += other.gradient
        whole.matrix[some, :-1, :-1] += other.matrix
    return here, others
