"""Map the residuals of the joint fit on the surface of the reed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.displacement import explained_amplitudes
from fitting.modal.identify import JointFit
from holography.arrays import Array

# Side of a cell of a residual map.
_CELL_M = 2e-3


@dataclass(frozen=True)
class ResidualMap:
    """Residuals of the holograms at a resonance, in cells of the reed's surface.

    Attributes
    ----------
    x_m, y_m : (c,) float
        Centres of the cells.
    value : (c,) float
        Mean square residual of the block amplitudes, in units of the noise: 1 is noise alone.
    """

    x_m: Array
    y_m: Array
    value: Array

    def to_json(self) -> dict[str, list[float]]:
        """Return the map with stable keys, places in mm."""
        return {
            "x_mm": [round(1e3 * float(x), 3) for x in self.x_m],
            "y_mm": [round(1e3 * float(y), 3) for y in self.y_m],
            "value": [round(float(v), 2) for v in self.value],
        }


def squared_residual(fit: JointFit, holograms: NDArray[np.intp]) -> Array:
    """Return the squared residuals (s, n) of holograms (s,), in units of the noise."""
    explained = explained_amplitudes(fit.block_amplitudes, fit.basis, fit.displacements)
    left = (fit.block_amplitudes.value.T - explained)[holograms]
    square: Array = left.real**2 + left.imag**2
    return square


def residual_map(fit: JointFit, name: str) -> ResidualMap:
    """Map the mean residual of the three holograms nearest to a mode's resonance.

    Parameters
    ----------
    fit : JointFit
    name : str
        Name of one of its modes.
    """
    block_amplitudes = fit.block_amplitudes
    hz = fit.modal.hz[fit.names.index(name)]
    nearest = np.argsort(np.abs(np.log(block_amplitudes.drive_hz / hz)))[:3]
    square = squared_residual(fit, nearest).mean(axis=0)
    cells = np.stack(
        [np.floor(block_amplitudes.x_m / _CELL_M), np.floor(block_amplitudes.y_m / _CELL_M)], axis=1
    )
    places, which = np.unique(cells, axis=0, return_inverse=True)
    mean = np.bincount(which.ravel(), square) / np.bincount(which.ravel())
    x_m, y_m = ((places + 0.5) * _CELL_M).T
    return ResidualMap(x_m, y_m, mean)
