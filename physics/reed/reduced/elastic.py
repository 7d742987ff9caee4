"""Named modes of the clamped reed: of fixed moduli, or of a viscoelastic cane."""

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from scipy import linalg

from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.reed.cane.material import stiffness_terms_pa
from physics.reed.cane.viscoelastic import ViscoelasticCane
from physics.reed.elements.fem import Symmetry
from physics.reed.mode_classification import ModeDescriptor, names_of
from physics.reed.modes import HIGHEST_HZ, NamedMode, at_frequency, named_mode, settled_mode
from physics.reed.reduced.dynamics import PIVOT_HZ
from physics.reed.reduced.reed import ReducedReed, ReedPart
from physics.reed.reduced.vibrations import Vibrations

# A fifth more modes are named than lie below 20 kHz in the middle of the box, for the sake of
# softer material. Still higher ones are no longer those of the full model (see `BasisSettings`)
# and would only compete for names.
_NAMED_BEYOND = Fraction(1, 5)
_SETTLED_CENTS = 1e-3
_MOST_ITERATIONS = 30


@dataclass(frozen=True)
class Mode:
    """One vibration of the undamped reed.

    Attributes
    ----------
    name : str
    frequency_hz : float
    part : Symmetry or None
        Key of the part of the reed that moves.
    symmetry : Symmetry
        Of most of its energy.
    coordinates : (r,) float
        Mass-normalised shape of that part in its reduced coordinates.
    similarity : float
        Fraction of its motion on the vamp, or of its energy for lateral modes and those of the
        heel, that bears out its name; low where two modes of the vamp exchange shapes.
    """

    name: str
    frequency_hz: float
    part: Symmetry | None
    symmetry: Symmetry
    coordinates: Array
    similarity: float


def reduced_modes(
    part: ReedPart, terms_pa: Array, density_kg_m3: float, air_kg: Array | None = None
) -> tuple[Array, Array]:
    """Eigenfrequencies (r,) in Hz, ascending, and mass-normalised reduced shapes (r, r).

    Parameters
    ----------
    part : ReedPart
    terms_pa : (9,) float
        Independent stiffnesses of the cane.
    density_kg_m3 : float
    air_kg : (r, r) float, optional
        Mass of the air that moves along. A vacuum if not given.
    """
    K = np.tensordot(terms_pa, part.stiffness_terms, axes=1)
    mass = density_kg_m3 * part.mass
    eigenvalues, shapes = linalg.eigh(K, mass if air_kg is None else mass + air_kg)
    return np.sqrt(np.clip(eigenvalues, 0.0, None)) / (2 * np.pi), shapes


def air_masses_kg(reed: ReducedReed, hz: float, air_fraction: float) -> list[Array | None]:
    """Mass (r, r) of the air that moves along with each part, at a frequency.

    Parameters
    ----------
    reed : ReducedReed
    hz : float
    air_fraction : float
        Density of the air as a fraction of normal air; 0 is a vacuum.
    """
    if reed.air is None or not air_fraction:
        return [None] * len(reed.loose)
    held = [part.held for part in reed.loose.values()]
    return [
        air_fraction * mass[:own, :own]
        for own, (mass, _) in zip(held, reed.air.at(hz), strict=True)
    ]


def named_modes(reed: ReducedReed) -> int:
    """How many modes of each part are named."""
    middles = [part.middle_hz for part in reed.loose.values()]
    below = max(1, max(int(np.count_nonzero(hz < HIGHEST_HZ)) for hz in middles))
    return min(below + math.ceil(_NAMED_BEYOND * below), min(map(len, middles)))


def elastic_modes(
    reed: ReducedReed,
    E_L_pa: float,
    G_LT_pa: float,
    air_fraction: float = 1.0,
    air_hz: float = PIVOT_HZ,
) -> dict[str, Mode]:
    """Modes of the reed with fixed moduli, by name.

    Parameters
    ----------
    reed : ReducedReed
    E_L_pa, G_LT_pa : float
    air_fraction : float
        Density of the air as a fraction of normal air; 0 is a vacuum.
    air_hz : float
        Frequency of the air in which shapes are computed. Frequencies have the air of their own, to
        first order in the difference: 0.02 cents.
    """
    cane = replace(reed.cane, E_L_pa=E_L_pa, G_LT_pa=G_LT_pa)
    terms, count = stiffness_terms_pa(cane), named_modes(reed)
    modes: dict[str, Mode] = {}
    each = air_masses_kg(reed, air_hz, air_fraction)
    for number, ((key, part), air_kg) in enumerate(zip(reed.parts.items(), each, strict=True)):
        hz, shapes = reduced_modes(part, terms, cane.density_kg_m3, air_kg)
        hz, shapes = hz[:count], shapes[:, :count]
        if air_kg is not None and reed.air is not None:
            grown = reed.air.forms(number, hz, shapes) - reed.air.forms(
                number, np.full(len(hz), air_hz), shapes
            )
            heavier = 1 + air_fraction * grown
            hz, shapes = hz / np.sqrt(heavier), shapes / np.sqrt(heavier)
        modes |= _named(part, key, hz, shapes, cane.density_kg_m3)
    return modes


def descriptors_of(part: ReedPart, shapes: Array, density_kg_m3: float) -> list[ModeDescriptor]:
    """What mass-normalised shapes (s, m) of a part are named by, one descriptor per symmetry."""

    def squared(form: Array) -> Array:
        squares: Array = np.einsum("rm,rm->m", shapes, form @ shapes)
        return squares

    return [
        ModeDescriptor(
            symmetry=symmetry,
            share=density_kg_m3 * squared(own.mass),
            sideways=density_kg_m3 * squared(own.lateral_mass),
            behind=density_kg_m3 * squared(own.heel_mass),
            profiles=own.profiles @ shapes,
            square=squared(own.vamp_square),
        )
        for symmetry, own in part.measures.items()
    ]


def all_descriptors(reed: ReducedReed, coordinates: Array) -> list[ModeDescriptor]:
    """What modes of unit mass (s, m) in the coordinates of all parts are named by."""
    density = reed.cane.density_kg_m3
    return [
        descriptor
        for start, part in zip(reed.starts, reed.loose.values(), strict=True)
        for descriptor in descriptors_of(part, coordinates[start : start + part.size], density)
    ]


def named_vibrations(found: Vibrations) -> list[NamedMode]:
    """Modes of a reed in a state by name, ascending in frequency; their shapes have no nodes."""
    namings = names_of(all_descriptors(found.reed, found.coordinates))
    return [
        named_mode(naming, hz, np.empty((0, 3)))
        for naming, hz in zip(namings, found.hz.tolist(), strict=True)
    ]


def _named(
    part: ReedPart, key: Symmetry | None, hz: Array, shapes: Array, density_kg_m3: float
) -> dict[str, Mode]:
    """Name mass-normalised shapes (r, m), ascending in frequency."""
    namings = names_of(descriptors_of(part, shapes, density_kg_m3))
    return {
        naming.name: Mode(naming.name, float(f), key, naming.symmetry, shape, naming.similarity)
        for naming, f, shape in zip(namings, hz, shapes.T, strict=True)
    }


def viscoelastic_mode(
    reed: ReducedReed,
    cane: ViscoelasticCane,
    name: str,
    start_hz: float,
    air_fraction: float = 1.0,
) -> Mode:
    """Mode of a given name, with the storage moduli taken at its own frequency.

    Where two modes exchange shapes, the frequency of either may have moduli with which the name is
    the other's. Then all modes are settled by their number, and named together.

    Parameters
    ----------
    reed : ReducedReed
    cane : ViscoelasticCane
    name : str
    start_hz : float
        Where the search begins. Of two modes that each bear the name with the moduli of their own
        frequency, the one nearer to it is likely to be found.
    air_fraction : float
        See `elastic_modes`.

    Raises
    ------
    ImpossibleReedError
        If the reed has no such mode, or moduli that grow too fast with frequency for modes to
        settle.
    """
    hz = start_hz
    for _ in range(_MOST_ITERATIONS):
        constants = at_frequency(reed.cane, cane, hz)
        modes = elastic_modes(reed, constants.E_L_pa, constants.G_LT_pa, air_fraction, hz)
        if name not in modes:
            break
        previous, hz = hz, modes[name].frequency_hz
        if abs(1200 * np.log2(hz / previous)) < _SETTLED_CENTS:
            return modes[name]
    modes = viscoelastic_modes(reed, cane, air_fraction)
    if name not in modes:
        raise ImpossibleReedError(f"this reed has no mode {name} near {hz:.0f} Hz")
    return modes[name]


def viscoelastic_modes(
    reed: ReducedReed, cane: ViscoelasticCane, air_fraction: float = 1.0
) -> dict[str, Mode]:
    """All modes with names, each settled by its number (see `modes.viscoelastic_modes`).

    Parameters
    ----------
    reed : ReducedReed
    cane : ViscoelasticCane
    air_fraction : float
        See `elastic_modes`.

    Raises
    ------
    ImpossibleReedError
        If moduli grow too fast with frequency for modes to settle.
    """
    count, density_kg_m3 = named_modes(reed), reed.cane.density_kg_m3
    modes: dict[str, Mode] = {}
    for place, (key, part) in enumerate(reed.parts.items()):

        def eigenpairs(hz: float, part: ReedPart = part, place: int = place) -> tuple[Array, Array]:
            terms = stiffness_terms_pa(at_frequency(reed.cane, cane, hz))
            air_kg = air_masses_kg(reed, hz, air_fraction)[place]
            return reduced_modes(part, terms, density_kg_m3, air_kg)

        found = [settled_mode(eigenpairs, number, HIGHEST_HZ) for number in range(count)]
        hz, shapes = (np.stack(parts, axis=-1) for parts in zip(*found, strict=True))
        modes |= _named(part, key, hz, shapes, density_kg_m3)
    return modes
