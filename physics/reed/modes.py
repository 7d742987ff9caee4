"""Named modes of a reed, straight from its finite elements: any geometry, any cane.

A reed that is its own mirror image is solved by halves, one for each symmetry; any other whole.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.cane.viscoelastic import ViscoelasticCane, storage_modulus_pa
from physics.reed.elements.fem import (
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
from physics.reed.elements.mesh import (
    HalfReedMesh,
    MeshLevel,
    ReedMesh,
    build_least_mesh,
)
from physics.reed.geometry import ReedGeometry
from physics.reed.mode_classification import (
    ModeClassification,
    ModeDescriptor,
    names_of,
    vamp_profiles,
)

# The sweep of the paper ends here.
HIGHEST_HZ = 20e3
# Modes just above the highest wanted are named too: a pair that exchanges shapes across that
# limit then shares its names as it would elsewhere.
_NAMED_BEYOND = 1.1
# Modes of either symmetry sought at first, and at most; a reed of cane has some ten below 20 kHz.
_FIRST_COUNT = 12
_MOST_MODES = 100
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


def class_of(name: str) -> ModeClass:
    """Class of a mode of a name."""
    return _CLASSES.get(name[0], ModeClass.GENERIC)


@dataclass(frozen=True)
class NamedMode:
    """One vibration of the undamped reed.

    Attributes
    ----------
    name : str
        See `physics.reed.mode_classification`; ``?`` and a number where another mode has the
        name.
    frequency_hz : float
    klass : ModeClass
    symmetry : Symmetry
        Of the part with more kinetic energy: a reed that is not its own mirror image mixes both.
    similarity : float
        Share of its motion that bears out its name; low where two modes exchange shapes.
    shape : (n, 3) float
        Displacements at the nodes of `mesh.build_least_mesh`, mass-normalised over that mesh.
    """

    name: str
    frequency_hz: float
    klass: ModeClass
    symmetry: Symmetry
    similarity: float
    shape: Array


def named_mode(naming: ModeClassification, hz: float, shape: Array) -> NamedMode:
    """Mode of a classification, of a frequency and a shape (n, 3)."""
    klass, similarity = class_of(naming.name), naming.similarity
    if klass not in (ModeClass.LATERAL, ModeClass.HEEL):
        # Motion next to the vamp and behind it does not support a name of the vamp.
        similarity *= 1 - naming.outside
    return NamedMode(naming.name, hz, klass, naming.symmetry, similarity, shape)


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
    ImpossibleReedError
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
    ImpossibleReedError
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
    systems = list(_systems(geometry, level, density_kg_m3))
    # Factoring and solving, which is most of it, leaves the other thread alone.
    with ThreadPoolExecutor(len(systems)) as pool:
        solved = list(pool.map(solve, systems))
    for system, (frequencies, reduced) in zip(systems, solved, strict=True):
        shapes = _at_nodes(system, reduced)
        namings = names_of(_descriptors(geometry, system, shapes))
        found += [
            named_mode(naming, float(hz), shapes[:, :, m])
            for m, (naming, hz) in enumerate(zip(namings, frequencies, strict=True))
        ]
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
            raise ImpossibleReedError(
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
        frequencies[j], vector = settled_mode(eigenpairs, j, highest_hz)
        shapes[:, j] = trial @ vector
    return frequencies, shapes


def settled_mode(
    eigenpairs: Callable[[float], tuple[Array, Array]], number: int, start_hz: float
) -> tuple[float, Array]:
    """Mode of a number, with the moduli of its own frequency.

    Parameters
    ----------
    eigenpairs : callable
        Eigenfrequencies (m,), ascending, and shapes (f, m) with the moduli of a frequency.
    number : int
    start_hz : float
        A frequency above the mode's own, or near it.

    Returns
    -------
    hz : float
        The frequency whose `number`-th eigenfrequency is itself.
    shape : (f,) float

    Raises
    ------
    ImpossibleReedError
        If the iteration does not settle.
    """
    hz = start_hz
    for _ in range(_MOST_ITERATIONS):
        frequencies, vectors = eigenpairs(hz)
        previous, hz = hz, float(frequencies[number])
        if abs(1200 * np.log2(hz / previous)) < _SETTLED_CENTS:
            return hz, vectors[:, number]
    raise ImpossibleReedError(
        f"a mode does not settle near {hz:.0f} Hz; check the cane's Zener parameters"
    )


def _span(mass_ff: sparse.csc_array, shapes: list[Array]) -> Array:
    """Mass-orthonormal basis (f, r) of what several sets of mass-normalised shapes span."""
    stacked = np.hstack(shapes)
    values, vectors = np.linalg.eigh(stacked.T @ (mass_ff @ stacked))
    kept = values > _LEAST_SHARE * values[-1]
    basis: Array = stacked @ (vectors[:, kept] / np.sqrt(values[kept]))
    return basis


def _parts(system: _System, shapes: Array) -> dict[Symmetry, Array]:
    """Split motions (n, 3, m) by symmetry; those of half a reed have one already."""
    if len(system.symmetries) == 1:
        return {system.symmetries[0]: shapes}
    columns = shapes.reshape(*system.mesh.block, *shapes.shape[1:])
    mirrored = columns[:, ::-1].reshape(shapes.shape) * _REFLECTION[:, None]
    return {
        Symmetry.SYMMETRIC: 0.5 * (shapes + mirrored),
        Symmetry.ANTISYMMETRIC: 0.5 * (shapes - mirrored),
    }


def _descriptors(geometry: ReedGeometry, system: _System, shapes: Array) -> list[ModeDescriptor]:
    """What names tell motions (n, 3, m) by."""
    parts = _parts(system, shapes)

    def energy(motion: Array) -> Array:
        product: Array = np.einsum("nm,nm->m", motion, system.matrices.mass @ motion)
        return product

    energies = {
        symmetry: np.sum([energy(part[:, k]) for k in range(3)], axis=0)
        for symmetry, part in parts.items()
    }
    # What little energy an uneven reed has between its parts belongs to neither.
    total = np.sum(list(energies.values()), axis=0)
    nodes_m, block = system.mesh.nodes_m, system.mesh.block
    behind = nodes_m[:, :1] > geometry.vamp_x_m[-1]
    plan_m = nodes_m.reshape(*block, 3)[:, :, -1, :2]
    # One side stands for both.
    right = plan_m[0, :, 1] >= 0
    answer = []
    for symmetry, part in parts.items():
        bark = part[:, 2].reshape(*block, -1)[:, right, -1]
        profiles, points = vamp_profiles(plan_m[:, right], bark, geometry.vamp_x_m[-1])
        answer.append(
            ModeDescriptor(
                symmetry=symmetry,
                share=energies[symmetry] / total,
                sideways=energy(part[:, 1]) / total,
                behind=energy(part[:, 2] * behind) / total,
                profiles=profiles,
                square=np.sum(points**2, axis=0),
            )
        )
    return answer
