"""Named modes of a reed, straight from its finite elements: any geometry, any cane.

A reed that is its own mirror image is solved by halves, one for each symmetry; any other whole.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from physics.reed.fem import (
    ReedMatrices,
    Symmetry,
    assemble,
    factor,
    free_dofs,
    lowest_modes,
    mass,
    projected_stiffness,
    stiffness,
)
from physics.reed.geometry import ReedGeometry
from physics.reed.material import Cane, stiffness_terms_pa
from physics.reed.mesh import HalfReedMesh, MeshLevel, ReedMesh, build_least_mesh
from physics.reed.names import assign_names, likenesses, width_profiles
from physics.reed.viscoelastic import ViscoelasticCane, storage_modulus_pa

Array = NDArray[np.floating[Any]]

# The sweep of the paper ends here.
HIGHEST_HZ = 20e3
# Modes just above the highest wanted are named too: a pair that exchanges shapes across that
# limit then shares its names as it would elsewhere.
_NAMED_BEYOND = 1.1
# Modes of either symmetry sought at first, and at most; a reed of cane has some ten below 20 kHz.
_FIRST_COUNT = 12
_MOST_MODES = 100
# The rounded tip has no straight line across; profiles start behind it.
_TIP_M = 0.5e-3
# A mode with more than this share of its kinetic energy sideways and behind the vamp is lateral or
# the heel's, whichever is more.
_FOREIGN_SHARE = 0.5
# A name that bears out less than this share of a motion says nothing of it.
_LEAST_CLAIM = 0.1
# Takes the displacement of a point to that of its mirror image.
_REFLECTION = np.array([1.0, -1.0, 1.0])
# Shapes at the highest frequency and at this share of it span those between, to 0.1 cent.
_SOFTER_SHARE = 1 / 6
# Trial shapes that differ from the others by less than this share of their energy are noise.
_LEAST_SHARE = 1e-12
_SETTLED_CENTS = 1e-4
_MOST_ITERATIONS = 50


class ModeClass(StrEnum):
    """What kind of motion a mode is: the paper's F, T and X, and L and H outside the vamp."""

    FLEXURAL = "flexural"
    TRANSVERSAL = "transversal"
    GENERIC = "generic"
    LATERAL = "lateral"
    HEEL = "heel"


_CLASSES = {
    "F": ModeClass.FLEXURAL,
    "T": ModeClass.TRANSVERSAL,
    "L": ModeClass.LATERAL,
    "H": ModeClass.HEEL,
}


@dataclass(frozen=True)
class NamedMode:
    """One vibration of the undamped reed.

    Attributes
    ----------
    name : str
        See `physics.reed.names`; ``?`` and a number where a better claimant bears the name.
    frequency_hz : float
    klass : ModeClass
    symmetry : Symmetry
        Of the part with more kinetic energy: a reed that is not its own mirror image mixes both.
    likeness : float
        Share of its motion that bears out its name; low where two modes exchange shapes.
    shape : (n, 3) float
        Displacements at the nodes of `mesh.build_least_mesh`, mass-normalised over that mesh.
    """

    name: str
    frequency_hz: float
    klass: ModeClass
    symmetry: Symmetry
    likeness: float
    shape: Array


@dataclass(frozen=True)
class _System:
    """The finite elements of the motions of one symmetry, or of any motion, clamped.

    Attributes
    ----------
    mesh : ReedMesh
    matrices : ReedMatrices
    symmetries : tuple of Symmetry
        That a motion may have: one of half a reed, both of a whole one.
    free : (f,) int
        Degrees of freedom left.
    mass : (f, f) sparse
        In kg.
    """

    mesh: ReedMesh
    matrices: ReedMatrices
    symmetries: tuple[Symmetry, ...]
    free: NDArray[np.intp]
    mass: sparse.csc_array


@dataclass(frozen=True)
class _Part:
    """What several motions have of one symmetry.

    Attributes
    ----------
    symmetry : Symmetry
    shapes : (n, 3, m) float
    share : (m,) float
        Of the kinetic energy of each motion.
    foreign : dict of (m,) float
        As `share`, of sideways motion (L) and of motion behind the vamp (H).
    """

    symmetry: Symmetry
    shapes: Array
    share: Array
    foreign: dict[str, Array]


def reed_modes(
    geometry: ReedGeometry, cane: Cane, level: MeshLevel, highest_hz: float = HIGHEST_HZ
) -> list[NamedMode]:
    """Every mode of a reed of fixed moduli up to a frequency, of both symmetries.

    Parameters
    ----------
    geometry : ReedGeometry
    cane : Cane
    level : MeshLevel
    highest_hz : float

    Returns
    -------
    list of NamedMode
        Ascending in frequency.

    Raises
    ------
    ValueError
        For an impossible geometry or material (see `build_whole_mesh`, `stiffness_terms_pa`).
    """

    def solve(system: _System) -> tuple[Array, Array]:
        return _modes_up_to(system, cane, _NAMED_BEYOND * highest_hz)

    return _named_modes(geometry, cane.density_kg_m3, level, highest_hz, solve)


def viscoelastic_modes(
    geometry: ReedGeometry,
    constants: Cane,
    cane: ViscoelasticCane,
    level: MeshLevel,
    highest_hz: float = HIGHEST_HZ,
) -> list[NamedMode]:
    """Every mode of a reed up to a frequency, each with the storage moduli of its own frequency.

    Numbered by frequency among those solved together, the j-th mode is where the j-th
    eigenfrequency of the reed with the moduli of a frequency is that frequency itself. Moduli that
    grow with frequency more slowly than its square have one such place for every j, so that no mode
    is found twice or missed where two of them cross.

    Parameters
    ----------
    geometry : ReedGeometry
    constants : Cane
        Supplies all constants but E_L and G_LT.
    cane : ViscoelasticCane
        Supplies these two.
    level : MeshLevel
    highest_hz : float

    Returns
    -------
    list of NamedMode
        Ascending in frequency.

    Raises
    ------
    ValueError
        As `reed_modes`, and if the iteration does not settle.
    """

    def solve(system: _System) -> tuple[Array, Array]:
        return _settled_modes(system, constants, cane, _NAMED_BEYOND * highest_hz)

    return _named_modes(geometry, constants.density_kg_m3, level, highest_hz, solve)


def at_frequency(constants: Cane, cane: ViscoelasticCane, frequency_hz: float) -> Cane:
    """Elastic constants that a viscoelastic cane has at a frequency."""
    return replace(
        constants,
        E_L_pa=float(storage_modulus_pa(cane.young_L, frequency_hz)),
        G_LT_pa=float(storage_modulus_pa(cane.shear_LT, frequency_hz)),
    )


def _named_modes(
    geometry: ReedGeometry,
    density_kg_m3: float,
    level: MeshLevel,
    highest_hz: float,
    solve: Callable[[_System], tuple[Array, Array]],
) -> list[NamedMode]:
    """Solve for all motions, name what comes out and keep what is wanted."""
    found: list[NamedMode] = []
    for system in _systems(geometry, level, density_kg_m3):
        frequencies, reduced = solve(system)
        shapes = _at_nodes(system, reduced)
        names = _names(geometry, system, shapes)
        for m, ((name, symmetry, likeness), hz) in enumerate(zip(names, frequencies, strict=True)):
            klass = _CLASSES.get(name[0], ModeClass.GENERIC)
            shape = shapes[:, :, m]
            found.append(NamedMode(name, float(hz), klass, symmetry, likeness, shape))
    wanted = [mode for mode in found if mode.frequency_hz <= highest_hz]
    return sorted(wanted, key=lambda mode: mode.frequency_hz)


def _systems(geometry: ReedGeometry, level: MeshLevel, density_kg_m3: float) -> Iterator[_System]:
    mesh = build_least_mesh(geometry, level)
    matrices = assemble(mesh)
    all_mass = mass(matrices, density_kg_m3)

    def system(symmetries: tuple[Symmetry, ...], free: NDArray[np.intp]) -> _System:
        return _System(mesh, matrices, symmetries, free, all_mass[free][:, free])

    if isinstance(mesh, HalfReedMesh):
        for symmetry in Symmetry:
            yield system((symmetry,), free_dofs(mesh, symmetry))
    else:
        yield system(tuple(Symmetry), np.flatnonzero(~np.repeat(mesh.clamped, 3)))


def _at_nodes(system: _System, vectors: Array) -> Array:
    """Displacements (n, 3, m) at all nodes of vectors (f, m)."""
    everywhere = np.zeros((3 * len(system.mesh.nodes_m), vectors.shape[1]))
    everywhere[system.free] = vectors
    return everywhere.reshape(len(system.mesh.nodes_m), 3, vectors.shape[1])


def _stiffness(system: _System, cane: Cane) -> sparse.csc_array:
    return stiffness(system.matrices, stiffness_terms_pa(cane))[system.free][:, system.free]


def _modes_up_to(system: _System, cane: Cane, highest_hz: float) -> tuple[Array, Array]:
    """Eigenfrequencies (m,) up to the highest, ascending, and mass-normalised shapes (f, m)."""
    K = _stiffness(system, cane)
    solve, count = factor(K), _FIRST_COUNT * len(system.symmetries)
    # The sparse solver finds a part of all modes only.
    most = min(_MOST_MODES * len(system.symmetries), len(system.free) // 2)
    while True:
        frequencies, shapes = lowest_modes(K, system.mass, min(count, most), solve)
        if frequencies.max() > highest_hz:
            order = np.argsort(frequencies)[: np.count_nonzero(frequencies <= highest_hz)]
            return frequencies[order], shapes[:, order]
        if count >= most:
            raise ValueError(
                f"the reed has over {most} modes below {highest_hz:.0f} Hz, more than cane can "
                "have; check moduli, density and thickness"
            )
        # Modes of a plate are evenly spaced in frequency.
        count = int(np.ceil(1.1 * count * highest_hz / frequencies.max())) + 2


def _settled_modes(
    system: _System, constants: Cane, cane: ViscoelasticCane, highest_hz: float
) -> tuple[Array, Array]:
    """As `_modes_up_to`, each mode with the moduli of its own frequency.

    By Rayleigh's and Ritz's method in the span of the modes at two frequencies.
    """
    stiff = _modes_up_to(system, at_frequency(constants, cane, highest_hz), highest_hz)[1]
    if not stiff.size:
        return np.empty(0), stiff
    softer = at_frequency(constants, cane, _SOFTER_SHARE * highest_hz)
    soft = lowest_modes(_stiffness(system, softer), system.mass, stiff.shape[1])[1]
    trial = _span(system.mass, [stiff, soft])
    terms = projected_stiffness(system.matrices, _at_nodes(system, trial))

    def eigenpairs(hz: float) -> tuple[Array, Array]:
        moduli = stiffness_terms_pa(at_frequency(constants, cane, hz))
        eigenvalues, vectors = np.linalg.eigh(np.tensordot(moduli, terms, axes=1))
        return np.sqrt(np.clip(eigenvalues, 0.0, None)) / (2 * np.pi), vectors

    # A mode settles below the highest frequency where the moduli of that frequency leave it below.
    frequencies, shapes = np.empty(stiff.shape[1]), np.empty_like(stiff)
    for j in range(len(frequencies)):
        frequencies[j], vector = _fixed_point(eigenpairs, j, highest_hz)
        shapes[:, j] = trial @ vector
    return frequencies, shapes


def _fixed_point(
    eigenpairs: Callable[[float], tuple[Array, Array]], number: int, start_hz: float
) -> tuple[float, Array]:
    """Frequency whose `number`-th eigenfrequency is itself, and the shape there."""
    hz = start_hz
    for _ in range(_MOST_ITERATIONS):
        frequencies, vectors = eigenpairs(hz)
        previous, hz = hz, float(frequencies[number])
        if abs(1200 * np.log2(hz / previous)) < _SETTLED_CENTS:
            return hz, vectors[:, number]
    raise ValueError(f"a mode does not settle near {hz:.0f} Hz; check the cane's Zener parameters")


def _span(mass_ff: sparse.csc_array, shapes: list[Array]) -> Array:
    """Mass-orthonormal basis (f, r) of what several sets of mass-normalised shapes span."""
    stacked = np.hstack(shapes)
    values, vectors = np.linalg.eigh(stacked.T @ (mass_ff @ stacked))
    kept = values > _LEAST_SHARE * values[-1]
    basis: Array = stacked @ (vectors[:, kept] / np.sqrt(values[kept]))
    return basis


def _parts(geometry: ReedGeometry, system: _System, shapes: Array) -> list[_Part]:
    """Split motions (n, 3, m) by symmetry; those of half a reed have one already."""
    if len(system.symmetries) == 1:
        split = {system.symmetries[0]: shapes}
    else:
        columns = shapes.reshape(*system.mesh.block, *shapes.shape[1:])
        mirrored = columns[:, ::-1].reshape(shapes.shape) * _REFLECTION[:, None]
        split = {
            Symmetry.SYMMETRIC: 0.5 * (shapes + mirrored),
            Symmetry.ANTISYMMETRIC: 0.5 * (shapes - mirrored),
        }

    def energy(motion: Array) -> Array:
        product: Array = np.einsum("nm,nm->m", motion, system.matrices.mass @ motion)
        return product

    energies = [np.sum([energy(part[:, k]) for k in range(3)], axis=0) for part in split.values()]
    # What little energy an uneven reed has between its parts belongs to neither.
    total = np.sum(energies, axis=0)
    behind = system.mesh.nodes_m[:, :1] > geometry.vamp_x_m[-1]
    return [
        _Part(
            symmetry,
            part,
            own / total,
            {"L": energy(part[:, 1]) / total, "H": energy(part[:, 2] * behind) / total},
        )
        for (symmetry, part), own in zip(split.items(), energies, strict=True)
    ]


def _names(
    geometry: ReedGeometry, system: _System, shapes: Array
) -> list[tuple[str, Symmetry, float]]:
    """Names, symmetries and likenesses of motions (n, 3, m), ascending in frequency."""
    parts = _parts(geometry, system, shapes)
    larger = [max(parts, key=lambda part: part.share[m]) for m in range(shapes.shape[2])]
    outside = np.sum([share for part in parts for share in part.foreign.values()], axis=0)
    answer: dict[int, tuple[str, float]] = {}
    counts: Counter[str] = Counter()
    for m in np.flatnonzero(outside > _FOREIGN_SHARE).tolist():
        symmetric, foreign = larger[m].symmetry is Symmetry.SYMMETRIC, larger[m].foreign
        kind = max(foreign, key=lambda kind: foreign[kind][m])
        # The paper's lateral modes bend in the plane, and modes of the heel are symmetric first.
        suffix = {("L", True): "s", ("H", False): "a"}.get((kind, symmetric), "")
        counts[kind + suffix] += 1
        answer[m] = f"{kind}{counts[kind + suffix]}{suffix}", float(foreign[kind][m])
    vamp = [m for m in range(shapes.shape[2]) if m not in answer]
    claims = _claims(geometry, system.mesh, parts)
    # Squared: one clear likeness is worth more than two faint ones.
    weights = [
        {name: claim**2 for name, claim in claims[m].items() if claim > _LEAST_CLAIM} for m in vamp
    ]
    for m, (name, _) in zip(vamp, assign_names(weights) if vamp else (), strict=True):
        if name.startswith("?"):
            # A place without a name is told from its like of the other symmetry.
            suffix = larger[m].symmetry[0]
            counts["?" + suffix] += 1
            answer[m] = f"?{counts['?' + suffix]}{suffix}", 0.0
        else:
            # What moves beside and behind the vamp bears out no name of the vamp.
            answer[m] = name, (1 - float(outside[m])) * claims[m][name]
    return [(answer[m][0], part.symmetry, answer[m][1]) for m, part in enumerate(larger)]


def _claims(geometry: ReedGeometry, mesh: ReedMesh, parts: list[_Part]) -> list[dict[str, float]]:
    """Names that motions could bear on the vamp, and the share of each motion behind each name."""
    claims: list[dict[str, float]] = [{} for _ in parts[0].share]
    for part in parts:
        # A lesser part is not worth a name, whatever it looks like.
        worthy = np.flatnonzero(part.share > _LEAST_CLAIM)
        symmetric = part.symmetry is Symmetry.SYMMETRIC
        vamp_claims = _vamp_claims(geometry, mesh, part.shapes[:, 2, worthy], symmetric=symmetric)
        for m, shares in zip(worthy, vamp_claims, strict=True):
            claims[m] |= {name: float(part.share[m]) * share for name, share in shares.items()}
    return claims


def _vamp_claims(
    geometry: ReedGeometry, mesh: ReedMesh, u_z: Array, *, symmetric: bool
) -> list[dict[str, float]]:
    """Names that deflections (n, m) of one symmetry could bear, and the share of it behind each.

    Lines across the vamp's bark side are weighted by the root of the area that each stands for, so
    that sums of their squares do not depend on how the mesh is graded.
    """
    plan = mesh.nodes_m.reshape(*mesh.block, 3)[:, :, -1, :2]
    # One side stands for both.
    right = plan[0, :, 1] >= 0
    plan, top = plan[:, right], u_z.reshape(*mesh.block, -1)[:, right, -1]
    vamp = (plan[:, 0, 0] > _TIP_M) & (plan[:, 0, 0] < geometry.vamp_x_m[-1])
    plan, top = plan[vamp], top[vamp]
    width = plan[:, -1:, 1]
    eta = plan[..., 1] / width
    top = top * np.sqrt(np.gradient(plan[:, 0, 0]) * width[:, 0])[:, None, None]
    profiles = width_profiles(top, eta)
    # Waves across that are finer than the profiles resolve, T7 and beyond, bear out no name.
    resolved = np.sum(profiles[:, (0 if symmetric else 1) :: 2] ** 2, axis=(0, 1))
    everything = np.sum(np.trapezoid(top**2, eta[..., None], axis=1), axis=0)
    fractions = np.minimum(resolved / everything, 1.0)
    claims = []
    for profile, fraction in zip(np.moveaxis(profiles, -1, 0), fractions, strict=True):
        shares = likenesses(profile, symmetric=symmetric)
        claims.append({name: float(fraction) * share for name, share in shares.items()})
    return claims
