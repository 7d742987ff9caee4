"""Modes of many reeds at once: any cane, any density, thickness near the drawing's.

Every reed is a standard symmetric eigenproblem of a few dozen coordinates. Its matrix is linear in
the nine stiffnesses of the cane and a polynomial in the thickness offset, so that derivatives are
those of the eigenvalues themselves. Most coordinates have no mass: they follow the others as if at
rest, and are eliminated first. `material_training` makes the matrices.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from queue import Empty, SimpleQueue

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from holography.arrays import Array, Mask
from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import ReedGeometry
from physics.reed.material_range.constants import (
    CONSTANTS,
    SLOPES,
    MaterialBox,
    possible_canes,
    terms_and_slopes,
    within_box,
)
from physics.reed.modes import ModeClass

_LARGEST_OFFSET_M = 1.0
# Modes beyond the named ones among which a name may be found where unnamed modes come lower.
SPARE_CANDIDATES = 8
# Blocks of columns into which quadratic forms are divided: of their mirrored parts, which need not
# be computed, more blocks leave less.
_BLOCKS = 4
# Reeds that are worked on together.
_CHUNK = 32


@dataclass(frozen=True)
class HalfMaterialBasis:
    """One symmetry of a reed in r reduced coordinates.

    The first c of them are orthonormal in the mass per unit density; the others have none. The
    stiffness of a reed is ``Σ_k a_k B_k`` with ``a_k = Σ_pi loadings[k, p, i] T_p(x) C_i``: C_i
    are the stiffnesses of the cane, T_p Chebyshev polynomials and x the thickness offset, -1 to 1
    over the box.

    Attributes
    ----------
    names : (m,) tuple of str
    components : (k, r, r) float
        The matrices B_k.
    loadings : (k, p, 9) float
    named_shapes : (c, m) float
        Unit shapes of the reference cane's modes, by which modes are named.
    error_cents : float
        Largest deviation of a named mode from the larger model that this one condenses, over the
        canes that it was condensed on and as many others.
    """

    names: tuple[str, ...]
    components: Array
    loadings: Array
    named_shapes: Array
    error_cents: float


@dataclass(frozen=True)
class MaterialBasis:
    """A reed of given drawing whose cane and thickness may take any value of a box.

    Attributes
    ----------
    geometry : ReedGeometry
    box : MaterialBox
    names : (m,) tuple of str
        Modes of both symmetries, ascending in frequency for the reference cane.
    classes : (m,) tuple of ModeClass
        Theirs.
    halves : dict
        A `HalfMaterialBasis` per `Symmetry`.
    """

    geometry: ReedGeometry
    box: MaterialBox
    names: tuple[str, ...]
    classes: tuple[ModeClass, ...]
    halves: dict[Symmetry, HalfMaterialBasis]


@dataclass(frozen=True)
class ReedModes:
    """Modes of n reeds.

    Attributes
    ----------
    names : (m,) tuple of str
    hz : (n, m) float
        Eigenfrequencies; NaN for a reed that cannot be (see `within`).
    slopes : (n, m, 11) float, or None if not asked for
        Derivatives of ln hz by the inputs in `SLOPES`: by the logarithms of moduli and density
        (no unit), by Poisson ratios (no unit) and by the thickness offset (1/m).
    similarity : (n, m) float
        Share of the mode in the motion of the mode that bears its name for the reference cane, 0
        to 1; near one half where two modes of one symmetry exchange shapes.
    within : (n,) bool
        Whether the reed lies in the box. Elsewhere frequencies are extrapolated: nothing is
        promised of them. A reed that cannot be, with moduli of no solid or Poisson ratios that
        would yield energy, has no frequencies at all.
    """

    names: tuple[str, ...]
    hz: Array
    slopes: Array | None
    similarity: Array
    within: Mask


def modes(
    basis: MaterialBasis,
    constants: ArrayLike,
    density_kg_m3: ArrayLike,
    thickness_offset_m: ArrayLike = 0.0,
    *,
    slopes: bool = True,
    threads: int = 2,
) -> ReedModes:
    """Named modes of n reeds, with their derivatives.

    A name goes with a shape, not with a place in the order: modes that cross are followed
    through. It is the shape of the reference cane, so that a name depends on the reed alone and
    not on a way to it. Half of the box's reeds at its corners, `names` would give the clarinet's
    modes the same names in nine of ten reeds and more, but T5 in 88 %, X4 in 74 and X6 in 66,
    which exchange shapes with each other; where `similarity` exceeds 3/4, always, but T5 in 90 %,
    X4 in 85 and X6 in 81 (``python -m benchmarks.reduced_basis``).

    Set ``OMP_NUM_THREADS=1``: the matrices are small, and more threads inside each slow all down.

    Parameters
    ----------
    basis : MaterialBasis
    constants : (n, 9) float
        Elastic constants in the order of `CONSTANTS`, in Pa (see `constants_of`).
    density_kg_m3, thickness_offset_m : (n,) float, or one for all
    slopes : bool
        Whether derivatives are wanted; frequencies alone take about half the time.
    threads : int

    Raises
    ------
    ValueError
        If the inputs are not of these shapes.
    """
    reeds = _reeds(basis, constants, density_kg_m3, thickness_offset_m)
    shape = len(reeds.possible), len(basis.names)
    answer = ReedModes(
        names=basis.names,
        hz=np.full(shape, np.nan),
        slopes=np.full((*shape, len(SLOPES)), np.nan) if slopes else None,
        similarity=np.full(shape, np.nan),
        within=reeds.within,
    )
    halves = [_prepared(half, basis.names) for half in basis.halves.values()]
    _solve_all(halves, reeds, answer, threads)
    return answer


def _solve_all(halves: Sequence["_Half"], reeds: "_Reeds", answer: ReedModes, threads: int) -> None:
    """Solve all possible reeds, some at a time in every thread."""
    which = np.flatnonzero(reeds.possible)
    chunks: SimpleQueue[NDArray[np.intp]] = SimpleQueue()
    for start in range(0, len(which), _CHUNK):
        chunks.put(which[start : start + _CHUNK])

    def work() -> None:
        # Held throughout: what is given back to the system after every chunk must be cleared by it
        # for the next, and that takes as long as the work.
        scratch = np.empty(max(_scratch_size(half) for half in halves))
        with suppress(Empty):
            while True:
                _solve(halves, reeds, chunks.get_nowait(), answer, scratch)

    if threads == 1 or chunks.qsize() < 2:
        work()
    else:
        with ThreadPoolExecutor(threads) as pool:
            for task in [pool.submit(work) for _ in range(threads)]:
                task.result()


def all_modes(
    basis: MaterialBasis,
    symmetry: Symmetry,
    constants: ArrayLike,
    density_kg_m3: ArrayLike,
    thickness_offset_m: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Modes of one symmetry of n reeds by number, not by name; the highest are rough.

    Parameters
    ----------
    basis, constants, density_kg_m3, thickness_offset_m
        As for `modes`.
    symmetry : Symmetry

    Returns
    -------
    hz : (n, c) float
        Ascending.
    shapes : (n, c, c) float
        Unit shapes in the coordinates of `HalfMaterialBasis.named_shapes`, one in each column.

    Raises
    ------
    ValueError
        If the inputs are not of these shapes, or a reed cannot be.
    """
    reeds = _reeds(basis, constants, density_kg_m3, thickness_offset_m)
    if not reeds.possible.all():
        raise ValueError(
            f"reed {np.argmin(reeds.possible)} of {len(reeds.possible)} cannot be: its constants "
            "are no solid's, or its density or thickness no reed's"
        )
    half = _prepared(basis.halves[symmetry], basis.names)
    solved = _solved(half, terms_and_slopes(reeds.constants)[0], reeds.place)
    return _hz(solved.eigenvalues, reeds.density_kg_m3[:, None]), solved.vectors


@dataclass(frozen=True)
class _Reeds:
    """Checked inputs of n reeds.

    Attributes
    ----------
    constants : (n, 9) float
    density_kg_m3, place : (n,) float
        The latter of the thickness offset in the box, -1 to 1.
    place_per_m : float
    possible, within : (n,) bool
        Whether a reed can be at all, and whether it lies in the box.
    """

    constants: Array
    density_kg_m3: Array
    place: Array
    place_per_m: float
    possible: Mask
    within: Mask


def _reeds(
    basis: MaterialBasis,
    constants: ArrayLike,
    density_kg_m3: ArrayLike,
    thickness_offset_m: ArrayLike,
) -> _Reeds:
    inputs = np.asarray(constants, dtype=float)
    if inputs.ndim != 2 or inputs.shape[1] != len(CONSTANTS):
        raise ValueError(
            f"constants of shape {inputs.shape}; give one row of {len(CONSTANTS)} per reed: "
            f"{', '.join(CONSTANTS)}"
        )
    density = _one_each("density_kg_m3", density_kg_m3, len(inputs))
    offset = _one_each("thickness_offset_m", thickness_offset_m, len(inputs))
    possible = possible_canes(inputs) & (density > 0) & (density < np.inf)
    possible &= np.abs(offset) < _LARGEST_OFFSET_M
    low, high = basis.box.thickness_offset_m
    return _Reeds(
        inputs,
        density,
        (2 * offset - low - high) / (high - low),
        2 / (high - low),
        possible,
        possible & within_box(basis.box, inputs, offset),
    )


def _one_each(name: str, values: ArrayLike, count: int) -> Array:
    given = np.asarray(values, dtype=float)
    if given.shape not in ((), (count,)):
        raise ValueError(f"{name} of shape {given.shape}; give one value, or one for each reed")
    return np.broadcast_to(given, (count,))


@dataclass(frozen=True)
class _Half:
    """A `HalfMaterialBasis` laid out for use.

    Attributes
    ----------
    places : (m,) int
        Of its modes among all names.
    components : (k, r, r) float
    forms : tuple of (int, int, Array)
        See `_forms`.
    loadings, loading_slopes : (p, k · 9) float
        Loadings, and those of the derivative by the place of the offset, on polynomials.
    named_shapes : (m, c) float
    """

    places: NDArray[np.intp]
    components: Array
    forms: tuple[tuple[int, int, Array], ...]
    loadings: Array
    loading_slopes: Array
    named_shapes: Array


def _prepared(half: HalfMaterialBasis, names: tuple[str, ...]) -> _Half:
    powers = half.loadings.shape[1]
    loadings = half.loadings.transpose(1, 0, 2).reshape(powers, -1)
    return _Half(
        places=np.array([names.index(name) for name in half.names]),
        components=half.components,
        forms=tuple(_forms(half.components)),
        loadings=loadings,
        loading_slopes=np.vstack([chebyshev.chebder(loadings), np.zeros_like(loadings[:1])]),
        named_shapes=np.ascontiguousarray(half.named_shapes.T),
    )


@dataclass(frozen=True)
class _Solved:
    """Every mode of n reeds in one symmetry, ascending.

    Attributes
    ----------
    loadings, loading_slopes : (n, k, 9) float
        Of the components on the cane's stiffnesses, at the thickness of each reed, and their
        derivatives by its place.
    eigenvalues, vectors : (n, c) and (n, c, c) float
    following : (n, r - c, c) float
        See `condensed_stiffness`.
    """

    loadings: Array
    loading_slopes: Array
    eigenvalues: Array
    vectors: Array
    following: Array


def _solved(half: _Half, terms: Array, place: Array) -> _Solved:
    """Solve reeds with stiffnesses (n, 9) and places (n,) of their thickness."""
    polynomials = chebyshev.chebvander(place, len(half.loadings) - 1)
    loadings, loading_slopes = (
        (polynomials @ part).reshape(len(terms), -1, terms.shape[1])
        for part in (half.loadings, half.loading_slopes)
    )
    amounts = (loadings @ terms[..., None])[..., 0]
    stiffness = np.tensordot(amounts, half.components, axes=1)
    condensed, following = condensed_stiffness(stiffness, half.named_shapes.shape[1])
    return _Solved(loadings, loading_slopes, *np.linalg.eigh(condensed), following)


def _solve(
    halves: Sequence[_Half],
    reeds: _Reeds,
    which: NDArray[np.intp],
    answer: ReedModes,
    scratch: Array,
) -> None:
    """Compute some reeds and write what is found into the answer."""
    terms, by_constants = terms_and_slopes(reeds.constants[which])
    for half in halves:
        at = np.ix_(which, half.places)
        solved = _solved(half, terms, reeds.place[which])
        chosen, answer.similarity[at] = _named(solved.vectors, half.named_shapes)
        eigenvalues = np.take_along_axis(solved.eigenvalues, chosen, axis=1)
        # Far outside the box a reed may have no stiffness left.
        eigenvalues = np.where(eigenvalues > 0, eigenvalues, np.nan)
        answer.hz[at] = _hz(eigenvalues, reeds.density_kg_m3[which, None])
        if answer.slopes is not None:
            moving = np.take_along_axis(solved.vectors, chosen[:, None], axis=2)
            shapes = np.concatenate([moving, solved.following @ moving], axis=1)
            energies = _energies(half.forms, shapes, scratch) / (2 * eigenvalues)[..., None]
            by_place = solved.loading_slopes @ terms[..., None] * reeds.place_per_m
            found = np.empty((*eigenvalues.shape, len(SLOPES)))
            found[..., :9] = energies @ (solved.loadings @ by_constants)
            found[..., 9] = -0.5
            found[..., 10] = (energies @ by_place)[..., 0]
            answer.slopes[at] = found


def _hz(eigenvalues: Array, density_kg_m3: Array | float) -> Array:
    return np.asarray(np.sqrt(eigenvalues / density_kg_m3) / (2 * np.pi))


def condensed_stiffness(stiffness: Array, count: int) -> tuple[Array, Array]:
    """Eliminate coordinates without mass, all but the first `count`.

    Parameters
    ----------
    stiffness : (n, r, r) float
    count : int

    Returns
    -------
    condensed : (n, count, count) float
    following : (n, r - count, count) float
        Takes the first coordinates to the others, on which nothing acts.
    """
    coupling = stiffness[:, count:, :count]
    following = -np.linalg.solve(stiffness[:, count:, count:], coupling)
    return stiffness[:, :count, :count] + coupling.swapaxes(1, 2) @ following, following


def _forms(components: Array) -> Iterator[tuple[int, int, Array]]:
    """Symmetric matrices (k, r, r) as blocks of columns (k · (r - start), stop - start).

    They begin at row `start`; below row `stop` they are doubled and stand for what is left out.
    """
    size = components.shape[1]
    for start, stop in pairwise(np.linspace(0, size, _BLOCKS + 1).astype(int).tolist()):
        block = components[:, start:, start:stop].copy()
        block[:, stop - start :] *= 2
        yield start, stop, block.reshape(-1, stop - start)


def _scratch_size(half: _Half) -> int:
    """Return how many numbers `_energies` stores at a time."""
    return max(len(block) for _, _, block in half.forms) * len(half.places) * _CHUNK


def _energies(forms: Sequence[tuple[int, int, Array]], shapes: Array, scratch: Array) -> Array:
    """Quadratic forms (n, m, k) of all components at shapes (n, r, m)."""
    count, size, modes = shapes.shape
    flat = shapes.transpose(1, 0, 2).reshape(size, -1)
    total: Array = np.zeros(1)
    for start, stop, block in forms:
        room = scratch[: len(block) * flat.shape[1]].reshape(len(block), -1)
        products = np.matmul(block, flat[start:stop], out=room)
        products = products.reshape(-1, size - start, flat.shape[1])
        total = total + np.einsum("krs,rs->sk", products, flat[start:])
    return total.reshape(count, modes, -1)


def _named(vectors: Array, named_shapes: Array) -> tuple[NDArray[np.intp], Array]:
    """Place (n, m) of each named mode among eigenvectors (n, r, r), and its similarity (n, m)."""
    candidates = vectors[:, :, : len(named_shapes) + SPARE_CANDIDATES]
    shares = np.matmul(named_shapes, candidates) ** 2
    chosen = shares.argmax(axis=2)
    # Two names may want the same mode where shapes mix: then all are given out together.
    for reed in np.flatnonzero((np.diff(np.sort(chosen, axis=1)) == 0).any(axis=1)):
        chosen[reed] = linear_sum_assignment(shares[reed], maximize=True)[1]
    return chosen, np.take_along_axis(shares, chosen[..., None], axis=2)[..., 0]
