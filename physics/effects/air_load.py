"""Air that moves along with the reed: a mass the nominal twin leaves out.

Stage: acoustics. Lowers every mode, the low ones most. Not to be told from frequency-dependent
stiffness by one sweep; a sweep at low pressure separates them.
"""

import numpy as np
import scipy.fft

from physics.reed.basis import ReducedReed
from physics.reed.response import Mode
from physics.reed.surface import on_reed, surface_shapes

AIR_DENSITY_KG_M3 = 1.204
# Fine enough for the shortest bending waves, wide enough that copies do not meet.
_GRID_M = 0.5e-3
_EXTENT_M = (64e-3, 128e-3)


def air_load_cents(reed: ReducedReed, mode: Mode, share: float = 1.0) -> float:
    """Shift of a mode under the load of free air on both sides.

    The reed is taken as part of a plane baffle: a wave of wavenumber k on the plane carries the
    mass ``ρ/√(k² − k₀²)`` per area and side (the imaginary part of the radiation impedance), so
    the added modal mass is a sum over the spectrum of the deflection. Waves longer than sound
    radiate instead and add none.

    Parameters
    ----------
    reed : ReducedReed
    mode : Mode
        Its shape is mass-normalised over half the reed.
    share : float
        Of the density of air; 0 is the nominal twin, exactly.

    Returns
    -------
    float
        In cents, negative.
    """
    counts = [int(extent / _GRID_M) for extent in _EXTENT_M]
    y, x = np.meshgrid(*[(np.arange(n) - n // 2) * _GRID_M for n in counts], indexing="ij")
    x = x + 0.5 * reed.geometry.length_m
    inside = on_reed(x, y)
    deflection = np.zeros(x.shape)
    shapes = surface_shapes(reed, x[inside], y[inside])[mode.symmetry]
    deflection[inside] = shapes @ mode.coordinates
    spectrum = scipy.fft.fft2(deflection) * _GRID_M**2
    ky, kx = (2 * np.pi * scipy.fft.fftfreq(n, _GRID_M) for n in counts)
    excess = np.add.outer(ky**2, kx**2) - (2 * np.pi * mode.frequency_hz / 343.0) ** 2
    per_area = np.divide(1, np.sqrt(np.abs(excess)), out=np.zeros_like(excess), where=excess > 0)
    cell = (1 / (counts[0] * _GRID_M)) * (1 / (counts[1] * _GRID_M))
    both_sides = 2 * AIR_DENSITY_KG_M3 * share
    added = both_sides * float(np.sum(np.abs(spectrum) ** 2 * per_area)) * cell
    # Both halves of the reed together have a modal mass of 2.
    return -600 * float(np.log2(1 + added / 2))
