"""Temperature and moisture of viscoelastic cane.

The paper measured at about 20 °C, on reeds of ambient moisture (series A) and on the same reeds
dried (series B). Temperature shifts the relaxation time after Arrhenius; moisture is interpolated
between the two series.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.constants import R, zero_Celsius

from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    Zener,
    h4_matrix,
    viscoelastic_cane,
)

# The paper's example of an activation energy, and its laboratory.
ACTIVATION_ENERGY_J_MOL = 13e3
REFERENCE_C = 20.0


def relaxation_time_factor(
    temperature_c: float,
    activation_energy_j_mol: float = ACTIVATION_ENERGY_J_MOL,
    reference_c: float = REFERENCE_C,
) -> float:
    """Factor on the relaxation time at a temperature: ``exp(Ea/R · (1/T - 1/Tref))``.

    The Arrhenius shift of the paper's footnote; 0.84 for 10 °C above 20 °C.

    Parameters
    ----------
    temperature_c, reference_c : float
        In °C.
    activation_energy_j_mol : float
        Ea; 0 for cane that does not mind.

    Raises
    ------
    ValueError
        At or below absolute zero, for a negative activation energy, or for what is not finite.
    """
    for name, value in (("temperature", temperature_c), ("reference", reference_c)):
        if not -zero_Celsius < value < np.inf:
            raise ValueError(
                f"{name} of {value} °C is not above absolute zero; give a temperature in °C, "
                f"above {-zero_Celsius}"
            )
    if not 0 <= activation_energy_j_mol < np.inf:
        raise ValueError(
            f"activation energy of {activation_energy_j_mol} J/mol; give 0 or more "
            f"(the paper's example is {ACTIVATION_ENERGY_J_MOL:.0f})"
        )
    inverse = 1 / (temperature_c + zero_Celsius) - 1 / (reference_c + zero_Celsius)
    return float(np.exp(activation_energy_j_mol / R * inverse))


def at_temperature(
    cane: ViscoelasticCane,
    temperature_c: float,
    activation_energy_j_mol: float = ACTIVATION_ENERGY_J_MOL,
    reference_c: float = REFERENCE_C,
) -> ViscoelasticCane:
    """Cane at another temperature than that at which its moduli hold.

    Both dashpots scale with the relaxation time τ1 = E3/E2: rubbery and glassy moduli stay, and a
    storage modulus becomes that of another frequency. Warmer cane is softer.

    Parameters
    ----------
    cane : ViscoelasticCane
        At the reference temperature.
    temperature_c, activation_energy_j_mol, reference_c
        See `relaxation_time_factor`.

    Raises
    ------
    ValueError
        As `relaxation_time_factor`.
    """
    factor = relaxation_time_factor(temperature_c, activation_energy_j_mol, reference_c)

    def shifted(zener: Zener) -> Zener:
        return replace(zener, arm_dashpot_mpa_s=factor * zener.arm_dashpot_mpa_s)

    return ViscoelasticCane(shifted(cane.young_L), shifted(cane.shear_LT))


def h4_matrix_at(dryness: float) -> NDArray[np.float64]:
    """Matrix (6, 5) of hypothesis H4 between its two series, see `viscoelastic.h4_matrix`.

    An interpolation between two states that were measured, and no more: that the moduli pass from
    one to the other along a straight line is assumed, and how dry a reed of series B was is not
    known (the paper's "ultra-dry" conditioning was not controlled). Density stays what it is: the
    paper takes it as constant in both series, so its coefficients of series B have the loss of
    mass, 2 to 4 %, within them.

    Parameters
    ----------
    dryness : float
        0 as the ambient reeds of series A, 1 as the dried ones of series B.

    Raises
    ------
    ValueError
        Beyond 0 and 1, where nothing was measured.
    """
    if not 0 <= dryness <= 1:
        raise ValueError(
            f"dryness {dryness} lies beyond what was measured; give 0 (series A, ambient) to "
            "1 (series B, dried)"
        )
    ambient, dried = h4_matrix(Series.A), h4_matrix(Series.B)
    return np.asarray((1 - dryness) * ambient + dryness * dried, dtype=float)


def dried(cane: ViscoelasticCane, dryness: float) -> ViscoelasticCane:
    """Return a cane that is drier: its springs change by what those of the mean reed do.

    For the cane of a reed in series A this is `cane_at_dryness` of a reed with e4 = e2: hypothesis
    H4 lets reeds differ in how they answer to drying by (e4 - e2)/2, with a mean of 0.

    Parameters
    ----------
    cane : ViscoelasticCane
    dryness : float
        1 changes it as much as series B differs from series A.
    """
    mean = [viscoelastic_cane(Components(), series) for series in (Series.A, Series.B)]

    def changed(zener: Zener, ambient: Zener, dry: Zener) -> Zener:
        return Zener(
            zener.spring_mpa + dryness * (dry.spring_mpa - ambient.spring_mpa),
            zener.arm_spring_mpa + dryness * (dry.arm_spring_mpa - ambient.arm_spring_mpa),
            zener.arm_dashpot_mpa_s,
        )

    return ViscoelasticCane(
        changed(cane.young_L, *(each.young_L for each in mean)),
        changed(cane.shear_LT, *(each.shear_LT for each in mean)),
    )


def cane_at_dryness(components: Components, dryness: float) -> ViscoelasticCane:
    """Cane of a reed between ambient (0) and dried (1) after hypothesis H4, see `h4_matrix_at`.

    All is linear in the components, so this is the same as interpolating the components on which
    the moduli of a series depend. Whether the result is a possible material is for
    `viscoelastic.require_physical` to say.

    Raises
    ------
    ValueError
        As `h4_matrix_at`.
    """
    e = np.array([1.0, components.e1, components.e2, components.e3, components.e4])
    E1, E2, E3, G1, G2, G3 = (float(value) for value in h4_matrix_at(dryness) @ e)
    return ViscoelasticCane(Zener(E1, E2, E3), Zener(G1, G2, G3))
