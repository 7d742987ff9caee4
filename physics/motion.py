"""Motion of a reed under a sinusoidal pressure, whatever its mechanical parameters are."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from holography.arrays import ComplexArray
from physics.conditions import ConditionChange
from physics.mechanics import Mechanics, ReedSolver, cane_law
from physics.reed.cane.material import Cane
from physics.reed.elements.fem import Symmetry
from physics.reed.reduced.dynamics import PIVOT_HZ, LossFactors
from physics.reed.reduced.reed import ReducedReed
from physics.reed.reduced.response import Pressure, PressureForce, response_at

Coordinates = Mapping[Symmetry | None, ComplexArray]
"""Reduced coordinates (r,) in m for each part of a reed."""


class ReedMotion(Protocol):
    """A reed that can be moved."""

    @property
    def reed(self) -> ReducedReed:
        """Its reduced coordinates."""
        ...

    @property
    def loose(self) -> bool:
        """Whether its coordinates are those in which the strips of the clamp may move."""
        ...

    def coordinates(
        self,
        mechanics: Mechanics,
        change: ConditionChange,
        hz: float,
        stiffer: float,
        pressure: Pressure | PressureForce,
    ) -> Coordinates:
        """Return its motion at a frequency.

        Parameters
        ----------
        mechanics : Mechanics
            Of the reed as it was clamped.
        change : ConditionChange
            What its condition has changed since.
        hz : float
        stiffer : float
            Logarithm of a factor on all stiffnesses, by which a large amplitude stiffens it.
        pressure : callable or PressureForce
        """
        ...


@dataclass(frozen=True)
class PlainMotion:
    """Motion of a reed of any shape, without alterations.

    Attributes
    ----------
    reed : ReducedReed
    loose : bool
    """

    reed: ReducedReed
    loose: bool = False

    def coordinates(
        self,
        mechanics: Mechanics,
        change: ConditionChange,
        hz: float,
        stiffer: float,
        pressure: Pressure | PressureForce,
    ) -> Coordinates:
        """Return the motion at a frequency; see `ReedMotion`."""
        material = _material(self.reed.cane, mechanics, change, hz, stiffer)
        loss = _loss(mechanics, change, hz)
        return response_at(self.reed, material, loss, hz, pressure, mechanics.air_share)

    @staticmethod
    def plays(mechanics: Mechanics) -> bool:
        """Whether such a reed needs no more than this."""
        return not (mechanics.alterations or mechanics.coarse_share)


@dataclass(frozen=True)
class AlteredMotion:
    """Motion of any reed that is its own mirror image but for its alterations.

    Attributes
    ----------
    solver : ReedSolver
    loose : bool
    """

    solver: ReedSolver
    loose: bool = True

    @property
    def reed(self) -> ReducedReed:
        """Its reduced coordinates."""
        return self.solver.reed

    def coordinates(
        self,
        mechanics: Mechanics,
        change: ConditionChange,
        hz: float,
        stiffer: float,
        pressure: Pressure | PressureForce,
    ) -> Coordinates:
        """Return the motion at a frequency; see `ReedMotion`."""
        material = _material(self.reed.cane, mechanics, change, hz, stiffer)
        loss = _loss(mechanics, change, hz)
        return self.solver.response(mechanics, material, loss, hz, pressure)


def _material(
    constants: Cane, mechanics: Mechanics, change: ConditionChange, hz: float, stiffer: float
) -> Cane:
    """Return the cane at a frequency, in its present condition."""
    before = cane_law(constants, mechanics.cane, mechanics.shift).at(hz)
    others = float(change.others)
    logs = {"E_L_pa": float(change.E_L), "G_LT_pa": float(change.G_LT)}
    logs |= dict.fromkeys(("E_T_pa", "E_R_pa", "G_LR_pa", "G_TR_pa"), others)
    moduli = {
        name: getattr(before, name) * float(np.exp(log + stiffer)) for name, log in logs.items()
    }
    return replace(before, **moduli)


def _loss(mechanics: Mechanics, change: ConditionChange, hz: float) -> LossFactors:
    growth = (hz / PIVOT_HZ) ** mechanics.loss_growth
    normal = float(mechanics.loss_factor * growth * np.exp(change.loss))
    return LossFactors(normal, normal * float(np.exp(mechanics.shear_loss_log)))
