"""Errors of the amplitudes: measurement noise, and discrepancy of the model.

The discrepancy is a fraction of the vibration of each hologram, correlated between neighbouring
holograms and equal in all directions. It is estimated from the residuals of a fit.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from fitting.holograms.displacement import Displacements
from fitting.modal.field_drift import SharedError
from fitting.modal.normal_equations import Data
from holography.arrays import Array, ComplexArray

# Limits of the discrepancy's standard deviation, as a fraction of a hologram's vibration.
_DISCREPANCY = (1e-4, 0.3)
# Prior standard deviation of amplitudes, rad: weak, for directions that the data do not determine.
_LOOSE_RAD = 100.0
# Largest distance in steps at which residuals may be correlated.
_FAR = 10
# A hologram is an outlier if its mean square residual exceeds the median by this factor.
_OFF = 10.0


@dataclass(frozen=True)
class Noise:
    """Noise of amplitudes, in directions in which it is independent.

    Attributes
    ----------
    directions : (k, 2j, 2j) float
        One direction in each row.
    variance : (k, 2j) float
        Variance along each direction.
    power : (k,) float
        Mean square of a hologram's amplitudes.
    inflation : (k,) float
        Factor on the variance of holograms that are outliers.
    """

    directions: Array
    variance: Array
    power: Array
    inflation: Array

    def deviation(self, discrepancy: float) -> Array:
        """Return the standard deviation (k, 2j) along the directions, including discrepancy."""
        variance = self.variance + discrepancy**2 * self.power[:, None]
        deviation: Array = np.sqrt(self.inflation[:, None] * variance)
        return deviation


def noise_of(displacements: Displacements) -> Noise:
    """Diagonalise the information of every hologram's amplitudes."""
    information, directions = np.linalg.eigh(displacements.information)
    return Noise(
        directions.swapaxes(1, 2),
        1 / (np.maximum(information, 0) + _LOOSE_RAD**-2),
        np.mean(np.abs(displacements.amplitude_rad) ** 2, axis=1),
        np.ones(len(displacements.amplitude_rad)),
    )


def inflated(noise: Noise, whitened_residual: Array) -> Noise:
    """Increase the variance of holograms whose whitened residuals (k, 2j) are outliers."""
    square = np.mean(whitened_residual**2, axis=1) * noise.inflation
    usual = max(float(np.median(square)), 1.0)
    return replace(noise, inflation=np.where(square > _OFF * usual, square / usual, 1.0))


def data_of(amplitude: ComplexArray, shared: SharedError, noise: Noise, discrepancy: float) -> Data:
    """Whiten amplitudes (k, j) by noise and a given discrepancy of the model."""
    root = noise.directions / noise.deviation(discrepancy)[..., None]
    response = root @ shared.response
    return Data(amplitude, root, response, shared.drift, shared.precision, shared.pull)


def balanced(noise: Noise, left: Array, freedoms: float) -> float:
    """Return the discrepancy for which residuals (k, 2j) have the χ² expected of `freedoms`."""

    def excess(log_discrepancy: float) -> float:
        return float(np.sum((left / noise.deviation(np.exp(log_discrepancy))) ** 2)) - freedoms

    least, most = np.log(_DISCREPANCY)
    if excess(least) <= 0:
        return _DISCREPANCY[0]
    if excess(most) >= 0:
        return _DISCREPANCY[1]
    return float(np.exp(optimize.brentq(excess, least, most, xtol=1e-3)))


def correlated_holograms(noise: Noise, whitened_residual: Array, log_drive: ComplexArray) -> float:
    """Return the number of neighbouring holograms that count as one independent hologram.

    The residuals of neighbouring holograms are correlated, up to the phase of the drive. The number
    is the sum of their correlations over all distances (integrated autocorrelation), at least 1.
    """
    left = (noise.directions.swapaxes(1, 2) @ whitened_residual[..., None])[..., 0]
    size = left.shape[1] // 2
    turned = (left[:, :size] + 1j * left[:, size:]) * np.exp(-1j * log_drive.imag)[:, None]
    whole = np.sum(np.abs(turned) ** 2)
    correlation = [
        np.sum(turned[:-lag].conj() * turned[lag:]).real / whole for lag in range(1, _FAR + 1)
    ]
    return max(1.0, 1 + 2 * float(np.sum(correlation)))
