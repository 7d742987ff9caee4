"""Make a `MaterialBasis` of a reed: once for every drawing, from finite elements.

Of the large basis that the snapshots span, the few coordinates are kept that modes of many canes
need, worst errors first. Then the mass is made the identity at every thickness and taken off those
coordinates that hardly move: they follow the others as if at rest, so that a reed is a standard
eigenproblem of few coordinates.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy import linalg

from holography.arrays import Array
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.mesh import MeshLevel
from physics.reed.geometry import ReedGeometry
from physics.reed.material_range.basis import HalfMaterialBasis, MaterialBasis, condensed_stiffness
from physics.reed.material_range.constants import terms_and_slopes
from physics.reed.material_range.snapshots import (
    TRAINED_BEYOND,
    LargeBasis,
    Pencil,
    TrainingSettings,
    at_place,
    canes_of_box,
    chebyshev_coefficients,
    large_bases,
)
from physics.reed.reduction.cache import STANDARD

# Modes of a sample that are looked at beyond the named ones.
_MORE_CANDIDATES = 8
# Share of a named mode's motion that makes a sample's mode one of the named.
_NAMED_SHARE = 0.2
# An unnamed mode's error matters where a named mode exchanges shapes with it.
_UNNAMED_WEIGHT = 0.3
# Rounds of new weights; how fast weights follow errors, and what keeps them from falling to
# nothing where errors are small; the norm that tells the best round.
_ROUNDS = 12
_FOLLOWING, _CALM = 0.5, 0.3
_WORST_NORM = 8
# Errors of a basis that is complete.
_ROUNDING_CENTS = 1e-6
# Coordinates that are added where a basis errs too much.
_MORE_COORDINATES = 4
# Share of the coordinates that keep their mass.
_WITH_MASS = 0.48
# In coordinates of unit mass the stiffness is no polynomial of the thickness; of degree 5, one is
# the same to 0.1 cent.
_THICKNESSES = 6
# Components of the stiffness that are smaller than this share of the largest are left out: that
# moves no mode by more than 0.3 cent.
_LEAST_COMPONENT = 2e-4
# Share of the time that the finite elements take, for those who watch.
_SNAPSHOT_SHARE = 0.7


@dataclass(frozen=True)
class _Sample:
    """A reed and its modes in the large basis: what the condensed basis is to give back.

    Attributes
    ----------
    terms_pa, place
        Stiffnesses (9,) of its cane, and place of its thickness in the box.
    eigenvalues, vectors : (c,) and (r, c) float
    named : (c,) bool
    """

    terms_pa: Array
    place: float
    eigenvalues: Array
    vectors: Array
    named: NDArray[np.bool_]


def build_material_basis(
    geometry: ReedGeometry,
    level: MeshLevel = STANDARD,
    settings: TrainingSettings | None = None,
    progress: Callable[[float], None] | None = None,
) -> MaterialBasis:
    """Compute a basis over materials from finite elements, on two threads.

    Parameters
    ----------
    geometry : ReedGeometry
    level : MeshLevel
    settings : TrainingSettings, optional
    progress : callable, optional
        Told, in this thread, the share of the work that is done, from 0 to 1.

    Raises
    ------
    ValueError
        For an impossible geometry, at any thickness of the box (see `build_mesh`), and for a box
        that is none or holds impossible canes.
    """
    settings = settings or TrainingSettings()

    def tell(share: float) -> None:
        if progress:
            progress(share)

    tell(0.0)
    named, large = large_bases(
        geometry, level, settings, lambda share: tell(_SNAPSHOT_SHARE * share)
    )
    with ThreadPoolExecutor(len(large)) as pool:
        tasks = [pool.submit(_half, basis, settings) for basis in large.values()]
        for done, _ in enumerate(as_completed(tasks), 1):
            tell(_SNAPSHOT_SHARE + (1 - _SNAPSHOT_SHARE) * done / len(tasks))
    halves = [task.result() for task in tasks]
    return MaterialBasis(
        geometry,
        settings.box,
        names=tuple(mode.name for mode in named),
        classes=tuple(mode.klass for mode in named),
        halves=dict(zip(large, halves, strict=True)),
    )


def _half(large: LargeBasis, settings: TrainingSettings) -> HalfMaterialBasis:
    """Smallest condensed basis whose errors over all samples are as small as asked for."""
    constants, places = canes_of_box(settings, 2 * settings.samples, edges=True)
    samples = _samples(large, constants, places, settings)
    # A basis fits those that it is condensed on better than others: half of them are for proof.
    learnt = samples[: len(samples) // 2]
    most = len(large.named_shapes)
    size = min(round(settings.size_per_mode * len(large.names)), most)
    while True:
        basis = _condensed(large.pencil, learnt, settings.cane, size)
        half = _half_of(basis, large, samples, settings)
        if half.error_cents <= settings.aim_cents or size == most:
            return half
        size = min(size + _MORE_COORDINATES, most)


def _half_of(
    basis: Array, large: LargeBasis, samples: Sequence[_Sample], settings: TrainingSettings
) -> HalfMaterialBasis:
    """What is to be kept of a basis (r, r') of the large one."""
    middle_mass = at_place(large.pencil.mass, 0.0)
    basis = basis @ _orthonormalising(basis.T @ middle_mass @ basis)
    components, loadings = _components(_with_unit_mass(_projected(large.pencil, basis)), settings)
    stiffnesses = _stiffnesses(components, loadings, samples)
    count = max(len(large.names), round(_WITH_MASS * len(components[0])))
    axes = _most_moving(stiffnesses, samples)
    named = np.concatenate([sample.named for sample in samples])
    condensed, _ = condensed_stiffness(axes.T @ stiffnesses @ axes, count)
    errors = _excess_cents(np.linalg.eigvalsh(condensed), samples)[named]
    # A subspace bounds every frequency from above: the typical error is taken off, or more if the
    # worst would still be too large.
    shift = max(float(np.median(errors)), float(errors.max()) - settings.aim_cents)
    shapes = (axes.T @ basis.T @ middle_mass @ large.named_shapes)[:count]
    return HalfMaterialBasis(
        names=large.names,
        components=2 ** (-shift / 600) * (axes.T @ components @ axes),
        loadings=loadings,
        named_shapes=shapes / np.linalg.norm(shapes, axis=0),
        error_cents=float(np.abs(errors - shift).max()),
    )


def _samples(
    large: LargeBasis, constants: Array, places: Array, settings: TrainingSettings
) -> list[_Sample]:
    """Reeds of constants (s, 9) and places (s,) that have named modes, in the large basis."""
    pencil, shapes = large.pencil, large.named_shapes
    highest = settings.cane.density_kg_m3 * (2 * np.pi * settings.highest_hz) ** 2
    answer = []
    for terms, place in zip(terms_and_slopes(constants)[0], places, strict=True):
        K = np.tensordot(terms, at_place(pencil.stiffness, place), axes=1)
        M = at_place(pencil.mass, place)
        most = min(len(M), shapes.shape[1] + _MORE_CANDIDATES) - 1
        eigenvalues, vectors = linalg.eigh(K, M, subset_by_index=[0, most])
        norms = np.sum(shapes * (M @ shapes), axis=0)
        shares = (vectors.T @ (M @ shapes)) ** 2 / norms
        wanted = eigenvalues < TRAINED_BEYOND**2 * highest
        named = wanted & (shares.max(axis=1) > _NAMED_SHARE)
        if not named.any():
            continue
        # What comes soon after the highest named mode may exchange shapes with it.
        kept = eigenvalues < TRAINED_BEYOND**2 * eigenvalues[named].max()
        answer.append(_Sample(terms, place, eigenvalues[kept], vectors[:, kept], named[kept]))
    return answer


def _condensed(pencil: Pencil, samples: Sequence[_Sample], cane: Cane, size: int) -> Array:
    """Basis (r, size) in which the samples' worst errors are small.

    Proper orthogonal decomposition, in the energy of the reference cane, of modes that are
    weighted again in every round by their error in the last.
    """
    energy = np.tensordot(stiffness_terms_pa(cane), at_place(pencil.stiffness, 0.0), axes=1)
    root = np.linalg.cholesky(energy)
    scaled = root.T @ np.hstack([s.vectors / np.sqrt(s.eigenvalues) for s in samples])
    named = np.concatenate([s.named for s in samples])
    importance = np.where(named, 1.0, _UNNAMED_WEIGHT)
    weights, best, least = importance, np.empty(0), np.inf
    for _ in range(_ROUNDS):
        vectors = np.linalg.eigh((scaled * weights) @ scaled.T)[1][:, -size:]
        basis = np.linalg.qr(linalg.solve_triangular(root.T, vectors))[0]
        excess = _excess_cents(_ritz(_projected(pencil, basis), samples), samples)
        errors = np.maximum(excess, _ROUNDING_CENTS)
        worst = float(np.linalg.norm(errors[named], _WORST_NORM))
        if worst < least:
            best, least = basis, worst
        weights = weights * (_CALM + importance * errors / errors[named].mean()) ** _FOLLOWING
        weights = weights / weights.mean()
    return best


def _ritz(pencil: Pencil, samples: Sequence[_Sample]) -> Array:
    """Eigenvalues (s, r) of samples in a small basis."""
    powers, terms, size, _ = pencil.stiffness.shape
    polynomials = chebyshev.chebvander(np.array([s.place for s in samples]), powers - 1)
    loads = polynomials[:, :, None] * np.stack([s.terms_pa for s in samples])[:, None]
    stiffnesses = loads.reshape(-1, powers * terms) @ pencil.stiffness.reshape(powers * terms, -1)
    unit = _orthonormalising(np.tensordot(polynomials, pencil.mass, axes=1))
    return np.linalg.eigvalsh(unit.swapaxes(1, 2) @ stiffnesses.reshape(-1, size, size) @ unit)


def _orthonormalising(mass: Array) -> Array:
    """Matrices (…, r, r) whose columns are orthonormal in positive definite ones."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(mass)).swapaxes(-1, -2))


def _excess_cents(eigenvalues: Array, samples: Sequence[_Sample]) -> Array:
    """By how much eigenvalues (s, r) lie above those of samples, which are put in one row."""
    return np.concatenate(
        [
            600 * np.log2(found[: len(sample.eigenvalues)] / sample.eigenvalues)
            for found, sample in zip(eigenvalues, samples, strict=True)
        ]
    )


def _projected(pencil: Pencil, basis: Array) -> Pencil:
    return Pencil(basis.T @ pencil.stiffness @ basis, basis.T @ pencil.mass @ basis)


def _with_unit_mass(pencil: Pencil) -> Array:
    """Stiffness (p, 9, r, r) in coordinates whose mass is the identity at every thickness.

    The inverse square root of the mass takes one there: of all ways it moves coordinates least.
    """
    places = chebyshev.chebpts1(_THICKNESSES)
    found = []
    for place in places:
        values, vectors = np.linalg.eigh(at_place(pencil.mass, place))
        root = (vectors / np.sqrt(values)) @ vectors.T
        found.append(root @ at_place(pencil.stiffness, place) @ root)
    return chebyshev_coefficients(places, np.stack(found))


def _components(stiffness: Array, settings: TrainingSettings) -> tuple[Array, Array]:
    """Few matrices in place of many (p, 9, r, r): by singular values, in the reference's energy.

    Returns
    -------
    components : (k, r, r) float
    loadings : (k, p, 9) float
        ``stiffness[p, i] = Σ_k loadings[k, p, i] components[k]``, nearly.
    """
    powers, terms, size, _ = stiffness.shape
    reference = stiffness_terms_pa(settings.cane)
    root = np.linalg.cholesky(np.tensordot(reference, at_place(stiffness, 0.0), axes=1))
    inverse = np.linalg.inv(root)
    scaled = inverse @ (reference[:, None, None] * stiffness) @ inverse.T
    left, values, right = np.linalg.svd(
        scaled.reshape(powers * terms, size * size), full_matrices=False
    )
    kept = values > _LEAST_COMPONENT * values[0]
    components = root @ (values[kept, None] * right[kept]).reshape(-1, size, size) @ root.T
    loadings = left.T[kept].reshape(-1, powers, terms) / reference
    return components, loadings


def _stiffnesses(components: Array, loadings: Array, samples: Sequence[_Sample]) -> Array:
    """Stiffness matrices (s, r, r) of samples."""
    amounts = [at_place(loadings.swapaxes(0, 1), s.place) @ s.terms_pa for s in samples]
    return np.tensordot(np.stack(amounts), components, axes=1)


def _most_moving(stiffnesses: Array, samples: Sequence[_Sample]) -> Array:
    """Axes (r, r) of coordinates of unit mass, those with most of the samples' motion first."""
    shapes = np.linalg.eigh(stiffnesses)[1]
    motions = [
        found[:, : len(sample.named)] * np.where(sample.named, 1.0, _UNNAMED_WEIGHT)
        for found, sample in zip(shapes, samples, strict=True)
    ]
    moved = np.hstack(motions)
    return np.asarray(np.linalg.eigh(moved @ moved.T)[1][:, ::-1])
