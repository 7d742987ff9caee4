"""Mechanical model of a reed: its cane, its alterations, and its modes by name.

If all shifts, growths, alterations and fractions are zero, the model is the nominal reed: the
geometry of the reed file and the cane of the paper, rigidly clamped, in vacuum.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from types import MappingProxyType

import numpy as np
from scipy.optimize import linear_sum_assignment

from holography.arrays import Array, ComplexArray
from physics.parameters.quantity import quantity
from physics.reed.cane.material import Cane
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    viscoelastic_cane,
)
from physics.reed.changes.shape_derivatives import ShapeDerivatives
from physics.reed.changes.structural_changes import (
    Change,
    added_mass,
    combined,
    layer,
    softening,
    yielding_clamp,
)
from physics.reed.changes.structural_modification import (
    AirLoad,
    CaneTable,
    Vibrations,
    response_of_changed,
    vibrations,
)
from physics.reed.elements.coarse import coarse_mesh_cents
from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import half_width_m
from physics.reed.mode_classification import ModeDescriptor, names_of
from physics.reed.modes import at_frequency
from physics.reed.radiation import air_load
from physics.reed.reduction.response import pressure_forces

# Frequency at which a growth of moduli or losses changes nothing. Chosen: near the middle of the
# sweep, on a logarithmic scale.
PIVOT_HZ = 4000.0
# Highest mode that is computed. Chosen: above the sweep, because modes just above its end still
# contribute to the response there.
HIGHEST_HZ = 24e3
_POPULATION = "population of reeds of one brand (paper, Table 5)"
_HANDBOOK = "spread of small clear specimens of one wood (Wood Handbook, chapter 5)"
_GROWTH = "population of reeds of one brand (paper, hypothesis H4)"
# Results to keep in each cache. Chosen: bounds the memory of a long diagnosis.
_KEPT = 512


@dataclass(frozen=True)
class CaneShift:
    """Difference of a cane from the nominal cane, as natural logarithms of factors.

    Attributes
    ----------
    E_L, E_T, E_R, G_LT, G_LR, G_TR, density : float
        Logarithm of the factor on this modulus, or on the density.
    growth_E_L, growth_G_LT : float
        Additional growth of these moduli with frequency: exponent of (f / 4 kHz).
    """

    E_L: float = quantity(0.0, "", -0.7, 0.7, _POPULATION)
    E_T: float = quantity(0.0, "", -0.7, 0.7, _HANDBOOK)
    E_R: float = quantity(0.0, "", -0.7, 0.7, _HANDBOOK)
    G_LT: float = quantity(0.0, "", -0.7, 0.7, _POPULATION)
    G_LR: float = quantity(0.0, "", -0.7, 0.7, _HANDBOOK)
    G_TR: float = quantity(0.0, "", -0.7, 0.7, _HANDBOOK)
    density: float = quantity(0.0, "", -0.4, 0.4, _HANDBOOK)
    growth_E_L: float = quantity(0.0, "", -0.4, 0.4, _GROWTH)
    growth_G_LT: float = quantity(0.0, "", -0.6, 0.6, _GROWTH)


@dataclass(frozen=True)
class Layer:
    """Additional cane on the vamp; an amount of 1 is a thickness of 1 m where it is thickest.

    The thickness is a product of two Legendre polynomials.

    Attributes
    ----------
    along : int
        Degree of the polynomial along the vamp.
    across : int
        Degree of the polynomial from the right side to the left side.
    """

    along: int
    across: int


@dataclass(frozen=True)
class TipMass:
    """Additional mass, spread uniformly over the tip; an amount of 1 is 1 kg.

    Attributes
    ----------
    length_m : float
        Length of the tip that is covered.
    """

    length_m: float = 2e-3


@dataclass(frozen=True)
class SoftSpot:
    """Cane without stiffness along the grain, in a Gaussian spot; an amount of 1 is 1 m deep.

    Attributes
    ----------
    x_m, y_m : float
        Centre of the spot on the bark side.
    radius_m : float
        Standard deviation of the Gaussian.
    """

    x_m: float
    y_m: float
    radius_m: float = 1.5e-3


@dataclass(frozen=True)
class YieldingClamp:
    """Compliance of the clamp; an amount of 1 is 1 m per Pa.

    Attributes
    ----------
    side : {0, 1, -1}
        Strip of the clamp that yields: 0 both, 1 the left one, −1 the right one.
    """

    side: int = 0


Alteration = Layer | TipMass | SoftSpot | YieldingClamp


@dataclass(frozen=True)
class Mechanics:
    """Mechanical parameters of a reed on the bench.

    Attributes
    ----------
    cane : ViscoelasticCane
        Nominal moduli.
    shift : CaneShift
        Difference from the nominal moduli.
    loss_factor, loss_growth : float
        Loss factor of the cane at 4 kHz, and its growth with frequency: exponent of (f / 4 kHz).
    alterations : tuple of (Alteration, float)
        Alterations of the reed or its clamp, each with its amount.
    air_share : float
        Density of the air around the reed, as a fraction of normal air; 0 is vacuum.
    coarse_share : float
        Fraction of the additional stiffness of a coarse mesh that is included (see
        `physics.reed.elements.coarse`).
    """

    cane: ViscoelasticCane = viscoelastic_cane(Components(), Series.A)
    shift: CaneShift = CaneShift()
    loss_factor: float = quantity(0.03, "", 5e-3, 0.15, "decision 0004: cane, 0.02 to 0.05")
    loss_growth: float = quantity(0.0, "", -0.5, 0.5, "decision 0004: nearly constant")
    alterations: tuple[tuple[Alteration, float], ...] = ()
    air_share: float = quantity(0.0, "", 0.0, 3.0, "a mouthpiece is no baffle: about 1")
    coarse_share: float = quantity(0.0, "", -2.0, 3.0, "decision 0009")


@dataclass(frozen=True)
class ReedMode:
    """One mode of a reed on the bench.

    Attributes
    ----------
    name : str
        Name of the mode, such as F1.
    hz, loss_factor : float
        Resonance frequency and loss factor.
    coordinates : (s,) float
        Mode shape, see `physics.reed.changes.structural_modification.Vibrations`.
    """

    name: str
    hz: float
    loss_factor: float
    coordinates: Array


class ReedSolver:
    """Compute the modes of reeds of one kind, and cache intermediate results.

    Parameters
    ----------
    shape_derivatives : ShapeDerivatives
        Finite-element model of the kind of reed.
    announce : callable, optional
        Called with a text before a computation that takes long.

    Attributes
    ----------
    modes : callable
        Cached function from `Mechanics` to a mapping of `ReedMode` by name, sorted by frequency.
        It raises ImpossibleReedError if such a reed is physically impossible.
    """

    def __init__(
        self, shape_derivatives: ShapeDerivatives, announce: Callable[[str], None] | None = None
    ) -> None:
        self.shape_derivatives = shape_derivatives
        self._unit = lru_cache(maxsize=None)(lambda kind: _unit_change(shape_derivatives, kind))
        self._air = lru_cache(maxsize=1)(lambda: air_load(shape_derivatives.reed))
        self._coarse = lru_cache(maxsize=1)(
            lambda: coarse_mesh_cents(
                shape_derivatives.reed.geometry, shape_derivatives.reed.cane, announce
            )
        )
        self._canes = lru_cache(maxsize=_KEPT)(
            lambda cane, shift: CaneTable.of(
                material_of(shape_derivatives.reed.cane, cane, shift), HIGHEST_HZ
            )
        )
        self._named = lru_cache(maxsize=None)(self._named_shapes)
        # Cached, because a finite difference in one parameter leaves most reeds of a campaign
        # unchanged.
        self.modes = lru_cache(maxsize=_KEPT)(self._modes)

    def _modes(self, reed: Mechanics) -> Mapping[str, ReedMode]:
        """Return the modes of a reed up to 24 kHz by name, sorted by frequency.

        Each mode gets the name of the most similar mode of the nominal reed.

        Raises
        ------
        ImpossibleReedError
            If such a reed is physically impossible.
        """
        found = self._vibrations(reed)
        growth = (found.hz / PIVOT_HZ) ** reed.loss_growth
        loss = reed.loss_factor * growth + found.radiated
        names, shapes = self._named(reed.cane)
        modes = {}
        similarity = np.abs(shapes.T @ self.mass_kg @ found.coordinates)
        rows, columns = linear_sum_assignment(similarity, maximize=True)
        named = dict(zip(columns.tolist(), (names[row] for row in rows), strict=True))
        for m in sorted(named):
            name, hz = named[m], float(found.hz[m])
            if reed.coarse_share:
                hz *= 2 ** (reed.coarse_share * self._coarse().get(name, 0.0) / 1200)
            modes[name] = ReedMode(name, hz, float(loss[m]), found.coordinates[:, m])
        return MappingProxyType(modes)

    def response(
        self,
        reed: Mechanics,
        material: Cane,
        loss_factor: float,
        hz: float,
        pressure: Callable[[float, Array, Array], ComplexArray],
    ) -> dict[Symmetry | None, ComplexArray]:
        """Return the motion of a reed under a pressure.

        Parameters
        ----------
        reed : Mechanics
            Its alterations, its air and its mesh; cane and loss are those of the next arguments.
        material : Cane
            All constants, at this frequency.
        loss_factor : float
            That of the cane at this frequency.
        hz : float
        pressure : callable
            See `physics.reed.reduction.response.forced_response`.

        Returns
        -------
        dict of (r,) complex
            Reduced coordinates in m for each symmetry.
        """
        derivatives = self.shape_derivatives
        forces = pressure_forces(derivatives.reed, hz, pressure)
        force = np.concatenate([forces[symmetry] for symmetry in derivatives.reed.halves])
        added = self._stiffness_of_coarse_mesh(reed) if reed.coarse_share else None
        moved = response_of_changed(
            derivatives,
            self._change(reed),
            material,
            loss_factor,
            hz,
            force,
            air=self._air_around(reed),
            added_n_m=added,
        )
        sizes = [half.mass.shape[0] for half in derivatives.reed.halves.values()]
        parts = np.split(moved, np.cumsum(sizes)[:-1])
        return dict(zip(derivatives.reed.halves, parts, strict=True))

    def _stiffness_of_coarse_mesh(self, reed: Mechanics) -> Array:
        """Return the stiffness (s, s) in N/m that a coarse mesh adds, mode by mode."""
        fine = replace(reed, coarse_share=0.0)
        modes, total = self.modes(fine), np.zeros_like(self.mass_kg)
        change = self._change(fine)
        density = material_of(self.shape_derivatives.reed.cane, reed.cane, reed.shift)(
            PIVOT_HZ
        ).density_kg_m3
        mass = density * (self.shape_derivatives.mass + change.mass) + change.mass_kg
        for name, mode in modes.items():
            cents = reed.coarse_share * self._coarse().get(name, 0.0)
            moved = mass @ mode.coordinates
            stiffer = (2 * np.pi * mode.hz) ** 2 * (2 ** (2 * cents / 1200) - 1)
            total += stiffer * np.multiply.outer(moved, moved)
        return total

    def _change(self, reed: Mechanics) -> Change:
        parts = [(amount, self._unit(kind)) for kind, amount in reed.alterations if amount]
        return combined(self.shape_derivatives, parts)

    def _air_around(self, reed: Mechanics) -> AirLoad | None:
        return _thinned(self._air(), reed.air_share) if reed.air_share else None

    def _vibrations(self, reed: Mechanics) -> Vibrations:
        return vibrations(
            self.shape_derivatives,
            self._change(reed),
            self._canes(reed.cane, reed.shift),
            HIGHEST_HZ,
            self._air_around(reed),
        )

    @cached_property
    def mass_kg(self) -> Array:
        """Return the mass matrix (s, s) of the nominal reed in kg, in coordinates of its modes."""
        return self.shape_derivatives.reed.cane.density_kg_m3 * self.shape_derivatives.mass

    def _named_shapes(self, cane: ViscoelasticCane) -> tuple[list[str], Array]:
        """Return names and shapes (s, m) of the modes of the nominal reed."""
        found = self._vibrations(Mechanics(cane=cane))
        descriptors, start = [], 0
        density = self.shape_derivatives.reed.cane.density_kg_m3
        for symmetry, half in self.shape_derivatives.reed.halves.items():
            own = found.coordinates[start : start + half.mass.shape[0]]
            start += half.mass.shape[0]

            def squared(part: Array, own: Array = own) -> Array:
                return density * np.asarray(np.einsum("rm,rm->m", own, part @ own))

            descriptors.append(
                ModeDescriptor(
                    symmetry=symmetry,
                    share=squared(half.mass),
                    sideways=squared(half.lateral_mass),
                    behind=squared(half.heel_mass),
                    profiles=half.profiles @ own,
                    square=squared(half.vamp_square) / density,
                )
            )
        return [naming.name for naming in names_of(descriptors)], found.coordinates


def material_of(nominal: Cane, kind: ViscoelasticCane, shift: CaneShift) -> Callable[[float], Cane]:
    """Return a function that gives the cane of a reed at a frequency in Hz.

    Parameters
    ----------
    nominal : Cane
        Supplies all constants but E_L and G_LT.
    kind : ViscoelasticCane
        Supplies these two.
    shift : CaneShift
        Difference of all constants from them.
    """

    def cane(hz: float) -> Cane:
        unshifted = at_frequency(nominal, kind, hz)
        log_ratio = np.log(hz / PIVOT_HZ)
        log_factors = {
            "E_L_pa": shift.E_L + shift.growth_E_L * log_ratio,
            "E_T_pa": shift.E_T,
            "E_R_pa": shift.E_R,
            "G_LT_pa": shift.G_LT + shift.growth_G_LT * log_ratio,
            "G_LR_pa": shift.G_LR,
            "G_TR_pa": shift.G_TR,
            "density_kg_m3": shift.density,
        }
        changed = {
            name: getattr(unshifted, name) * float(np.exp(log))
            for name, log in log_factors.items()
            if log
        }
        return replace(unshifted, **changed) if changed else unshifted

    return cane


def _thinned(air: AirLoad, fraction: float) -> AirLoad:
    return AirLoad(air.hz, fraction * air.mass_kg, fraction * air.resistance_kg_s)


def _unit_change(shape_derivatives: ShapeDerivatives, kind: Alteration) -> Change:
    """Return the change of stiffness and mass by an alteration of amount 1."""
    outline, end_m = (
        shape_derivatives.reed.geometry.outline,
        shape_derivatives.reed.geometry.vamp_x_m[-1],
    )
    if isinstance(kind, YieldingClamp):
        return yielding_clamp(shape_derivatives, float(kind.side >= 0), float(kind.side <= 0))
    if isinstance(kind, TipMass):
        zone = shape_derivatives.area_m2 * (shape_derivatives.bark_m[:, 0] < kind.length_m)
        area_m2 = 2 * float(zone.sum())
        return added_mass(shape_derivatives, lambda x, y: (x < kind.length_m) / area_m2)
    if isinstance(kind, SoftSpot):

        def depth(x: Array, y: Array) -> Array:
            r2 = (x - kind.x_m) ** 2 + (y - kind.y_m) ** 2
            bell: Array = np.exp(-r2 / (2 * kind.radius_m**2))
            return bell

        return softening(shape_derivatives, depth)
    along = np.polynomial.legendre.Legendre.basis(kind.along)
    across = np.polynomial.legendre.Legendre.basis(kind.across)

    def thickness(x: Array, y: Array) -> Array:
        eta = y / np.maximum(half_width_m(outline, x), 1e-6)
        grown: Array = along(2 * x / end_m - 1) * across(eta)
        return grown

    return layer(shape_derivatives, thickness)
