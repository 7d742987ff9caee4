"""The result of the joint fit of modes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.modal.model import (
    State,
)

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True)
class ModalFit:
    """Modes of a sweep.

    Attributes
    ----------
    names : tuple of str
        Of the a modes whose resonance lies in the sweep.
    hz, loss_factor : (a,) float
        Eigenfrequencies and loss factors.
    error_cents, loss_error : (a,) float
        Standard errors; of the loss factor, relative.
    covariance : (2a, 2a) float
        Of log frequencies, then of log loss factors.
    shapes : (a, j) float
        Coordinates of the shapes in the `ShapeBasis`.
    mixing, mixing_error, mixing_spread : (m, a) float
        By how much of each mode's shape in the basis each of these modes has more than by the
        finite elements, its standard error and that of its prior; 0 where none is allowed.
    participation : (a,) complex
        At the mode's own frequency, per unit of drive.
    participation_error : (a,) float
        Standard error of its magnitude, beside a given drive.
    participations : (k, a) complex
        At all frequencies.
    drive : (k,) complex
        Of every hologram; the phase is arbitrary.
    amplitude_rad : (k, j) complex
        As the model has it.
    modal_rad : (k, a) complex
        Largest deflection of every mode in every hologram.
    misfit : float
        Mean square of what is left, in units of noise and discrepancy.
    discrepancy : float
        See `_Stage`, as estimated.
    together : (q,) float
        What displacements are off together (see `fitting.holograms.object_field.SharedError`).
    off : (k,) bool
        Holograms that show something else, by far, or nothing that was told.
    state : State
    """

    names: tuple[str, ...]
    hz: Array
    error_cents: Array
    loss_factor: Array
    loss_error: Array
    covariance: Array
    shapes: Array
    mixing: Array
    mixing_error: Array
    mixing_spread: Array
    participation: Complex
    participation_error: Array
    participations: Complex
    drive: Complex
    amplitude_rad: Complex
    modal_rad: Complex
    misfit: float
    discrepancy: float
    together: Array
    off: NDArray[np.bool_]
    state: State
