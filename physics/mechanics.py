"""Mechanical model of a reed: its cane, its alterations, and its modes by name.

If all shifts, growths and alterations are zero, the model is the nominal reed: the
geometry of the reed file and the cane of the paper, rigidly clamped, in free air.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import combinations
from types import MappingProxyType

import numpy as np
from scipy.optimize import linear_sum_assignment

from holography.arrays import Array, ComplexArray
from physics.alterations import Alterations, unit_change, with_sliding
from physics.parameters.quantity import quantity
from physics.reed.cane.material import Cane
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    viscoelastic_cane,
)
from physics.reed.elements.coarse import coarse_mesh_cents
from physics.reed.elements.fem import Symmetry
from physics.reed.mode_classification import names_of
from physics.reed.nearby import NearbyModes
from physics.reed.reduced.changes import Change, as_matrix, combined
from physics.reed.reduced.derivatives import form_by_ln_hz
from physics.reed.reduced.dynamics import PIVOT_HZ, CaneLaw, LossFactors, State
from physics.reed.reduced.elastic import all_descriptors
from physics.reed.reduced.losses import cane_loss_factors, radiated, spring_energies
from physics.reed.reduced.reed import ReducedReed
from physics.reed.reduced.response import (
    Pressure,
    PressureForce,
    pressure_forces,
    response_of_changed,
)
from physics.reed.reduced.vibrations import Vibrations, vibrations

# Highest mode that is computed. Chosen: above the sweep, because modes just above its end still
# contribute to the response there.
HIGHEST_HZ = 24e3
_POPULATION = "population of reeds of one brand (paper, Table 5)"
_HANDBOOK = "spread of small clear specimens of one wood (Wood Handbook, chapter 5)"
_GROWTH = "population of reeds of one brand (paper, hypothesis H4)"
_POISSON = "chosen: a third, as `ReedBox.poisson_spread`"
_SHEAR_LOSS = (
    "shear loses more than bending: J. Wood Sci. 69, 38 (2023); Labonnote et al., Wood Sci. "
    "Technol. 47, 1033 (2013). Chosen: up to three times as much"
)
_BED_SHEAR = (
    "decision 0096: along, dry contacts yield 1.2 times as much as away (Mindlin, J. Appl. Mech. "
    "16, 259 (1949)), cork twice, hard plastic 2.7 times, thin layers that cannot spread 4.3 times"
)
# Results to keep in each cache. Chosen: bounds the memory of a long diagnosis; a change is some
# megabytes.
_KEPT, _KEPT_CHANGES = 512, 16
# Reeds to keep with all their modes, and with what those of others are sought from: some ten
# megabytes each.
_KEPT_REEDS = 4
# Two modes may exchange their names if their similarity to each other's modes of the nominal reed
# is at least this share of that to their own. Chosen: it is a fifth of their energy.
_MIXED = 0.5


@dataclass(frozen=True)
class CaneShift:
    """Difference of a cane from the nominal cane, as natural logarithms of factors.

    Attributes
    ----------
    E_L, E_T, E_R, G_LT, G_LR, G_TR, density : float
        Logarithm of the factor on this modulus, or on the density.
    nu_LT, nu_LR, nu_TR : float
        Logarithm of the factor on this Poisson ratio.
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
    nu_LT: float = quantity(0.0, "", -0.4, 0.4, _POISSON)
    nu_LR: float = quantity(0.0, "", -0.4, 0.4, _POISSON)
    nu_TR: float = quantity(0.0, "", -0.4, 0.4, _POISSON)


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
    shear_loss_log : float
        Logarithm of the loss factor of shear moduli over `loss_factor`, which is that of the
        stiffness against normal strains.
    alterations : tuple of (Alteration, float)
        Alterations of the reed or its clamp, each with its amount.
    bed_shear_log : float
        Logarithm of how many times more a yielding clamp yields along the reed, in both directions,
        than a bed of hard plastic does (`physics.reed.reduced.changes.BED_SHEAR`).
    air_share : float
        Air that moves along with the reed, relative to normal air around a free plate (see
        `physics.reed.radiation`); 0 is a vacuum.
    coarse_share : float
        Fraction of the additional stiffness of a coarse mesh that is included (see
        `physics.reed.elements.coarse`).
    near : Mechanics, optional
        A reed that differs little, from which modes are sought; it changes no result.
    """

    cane: ViscoelasticCane = viscoelastic_cane(Components(), Series.A)
    shift: CaneShift = CaneShift()
    loss_factor: float = quantity(0.03, "", 5e-3, 0.15, "decision 0004: cane, 0.02 to 0.05")
    loss_growth: float = quantity(0.0, "", -0.5, 0.5, "decision 0004: nearly constant")
    shear_loss_log: float = quantity(0.0, "", -0.5, 1.2, _SHEAR_LOSS)
    alterations: Alterations = ()
    bed_shear_log: float = quantity(0.0, "", -2.0, 2.0, _BED_SHEAR)
    air_share: float = quantity(
        1.0, "", 0.0, 4.0, "decision 0026: a free plate; in a wide wall it is up to twice as much"
    )
    coarse_share: float = quantity(0.0, "", -2.0, 3.0, "decision 0009")
    near: "Mechanics | None" = field(default=None, compare=False, repr=False)

    @property
    def lossless(self) -> "Mechanics":
        """What decides frequencies and shapes: all but losses and the mesh."""
        usual = Mechanics()
        return replace(
            self,
            loss_factor=usual.loss_factor,
            loss_growth=usual.loss_growth,
            shear_loss_log=usual.shear_loss_log,
            coarse_share=usual.coarse_share,
        )


@dataclass(frozen=True)
class ReedMode:
    """One mode of a reed on the bench.

    Attributes
    ----------
    name : str
        Name of the mode, such as F1.
    hz, loss_factor : float
        Resonance frequency and loss factor.
    stiffening : float
        Exponent of the growth of the mode's stiffness with frequency, by its cane and its air.
    coordinates : (s,) float
        Mode shape, see `physics.reed.reduced.vibrations.Vibrations`.
    """

    name: str
    hz: float
    loss_factor: float
    stiffening: float
    coordinates: Array


class ReedSolver:
    """Compute the modes of reeds of one kind, and cache intermediate results.

    Parameters
    ----------
    reed : ReducedReed
        Finite-element model of the kind of reed.
    announce : callable, optional
        Called with a text before a computation that takes long.

    Attributes
    ----------
    order : tuple of str
        Modes whose order is known, see `in_order`.
    """

    def __init__(self, reed: ReducedReed, announce: Callable[[str], None] | None = None) -> None:
        self.reed = reed
        self.order: tuple[str, ...] = ()
        self._unit = lru_cache(maxsize=None)(lambda kind: unit_change(reed, kind))
        self._coarse = lru_cache(maxsize=1)(
            lambda: coarse_mesh_cents(reed.geometry, reed.cane, announce)
        )
        self._laws = lru_cache(maxsize=_KEPT)(lambda cane, shift: cane_law(reed.cane, cane, shift))
        self._change = lru_cache(maxsize=_KEPT_CHANGES)(self._combined)
        self._named = lru_cache(maxsize=1)(self._named_shapes)
        self._vibrations = lru_cache(maxsize=_KEPT_REEDS)(self._vibrations_of)
        self._nearby = lru_cache(maxsize=_KEPT_REEDS)(
            lambda known: NearbyModes(reed, self.state(known), HIGHEST_HZ)
        )
        # Cached, because a finite difference in one parameter leaves most reeds of a campaign
        # unchanged.
        self._modes = lru_cache(maxsize=_KEPT)(self._named_modes)

    def in_order(self, names: Sequence[str]) -> "ReedSolver":
        """Return a solver for a reed of which the order of some modes is known.

        Where two modes have each much of both shapes, either name suits either of them, and names
        would change from one reed to the next. They get them in this order.

        Parameters
        ----------
        names : sequence of str
            By frequency, the lowest first.
        """
        other = copy(self)
        other.order = tuple(names)
        return other

    def modes(self, reed: Mechanics) -> Mapping[str, ReedMode]:
        """Return the modes of a reed up to 24 kHz by name, sorted by frequency.

        Each mode gets the name of the most similar mode of the nominal reed, see also `in_order`.

        Raises
        ------
        ImpossibleReedError
            If such a reed is physically impossible.
        """
        return self._modes(reed, self.order)

    @cached_property
    def mass_kg(self) -> Array:
        """Mass matrix (s, s) of the nominal reed in kg, in the coordinates of its modes."""
        return self.reed.cane.density_kg_m3 * self.reed.mass

    def state(self, reed: Mechanics) -> State:
        """Return what decides the vibrations of a reed."""
        return State(
            law=self._laws(reed.cane, reed.shift),
            change=self._change(reed.alterations, reed.bed_shear_log),
            air=self.reed.air if reed.air_share else None,
            air_fraction=reed.air_share,
        )

    def _named_modes(self, reed: Mechanics, order: tuple[str, ...]) -> Mapping[str, ReedMode]:
        found = self._vibrations(reed.lossless)
        loss = reed.loss_factor * (found.hz / PIVOT_HZ) ** reed.loss_growth
        if reed.shear_loss_log:
            unequal = LossFactors(1.0, float(np.exp(reed.shear_loss_log)))
            loss = loss * cane_loss_factors(found, unequal)
        # What the springs of a compliant clamp store is not lost in the cane.
        in_springs = spring_energies(found) / np.square(2 * np.pi * found.hz)
        loss = loss * (1 - in_springs) + radiated(found)
        names, momenta = self._named()
        # Moduli grow with frequency: a mode that is stiffer rises by more than the root says.
        follow = 2 * np.square(2 * np.pi * found.hz) / -form_by_ln_hz(found)
        modes = {}
        named = _in_order(names, np.abs(momenta @ found.coordinates), found.hz, order)
        for m in sorted(named):
            name, hz = named[m], float(found.hz[m])
            if reed.coarse_share:
                octaves = self._coarse().get(name, 0.0) / 1200
                hz *= 2 ** (reed.coarse_share * follow[m] * octaves)
            grown = float(2 - 2 / follow[m])
            modes[name] = ReedMode(name, hz, float(loss[m]), grown, found.coordinates[:, m])
        return MappingProxyType(modes)

    def _vibrations_of(self, reed: Mechanics) -> Vibrations:
        if reed.near is not None:
            known = self._nearby(reed.near.lossless)
            if reed == reed.near.lossless:
                return known.own
            found = known.modes(self.state(reed))
            if found is not None:
                return found
        return vibrations(self.reed, self.state(reed), HIGHEST_HZ)

    def response(
        self,
        reed: Mechanics,
        material: Cane,
        loss_factor: float | LossFactors,
        hz: float,
        pressure: Pressure | PressureForce,
    ) -> dict[Symmetry | None, ComplexArray]:
        """Return the motion of a reed under a pressure.

        Parameters
        ----------
        reed : Mechanics
            Its alterations, its air and its mesh; cane and loss are those of the next arguments.
        material : Cane
            All constants, at this frequency.
        loss_factor : float or LossFactors
            Of the cane at this frequency.
        hz : float
        pressure : callable or PressureForce
            See `physics.reed.reduced.response.forced_response`.

        Returns
        -------
        dict of (s,) complex
            Reduced coordinates in m for each part, its strips free to move.
        """
        forces = pressure_forces(self.reed, hz, pressure, loose=True)
        moved = response_of_changed(
            self.reed,
            self._change(reed.alterations, reed.bed_shear_log),
            material,
            loss_factor,
            hz,
            np.concatenate(list(forces.values())),
            air_fraction=reed.air_share,
            added_n_m=self.stiffness_of_coarse_mesh(reed) if reed.coarse_share else None,
        )
        return dict(zip(forces, np.split(moved, self.reed.starts[1:]), strict=True))

    def stiffness_of_coarse_mesh(self, reed: Mechanics) -> Array:
        """Return the stiffness (s, s) in N/m that a coarse mesh adds, mode by mode."""
        fine = replace(reed, coarse_share=0.0)
        modes, total = self.modes(fine), np.zeros_like(self.mass_kg)
        change = self._change(fine.alterations, fine.bed_shear_log)
        density = self._laws(reed.cane, reed.shift).constants.density_kg_m3
        mass = density * (self.reed.mass + as_matrix(self.reed, change.mass))
        mass = mass + as_matrix(self.reed, change.mass_kg)
        for name, mode in modes.items():
            cents = reed.coarse_share * self._coarse().get(name, 0.0)
            moved = mass @ mode.coordinates
            if self.reed.air is not None and reed.air_share:
                moved += reed.air_share * self.reed.air.products(mode.hz, mode.coordinates)
            stiffer = (2 * np.pi * mode.hz) ** 2 * (2 ** (2 * cents / 1200) - 1)
            total += stiffer * np.multiply.outer(moved, moved)
        return total

    def _combined(self, alterations: Alterations, bed_shear_log: float) -> Change:
        each = with_sliding(alterations, bed_shear_log)
        return combined((amount, self._unit(kind)) for kind, amount in each if amount)

    def _named_shapes(self) -> tuple[list[str], Array]:
        """Return names of the modes of the nominal reed, and shapes times mass (m, s)."""
        found = vibrations(self.reed, self.state(Mechanics()), HIGHEST_HZ)
        names = [naming.name for naming in names_of(all_descriptors(self.reed, found.coordinates))]
        return names, found.coordinates.T @ self.mass_kg


def _in_order(
    names: Sequence[str], similar: Array, hz: Array, order: Sequence[str]
) -> dict[int, str]:
    """Return the names of modes by their place.

    Parameters
    ----------
    names : sequence of str
        Of n modes of the nominal reed.
    similar : (n, m) float
        How similar modes are to these.
    hz : (m,) float
    order : sequence of str
        See `ReedSolver.in_order`.
    """
    rows, columns = linear_sum_assignment(similar, maximize=True)
    rank = {names[row]: row for row in rows.tolist()}
    mode = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    for low, high in combinations([rank[name] for name in order if name in rank], 2):
        one, other = mode[low], mode[high]
        own = similar[low, one] + similar[high, other]
        exchanged = similar[low, other] + similar[high, one]
        if hz[one] > hz[other] and exchanged > _MIXED * own:
            mode[low], mode[high] = other, one
    return {m: names[row] for row, m in mode.items()}


def cane_law(nominal: Cane, kind: ViscoelasticCane, shift: CaneShift) -> CaneLaw:
    """Return the cane of a reed at every frequency.

    Parameters
    ----------
    nominal : Cane
        Supplies all constants but E_L and G_LT.
    kind : ViscoelasticCane
        Supplies these two.
    shift : CaneShift
        Difference of all constants from them.
    """
    logs = {
        "E_T_pa": shift.E_T,
        "E_R_pa": shift.E_R,
        "G_LR_pa": shift.G_LR,
        "G_TR_pa": shift.G_TR,
        "density_kg_m3": shift.density,
        "nu_LT": shift.nu_LT,
        "nu_LR": shift.nu_LR,
        "nu_TR": shift.nu_TR,
    }
    changed = {name: getattr(nominal, name) * float(np.exp(log)) for name, log in logs.items()}
    return CaneLaw(
        constants=replace(nominal, **changed),
        viscoelastic=kind,
        log_E_L=shift.E_L,
        log_G_LT=shift.G_LT,
        growth_E_L=shift.growth_E_L,
        growth_G_LT=shift.growth_G_LT,
    )
