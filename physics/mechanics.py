"""The reed of the twin: its cane, what has been done to it, and the modes that follow, by name.

A description is made of what is known of the reed on the bench; a null in every field is the
nominal twin: the reed of the drawing, of cane as the paper has it, clamped fast, in vacuum.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from physics.reed.altered import (
    AirLoad,
    CaneTable,
    Change,
    Vibrations,
    added_mass,
    combined,
    layer,
    softening,
    vibrations,
    yielding_clamp,
)
from physics.reed.anatomy import Anatomy
from physics.reed.coarse import coarse_mesh_cents
from physics.reed.geometry import half_width_m
from physics.reed.material import Cane
from physics.reed.modes import at_frequency
from physics.reed.names import Portrait, names_of
from physics.reed.radiation import air_load
from physics.reed.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    viscoelastic_cane,
)

Array = NDArray[np.floating[Any]]

# Where moduli and losses that grow with frequency are those without growth.
PIVOT_HZ = 4000.0
# Modes up to here are told; those just above the sweep bend its end.
HIGHEST_HZ = 24e3
_KEPT = 512


@dataclass(frozen=True)
class CaneShift:
    """By how much a cane differs from the nominal one, as logarithms of factors.

    Attributes
    ----------
    E_L, E_T, E_R, G_LT, G_LR, G_TR, density : float
    growth_E_L, growth_G_LT : float
        Exponents with which these moduli grow with frequency beyond the nominal growth, as
        (f / 4 kHz) to their power.
    """

    E_L: float = 0.0
    E_T: float = 0.0
    E_R: float = 0.0
    G_LT: float = 0.0
    G_LR: float = 0.0
    G_TR: float = 0.0
    density: float = 0.0
    growth_E_L: float = 0.0
    growth_G_LT: float = 0.0


@dataclass(frozen=True)
class Layer:
    """Cane that the vamp has beyond the drawing, 1 m thick at its thickest.

    A product of Legendre polynomials, of a degree along the vamp and of one from the right side to
    the left.
    """

    along: int
    across: int


@dataclass(frozen=True)
class TipMass:
    """Mass of 1 kg spread evenly over the last part of the reed's tip."""

    length_m: float = 2e-3


@dataclass(frozen=True)
class SoftSpot:
    """Cane 1 m deep that carries nothing along the grain, around a place of the bark side."""

    x_m: float
    y_m: float
    radius_m: float = 1.5e-3


@dataclass(frozen=True)
class YieldingClamp:
    """Strips on beds that yield by 1 m per Pa; side 0 is both, 1 the left one, −1 the right one."""

    side: int = 0


Alteration = Layer | TipMass | SoftSpot | YieldingClamp


@dataclass(frozen=True)
class Mechanics:
    """A reed on the bench.

    Attributes
    ----------
    cane : ViscoelasticCane
        The nominal moduli.
    shift : CaneShift
    loss_factor, loss_growth : float
        Of the cane at 4 kHz, and the exponent with which it grows with frequency.
    alterations : tuple of (Alteration, float)
        Each with its amount, in the unit that it names.
    air_share : float
        Of the density of air around the reed; 0 is vacuum.
    coarse_share : float
        Of the stiffness that a coarse mesh adds (see `physics.reed.coarse`).
    """

    cane: ViscoelasticCane = viscoelastic_cane(Components(), Series.A)
    shift: CaneShift = CaneShift()
    loss_factor: float = 0.03
    loss_growth: float = 0.0
    alterations: tuple[tuple[Alteration, float], ...] = ()
    air_share: float = 0.0
    coarse_share: float = 0.0


@dataclass(frozen=True)
class ReedMode:
    """One mode of a reed on the bench.

    Attributes
    ----------
    name : str
    hz, loss_factor : float
    coordinates : (s,) float
        See `physics.reed.altered.Vibrations`.
    """

    name: str
    hz: float
    loss_factor: float
    coordinates: Array


class ReedSolver:
    """Makes reeds of one kind and tells their modes; keeps what does not depend on amounts.

    Parameters
    ----------
    anatomy : Anatomy
    announce : callable, optional
        Told what is being waited for, if anything.
    """

    def __init__(self, anatomy: Anatomy, announce: Callable[[str], None] | None = None) -> None:
        self.anatomy = anatomy
        self._unit = lru_cache(maxsize=None)(lambda kind: _unit_change(anatomy, kind))
        self._air = lru_cache(maxsize=1)(lambda: air_load(anatomy.reed))
        self._coarse = lru_cache(maxsize=1)(
            lambda: coarse_mesh_cents(anatomy.reed.geometry, anatomy.reed.cane, announce)
        )
        self._canes = lru_cache(maxsize=_KEPT)(
            lambda cane, shift: CaneTable.of(material_of(anatomy, cane, shift), HIGHEST_HZ)
        )
        self._named = lru_cache(maxsize=None)(self._named_shapes)
        # Differences by one parameter leave most of a campaign's reeds as they were.
        self.modes = lru_cache(maxsize=_KEPT)(self._modes)

    def _modes(self, reed: Mechanics) -> Mapping[str, ReedMode]:
        """Modes of a reed up to 24 kHz, by name, in order of frequency.

        Each has the name of the mode of the nominal reed that it is most like.

        Raises
        ------
        ValueError
            If the description is of no possible reed.
        """
        found = self._vibrations(reed)
        growth = (found.hz / PIVOT_HZ) ** reed.loss_growth
        loss = reed.loss_factor * growth + found.radiated
        names, shapes = self._named(reed.cane)
        modes = {}
        likeness = np.abs(shapes.T @ self.mass_kg @ found.coordinates)
        rows, columns = linear_sum_assignment(likeness, maximize=True)
        named = dict(zip(columns.tolist(), (names[row] for row in rows), strict=True))
        for m in sorted(named):
            name, hz = named[m], float(found.hz[m])
            if reed.coarse_share:
                hz *= 2 ** (reed.coarse_share * self._coarse().get(name, 0.0) / 1200)
            modes[name] = ReedMode(name, hz, float(loss[m]), found.coordinates[:, m])
        return MappingProxyType(modes)

    def _vibrations(self, reed: Mechanics) -> Vibrations:
        parts = [(amount, self._unit(kind)) for kind, amount in reed.alterations if amount]
        change = combined(self.anatomy, parts)
        air = _thinner(self._air(), reed.air_share) if reed.air_share else None
        return vibrations(self.anatomy, change, self._canes(reed.cane, reed.shift), HIGHEST_HZ, air)

    @cached_property
    def mass_kg(self) -> Array:
        """Mass (s, s) of the nominal reed, in coordinates of its modes."""
        return self.anatomy.reed.cane.density_kg_m3 * self.anatomy.mass

    def _named_shapes(self, cane: ViscoelasticCane) -> tuple[list[str], Array]:
        """Names and shapes (s, m) of the modes of the nominal reed."""
        found = self._vibrations(Mechanics(cane=cane))
        portraits, start = [], 0
        density = self.anatomy.reed.cane.density_kg_m3
        for symmetry, half in self.anatomy.reed.halves.items():
            own = found.coordinates[start : start + half.mass.shape[0]]
            start += half.mass.shape[0]

            def squared(part: Array, own: Array = own) -> Array:
                return density * np.asarray(np.einsum("rm,rm->m", own, part @ own))

            portraits.append(
                Portrait(
                    symmetry=symmetry,
                    share=squared(half.mass),
                    sideways=squared(half.lateral_mass),
                    behind=squared(half.heel_mass),
                    profiles=half.profiles @ own,
                    square=squared(half.vamp_square) / density,
                )
            )
        return [naming.name for naming in names_of(portraits)], found.coordinates


def material_of(
    anatomy: Anatomy, kind: ViscoelasticCane, shift: CaneShift
) -> Callable[[float], Cane]:
    """Cane of a reed at a frequency in Hz."""
    nominal = anatomy.reed.cane

    def cane(hz: float) -> Cane:
        here = at_frequency(nominal, kind, hz)
        octaves = np.log(hz / PIVOT_HZ)
        factors = {
            "E_L_pa": shift.E_L + shift.growth_E_L * octaves,
            "E_T_pa": shift.E_T,
            "E_R_pa": shift.E_R,
            "G_LT_pa": shift.G_LT + shift.growth_G_LT * octaves,
            "G_LR_pa": shift.G_LR,
            "G_TR_pa": shift.G_TR,
            "density_kg_m3": shift.density,
        }
        changed = {
            name: getattr(here, name) * float(np.exp(log)) for name, log in factors.items() if log
        }
        return replace(here, **changed) if changed else here

    return cane


def _thinner(air: AirLoad, share: float) -> AirLoad:
    return AirLoad(air.hz, share * air.mass_kg, share * air.resistance_kg_s)


def _unit_change(anatomy: Anatomy, kind: Alteration) -> Change:
    """What an alteration of one unit adds."""
    outline, end_m = anatomy.reed.geometry.outline, anatomy.reed.geometry.vamp_x_m[-1]
    if isinstance(kind, YieldingClamp):
        return yielding_clamp(anatomy, float(kind.side >= 0), float(kind.side <= 0))
    if isinstance(kind, TipMass):
        zone = anatomy.area_m2 * (anatomy.bark_m[:, 0] < kind.length_m)
        area_m2 = 2 * float(zone.sum())
        return added_mass(anatomy, lambda x, y: (x < kind.length_m) / area_m2)
    if isinstance(kind, SoftSpot):

        def depth(x: Array, y: Array) -> Array:
            r2 = (x - kind.x_m) ** 2 + (y - kind.y_m) ** 2
            bell: Array = np.exp(-r2 / (2 * kind.radius_m**2))
            return bell

        return softening(anatomy, depth)
    along = np.polynomial.legendre.Legendre.basis(kind.along)
    across = np.polynomial.legendre.Legendre.basis(kind.across)

    def thickness(x: Array, y: Array) -> Array:
        eta = y / np.maximum(half_width_m(outline, x), 1e-6)
        grown: Array = along(2 * x / end_m - 1) * across(eta)
        return grown

    return layer(anatomy, thickness)
