"""Frequency-dependent cane: Zener storage moduli and the paper's hypothesis H4."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from holography.arrays import Array
from physics.errors import ImpossibleReedError
from physics.parameters.quantity import bounded

_TABLES = "paper, Tables 6 and 7: means of both series and six standard deviations"


class Series(StrEnum):
    """The two series of measurements: ambient reed, and the same reed dried."""

    A = "A"
    B = "B"


@dataclass(frozen=True)
class Components:
    """The four components e1…e4 of a reed, N(0, 1) over the population (paper, section IV.B).

    e1 goes with G_LT, e2 with E_L, e3 with the viscous part of both, e4 with drying.
    """

    e1: float = 0.0
    e2: float = 0.0
    e3: float = 0.0
    e4: float = 0.0


@dataclass(frozen=True)
class Zener:
    """Standard linear solid (paper, Eqs 2 to 4), in MPa and MPa·s as the paper has it.

    Attributes
    ----------
    spring_mpa : float
        Rubbery modulus, E1 or G1.
    arm_spring_mpa : float
        Spring of the Maxwell arm, E2 or G2.
    arm_dashpot_mpa_s : float
        Dashpot of the Maxwell arm, E3 or G3.
    """

    spring_mpa: float = bounded("MPa", 100.0, 40e3, _TABLES)
    arm_spring_mpa: float = bounded("MPa", 0.0, 40e3, _TABLES)
    arm_dashpot_mpa_s: float = bounded("MPa s", 0.0, 10.0, _TABLES)

    def scaled(self, factor: float) -> "Zener":
        """Return a solid whose storage modulus is larger by a factor at every frequency."""
        parts = (self.spring_mpa, self.arm_spring_mpa, self.arm_dashpot_mpa_s)
        return Zener(*(factor * part for part in parts))


@dataclass(frozen=True)
class ViscoelasticCane:
    """The two frequency-dependent moduli of a reed in one series."""

    young_L: Zener
    shear_LT: Zener


def storage_modulus_pa(zener: Zener, frequency_hz: Array | float) -> Array:
    """Storage modulus in Pa at frequency (any shape), paper Eq. 4."""
    dashpot2 = (2 * np.pi * np.asarray(frequency_hz, dtype=float) * zener.arm_dashpot_mpa_s) ** 2
    stiffness2 = zener.arm_spring_mpa**2 + dashpot2
    # Without spring and without motion the arm carries nothing: 0/0.
    share = np.divide(dashpot2, stiffness2, out=np.zeros_like(stiffness2), where=stiffness2 > 0)
    arm = zener.arm_spring_mpa * share
    storage: Array = 1e6 * (zener.spring_mpa + arm)
    return storage


@dataclass(frozen=True)
class StorageModulus:
    """Storage moduli of many Zener solids, and how they follow what makes them.

    Attributes
    ----------
    value_mpa : Array
    by_arm_spring, by_arm_dashpot_per_s, by_ln_frequency_mpa : Array
        Derivatives with respect to E2, E3 and ln f; that with respect to E1 is 1.
    """

    value_mpa: Array
    by_arm_spring: Array
    by_arm_dashpot_per_s: Array
    by_ln_frequency_mpa: Array


def storage_modulus(
    spring_mpa: Array, arm_spring_mpa: Array, arm_dashpot_mpa_s: Array, frequency_hz: Array
) -> StorageModulus:
    """Storage moduli in MPa with derivatives (paper Eq. 4); arguments of shapes that broadcast.

    A Maxwell arm with neither spring nor motion, 0/0, carries nothing.
    """
    omega = 2 * np.pi * np.asarray(frequency_hz, dtype=float)
    moved = omega * arm_dashpot_mpa_s
    squares = np.square(arm_spring_mpa) + moved**2
    share = np.divide(moved**2, squares, out=np.zeros_like(squares), where=squares > 0)
    by_moved = np.zeros_like(squares)
    np.divide(2 * moved * np.power(arm_spring_mpa, 3), squares**2, out=by_moved, where=squares > 0)
    return StorageModulus(
        value_mpa=spring_mpa + arm_spring_mpa * share,
        by_arm_spring=share * (2 * share - 1),
        by_arm_dashpot_per_s=omega * by_moved,
        by_ln_frequency_mpa=moved * by_moved,
    )


# Coefficients of hypothesis H4 (paper, section IV.B).
_C10, _C20, _C30 = 1.011, -2.197, 0.8294
_D10, _D12, _D20, _D30, _D41, _D60 = 10300.0, 640.5, 7309.0, 0.2822, 115.7, 0.02038


def viscoelastic_cane(components: Components, series: Series) -> ViscoelasticCane:
    """Zener moduli of a reed in a series after hypothesis H4 (paper, section IV.B).

    Linear in the components; whether the result is a possible material is for
    `require_physical` to say.
    """
    e1, e2, e3 = components.e1, components.e2, components.e3
    if series is Series.B:
        e1, e2, e3 = _C10 + e1, _C20 + 0.5 * (e2 + components.e4), _C30 + e3
    return ViscoelasticCane(
        Zener(_D10 + _D12 * (e2 + e3), _D20 + _D12 * (2 * e2 - e3), _D30),
        Zener(_D41 * (6 + e1), 2 * _D41 * (3 + e1 - e3), _D60),
    )


def h4_matrix(series: Series) -> Array:
    """Matrix (6, 5) from (1, e1, e2, e3, e4) to (E1, E2, E3, G1, G2, G3) after hypothesis H4.

    The paper's M[s] of both moduli, one above the other; MPa and MPa·s.
    """

    def parameters(*e: float) -> Array:
        cane = viscoelastic_cane(Components(*e), series)
        return np.array(
            [
                part
                for zener in (cane.young_L, cane.shear_LT)
                for part in (zener.spring_mpa, zener.arm_spring_mpa, zener.arm_dashpot_mpa_s)
            ]
        )

    constant = parameters(0.0, 0.0, 0.0, 0.0)
    return np.stack([constant, *(parameters(*unit) - constant for unit in np.eye(4))], axis=1)


def require_physical(cane: ViscoelasticCane) -> None:
    """Refuse springs that are not positive: 1.7 % of the population of H4 has G2 < 0.

    Raises
    ------
    ImpossibleReedError
        Names the first such spring.
    """
    for letter, zener in (("E", cane.young_L), ("G", cane.shear_LT)):
        for rank, value in ((1, zener.spring_mpa), (2, zener.arm_spring_mpa)):
            if value <= 0:
                raise ImpossibleReedError(
                    f"{letter}{rank} = {value:.0f} MPa: no material is like that"
                )
