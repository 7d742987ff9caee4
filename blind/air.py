"""Air that a reed in free air moves along: Ritz's method in the plane of wavenumbers.

The potential jumps across a plate that moves with w(x) by what makes ``½⟨φ, Nφ⟩ - ⟨φ, w⟩``
stationary; in the plane of wavenumbers κ, N is a factor ``½√(κ² - k²)``. Jumps are polynomials
times the root with which they vanish at an edge. Sound that is radiated is left out.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from blind.reed import ModalReed
from blind.shape import half_width_m

Array = NDArray[np.floating[Any]]

_SOUND_M_S, _AIR_KG_M3 = 343.4, 1.2
# The reed behind this hardly moves and lies on its mouthpiece.
_END_M = 46e-3
# Degrees of the polynomials along the reed and across it, and the grid of the transform. Chosen:
# with 20, 9 and 0.3 mm no mode moves by more than a cent.
_ALONG, _ACROSS = 15, 6
_STEP_M, _GRID = 0.4e-3, (512, 128)


def air_masses(reed: ModalReed, each_hz: Array) -> Array:
    """Mass (f, m, m) of air on both sides of the modes of a reed."""
    x = (np.arange(_GRID[0]) + 0.5) * _STEP_M
    y = (np.arange(_GRID[1]) + 0.5 - _GRID[1] / 2) * _STEP_M
    X, Y = np.meshgrid(x, y, indexing="ij")
    jumps = _jumps(X.ravel(), Y.ravel()).reshape(*_GRID, -1)
    seen = np.fft.fft2(jumps, axes=(0, 1)) * _STEP_M**2
    kx, ky = (2 * np.pi * np.fft.fftfreq(n, _STEP_M) for n in _GRID)
    squares = np.add.outer(kx**2, ky**2).ravel()
    flat = seen.reshape(len(squares), -1)
    # Only half of a real function's transform is its own.
    half = np.flatnonzero(np.add.outer(kx >= 0, 0 * ky).ravel() > 0)
    weights = np.where(np.repeat(kx[kx >= 0] > 0, _GRID[1]), 2.0, 1.0)
    area = np.prod(_GRID) * _STEP_M**2
    on_top = _jumps(*reed.top_m.T)
    pushed = on_top.T @ (reed.top_area_m2[:, None] * reed.top)
    masses = []
    for hz in each_hz.tolist():
        k2 = (2 * np.pi * hz / _SOUND_M_S) ** 2
        symbol = 0.5 * np.sqrt(np.maximum(squares[half] - k2, 0.0)) * weights / area
        N = (flat[half].conj().T @ (symbol[:, None] * flat[half])).real
        masses.append(_AIR_KG_M3 * pushed.T @ np.linalg.solve(N, pushed))
    return np.stack(masses)


def _jumps(x: Array, y: Array) -> Array:
    """Functions (n, j) of the plan that vanish like roots at the edges."""
    wide = half_width_m(x)
    edge = np.sqrt(np.maximum(wide**2 - y**2, 0.0) * np.maximum(_END_M - x, 0.0))
    edge = np.where(x > 0, edge, 0.0)
    along = np.polynomial.legendre.legvander(np.clip(2 * x / _END_M - 1, -1, 1), _ALONG)
    across = np.polynomial.legendre.legvander(np.clip(y / np.maximum(wide, 1e-6), -1, 1), _ACROSS)
    both = (along[:, :, None] * across[:, None, :]).reshape(len(x), -1)
    found = edge[:, None] * both
    return np.asarray(found / np.abs(found).max(axis=0))
