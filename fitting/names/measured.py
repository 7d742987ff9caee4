"""What a modal fit has measured of each mode: its frequency and its shape, with their errors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.modal.modal_fit import ModalFit
from holography.arrays import Array


@dataclass(frozen=True)
class MeasuredModes:
    """Frequencies and shapes of modes (a) of a sweep.

    Attributes
    ----------
    index : (a,) int
        Which of the modes of the `ModalFit` these are.
    ln_hz, error : (a,) float
        Logarithm of the frequency, and its standard error.
    shape : (a, j) float
        Coordinates in the `ShapeBasis`, of length 1.
    directions, variance : (a, j, j) and (a, j) float
        Orthonormal directions in which the errors of each shape are independent, in rows, and the
        variance along each. Along the shape itself it is 0: size says nothing of a name.
    ln_strength, strength_error : (a,) float
        Logarithm of a mode's participation, times ω² and the length of its shape, and the standard
        error. It is the square of what is visible of the mode, of unit mass, times the force of the
        drive on a unit of that.
    """

    index: NDArray[np.intp]
    ln_hz: Array
    error: Array
    shape: Array
    directions: Array
    variance: Array
    ln_strength: Array
    strength_error: Array


def measured_modes(modal: ModalFit, index: NDArray[np.intp]) -> MeasuredModes:
    """Return what is measured of some modes of a fit.

    The covariance of a shape contains its mixing and the common-mode error of all displacements.

    Parameters
    ----------
    modal : ModalFit
    index : (a,) int
        Modes whose amplitude and frequency are known well enough. In a mode that hardly shows, the
        shape would be the one that the fit expected.
    """
    size = modal.resonant.amplitude_rad[index]
    length = np.linalg.norm(size, axis=1, keepdims=True)
    shape = size / length
    across = np.eye(shape.shape[1]) - shape[:, :, None] * shape[:, None, :]
    covariance = across @ modal.resonant.covariance[index] @ across / length[..., None] ** 2
    variance, directions = np.linalg.eigh(covariance)
    deviation = np.sqrt(np.diag(modal.covariance)[: len(modal.names)])
    strength = np.abs(modal.participation[index]) * modal.hz[index] ** 2
    return MeasuredModes(
        index=index,
        ln_hz=np.log(modal.hz[index]),
        error=deviation[index],
        shape=shape,
        directions=np.swapaxes(directions, 1, 2),
        variance=np.maximum(variance, 0.0),
        ln_strength=np.log(strength * np.linalg.norm(modal.shapes[index], axis=1)),
        strength_error=modal.participation_error[index] / np.abs(modal.participation[index]),
    )
