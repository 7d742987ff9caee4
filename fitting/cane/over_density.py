"""What frequencies say of cane whose density is not known: its moduli over density.

All numbers are those of the cane of the drawing's density that sounds the same: its moduli are the
reed's, times the density of the drawing over that of the reed. They leave hypothesis H4 by a
little, because H4 varies moduli with three components and cannot scale all four springs; the
components are those of the cane of H4 whose moduli are most similar.
"""

from collections.abc import Mapping

import numpy as np

from holography.arrays import Array
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    storage_modulus_pa,
    viscoelastic_cane,
)

# The paper quotes storage moduli at this frequency (Tables 6 and 7).
QUOTED_HZ = 4000.0
MODULI = ("E1_mpa", "E2_mpa", "G1_mpa", "G2_mpa", "E_4kHz_mpa", "G_4kHz_mpa")
# Newton's steps for components. For cane that is denser by two standard deviations (0.23), a fifth
# step moves no component by more than 1e-4.
_STEPS = 4
_DIFFERENCE = 1e-4


def cane_of(values: Array, series: Series) -> ViscoelasticCane:
    """Return the cane of components e1 … e3 or e1 … e4 in a series."""
    return viscoelastic_cane(Components(*map(float, values)), series)


def moduli_mpa(values: Array, log_density: float, series: Series) -> Array:
    """Return the numbers `MODULI` (6,) of the cane of components, at the drawing's density.

    Parameters
    ----------
    values : (3,) or (4,) float
        Components of the cane.
    log_density : float
        Logarithm of the cane's density over that of the drawing.
    series : Series
    """
    cane = cane_of(values, series)
    E, G = cane.young_L, cane.shear_LT
    storage = [1e-6 * float(storage_modulus_pa(z, QUOTED_HZ)) for z in (E, G)]
    whole = np.array([E.spring_mpa, E.arm_spring_mpa, G.spring_mpa, G.arm_spring_mpa, *storage])
    return np.asarray(whole * np.exp(-log_density))


def components_over_density(
    values: Array, log_density: float, frequencies_hz: Mapping[Series, Array]
) -> Array:
    """Return components (c,) of cane of the drawing's density whose moduli are most similar.

    The logarithms of both storage moduli are compared, at given frequencies in each series.

    Parameters
    ----------
    values : (c,) float
    log_density : float
    frequencies_hz : mapping of (n,) float
    """
    aim, near = _log_moduli(values, frequencies_hz) - log_density, values
    for _ in range(_STEPS if log_density else 0):
        steps = _DIFFERENCE * np.eye(len(near))
        slopes = [
            (_log_moduli(near + d, frequencies_hz) - _log_moduli(near - d, frequencies_hz))
            / (2 * _DIFFERENCE)
            for d in steps
        ]
        missing = aim - _log_moduli(near, frequencies_hz)
        near = near + np.linalg.lstsq(np.stack(slopes, axis=1), missing, rcond=None)[0]
    return near


def _log_moduli(values: Array, frequencies_hz: Mapping[Series, Array]) -> Array:
    found = []
    for series, hz in frequencies_hz.items():
        cane = cane_of(values, series)
        found += [storage_modulus_pa(zener, hz) for zener in (cane.young_L, cane.shear_LT)]
    return np.asarray(np.log(np.concatenate(found)))
