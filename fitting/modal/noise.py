"""Errors of the amplitudes: measurement noise, and discrepancy of the model.

The discrepancy is a fraction of the vibration of each hologram, correlated between neighbouring
holograms and equal in all directions. It is estimated from the residuals of a fit. Noise is not
correlated: in a fit, only the discrepancy counts as often as holograms share it (decision 0081).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import optimize

from fitting.holograms.linearisation import triangle
from fitting.holograms.solved_sweep import Displacements
from fitting.modal.field_drift import FieldDrift, SharedError
from fitting.modal.model import LOSS_PARAMETERS
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
class Data:
    """Amplitudes of all holograms, with the root of their information.

    Attributes
    ----------
    amplitude : (k, j) complex
    root : (k, 2j, 2j) float
        Root of the information on the real, then imaginary parts of the amplitudes.
    response : (k, 2j, q) float
        Derivatives of the amplitudes by the common-mode error of each hologram, times that root.
    drift : FieldDrift
        How this follows from the parameters that all holograms share.
    precision : (p, p) float
        Inverse covariance of these parameters.
    pull : (p,) float
        This times their expectation.
    """

    amplitude: ComplexArray
    root: Array
    response: Array
    drift: FieldDrift
    precision: Array
    pull: Array

    def whitened_residual(self, amplitude: ComplexArray, shared: Array) -> Array:
        """Return the whitened residuals (k, 2j) of amplitudes (k, j) that a model predicts."""
        whitened_residual = self.root @ parts(self.amplitude - amplitude)[..., None]
        shift = self.drift.shift(shared)[:, LOSS_PARAMETERS:]
        found: Array = (whitened_residual + self.response @ shift[..., None])[..., 0]
        return found

    @cached_property
    def information(self) -> Array:
        """Information (k, 2j, 2j) on the amplitudes."""
        found: Array = self.root.swapaxes(1, 2) @ self.root
        return found

    @cached_property
    def seen(self) -> Array:
        """Sum (k,) of the information on the amplitudes of each hologram."""
        found: Array = np.sum(self.root**2, axis=(1, 2))
        return found

    @cached_property
    def pulls(self) -> Array:
        """Responses (k, 2j, q) to the common-mode error, as the amplitudes feel them."""
        found: Array = self.root.swapaxes(1, 2) @ self.response
        return found

    @cached_property
    def drifting_pulls(self) -> Array:
        """Those of `pulls` that drift, (k, 2, j r), for real and imaginary parts."""
        which = self.drift.drifting - LOSS_PARAMETERS
        count, size = len(self.pulls), self.amplitude.shape[1] * len(which)
        return np.ascontiguousarray(self.pulls[:, :, which]).reshape(count, 2, size)

    @cached_property
    def coordinate_pairs(self) -> Array:
        """Information (2, 2, k, p) on pairs of coordinates, of which the first is not the larger.

        The first axes are real or imaginary parts of the first, and of the second coordinate.
        """
        count, size = len(self.root), self.root.shape[1] // 2
        one, other = triangle(size)
        parts = self.information.reshape(count, 2, size, 2, size).transpose(1, 3, 0, 2, 4)
        return np.ascontiguousarray(parts[..., one, other])

    @cached_property
    def common_mode_products(self) -> Array:
        """Products (p, p) of the responses to the parameters that all holograms share.

        Those of losses are left 0: they depend on the state.
        """
        rows = LOSS_PARAMETERS + self.response.shape[2]
        products = np.zeros((rows, rows, len(self.response)))
        each = self.response.swapaxes(1, 2) @ self.response
        products[LOSS_PARAMETERS:, LOSS_PARAMETERS:] = each.transpose(1, 2, 0)
        return self.drift.products(products)


def parts(complex_rows: ComplexArray) -> Array:
    """Concatenate real and imaginary parts: (k, j) → (k, 2j)."""
    return np.concatenate([complex_rows.real, complex_rows.imag], axis=1)


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

    def deviation(self, discrepancy: float, sharing: float = 1.0) -> Array:
        """Return the standard deviation (k, 2j) along the directions, including discrepancy.

        Parameters
        ----------
        discrepancy : float
        sharing : float
            Number of neighbours that have one discrepancy, where the deviation is that of their
            mean times the root of their number.
        """
        variance = self.variance + sharing * discrepancy**2 * self.power[:, None]
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


def data_of(amplitude: ComplexArray, shared: SharedError, noise: Noise, deviation: Array) -> Data:
    """Whiten amplitudes (k, j) by their standard deviations (k, 2j), see `Noise.deviation`."""
    root = noise.directions / deviation[..., None]
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


def sharing_holograms(
    noise: Noise, whitened_residual: Array, log_drive: ComplexArray, discrepancy: float
) -> float:
    """Return the number of neighbouring holograms that have one discrepancy.

    The discrepancies of neighbouring holograms are correlated, up to the phase of the drive. The
    number is the sum of their correlations over all distances (integrated autocorrelation), at
    least 1. Products of residuals have the noise of the residuals, but nothing of it in the mean;
    each counts as the noise there allows.

    Parameters
    ----------
    noise : Noise
    whitened_residual : (k, 2j) float
        Residuals along the directions of the noise, over `Noise.deviation`.
    log_drive : (k,) complex
    discrepancy : float
        With which the deviations were found.
    """
    directions = _turned(noise.directions, -log_drive.imag)
    weighed = (directions.swapaxes(1, 2) @ whitened_residual[..., None])[..., 0]
    weights = directions.swapaxes(1, 2) @ (directions / noise.deviation(discrepancy)[..., None])
    # What one discrepancy adds to the products of two holograms, for a correlation of 1. What makes
    # a hologram an outlier is its own.
    size = discrepancy * np.sqrt(noise.power)
    whole = 1.0
    for lag in range(1, min(_FAR, len(weighed) - 1) + 1):
        found = float(np.sum(weighed[:-lag] * weighed[lag:]))
        expected = np.sum(weights[:-lag] * weights[lag:], axis=(1, 2)) @ (size[:-lag] * size[lag:])
        # No correlation is beyond 1, whatever noise makes of it.
        within = float(np.clip(found, -expected, expected))
        whole += 2 * within / max(float(expected), np.finfo(float).tiny)
    return max(1.0, whole)


def _turned(directions: Array, phase: Array) -> Array:
    """Turn directions (k, r, 2j) of complex amplitudes by the phase of each hologram (k,)."""
    size = directions.shape[2] // 2
    turned = directions[..., :size] + 1j * directions[..., size:]
    turned = turned * np.exp(1j * phase)[:, None, None]
    return np.concatenate([turned.real, turned.imag], axis=2)
