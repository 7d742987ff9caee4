"""Modes that a plausible reed would show in a sweep, with their derivatives."""

from dataclasses import dataclass

import numpy as np

from holography.arrays import Array
from physics.plausible.nearby import NearbyReeds
from physics.plausible.reeds import PlausibleReeds


@dataclass(frozen=True)
class Prediction:
    """Modes (m) of a reed with p parameters, as they are seen in j coordinates.

    Attributes
    ----------
    nearby : NearbyReeds
    seen : (j, m) float
        Coordinates in the `ShapeBasis` of the modes of `nearby`.
    parameters : (p,) float
    ln_hz, by_ln_hz : (m,) and (m, p) float
    shape, by_shape : (m, j) and (m, j, p) float
        Of unit length.
    ln_size, by_ln_size : (m,) and (m, p) float
        Logarithm of the length of what is seen of each mode, of unit mass.
    """

    nearby: NearbyReeds
    seen: Array
    parameters: Array
    ln_hz: Array
    by_ln_hz: Array
    shape: Array
    by_shape: Array
    ln_size: Array
    by_ln_size: Array

    def at(self, parameters: Array) -> "Prediction":
        """Return the prediction for other parameters (p,), with the cane linearised here."""
        return _predicted(self.nearby, self.seen, parameters)

    @property
    def ln_levels(self) -> Array:
        """Logarithm of the frequency (r,) that each mode of the reference would have alone."""
        _, mixing = self.nearby.modes(self.parameters)
        fraction = (self.nearby.turned @ mixing) ** 2
        return np.asarray(fraction @ self.ln_hz / fraction.sum(axis=1))


def predict(reeds: PlausibleReeds, visible: Array, parameters: Array) -> Prediction:
    """Predict the modes of a reed.

    Parameters
    ----------
    reeds : PlausibleReeds
    visible : (j, s) float
        Coordinates in the `ShapeBasis` of what is seen of each coordinate of the reed.
    parameters : (p,) float

    Raises
    ------
    ImpossibleReedError
        If no material has its moduli.
    """
    nearby = reeds.near(parameters)
    return _predicted(nearby, visible @ nearby.found.coordinates, parameters)


def _predicted(nearby: NearbyReeds, seen: Array, parameters: Array) -> Prediction:
    hz, mixing = nearby.modes(parameters)
    by_ln_hz, by_mixing = nearby.slopes(parameters)
    shape, by_shape = (seen @ mixing).T, np.einsum("ja,amp->mjp", seen, by_mixing, optimize=True)
    # What moves in the plane only has no shape.
    length = np.maximum(np.linalg.norm(shape, axis=1), 1e-30)
    shape, by_shape = shape / length[:, None], by_shape / length[:, None, None]
    return Prediction(
        nearby=nearby,
        seen=seen,
        parameters=parameters,
        ln_hz=np.log(hz),
        by_ln_hz=by_ln_hz,
        shape=shape,
        by_shape=by_shape,
        ln_size=np.log(length),
        by_ln_size=np.einsum("mj,mjp->mp", shape, by_shape),
    )
