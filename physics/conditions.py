"""What temperature, moisture and amplitude do to a reed: one law for bench, fit and diagnosis.

Drying moves the moduli of the cane along the difference of the paper's two series; warming shifts
their relaxation time after Arrhenius. Both laws are those of `physics.reed.cane.conditions`. What
they leave open is a change of each modulus by the same factor at all frequencies (decision 0023).
"""

from dataclasses import dataclass

import numpy as np

from holography.arrays import Array
from physics.parameters.environment import Environment
from physics.reed.cane.conditions import REFERENCE_C, dried, relaxation_time_factor
from physics.reed.cane.viscoelastic import ViscoelasticCane, Zener, storage_modulus

# Amplitude to which `Environment.hardening` refers.
HARDENING_RAD = 10.0
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
    loss : array
        Loss factor.
    """

    E_L: Array
    G_LT: Array
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
    changed = {}
    for name, zener, dry_log, warm_log in (
        ("young_L", cane.young_L, environment.dry_E_L, environment.warm_E_L),
        ("shear_LT", cane.shear_LT, environment.dry_G_LT, environment.warm_G_LT),
    ):
        dry: Zener = getattr(dried(cane, 1.0), name)
        shift = np.vectorize(relaxation_time_factor)(REFERENCE_C + warmer_c)
        now = storage_modulus(
            zener.spring_mpa + dryness * (dry.spring_mpa - zener.spring_mpa),
            zener.arm_spring_mpa + dryness * (dry.arm_spring_mpa - zener.arm_spring_mpa),
            zener.arm_dashpot_mpa_s * shift,
            np.asarray(hz, dtype=float),
        ).value_mpa
        before = storage_modulus(
            np.asarray(zener.spring_mpa),
            np.asarray(zener.arm_spring_mpa),
            np.asarray(zener.arm_dashpot_mpa_s),
            np.asarray(hz, dtype=float),
        ).value_mpa
        changed[name] = np.log(now / before) + dry_log * dryness + warm_log * warmer_c
    loss = environment.dry_loss * dryness + environment.warm_loss * warmer_c
    return ConditionChange(changed["young_L"], changed["shear_LT"], np.asarray(loss))


def hardened(environment: Environment, largest_rad: Array | float) -> Array:
    """Return the logarithm of the factor on stiffness at a largest phase amplitude, first order."""
    relative: Array = np.square(np.asarray(largest_rad, dtype=float) / HARDENING_RAD)
    return _DEEP * environment.hardening * relative
