"""The result of the joint fit of modes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.modal.drive_prior import DriveForm
from fitting.modal.model import State
from fitting.modal.posterior import ResonantDisplacements
from holography.arrays import Array, ComplexArray


@dataclass(frozen=True)
class ModalFit:
    """Modes of a sweep.

    Attributes
    ----------
    names : tuple of str
        Names of the a modes whose resonance lies in the sweep.
    hz, loss_factor : (a,) float
        Eigenfrequencies and loss factors, these with the stiffening of mean cane.
    error_cents, loss_error : (a,) float
        Standard errors; that of the loss factor is relative.
    covariance : (2a, 2a) float
        Covariance of log frequencies, then of log loss factors.
    shapes : (a, j) float
        Coordinates of the shapes in the `ShapeBasis`.
    mixing, mixing_error, mixing_spread : (m, a) float
        Coefficient of each shape of the basis in the shape of each of these modes, in addition to
        the shape of the finite elements; its standard error; standard deviation of its prior. 0
        where no mixing is allowed.
    participation : (a,) complex
        Participation at the mode's own frequency, per unit of drive.
    participation_error : (a,) float
        Standard error of its magnitude for a given drive.
    participations : (k, a) complex
        Participations at all frequencies.
    drive : (k,) complex
        Drive of every hologram; its phase is arbitrary.
    amplitude_rad : (k, j) complex
        Amplitudes that the model predicts.
    modal_rad : (k, a) complex
        Largest deflection of every mode in every hologram.
    misfit : float
        Mean square residual, in units of noise and discrepancy.
    discrepancy : float
        Estimated discrepancy of the model, as a fraction of a hologram's rms amplitude.
    common_mode_shift : (k, q) float
        Fitted common-mode error of every hologram's displacements (see
        `fitting.holograms.object_field.CommonModeError`).
    field_walk : float
        Standard deviation of the change of its coefficients from one hologram to the next, in
        nepers and rad (see `fitting.modal.field_drift`).
    common_mode_covariance : (k, q, q) float
        Its covariance.
    resonant : ResonantDisplacements
        Displacement of every mode at its own resonance.
    log_drive_covariance : (k, k) float
        Covariance of the log magnitude of the drive. A factor that is common to all holograms, and
        varies smoothly, can move between drive and participations: it is in this covariance.
    drive_forms : tuple of DriveForm
        Explanations of the drive that are not improbable, the best first.
    off : (k,) bool
        Holograms that are outliers, or that have no information.
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
    participation: ComplexArray
    participation_error: Array
    participations: ComplexArray
    drive: ComplexArray
    amplitude_rad: ComplexArray
    modal_rad: ComplexArray
    misfit: float
    discrepancy: float
    common_mode_shift: Array
    field_walk: float
    common_mode_covariance: Array
    resonant: ResonantDisplacements
    log_drive_covariance: Array
    drive_forms: tuple[DriveForm, ...]
    off: NDArray[np.bool_]
    state: State

    def loss_over_others(self, mode: int) -> float:
        """Return the loss factor of a mode over the median of all others, 1 if it is the only one.

        Parameters
        ----------
        mode : int
            Position among the fitted modes.
        """
        others = np.delete(self.loss_factor, mode)
        return float(self.loss_factor[mode] / np.median(others)) if others.size else 1.0
