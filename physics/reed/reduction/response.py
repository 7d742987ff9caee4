"""Modes and forced vibration of a reed whose cane depends on frequency."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from holography.arrays import Array, ComplexArray
from physics.errors import ImpossibleReedError
from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.cane.viscoelastic import ViscoelasticCane
from physics.reed.elements.fem import Symmetry
from physics.reed.elements.whole import (
    ReedPart,
    WholeReed,
    parts_of,
)
from physics.reed.mode_classification import ModeDescriptor, names_of
from physics.reed.modes import (
    HIGHEST_HZ,
    at_frequency,
    settled_mode,
)
from physics.reed.reduction.basis import (
    HalfBasis,
    ReducedReed,
    reduced_modes,
)

# A fifth more modes are named than lie below 20 kHz in the middle of the basis's box, for the sake
# of softer material. Still higher ones are no longer those of the full model (see `BasisSettings`)
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
    symmetry : Symmetry
    coordinates : (r,) float
        Mass-normalised shape of the half reed in its reduced coordinates.
    similarity : float
        Share of its motion on the vamp, or of its energy for lateral modes and those of the heel,
        that bears out its name; low where two modes of the vamp exchange shapes.
    """

    name: str
    frequency_hz: float
    symmetry: Symmetry
    coordinates: Array
    similarity: float


def named_modes(reed: ReducedReed) -> int:
    """How many modes of either symmetry are named."""
    middles = [half.middle_hz for half in reed.halves.values()]
    below = max(1, *(int(np.count_nonzero(hz < HIGHEST_HZ)) for hz in middles))
    return min(below + math.ceil(_NAMED_BEYOND * below), *map(len, middles))


def elastic_modes(reed: ReducedReed, E_L_pa: float, G_LT_pa: float) -> dict[str, Mode]:
    """Modes of the reed with fixed moduli, by name."""
    cane = replace(reed.cane, E_L_pa=E_L_pa, G_LT_pa=G_LT_pa)
    terms, count = stiffness_terms_pa(cane), named_modes(reed)
    modes: dict[str, Mode] = {}
    for symmetry, half in reed.halves.items():
        hz, shapes = reduced_modes(half, terms, cane.density_kg_m3)
        modes |= _named(half, symmetry, hz[:count], shapes[:, :count], cane.density_kg_m3)
    return modes


def _named(
    half: HalfBasis, symmetry: Symmetry, hz: Array, shapes: Array, density_kg_m3: float
) -> dict[str, Mode]:
    """Name mass-normalised shapes (r, m), ascending in frequency."""

    def squared(part: Array) -> Array:
        squares: Array = np.einsum("rm,rm->m", shapes, part @ shapes)
        return squares

    descriptor = ModeDescriptor(
        symmetry=symmetry,
        share=np.ones(len(hz)),
        sideways=density_kg_m3 * squared(half.lateral_mass),
        behind=density_kg_m3 * squared(half.heel_mass),
        profiles=half.profiles @ shapes,
        square=squared(half.vamp_square),
    )
    return {
        naming.name: Mode(naming.name, float(f), symmetry, shape, naming.similarity)
        for naming, f, shape in zip(names_of([descriptor]), hz, shapes.T, strict=True)
    }


def viscoelastic_mode(
    reed: ReducedReed, cane: ViscoelasticCane, name: str, start_hz: float
) -> Mode:
    """Mode of a given name, with the storage moduli taken at its own frequency.

    Where two modes exchange shapes, the frequency of either may have moduli with which the name is
    the other's. Then all modes are settled by their number, and named side by side.

    Parameters
    ----------
    start_hz : float
        Where the search begins. Of two modes that each bear the name with the moduli of their own
        frequency, the one nearer to it is likely to be found.

    Raises
    ------
    ImpossibleReedError
        If the reed has no such mode, or moduli that grow too fast with frequency for modes to
        settle.
    """
    hz = start_hz
    for _ in range(_MOST_ITERATIONS):
        constants = at_frequency(reed.cane, cane, hz)
        modes = elastic_modes(reed, constants.E_L_pa, constants.G_LT_pa)
        if name not in modes:
            break
        previous, hz = hz, modes[name].frequency_hz
        if abs(1200 * np.log2(hz / previous)) < _SETTLED_CENTS:
            return modes[name]
    modes = viscoelastic_modes(reed, cane)
    if name not in modes:
        raise ImpossibleReedError(f"this reed has no mode {name} near {hz:.0f} Hz")
    return modes[name]


def viscoelastic_modes(reed: ReducedReed, cane: ViscoelasticCane) -> dict[str, Mode]:
    """All modes with names, each settled by its number (see `modes.viscoelastic_modes`).

    Raises
    ------
    ImpossibleReedError
        If moduli grow too fast with frequency for modes to settle.
    """
    count, density_kg_m3 = named_modes(reed), reed.cane.density_kg_m3
    modes: dict[str, Mode] = {}
    for symmetry, half in reed.halves.items():

        def eigenpairs(hz: float, half: HalfBasis = half) -> tuple[Array, Array]:
            terms = stiffness_terms_pa(at_frequency(reed.cane, cane, hz))
            return reduced_modes(half, terms, density_kg_m3)

        found = [settled_mode(eigenpairs, number, HIGHEST_HZ) for number in range(count)]
        hz, shapes = (np.stack(parts, axis=-1) for parts in zip(*found, strict=True))
        modes |= _named(half, symmetry, hz, shapes, density_kg_m3)
    return modes


def forced_response(
    reed: ReducedReed | WholeReed,
    cane: ViscoelasticCane,
    loss_factor: float,
    frequencies_hz: Array,
    pressure: Callable[[float, Array, Array], ComplexArray],
) -> dict[Symmetry | None, ComplexArray]:
    """Steady vibration under a sinusoidal pressure on the flat side.

    Solves ``(K(ω)(1 + iη) − ω²M) q = F`` at every frequency, with the storage moduli of that
    frequency and a loss factor η of its own (see decision 0004).

    Parameters
    ----------
    loss_factor : float
        Ratio η of dissipated to stored energy per radian.
    frequencies_hz : (k,) float
    pressure : callable
        ``pressure(frequency_hz, x_m, y_m)`` gives complex pressures in Pa at points of the flat
        side, y of either sign; positive pushes towards the bark side (+z).

    Returns
    -------
    dict of (k, r) complex
        Reduced coordinates in m, per part of the reed (see `whole.parts_of`), time factor
        exp(+iωt).
    """
    each = [
        response_at(reed, at_frequency(reed.cane, cane, hz), loss_factor, hz, pressure)
        for hz in frequencies_hz.tolist()
    ]
    return {part: np.stack([response[part] for response in each]) for part in parts_of(reed)}


def response_at(
    reed: ReducedReed | WholeReed,
    material: Cane,
    loss_factor: float,
    hz: float,
    pressure: Callable[[float, Array, Array], ComplexArray],
) -> dict[Symmetry | None, ComplexArray]:
    """Steady vibration at one frequency; see `forced_response`.

    Parameters
    ----------
    material : Cane
        All constants, at this frequency.

    Returns
    -------
    dict of (r,) complex
    """
    forces = pressure_forces(reed, hz, pressure)
    return {
        symmetry: _solve(part, material, loss_factor, hz, forces[symmetry])
        for symmetry, part in parts_of(reed).items()
    }


def pressure_forces(
    reed: ReducedReed | WholeReed,
    hz: float,
    pressure: Callable[[float, Array, Array], ComplexArray],
) -> dict[Symmetry | None, ComplexArray]:
    """Return the forces (r,) of a pressure in the reduced coordinates of each part of a reed."""
    x, y = reed.load_points_m.T
    return {
        symmetry: _pressure_on(symmetry, pressure, hz, x, y) @ part.load_z
        for symmetry, part in parts_of(reed).items()
    }


def _pressure_on(
    symmetry: Symmetry | None,
    pressure: Callable[[float, Array, Array], ComplexArray],
    hz: float,
    x_m: Array,
    y_m: Array,
) -> ComplexArray:
    """What of a pressure moves the part of a symmetry; all of it, a part of any shape."""
    if symmetry is None:
        return pressure(hz, x_m, y_m)
    sign = 1 if symmetry is Symmetry.SYMMETRIC else -1
    return 0.5 * (pressure(hz, x_m, y_m) + sign * pressure(hz, x_m, -y_m))


def _solve(
    part: ReedPart, material: Cane, loss_factor: float, hz: float, load: ComplexArray
) -> ComplexArray:
    K = np.tensordot(stiffness_terms_pa(material), part.stiffness_terms, axes=1)
    omega2 = (2 * np.pi * hz) ** 2
    answer: ComplexArray = np.linalg.solve(
        (1 + 1j * loss_factor) * K - omega2 * material.density_kg_m3 * part.mass, load
    )
    return answer
