"""The reed in a few dozen coordinates, for every cane of a box.

Stiffness is affine in the nine independent stiffnesses of the cane, mass in the density. What the
clamp, the thickness, added mass and air change is affine, too (see `changes`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from holography.arrays import Array
from physics.reed.cane.material import Cane
from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import ReedGeometry
from physics.reed.reduced.air_matrices import AirMatrices

# Elastic constants in the order of `Cane`: six moduli, three Poisson ratios.
CONSTANTS = tuple(field.name for field in fields(Cane))[:-1]
MODULI = CONSTANTS[:6]
# An edge of the box that was computed is not outside by its rounding error.
_SLACK = 1e-9


@dataclass(frozen=True)
class ReedBox:
    """Canes that a reduced reed answers for.

    Density is exact, but heavier cane has modes below 20 kHz that the basis was not computed for.

    Attributes
    ----------
    cane : Cane
        The reference: its density, and the middle of the ranges of all but E_L and G_LT.
    E_L_pa, G_LT_pa : (float, float)
        Lowest and highest value. Chosen: of the paper's population, one reed in a thousand leaves
        this range (`studies.populations`).
    modulus_factor : float
        The other moduli lie within this factor of those of the reference. Chosen: about 2.5
        standard deviations of handbook values, 0.1 to 0.12 in the logarithm.
    poisson_spread : float
        Poisson ratios differ from those of the reference by no more. Chosen: a third of the paper's
        0.22, as for the moduli.
    """

    cane: Cane = Cane()
    E_L_pa: tuple[float, float] = (7e9, 22e9)
    G_LT_pa: tuple[float, float] = (0.4e9, 2.1e9)
    modulus_factor: float = 1.33
    poisson_spread: float = 0.08

    @property
    def middle(self) -> Cane:
        """Reference cane with the geometric means of E_L and G_LT."""
        E, G = (float(np.sqrt(low * high)) for low, high in (self.E_L_pa, self.G_LT_pa))
        return replace(self.cane, E_L_pa=E, G_LT_pa=G)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of each of `CONSTANTS`."""
        found = {}
        for name in CONSTANTS:
            value = getattr(self.cane, name)
            if name in ("E_L_pa", "G_LT_pa"):
                found[name] = getattr(self, name)
            elif name in MODULI:
                found[name] = value / self.modulus_factor, value * self.modulus_factor
            else:
                found[name] = value - self.poisson_spread, value + self.poisson_spread
        return found

    @property
    def heaviest_kg_m3(self) -> float:
        """Density up to which all modes below 20 kHz are those below 22 kHz of the reference."""
        return 1.1**2 * self.cane.density_kg_m3

    def contains(self, cane: Cane) -> bool:
        """Whether all constants of a cane lie within their ranges, ends included."""
        return not any(True for _ in self.outside(cane))

    def outside(self, cane: Cane) -> Iterator[str]:
        """Yield the names of the constants that lie outside their ranges."""
        for name, (low, high) in self.ranges.items():
            slack = _SLACK * max(abs(low), abs(high))
            if not low - slack <= getattr(cane, name) <= high + slack:
                yield name

    def at(self, places: Array) -> list[Cane]:
        """Canes at places (n, 9), each from 0 to 1; moduli by their logarithms."""
        low, high = np.array(list(self.ranges.values())).T
        logarithmic = np.arange(len(CONSTANTS)) < len(MODULI)
        with np.errstate(invalid="ignore"):
            values = np.where(
                logarithmic, low * (high / low) ** places, low + (high - low) * places
            )
        return [
            replace(self.cane, **dict(zip(CONSTANTS, row, strict=True))) for row in values.tolist()
        ]


@dataclass(frozen=True)
class BasisSettings:
    """How a reduced reed is computed.

    Attributes
    ----------
    box : ReedBox
    modes : int, optional
        Modes taken from each cane, per part of the reed. A third more than the reed has below
        20 kHz in the middle of the box, if not given.
    size : int, optional
        Coordinates per part that leave the clamp at rest; 7 for each of these modes if not given.
    snapshots : int
        Canes whose modes are computed, in addition to those at the four corners of E_L and G_LT
        and in the middle. With 12, 16, 20 and 28 the farthest mode below 20 kHz of 24 other canes
        is 3.1, 2.1, 1.7 and 1.5 cents off; each costs 3 s of one processor.
    """

    box: ReedBox = ReedBox()
    modes: int | None = None
    size: int | None = None
    snapshots: int = 28


@dataclass(frozen=True)
class ShapeMeasures:
    """Quadratic forms and profiles by which the part of a motion that has a symmetry is named.

    Attributes
    ----------
    mass, lateral_mass, heel_mass : (s, s) float
        Per unit density: of all motion, of what moves along y, of what moves along z behind the
        vamp.
    profiles : (k, 7, s) float
        See `mode_classification.vamp_profiles`.
    vamp_square : (s, s) float
        Integral over the vamp of the square of its deflection.
    """

    mass: Array
    lateral_mass: Array
    heel_mass: Array
    profiles: Array
    vamp_square: Array


@dataclass(frozen=True)
class ReedPart:
    """Motions of a reed that are solved for by themselves, in s coordinates.

    Those of one symmetry, given over y ≥ 0, or all of a whole reed.

    Attributes
    ----------
    held : int
        Number of coordinates that leave the strips of the clamp at rest; in the others they move.
    middle_hz : (held,) float
        Eigenfrequencies of the material in the middle of the box, ascending. The first coordinates
        are its modes.
    stiffness_terms : (9, s, s) float
        Stiffness per unit of each independent stiffness of the cane.
    mass : (s, s) float
        Mass per unit density.
    surface_z : (p, s) float
        Deflection u_z of the bark side at the nodes of the plan.
    load_z : (q, s) float
        Deflection of the flat side at the points of a pressure, times their area.
    strain : (6, b, s) float
        Engineering strains at points of the bark side, in Voigt order.
    motion : (3, b, s) float
        Displacements there.
    measures : mapping
        `ShapeMeasures` by symmetry: one of half a reed, both of a whole one.
    """

    held: int
    middle_hz: Array
    stiffness_terms: Array
    mass: Array
    surface_z: Array
    load_z: Array
    strain: Array
    motion: Array
    measures: Mapping[Symmetry, ShapeMeasures]

    @property
    def size(self) -> int:
        """Number of coordinates s."""
        return int(self.mass.shape[0])

    @cached_property
    def clamped(self) -> "ReedPart":
        """The same part with its strips at rest: views of the same numbers."""
        cut = slice(self.held)
        return ReedPart(
            held=self.held,
            middle_hz=self.middle_hz,
            stiffness_terms=self.stiffness_terms[:, cut, cut],
            mass=self.mass[cut, cut],
            surface_z=self.surface_z[:, cut],
            load_z=self.load_z[:, cut],
            strain=self.strain[..., cut],
            motion=self.motion[..., cut],
            measures={
                symmetry: ShapeMeasures(
                    mass=own.mass[cut, cut],
                    lateral_mass=own.lateral_mass[cut, cut],
                    heel_mass=own.heel_mass[cut, cut],
                    profiles=own.profiles[..., cut],
                    vamp_square=own.vamp_square[cut, cut],
                )
                for symmetry, own in self.measures.items()
            },
        )


@dataclass(frozen=True)
class FrontEdge:
    """Derivatives of a reed when the front edge of its strips moves back, per metre.

    Attributes
    ----------
    stiffness_terms, mass : (2, 9, s, s) and (2, s, s) float
        In coordinates of all parts: if both strips begin farther from the tip, and if that of
        y > 0 begins farther from it and that of y < 0 nearer to it.
    """

    stiffness_terms: Array
    mass: Array


@dataclass(frozen=True)
class ReducedReed:
    """A reed of given shape whose cane may be any of a box.

    Attributes
    ----------
    geometry : ReedGeometry
    box : ReedBox
    plan_m : (p, 2) float
        Nodes (x, y) of the plan at which `ReedPart.surface_z` is given.
    load_points_m : (q, 2) float
        Points of the flat side at which a pressure is sampled.
    bark_m, area_m2 : (b, 2) and (b,) float
        Gauss points of the bark side, and the area of the plan that each stands for.
    strip_m2 : (m, m) float
        Integrals over the strips of products of what they do in the m coordinates of one part in
        which they move.
    loose : mapping
        A `ReedPart` per symmetry of a reed that is its own mirror image, with y ≥ 0; for any other
        reed one part, of the whole plan, with the key None.
    edge : FrontEdge
    air : AirMatrices, optional
        Normal air around the reed; without it the reed can only be in a vacuum.
    """

    geometry: ReedGeometry
    box: ReedBox
    plan_m: Array
    load_points_m: Array
    bark_m: Array
    area_m2: Array
    strip_m2: Array
    loose: Mapping[Symmetry | None, ReedPart]
    edge: FrontEdge
    air: AirMatrices | None = None

    @property
    def cane(self) -> Cane:
        """Reference cane: constants other than E_L and G_LT, and density."""
        return self.box.cane

    @cached_property
    def parts(self) -> dict[Symmetry | None, ReedPart]:
        """The parts with the strips of the clamp at rest."""
        return {key: part.clamped for key, part in self.loose.items()}

    @cached_property
    def stiffness_terms(self) -> Array:
        """Stiffness (9, s, s) per unit of each stiffness, in the coordinates of all parts."""
        each = [part.stiffness_terms for part in self.loose.values()]
        return np.stack([linalg.block_diag(*terms) for terms in zip(*each, strict=True)])

    @cached_property
    def mass(self) -> Array:
        """Mass (s, s) per unit density, in the coordinates of all parts."""
        whole: Array = linalg.block_diag(*[part.mass for part in self.loose.values()])
        return whole

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """Number of the first coordinate of each part."""
        sizes = [part.size for part in self.loose.values()]
        return tuple(np.cumsum([0, *sizes[:-1]]).tolist())

    @cached_property
    def strip(self) -> NDArray[np.intp]:
        """Numbers of the coordinates in which the strips move, part after part."""
        return np.concatenate(
            [
                start + np.arange(part.held, part.size)
                for start, part in zip(self.starts, self.loose.values(), strict=True)
            ]
        )
