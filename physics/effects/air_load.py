"""Air that moves along with the reed: a mass the nominal twin leaves out.

Stage: acoustics. Lowers every mode, the low ones most. Not to be told from frequency-dependent
stiffness by one sweep; a sweep at low pressure separates them.
"""

from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from physics.reed.basis import ReducedReed
from physics.reed.response import Mode
from physics.reed.surface import on_reed, surface_shapes

Array = NDArray[np.floating[Any]]

AIR_DENSITY_KG_M3 = 1.204
SOUND_M_S = 343.0
# Fine enough for the shortest bending waves.
_GRID_M = 0.5e-3
_WIDTH_M = 14e-3


def air_load_cents(reed: ReducedReed, mode: Mode, share: float = 1.0) -> float:
    """Shift of a mode under the load of free air on both sides.

    The reed is taken as part of a plane baffle. The added modal mass is the reactive part of
    Rayleigh's integral, ``ρ/2π ∫∫ w w′ cos(k₀R)/R`` per side, with the wavenumber k₀ of sound.

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
    shape = round(_WIDTH_M / _GRID_M), round(reed.geometry.outline.length_m / _GRID_M)
    y, x = np.meshgrid(*[(np.arange(n) + 0.5) * _GRID_M for n in shape], indexing="ij")
    y -= 0.5 * _WIDTH_M
    inside = on_reed(reed.geometry.outline, x, y)
    deflection = np.zeros(shape)
    shapes = surface_shapes(reed, x[inside], y[inside])[mode.symmetry]
    deflection[inside] = shapes @ mode.coordinates
    pushed = _convolve(deflection, 2 * np.pi * mode.frequency_hz / SOUND_M_S)
    cell_m2 = _GRID_M**2
    one_side = AIR_DENSITY_KG_M3 * share / (2 * np.pi) * float(np.sum(deflection * pushed))
    # Both halves of the reed together have a modal mass of 2.
    return -600 * float(np.log2(1 + 2 * one_side * cell_m2 / 2))


def _convolve(deflection: Array, wavenumber: float) -> Array:
    """Integral of w′ cos(kR)/R over the plane at every point of the grid, without wrapping."""
    padded = [2 * n for n in deflection.shape]
    away = [np.minimum(np.arange(n), n - np.arange(n)) * _GRID_M for n in padded]
    distance = np.hypot(away[0][:, None], away[1])
    distance[0, 0] = 1.0
    kernel = np.cos(wavenumber * distance) / distance
    # Mean of 1/R over a square, from its centre.
    kernel[0, 0] = 4 * np.log(1 + np.sqrt(2)) / _GRID_M
    product = scipy.fft.rfft2(deflection, padded) * scipy.fft.rfft2(kernel)
    rows, columns = deflection.shape
    answer: Array = scipy.fft.irfft2(product, padded)[:rows, :columns] * _GRID_M**2
    return answer
