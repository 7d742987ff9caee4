"""Air that moves along with a reed, and sound that it sends out: what a vacuum lacks.

The reed is taken as part of a plane baffle. By Rayleigh's integral the force on a reed that moves
with ``w(x)·exp(iωt)`` is, on either side, ``ω²·ρ/2π ∫ w′ exp(−ikR)/R dA′``: its part in phase is a
mass, the other one a resistance.
"""

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from holography.arrays import Array, Float32Array
from physics.reed.reduced.dynamics import AirMatrices
from physics.reed.reduced.reed import ReducedReed
from physics.reed.surface import on_reed, surface_shapes

AIR_DENSITY_KG_M3 = 1.204
SOUND_M_S = 343.0
# Fine enough for the shortest bending waves.
_GRID_M = 0.5e-3
_HZ = tuple(np.geomspace(1e3, 25e3, 13).tolist())


def air_load(reed: ReducedReed) -> AirMatrices:
    """Free air on both sides of a reed, in the coordinates in which its strips may move."""
    outline = reed.geometry.outline
    width_m = 2 * outline.side_half_width_m + _GRID_M
    shape = round(width_m / _GRID_M), round(outline.length_m / _GRID_M)
    y, x = np.meshgrid(*[(np.arange(n) + 0.5) * _GRID_M for n in shape], indexing="ij")
    y -= 0.5 * shape[0] * _GRID_M
    inside = on_reed(outline, x, y)
    surface = surface_shapes(reed, x[inside], y[inside], loose=True)
    # Of both sides; over half the reed, as all modal masses, if it is its own mirror image.
    fraction = 2.0 if None in surface else 1.0
    masses, resistances = zip(
        *[_loads(shapes, inside, fraction) for shapes in surface.values()], strict=True
    )
    return AirMatrices.of(np.array(_HZ), list(masses), list(resistances))


def _loads(shapes: Float32Array, inside: NDArray[np.bool_], fraction: float) -> tuple[Array, Array]:
    """Mass and resistance (f, r, r) of deflections (n, r) at the cells inside (ny, nx)."""
    padded = [2 * n for n in inside.shape]
    away = [np.minimum(np.arange(n), n - np.arange(n)) * _GRID_M for n in padded]
    distance_m = np.hypot(away[0][:, None], away[1])
    grid = np.zeros((shapes.shape[1], *inside.shape))
    grid[:, inside] = shapes.T
    spectra = scipy.fft.rfft2(grid, padded)
    masses, resistances = [], []
    for hz in _HZ:
        pushed = [
            scipy.fft.irfft2(spectra * scipy.fft.rfft2(kernel), padded)[
                :, : inside.shape[0], : inside.shape[1]
            ][:, inside]
            for kernel in _kernels(distance_m, 2 * np.pi * hz / SOUND_M_S)
        ]
        scale = fraction * AIR_DENSITY_KG_M3 / (2 * np.pi) * _GRID_M**4
        in_phase, behind = (scale * (part @ shapes) for part in pushed)
        masses.append(0.5 * (in_phase + in_phase.T))
        resistances.append(np.pi * hz * (behind + behind.T))
    return np.stack(masses), np.stack(resistances)


def _kernels(distance_m: Array, wavenumber: float) -> tuple[Array, Array]:
    """cos(kR)/R and sin(kR)/R, averaged over the cell at R = 0."""
    safe_m = np.where(distance_m > 0, distance_m, 1.0)
    in_phase, behind = np.cos(wavenumber * safe_m) / safe_m, np.sin(wavenumber * safe_m) / safe_m
    # Mean of 1/R over a square, from its centre.
    in_phase[0, 0], behind[0, 0] = 4 * np.log(1 + np.sqrt(2)) / _GRID_M, wavenumber
    return in_phase, behind
