"""What amplitudes may be off: noise, and what no model explains.

The latter is a share of the vibration of each hologram, alike in neighbouring ones, and the same in
all directions. It is estimated from what a fit leaves.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from fitting.holograms.displacement import Displacements
from fitting.modal.normal_equations import Data

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

# Standard deviations that discrepancy may have, as shares of a hologram's vibration.
_DISCREPANCY = (1e-4, 0.3)
# Prior standard deviation of amplitudes, rad: only against what the data do not tell at all.
_LOOSE_RAD = 100.0
# Holograms so many steps apart may still be alike in what no model explains.
_FAR = 10
# Holograms are off if what is left of them is that many times as much as usual, squared.
_OFF = 10.0


@dataclass(frozen=True)
class Noise:
    """Noise of amplitudes, in directions in which it is independent.

    Attributes
    ----------
    directions : (k, 2j, 2j) float
        One in each row.
    variance : (k, 2j) float
        Along them.
    power : (k,) float
        Mean square of a hologram's amplitudes.
    inflation : (k,) float
        Factor on the variance of holograms that show something else.
    """

    directions: Array
    variance: Array
    power: Array
    inflation: Array

    def deviation(self, discrepancy: float) -> Array:
        """Standard deviation (k, 2j) along the directions, with discrepancy."""
        variance = self.variance + discrepancy**2 * self.power[:, None]
        deviation: Array = np.sqrt(self.inflation[:, None] * variance)
        return deviation


def noise_of(displacements: Displacements) -> Noise:
    """Diagonalise what is known of every hologram's amplitudes."""
    information, directions = np.linalg.eigh(displacements.information)
    return Noise(
        directions.swapaxes(1, 2),
        1 / (np.maximum(information, 0) + _LOOSE_RAD**-2),
        np.mean(np.abs(displacements.amplitude_rad) ** 2, axis=1),
        np.ones(len(displacements.amplitude_rad)),
    )


def inflated(noise: Noise, apart: Array) -> Noise:
    """Trust holograms less that are off (k, 2j), in deviations, by far more than others."""
    square = np.mean(apart**2, axis=1) * noise.inflation
    usual = max(float(np.median(square)), 1.0)
    return replace(noise, inflation=np.where(square > _OFF * usual, square / usual, 1.0))


def data_of(displacements: Displacements, noise: Noise, discrepancy: float) -> Data:
    """Tell what holograms tell if the model is off by a share of each hologram's amplitude."""
    shared = displacements.shared
    root = noise.directions / noise.deviation(discrepancy)[..., None]
    return Data(displacements.amplitude_rad, root, root @ shared.response, shared.precision)


def balanced(noise: Noise, left: Array, freedoms: float) -> float:
    """Discrepancy with which what is left (k, 2j), along the directions, is what it should be."""

    def excess(log_discrepancy: float) -> float:
        return float(np.sum((left / noise.deviation(np.exp(log_discrepancy))) ** 2)) - freedoms

    least, most = np.log(_DISCREPANCY)
    if excess(least) <= 0:
        return _DISCREPANCY[0]
    if excess(most) >= 0:
        return _DISCREPANCY[1]
    return float(np.exp(optimize.brentq(excess, least, most, xtol=1e-3)))


def alike(noise: Noise, apart: Array, log_drive: Complex) -> float:
    """How many holograms tell as much as one would if what is left of each were its own.

    What no model explains is alike in neighbouring holograms, up to the phase of the drive: the sum
    of correlations over distances.
    """
    left = (noise.directions.swapaxes(1, 2) @ apart[..., None])[..., 0]
    size = left.shape[1] // 2
    turned = (left[:, :size] + 1j * left[:, size:]) * np.exp(-1j * log_drive.imag)[:, None]
    whole = np.sum(np.abs(turned) ** 2)
    correlation = [
        np.sum(turned[:-lag].conj() * turned[lag:]).real / whole for lag in range(1, _FAR + 1)
    ]
    return max(1.0, 1 + 2 * float(np.sum(correlation)))
