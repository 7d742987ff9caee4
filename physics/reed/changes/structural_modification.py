"""Vibrations of a reed that is changed (see `structural_changes`), with cane and air."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.interpolate import CubicSpline

from holography.arrays import Array, ComplexArray
from physics.errors import ImpossibleReedError
from physics.reed.cane.material import (
    Cane,
    stiffness_terms_pa,
)
from physics.reed.changes.shape_derivatives import ShapeDerivatives
from physics.reed.changes.structural_changes import Change

# Modes of either symmetry with the moduli of two frequencies, as shares of the highest, and how
# many: their span holds all modes with moduli of their own frequency, to hundredths of a cent, the
# very highest to two tenths. Of one frequency many more would not.
_SPANNING = ((0.1, 10), (0.6, 22))
# A clamp's yielding in a direction counts if it is more than this share of the greatest.
_LEAST_SHARE = 1e-12
_SETTLED_CENTS = 1e-3
_MOST_ITERATIONS = 30
# Frequencies are the same to this share; by how much of what is asked answers may follow it.
_SAME, _SHARES = 1e-9, (-0.5, 0.5)
# Number of frequencies at which cane is tabulated, and their range relative to the highest.
_TABULATED, _LOWEST_SHARE, _HIGHEST_SHARE = 25, 0.01, 2.0
# Factor above the highest frequency from which modes are followed; similarity above which two
# modes are one.
_MARGIN, _ALIKE = 1.15, 0.3
# ... and begin with moduli of the nearest of these shares of it.
_PIVOTS = (0.12, 0.3, 0.55, 0.85)
_NO_STIFFNESS = "a mode has no stiffness left: thickness, moduli or clamp are of no reed"


@dataclass(frozen=True)
class AirLoad:
    """What the air around a reed adds, in the s coordinates of a `Change`.

    Attributes
    ----------
    hz : (f,) float
        Frequencies, ascending.
    mass_kg : (f, s, s) float
        Moved along.
    resistance_kg_s : (f, s, s) float
        Of sound that is radiated.
    """

    hz: Array
    mass_kg: Array
    resistance_kg_s: Array


@dataclass(frozen=True)
class Vibrations:
    """Modes of a changed reed, each with cane and air of its own frequency.

    Attributes
    ----------
    hz : (m,) float
        Ascending.
    coordinates : (s, m) float
        Shapes, mass-normalised over half the reed where they have a symmetry.
    radiated : (m,) float
        Loss factor by what air takes away.
    """

    hz: Array
    coordinates: Array
    radiated: Array


@dataclass(frozen=True)
class CaneTable:
    """Cane at all frequencies, interpolated between some: moduli grow smoothly.

    Attributes
    ----------
    moduli_pa : callable
        At log frequencies (m,): (m, 9), see `material.stiffness_terms_pa`.
    density_kg_m3 : callable
        (m,).
    spanning : tuple of (Cane, int)
        So many modes of these span those of all frequencies.
    """

    moduli_pa: Callable[[Array], Array]
    density_kg_m3: Callable[[Array], Array]
    spanning: tuple[tuple[Cane, int], ...]

    @classmethod
    def of(cls, material: Callable[[float], Cane], highest_hz: float) -> "CaneTable":
        """Tabulate a cane (at a frequency in Hz) up to beyond a frequency."""
        log_hz = np.linspace(np.log(_LOWEST_SHARE), np.log(_HIGHEST_SHARE), _TABULATED)
        log_hz += np.log(highest_hz)
        canes = [material(float(hz)) for hz in np.exp(log_hz)]
        moduli = np.array([stiffness_terms_pa(cane) for cane in canes])
        density = np.array([cane.density_kg_m3 for cane in canes])
        spanning = tuple((material(share * highest_hz), count) for share, count in _SPANNING)
        return cls(CubicSpline(log_hz, moduli), CubicSpline(log_hz, density), spanning)


def vibrations(
    shape_derivatives: ShapeDerivatives,
    change: Change,
    canes: CaneTable,
    highest_hz: float,
    air: AirLoad | None = None,
) -> Vibrations:
    """Modes of a changed reed up to a frequency.

    By Rayleigh's and Ritz's method in the span of the modes with the moduli of two frequencies.

    Parameters
    ----------
    shape_derivatives : ShapeDerivatives
    change : Change
    canes : CaneTable
        Up to that frequency.
    highest_hz : float
    air : AirLoad, optional
        Vacuum if not given.

    Raises
    ------
    ImpossibleReedError
        If moduli grow too fast with frequency for modes to settle, or a change leaves no reed.
    """
    found = [
        _settled(span, canes, highest_hz)
        for span in _spans(shape_derivatives, change, canes.spanning, air)
    ]
    hz, coordinates, radiated = (np.concatenate(p, axis=-1) for p in zip(*found, strict=True))
    order = np.argsort(hz)
    return Vibrations(hz[order], coordinates[:, order], radiated[order])


@dataclass(frozen=True)
class _Span:
    """What a few shapes (s, n) make of a changed reed.

    Attributes
    ----------
    shapes : (s, n) float
    stiffness_terms : (9, n, n) float
    springs_n_m : (n, n) float
        Of the clamp.
    mass, mass_kg : (n, n) float
    air_kg, resistance_kg_s : callable
        At frequencies (m,): (m, n, n).
    """

    shapes: Array
    stiffness_terms: Array
    springs_n_m: Array
    mass: Array
    mass_kg: Array
    air_kg: Callable[[Array], Array]
    resistance_kg_s: Callable[[Array], Array]


def _spans(
    shape_derivatives: ShapeDerivatives,
    change: Change,
    spanning: Sequence[tuple[Cane, int]],
    air: AirLoad | None,
) -> Iterator[_Span]:
    """Yield spans of low modes: one per symmetry, or one if the change couples them."""
    terms = shape_derivatives.stiffness_terms + change.stiffness_terms
    mass = shape_derivatives.mass + change.mass
    matrices = [
        (
            np.tensordot(stiffness_terms_pa(cane), terms, axes=1),
            cane.density_kg_m3 * mass + change.mass_kg,
        )
        for cane, _ in spanning
    ]
    for into, springs, symmetries in _coordinates(shape_derivatives, change):
        vectors = np.linalg.qr(
            np.hstack(
                [
                    _lowest(into.T @ K @ into + springs, into.T @ M @ into, symmetries * count)
                    for (K, M), (_, count) in zip(matrices, spanning, strict=True)
                ]
            )
        ).Q
        shapes = into @ vectors
        yield _Span(
            shapes=shapes,
            stiffness_terms=shapes.T @ terms @ shapes,
            springs_n_m=vectors.T @ springs @ vectors,
            mass=shapes.T @ mass @ shapes,
            mass_kg=shapes.T @ change.mass_kg @ shapes,
            air_kg=_at_frequencies(air.hz, air.mass_kg, shapes) if air else _none_of(shapes),
            resistance_kg_s=(
                _at_frequencies(air.hz, air.resistance_kg_s, shapes) if air else _none_of(shapes)
            ),
        )


def response_of_changed(
    shape_derivatives: ShapeDerivatives,
    change: Change,
    material: Cane,
    loss_factor: float,
    hz: float,
    force_n: ComplexArray,
    *,
    air: AirLoad | None = None,
    added_n_m: Array | None = None,
) -> ComplexArray:
    """Return the motion (s,) of a changed reed under forces (s,) at one frequency.

    Solves ``((1 + iη) K - ω²M + iωR) q = F``, in which only the cane has a loss factor.

    Parameters
    ----------
    shape_derivatives : ShapeDerivatives
    change : Change
    material : Cane
        All constants, at this frequency.
    loss_factor : float
        η.
    hz : float
    force_n : (s,) complex
    air : AirLoad, optional
        Vacuum if not given.
    added_n_m : (s, s) float, optional
        More stiffness, with the cane's loss factor.
    """
    omega = 2 * np.pi * hz
    terms = shape_derivatives.stiffness_terms + change.stiffness_terms
    cane = np.tensordot(stiffness_terms_pa(material), terms, axes=1)
    if added_n_m is not None:
        cane = cane + added_n_m
    mass = material.density_kg_m3 * (shape_derivatives.mass + change.mass) + change.mass_kg
    dynamic = (1 + 1j * loss_factor) * cane - omega**2 * mass
    if air is not None:
        splines = [CubicSpline(np.log(air.hz), part) for part in (air.mass_kg, air.resistance_kg_s)]
        carried, resistance = (spline(np.log(hz)) for spline in splines)
        dynamic = dynamic - omega**2 * carried + 1j * omega * resistance
    moved = np.zeros(len(force_n), dtype=complex)
    for into, springs, _ in _coordinates(shape_derivatives, change):
        own = into.T @ dynamic @ into + springs
        moved += into @ np.linalg.solve(own, into.T @ force_n)
    return moved


def _lowest(stiffness: Array, mass: Array, count: int) -> Array:
    """Vectors (n, count) of the lowest modes, or of all."""
    # The clamp's own coordinates have no mass if it hardly yields: the inverse problem minds that
    # less.
    size = len(mass)
    subset = size - min(count, size), size - 1
    try:
        vectors: Array = linalg.eigh(mass, stiffness, subset_by_index=subset)[1]
    except np.linalg.LinAlgError:
        raise ImpossibleReedError(_NO_STIFFNESS) from None
    return vectors


def _coordinates(
    shape_derivatives: ShapeDerivatives, change: Change
) -> Iterator[tuple[Array, Array, int]]:
    """Coordinates (s, c) that are solved for together, their springs (c, c), and symmetries.

    Those of the strip are taken in units in which each stores the energy of a unit spring: a clamp
    that does not yield has none.
    """
    sizes = [half.mass.shape[0] for half in shape_derivatives.reed.halves.values()]
    held = list(shape_derivatives.clamped.values())
    starts = np.cumsum([0, *sizes[:-1]])
    m = len(shape_derivatives.strip_m2)
    strip = np.concatenate(
        [start + n + np.arange(m) for start, n in zip(starts, held, strict=True)]
    )
    values, vectors = linalg.eigh(change.compliance_m_n)
    kept = values > _LEAST_SHARE * max(values.max(), 0.0)
    yielding = np.zeros((sum(sizes), np.count_nonzero(kept)))
    yielding[strip] = vectors[:, kept] * np.sqrt(values[kept])
    at_rest = [
        np.eye(sum(sizes))[:, start : start + n] for start, n in zip(starts, held, strict=True)
    ]
    if _couples(change, sizes[0], m):
        into = np.hstack([*at_rest, yielding])
        springs = _unit_springs(sum(held), yielding.shape[1])
        yield into, springs, len(sizes)
        return
    for number, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        own = np.any(yielding[start : start + size], axis=0)
        into = np.hstack([at_rest[number], yielding[:, own]])
        springs = _unit_springs(held[number], int(np.count_nonzero(own)))
        yield into, springs, 1


def _unit_springs(without: int, count: int) -> Array:
    """Stiffness of coordinates of which the last `count` are held by a spring of their own."""
    return np.diag(np.concatenate([np.zeros(without), np.ones(count)]))


def _couples(change: Change, first: int, strip: int) -> bool:
    """Whether a change makes motions of either symmetry excite the other."""
    return bool(
        np.any(change.stiffness_terms[:, :first, first:])
        or np.any(change.mass[:first, first:])
        or np.any(change.mass_kg[:first, first:])
        or np.any(change.compliance_m_n[:strip, strip:])
    )


def _at_frequencies(hz: Array, matrices: Array, shapes: Array) -> Callable[[Array], Array]:
    """Interpolate matrices (f, s, s) given at frequencies, between shapes (s, n)."""
    spline = CubicSpline(np.log(hz), shapes.T @ matrices @ shapes)
    return lambda asked_hz: np.asarray(spline(np.log(asked_hz)))


def _none_of(shapes: Array) -> Callable[[Array], Array]:
    return lambda hz: np.zeros((len(hz), shapes.shape[1], shapes.shape[1]))


def _settled(span: _Span, table: CaneTable, highest_hz: float) -> tuple[Array, Array, Array]:
    """Frequencies (m,), shapes (s, m) and radiated loss (m,) of modes."""
    hz, vectors = _followed(span, table, highest_hz)
    if hz is None or vectors is None:
        hz, vectors = _numbered(span, table, highest_hz)
    damped = _energy(span.resistance_kg_s(hz), vectors)
    return hz, span.shapes @ vectors.T, damped / (2 * np.pi * hz)


def _energy(matrices: Array, vectors: Array) -> Array:
    """Quadratic forms (m,) of matrices (m, n, n) in vectors (m, n)."""
    forms: Array = np.sum(vectors * (matrices @ vectors[..., None])[..., 0], axis=1)
    return forms


def _followed(
    span: _Span, table: CaneTable, highest_hz: float
) -> tuple[Array, Array] | tuple[None, None]:
    """Frequencies (m,) and vectors (m, n), by Rayleigh's quotient from those of few moduli.

    None if two of them come to the same mode, or one to none.
    """
    pivots_hz = highest_hz * np.array(_PIVOTS)
    all_hz, vectors = _solved(span, table, pivots_hz)
    near = np.flatnonzero(all_hz[0] < _MARGIN * highest_hz)
    if np.any(all_hz[0, near] <= 0):
        raise ImpossibleReedError(_NO_STIFFNESS)
    # Of each mode the shape that it has with the moduli of a frequency near its own.
    pivot = np.abs(np.log(all_hz[0, near, None] / pivots_hz)).argmin(axis=1)
    hz, v = all_hz[pivot, near], vectors[pivot, :, near]
    asked = answered = hz
    for _ in range(_MOST_ITERATIONS):
        K, M = _matrices(span, table, hz)
        Mv = M @ v[..., None]
        quotient = _energy(K, v) / np.sum(v * Mv[..., 0], axis=1)
        v = np.linalg.solve(K - ((1 + _SAME) * quotient)[:, None, None] * M, Mv)[..., 0]
        v /= np.sqrt(_energy(M, v))[:, None]
        found = np.sqrt(np.maximum(_energy(K, v), 0)) / (2 * np.pi)
        if np.abs(1200 * np.log2(np.maximum(found, 1e-9) / hz)).max(initial=0.0) < _SETTLED_CENTS:
            hz = found
            break
        asked, answered, hz = hz, found, _between(asked, answered, hz, found)
    else:
        return None, None
    kept = hz < highest_hz
    hz, v = hz[kept], v[kept]
    similarity = np.abs(v @ (_matrices(span, table, hz[:1])[1][0] if len(hz) else 0) @ v.T)
    if len(hz) and np.abs(similarity - np.diag(np.diag(similarity))).max(initial=0.0) > _ALIKE:
        return None, None
    order = np.argsort(hz)
    return hz[order], v[order]


def _numbered(span: _Span, table: CaneTable, highest_hz: float) -> tuple[Array, Array]:
    """Frequencies (m,) and vectors (m, n) of modes, each settled by its number."""
    answers = _solved(span, table, np.array([highest_hz]))[0][0]
    number = np.arange(answers.searchsorted(highest_hz))
    # With the moduli of `asked`, modes are at `answered`; sought is where both are the same.
    asked, answered = np.full(len(number), highest_hz), answers[number]
    hz = answered
    for _ in range(_MOST_ITERATIONS):
        all_hz, vectors = _solved(span, table, hz)
        found = all_hz[number, number]
        if np.any(found <= 0):
            raise ImpossibleReedError(_NO_STIFFNESS)
        if not number.size or np.abs(1200 * np.log2(found / hz)).max() < _SETTLED_CENTS:
            hz = found
            break
        asked, answered, hz = hz, found, _between(asked, answered, hz, found)
    else:
        raise ImpossibleReedError(
            "modes do not settle: the moduli of this cane grow too fast with frequency"
        )
    return hz, vectors[number, :, number]


def _between(asked: Array, answered: Array, hz: Array, found: Array) -> Array:
    """Frequencies (m,) to ask for next: answers follow what is asked by a small share."""
    apart = np.where(np.abs(hz - asked) > _SAME * hz, hz - asked, np.inf)
    share = np.clip((found - answered) / apart, *_SHARES)
    return hz + (found - hz) / (1 - share)


def _solved(span: _Span, table: CaneTable, hz: Array) -> tuple[Array, Array]:
    """Eigenfrequencies (m, n) and mass-normalised vectors (m, n, n) with what holds at (m,)."""
    K, M = _matrices(span, table, hz)
    try:
        root = np.linalg.cholesky(M)
    except np.linalg.LinAlgError:
        raise ImpossibleReedError(_NO_STIFFNESS) from None
    half = np.linalg.solve(root, K)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, half.transpose(0, 2, 1)))
    own = np.linalg.solve(root.transpose(0, 2, 1), vectors)
    return np.sqrt(np.clip(values, 0, None)) / (2 * np.pi), own


def _matrices(span: _Span, table: CaneTable, hz: Array) -> tuple[Array, Array]:
    """Stiffness and mass (m, n, n) with what holds at (m,)."""
    if np.any(hz <= 0):
        raise ImpossibleReedError(_NO_STIFFNESS)
    log_hz = np.log(hz)
    density = table.density_kg_m3(log_hz)[:, None, None]
    K = np.tensordot(table.moduli_pa(log_hz), span.stiffness_terms, axes=1) + span.springs_n_m
    return K, density * span.mass + span.mass_kg + span.air_kg(hz)
