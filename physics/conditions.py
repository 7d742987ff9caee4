"""What temperature, moisture and amplitude do to a reed: one law for bench, fit and diagnosis.

Drying moves the moduli of the cane along the difference of the paper's two series; warming shifts
their relaxation time after Arrhenius. Both laws are those of `physics.reed.cane.conditions`. What
they leave open is a change of each modulus by the same factor at all frequencies (decision 0023),
and how much of the law of wood there is in them: wood becomes stiffer as it dries, and softer as it
warms, equally at all frequencies, across the grain more than along it (decision 0098).
"""

from dataclasses import dataclass

import numpy as np

from holography.arrays import Array
from physics.parameters.environment import Environment
from physics.reed.cane.conditions import REFERENCE_C, dried, relaxation_time_factor
from physics.reed.cane.viscoelastic import ViscoelasticCane, Zener, storage_modulus

# Amplitude to which `Environment.hardening` refers.
HARDENING_RAD = 10.0
# Change of ln E_L of wood along the grain for 3 % less water (1.5 to 2 % for each per cent: Wood
# Handbook, FPL-GTR-190, chapter 5), and 3 % less mass, which counts as stiffness (decision 0023).
_WOOD_DRY_E_L = 0.05 + 0.03
# The same of both moduli along the grain per °C (Wood Handbook, Table 5-15, 12 % moisture).
_WOOD_WARM = -2.3e-3
# Mean of the square of a deflection over the peak's, in terms that stiffen: a quarter of the square
# would be that of a bar; a reed's tip moves over little of its area. Chosen: between them.
_DEEP = 0.7


@dataclass(frozen=True)
class Condition:
    """Condition of a reed at some times.

    Attributes
    ----------
    dryness : float or array
        0 as at the start; see `Environment.drying`.
    warmer_c : float or array
        Degrees above the temperature at the start.
    """

    dryness: Array
    warmer_c: Array

    @property
    def is_initial(self) -> bool:
        """Whether nothing has changed since the start."""
        return not (np.any(self.dryness) or np.any(self.warmer_c))


@dataclass(frozen=True)
class ConditionChange:
    """What a condition changes, as natural logarithms of factors, at some frequencies.

    Attributes
    ----------
    E_L, G_LT : array
        Storage moduli.
    others : array
        E_T, E_R, G_LR and G_TR.
    loss : array
        Loss factor.
    """

    E_L: Array
    G_LT: Array
    others: Array
    loss: Array


def condition_at(environment: Environment, time_s: Array | float) -> Condition:
    """Return the condition of a reed at times (any shape) since the campaign began."""
    gone_h = np.asarray(time_s, dtype=float) / 3600 + environment.begun_h
    dryness = environment.drying * -np.expm1(-3600 * gone_h / environment.drying_s)
    return Condition(np.asarray(dryness), np.asarray(environment.warming_c_h * gone_h))


def change_of_cane(
    cane: ViscoelasticCane, environment: Environment, condition: Condition, hz: Array | float
) -> ConditionChange:
    """Return what a condition changes in a cane, at frequencies that broadcast with it.

    Parameters
    ----------
    cane : ViscoelasticCane
        At the start of the campaign.
    environment : Environment
        Supplies what the laws leave open.
    condition : Condition
    hz : float or array
        Frequencies.
    """
    dryness, warmer_c = condition.dryness, condition.warmer_c
    frequency_hz = np.asarray(hz, dtype=float)
    none, still = np.zeros_like(dryness), np.zeros_like(warmer_c)
    law, changed = environment, {}
    for name, zener, wood, dry_log, warm_log in (
        ("young_L", cane.young_L, law.dry_as_wood, law.dry_E_L, law.warm_E_L),
        ("shear_LT", cane.shear_LT, 0.0, law.dry_G_LT, law.warm_G_LT),
    ):
        dry: Zener = getattr(dried(cane, 1.0), name)
        log = _log_change(zener, dry, dryness, warmer_c, frequency_hz)
        if wood:
            by_drying = _log_change(zener, dry, dryness, still, frequency_hz)
            log = log + wood * (_WOOD_DRY_E_L * dryness - by_drying)
        if law.warm_as_wood:
            by_warmth = _log_change(zener, dry, none, warmer_c, frequency_hz)
            log = log + law.warm_as_wood * (_WOOD_WARM * warmer_c - by_warmth)
        changed[name] = log + dry_log * dryness + warm_log * warmer_c
    return ConditionChange(
        E_L=changed["young_L"],
        G_LT=changed["shear_LT"],
        others=np.asarray(law.dry_others * dryness + law.warm_others * warmer_c),
        loss=np.asarray(law.dry_loss * dryness + law.warm_loss * warmer_c),
    )


def _log_change(
    zener: Zener, dry: Zener, dryness: Array, warmer_c: Array, frequency_hz: Array
) -> Array:
    """Change of the log of a storage modulus by hypothesis H4 and the Arrhenius shift."""
    shift = np.vectorize(relaxation_time_factor)(REFERENCE_C + warmer_c)
    now = storage_modulus(
        zener.spring_mpa + dryness * (dry.spring_mpa - zener.spring_mpa),
        zener.arm_spring_mpa + dryness * (dry.arm_spring_mpa - zener.arm_spring_mpa),
        zener.arm_dashpot_mpa_s * shift,
        frequency_hz,
    ).value_mpa
    before = storage_modulus(
        np.asarray(zener.spring_mpa),
        np.asarray(zener.arm_spring_mpa),
        np.asarray(zener.arm_dashpot_mpa_s),
        frequency_hz,
    ).value_mpa
    return np.asarray(np.log(now / before))


def hardened(environment: Environment, largest_rad: Array | float) -> Array:
    """Return the logarithm of the factor on stiffness at a largest phase amplitude, first order."""
    relative: Array = np.square(np.asarray(largest_rad, dtype=float) / HARDENING_RAD)
    return _DEEP * environment.hardening * relative
