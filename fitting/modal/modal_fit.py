"""The result of the joint fit of modes."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

from fitting.modal.drive.prior import DriveForm
from fitting.modal.model import State
from fitting.modal.posterior import ResonantDisplacements
from holography.arrays import Array, ComplexArray

# Fewest other modes whose losses show a power of frequency. Chosen: half of them may be wrong.
_FEWEST_OF_A_POWER = 4
# Part of the width of a mode that may be left out without a gap. Chosen: half of what it is from
# its peak to half of its power; in steps of 25 cents, two neighbours are more (decision 0077).
_MOST_LEFT_OUT = 0.25


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
    influence : (3a, k, 2j) float
        How these, and the logs of displacements at resonance, follow the amplitudes of holograms
        (real, then imaginary parts).
    shapes : (a, j) float
        Coordinates of the shapes in the `ShapeBasis`.
    mixing, mixing_error, mixing_spread : (m, a) float
        Coefficient of each shape of the basis in the shape of each of these modes, in addition to
        the shape of the finite elements; its standard error; standard deviation of its prior. 0
        where no mixing is allowed.
    mixing_factor : float
        By which those priors are wider than a perturbation of usual size gives (decision 0083).
    participation : (a,) complex
        Participation at the mode's own frequency, per unit of drive, with what other modes add.
    participation_error : (a,) float
        Standard error of its magnitude for a given drive.
    by_pressure : (a,) complex
        The same without what other modes add.
    by_pressure_error : (a,) float
    participations : (k, a) complex
        Those at all frequencies.
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
    magnitude_error : (k,) float
        Standard error of the magnitude of the object field in each hologram, in nepers.
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
    influence: Array
    shapes: Array
    mixing: Array
    mixing_error: Array
    mixing_spread: Array
    mixing_factor: float
    participation: ComplexArray
    participation_error: Array
    by_pressure: ComplexArray
    by_pressure_error: Array
    participations: ComplexArray
    drive: ComplexArray
    amplitude_rad: ComplexArray
    modal_rad: ComplexArray
    misfit: float
    discrepancy: float
    common_mode_shift: Array
    field_walk: float
    common_mode_covariance: Array
    magnitude_error: Array
    resonant: ResonantDisplacements
    log_drive_covariance: Array
    drive_forms: tuple[DriveForm, ...]
    off: NDArray[np.bool_]
    state: State

    def with_errors(self, more: Array) -> Self:
        """Return the same modes with further errors, of covariance (3a, 3a).

        They are those of log frequencies, log loss factors and logs of displacements.
        """
        logs = len(self.covariance)
        covariance = self.covariance + more[:logs, :logs]
        resonant = self.resonant.with_errors(np.diag(more)[logs:])
        of_hz, of_loss = np.split(np.sqrt(np.diag(covariance)), 2)
        cents = of_hz * 1200 / np.log(2)
        return replace(
            self,
            covariance=covariance,
            error_cents=cents,
            loss_error=of_loss,
            resonant=resonant,
        )

    def loss_over_others(self, mode: int) -> float:
        """Return the loss factor of a mode over that of the others, 1 if it is the only one.

        That of the others is their median. If there are enough, it is a power of frequency, up to
        that of a dashpot: then losses of all modes may grow with frequency.

        Parameters
        ----------
        mode : int
            Position among the fitted modes.
        """
        log_hz, log_loss = np.log(self.hz / self.hz[mode]), np.log(self.loss_factor)
        others = np.arange(len(log_hz)) != mode
        if not others.any():
            return 1.0
        power = 0.0
        if np.count_nonzero(others) >= _FEWEST_OF_A_POWER:
            power = float(np.clip(theilslopes(log_loss[others], log_hz[others])[0], -1, 1))
        expected = np.median(log_loss[others] - power * log_hz[others])
        return float(np.exp(log_loss[mode] - expected))

    def is_left_out(self, mode: int, drive_hz: Array) -> bool:
        """Whether most of a resonance, or a part of it without a gap, is left out.

        Parameters
        ----------
        mode : int
            Position among the fitted modes.
        drive_hz : (k,) float
            Drive frequencies, in any order.
        """
        width, away = float(self.loss_factor[mode]), np.log(drive_hz / self.hz[mode])
        near = np.flatnonzero(np.abs(away) < width)
        near = near[np.argsort(away[near])]
        off = np.flatnonzero(self.off[near])
        if 2 * off.size > near.size:
            return True
        runs = np.split(away[near[off]], np.flatnonzero(np.diff(off) > 1) + 1)
        return any(run.size and run[-1] - run[0] > _MOST_LEFT_OUT * width for run in runs)
