"""The least-squares problem of a sweep: block amplitudes as functions of the displacement.

The amplitude of block n in hologram k is ``A_kn e^{γ_k} F(u_kn)`` with object field A, log gain γ
and ``u = Σ_j a_j Φ_j``. Where the object field is the same in all holograms, it has one row only.
In the plane of real and imaginary parts ``F = α u`` and ``dF/du = α 1 + β u uᵀ`` (see
`fitting.holograms.bessel`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import SidebandAmplitudes
from fitting.holograms.linearisation import (
    Local,
    fill_matrix,
    gradient,
    rows,
    triangle,
)
from fitting.holograms.sidebands import (
    OtherSideband,
    SidebandEquations,
    sideband_equations,
    sideband_misfit,
)
from fitting.parallel.threads import map_threads
from holography.arrays import Array, ComplexArray, IndexArray

# Limit of log gains, in nepers: far beyond any real difference between holograms.
MOST_GAIN = 3.0
# Prior standard deviation of a hologram's gain, in nepers, until the sweep shows its own.
GAIN_NEPERS = 0.05


@dataclass(frozen=True)
class Problem:
    """Block amplitudes, functions of the displacement, and products that never change.

    Attributes
    ----------
    real, imaginary : (k, n) float
        Block amplitudes of each hologram.
    functions : (n, j) float
        Functions Φ whose sum is the displacement.
    pairs : (n, j(j+1)/2) float
        Products of two functions.
    bessel : BesselTable
    others : tuple of OtherSideband
        Other sidebands of the same vibrations.
    recording_rank : (k,) int
        Rank of each hologram in the order of recording.
    weight : (k, n) float, optional
        Inverse variance of the block amplitudes; 1 if it is not given.
    slopes : (2, n, j) float, optional
        See `fitting.holograms.within_blocks.spread_slopes`.
    gain_nepers : float
        Prior standard deviation of log gains.
    independent_fraction : float
        See `BlockAmplitudes`.
    """

    real: Array
    imaginary: Array
    functions: Array
    pairs: Array
    bessel: BesselTable
    others: tuple[OtherSideband, ...]
    recording_rank: IndexArray
    weight: Array | None = None
    slopes: Array | None = None
    gain_nepers: float = GAIN_NEPERS
    independent_fraction: float = 1.0

    @classmethod
    def of(
        cls,
        value: ComplexArray,
        functions: Array,
        bessel: BesselTable,
        others: Sequence[SidebandAmplitudes] = (),
        recording_rank: IndexArray | None = None,
    ) -> "Problem":
        """Set up a problem from block amplitudes (n, k), in the precision of the functions.

        Without `recording_rank`, holograms were recorded in the order of their frequencies.
        """
        one, other = triangle(functions.shape[1])
        real, imaginary = (
            np.ascontiguousarray(part.T.astype(functions.dtype))
            for part in (value.real, value.imag)
        )
        pairs = functions[:, one] * functions[:, other]
        sidebands = tuple(OtherSideband.of(each, functions.dtype) for each in others)
        ranks = np.arange(len(real)) if recording_rank is None else recording_rank
        return cls(real, imaginary, functions, pairs, bessel, sidebands, ranks)

    def every(self, stride: int) -> "Problem":
        """Return the same problem for every `stride`-th block."""
        # Contiguous copies: products with strided arrays take several times as long.
        return replace(
            self,
            real=np.ascontiguousarray(self.real[:, ::stride]),
            imaginary=np.ascontiguousarray(self.imaginary[:, ::stride]),
            functions=np.ascontiguousarray(self.functions[::stride]),
            pairs=np.ascontiguousarray(self.pairs[::stride]),
            others=tuple(each.every(stride) for each in self.others),
            weight=None if self.weight is None else np.ascontiguousarray(self.weight[:, ::stride]),
            slopes=None if self.slopes is None else np.ascontiguousarray(self.slopes[:, ::stride]),
        )

    def some(self, steps: IndexArray) -> "Problem":
        """Return the same problem for some of the holograms."""
        return replace(
            self,
            real=self.real[steps],
            imaginary=self.imaginary[steps],
            others=tuple(each.some(steps) for each in self.others),
            recording_rank=self.recording_rank[steps],
            weight=None if self.weight is None else self.weight[steps],
        )

    def exact(self) -> "Problem":
        """Return the same problem in double precision."""
        real, imaginary, functions, pairs = (
            a.astype(float) for a in (self.real, self.imaginary, self.functions, self.pairs)
        )
        others = tuple(each.exact() for each in self.others)
        return replace(
            self,
            real=real,
            imaginary=imaginary,
            functions=functions,
            pairs=pairs,
            others=others,
            weight=None if self.weight is None else self.weight.astype(float),
        )

    def less(self, amplitudes: ComplexArray) -> "Problem":
        """Return the same problem with (k, n) subtracted from the block amplitudes."""
        dtype = self.real.dtype
        return replace(
            self,
            real=self.real - amplitudes.real.astype(dtype),
            imaginary=self.imaginary - amplitudes.imag.astype(dtype),
        )

    def weighed(self, steps: IndexArray, values: Array) -> Array:
        """Multiply values (s, n) of holograms (s,) by their inverse variance."""
        return values if self.weight is None else values * self.weight[steps]

    @property
    def half_gain_precision(self) -> float:
        """Half of the prior precision of log gains."""
        # The misfit, of noise of variance 1, is half of χ².
        return 0.5 / self.gain_nepers**2

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.functions)

    @property
    def seen(self) -> Array:
        """Number of block amplitudes of each vibration (k,), over all sidebands."""
        seen: Array = np.full(len(self.real), float(self.blocks))
        for each in self.others:
            seen += self.blocks * each.present
        return seen

    def bessel_vectors(self, a: ComplexArray) -> tuple[Array, Array]:
        """Return real and imaginary parts (s, n) of F(u) for amplitudes (s, j)."""
        u, v = self.displacement(a)
        over, _ = self.tensor(u, v)
        return over * u, over * v

    def turned(
        self, object_field: ComplexArray, steps: IndexArray, a: ComplexArray
    ) -> ComplexArray:
        """Multiply amplitudes (s, j) by the phase factors that fit holograms (s,) best."""
        u, v = self.bessel_vectors(a)
        seen = self.real[steps] + 1j * self.imaginary[steps]
        overlap = np.sum((u - 1j * v) * rows(object_field, steps).conj() * seen, axis=1)
        turned: ComplexArray = a * np.exp(1j * np.angle(overlap))[:, None]
        return turned

    def displacement(self, a: ComplexArray) -> tuple[Array, Array]:
        """Return real and imaginary parts (s, n) of the displacement for amplitudes (s, j)."""
        real, imaginary = (np.asarray(p, self.functions.dtype) for p in (a.real, a.imag))
        return real @ self.functions.T, imaginary @ self.functions.T

    def tensor(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return α and β for displacements with real and imaginary parts u, v."""
        phi = np.sqrt(u * u + v * v)
        over, bend = self.bessel.tensor(phi.astype(np.float32, copy=False))
        return over.astype(phi.dtype, copy=False), bend.astype(phi.dtype, copy=False)


def local(
    problem: Problem, object_field: ComplexArray, steps: IndexArray, a: ComplexArray, gain: Array
) -> Local:
    """Linearise the block amplitudes of holograms (s,) at amplitudes (s, j) and log gains (s,)."""
    p, q = problem.displacement(a)
    alpha, beta = problem.tensor(p, q)
    u, v = alpha * p, alpha * q
    beta_p = beta * p
    uv = beta_p * q
    uu = alpha + beta_p * p
    vv = alpha + beta * q * q
    lit_u, lit_v = lit = _parts(rows(object_field, steps), problem.functions.dtype)
    factor, residual_u, residual_v, misfit = _residuals(problem, lit, steps, (u, v), gain)
    return Local(
        u, v, uu, uv, uv, vv,
        problem.weighed(steps, lit_u * residual_u + lit_v * residual_v),
        problem.weighed(steps, lit_u * residual_v - lit_v * residual_u),
        problem.weighed(steps, lit_u * lit_u + lit_v * lit_v),
        factor,
        misfit,
    )  # fmt: skip


def _parts(object_field: ComplexArray, dtype: np.dtype[Any]) -> tuple[Array, Array]:
    """Return real and imaginary parts."""
    return object_field.real.astype(dtype), object_field.imag.astype(dtype)


def _residuals(
    problem: Problem,
    lit: tuple[Array, Array],
    steps: IndexArray,
    shown: tuple[Array, Array],
    gain: Array,
) -> tuple[Array, Array, Array, Array]:
    """Compute the residuals of holograms for real and imaginary parts of F(u) (s, n).

    Returns
    -------
    factor : (s, 1) float
        Gains (not their logs).
    residual_u, residual_v : (s, n) float
        Real and imaginary parts.
    misfit : (s,) float
        Sum of their squares over the variance of the noise.
    """
    u, v = shown
    lit_u, lit_v = lit
    # A long step must not overflow.
    factor = np.exp(np.clip(gain, -MOST_GAIN, MOST_GAIN)).astype(lit_u.dtype)[:, None]
    residual_u = problem.real[steps] - factor * (lit_u * u - lit_v * v)
    residual_v = problem.imaginary[steps] - factor * (lit_u * v + lit_v * u)
    misfit = np.einsum("sn,sn->s", problem.weighed(steps, residual_u), residual_u) + np.einsum(
        "sn,sn->s", problem.weighed(steps, residual_v), residual_v
    )
    return factor, residual_u, residual_v, misfit.astype(float)


def misfits(
    problem: Problem, object_field: ComplexArray, steps: IndexArray, a: ComplexArray, gain: Array
) -> Array:
    """Return squared residuals (s,) at amplitudes (s, j) and log gains (s,)."""

    def of(some: slice) -> Array:
        lit = _parts(rows(object_field, steps[some]), problem.functions.dtype)
        displacement = problem.displacement(a[some])
        over, _ = problem.tensor(*displacement)
        shown = over * displacement[0], over * displacement[1]
        _, _, _, left = _residuals(problem, lit, steps[some], shown, gain[some])
        for side in problem.others:
            left = left + sideband_misfit(side, object_field, steps[some], displacement)
        return left

    return np.concatenate([np.zeros(0), *map_threads(of, len(a))])


@dataclass
class Normal:
    """Normal equations of s holograms.

    The unknowns are the real and imaginary parts of the amplitudes, then the log gain.

    Attributes
    ----------
    misfit : (s,) float
    gradient : (s, 2j + 1) float
        Negative gradient of half the misfit.
    matrix : (s, 2j + 1, 2j + 1) float
    """

    misfit: Array
    gradient: Array
    matrix: Array

    @classmethod
    def empty(cls, holograms: int, functions: int) -> "Normal":
        """Allocate normal equations."""
        size = 2 * functions + 1
        return cls(
            np.empty(holograms), np.empty((holograms, size)), np.empty((holograms, size, size))
        )


def normal(
    problem: Problem, object_field: ComplexArray, steps: IndexArray, a: ComplexArray, gain: Array
) -> Normal:
    """Return the normal equations of holograms (s,) at amplitudes (s, j) and log gains (s,)."""
    whole = Normal.empty(len(a), problem.functions.shape[1])

    def fill(some: slice) -> None:
        fill_normal(whole, some, problem, object_field, steps[some], a[some], gain[some])

    map_threads(fill, len(a))
    return whole


def fill_normal(
    whole: Normal,
    some: slice,
    problem: Problem,
    object_field: ComplexArray,
    steps: IndexArray,
    a: ComplexArray,
    gain: Array,
) -> tuple[Local, list[SidebandEquations]]:
    """Write normal equations of all sidebands into a slice of `whole`.

    Parameters
    ----------
    whole : Normal
        Overwritten in `some`.
    some : slice
        The s holograms of `whole` to write.
    steps : (s,) int
        Numbers of these holograms in the problem.
    a : (s, j) complex
    gain : (s,) float

    Returns
    -------
    tuple of Local and list of SidebandEquations
        Linearisations of the first sideband and of the others.
    """
    functions, pairs = problem.functions, problem.pairs
    here = local(problem, object_field, steps, a, gain)
    whole.misfit[some] = here.misfit
    whole.gradient[some] = gradient(here, functions)
    fill_matrix(whole.matrix[some], here, functions, pairs)
    others = [
        sideband_equations(side, functions, pairs, object_field, steps, problem.displacement(a))
        for side in problem.others
    ]
    for other in others:
        whole.misfit[some] += other.misfit
        whole.gradient[some, :-1] += other.gradient
        whole.matrix[some, :-1, :-1] += other.matrix
    return here, others
