"""What frequencies say of cane whose density is not known: its moduli over density.

All numbers are those of the cane of the drawing's density that sounds the same: its moduli are the
reed's, times the density of the drawing over that of the reed. They need not be those of a cane of
hypothesis H4, which varies all moduli with three components. The components are those of the cane
of H4 whose moduli are most similar.
"""

from collections.abc import Mapping

import numpy as np

from holography.arrays import Array
from physics.mechanics import CaneShift
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    Zener,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.reduced.dynamics import PIVOT_HZ

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


def moduli_mpa(values: Array, shift: CaneShift, series: Series, frequencies_hz: Array) -> Array:
    """Return the numbers `MODULI` (6,) of a cane, at the drawing's density.

    Springs are those of the `Zener` bodies with the dashpot times of H4's cane whose storage moduli
    are most similar to those of the cane at given frequencies.

    Parameters
    ----------
    values : (3,) or (4,) float
        Components of H4's cane.
    shift : CaneShift
        How the cane differs from it, and from the drawing's density.
    series : Series
    frequencies_hz : (n,) float
    """
    cane, quoted_hz = cane_of(values, series), np.array([QUOTED_HZ])
    springs, storage = [], []
    for zener, (log, growth) in zip((cane.young_L, cane.shear_LT), _logs(shift), strict=True):
        springs.append(_springs_mpa(zener, log, growth, frequencies_hz))
        storage.append(1e-6 * np.exp(log) * storage_modulus_pa(zener, quoted_hz))
    return np.concatenate([*springs, *storage])


def _logs(shift: CaneShift) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return for E_L and G_LT over density the log of a factor, and an additional growth."""
    return (
        (shift.E_L - shift.density, shift.growth_E_L),
        (shift.G_LT - shift.density, shift.growth_G_LT),
    )


def _springs_mpa(zener: Zener, log: float, growth: float, hz: Array) -> Array:
    """Return both springs of a Zener body whose storage modulus is that of another, shifted."""
    storage_mpa = 1e-6 * storage_modulus_pa(zener, hz)
    # The storage modulus is linear in both springs, if the time of the dashpot is kept.
    arm = (storage_mpa - zener.spring_mpa) / zener.arm_spring_mpa
    aim_mpa = np.exp(log) * storage_mpa * (hz / PIVOT_HZ) ** growth
    columns = np.stack([np.ones(len(hz)), arm], axis=1) / aim_mpa[:, None]
    return np.asarray(np.linalg.lstsq(columns, np.ones(len(hz)), rcond=None)[0])


def components_over_density(
    values: Array, shift: CaneShift, frequencies_hz: Mapping[Series, Array]
) -> Array:
    """Return components (c,) of cane of the drawing's density whose moduli are most similar.

    The logarithms of both storage moduli are compared, at given frequencies in each series. Cane
    that has none, because it is impossible, keeps its components.

    Parameters
    ----------
    values : (c,) float
    shift : CaneShift
        See `moduli_mpa`.
    frequencies_hz : mapping of (n,) float
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return _most_similar(values, shift, frequencies_hz)


def _most_similar(values: Array, shift: CaneShift, frequencies_hz: Mapping[Series, Array]) -> Array:
    aim = _log_moduli(values, shift, frequencies_hz)
    near, none = values, CaneShift()
    for _ in range(_STEPS if shift != none else 0):
        steps = _DIFFERENCE * np.eye(len(near))
        slopes = [
            (
                _log_moduli(near + d, none, frequencies_hz)
                - _log_moduli(near - d, none, frequencies_hz)
            )
            / (2 * _DIFFERENCE)
            for d in steps
        ]
        missing = aim - _log_moduli(near, none, frequencies_hz)
        if not np.isfinite([missing, *slopes]).all():
            return values
        near = near + np.linalg.lstsq(np.stack(slopes, axis=1), missing, rcond=None)[0]
    return near


def _log_moduli(values: Array, shift: CaneShift, frequencies_hz: Mapping[Series, Array]) -> Array:
    found = []
    for series, hz in frequencies_hz.items():
        cane = cane_of(values, series)
        for zener, (log, growth) in zip((cane.young_L, cane.shear_LT), _logs(shift), strict=True):
            found.append(
                np.log(storage_modulus_pa(zener, hz)) + log + growth * np.log(hz / PIVOT_HZ)
            )
    return np.concatenate(found)
