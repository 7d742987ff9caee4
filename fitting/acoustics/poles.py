"""Find excitation peaks: resonances that the fitted drive of one sweep has passed through.

The joint fit has a free drive for every hologram, so that an acoustic resonance moves no mode but
shows in the drive. Its phase is unknown in every hologram, so only its magnitude is used. Resonant
paths in parallel to the direct one multiply the pressure by

    1 + Σ c / (1 − (f/f₀)² + i f/(f₀ Q))

The drive is largest below the pole f₀ if c is positive, because the two paths cancel above it. The
pole is therefore fitted, not the largest value: f₀, Q and complex c of all peaks together, over the
smooth drive of a loudspeaker (`fitting.modal.drive.prior`) and with the covariance of the drive.

In one sweep a peak of the drive may still belong to the reed, if no mode explains it. A peak at the
same frequency in several reeds does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import linalg
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import chi2

from fitting.modal.drive.prior import LEAST_GAIN, quiet_ripple
from holography.arrays import Array, Mask

# Least height of a line in dB: ripple of loudspeakers reaches 3 dB. Most lines of a drive.
_LEAST_DB, _MOST_LINES = 2.6, 8
# Quality factors with which a line is looked for, and frequencies per step of the sweep.
_LOOKED_FOR, _PER_STEP = (8.0, 16.0, 32.0, 64.0), 2
# Prior of a quality factor: cavities and loudspeakers have 3 to 100, see
# `physics.parameters.drive.AcousticResonance`; that is two standard deviations to either side.
_LOG_QUALITY, _LOG_QUALITY_SD = np.log(17.0), 0.9
# Prior standard deviations of the log frequency around where a line is looked for, and of both
# parts of the strength c: weak, for peaks that do not determine them.
_LOG_HZ_SD, _STRENGTH_SD = 0.05, 1.0
_SPREAD = np.array([_LOG_HZ_SD, _LOG_QUALITY_SD, _STRENGTH_SD, _STRENGTH_SD])
# Starts of the search. Chosen: a search from any one of them ends in another minimum for some of
# the lines of the tests.
_QUALITIES, _PHASES = (10.0, 40.0), (0.0, 1.2, -1.2, np.pi)
# Evaluations after which starts are compared: a Gauss-Newton search that is near a minimum takes
# ten or fewer, and one that is not creeps along a valley.
_EVALUATIONS = 40
# When the search from the best ends. With the limits of the library, what is only rounding moved
# errors of modes in the sixth digit.
_CONVERGED = 1e-12
# Probability with which χ² of a drive without a line may decrease as much by its four parameters,
# at any of its frequencies.
_BY_CHANCE = 1e-3
# Log variance of the drive of holograms that are outliers, nepers².
_OFF = 1.0
# A peak is next to a mode that is this near: two widths at half power of a mode with a loss factor
# of 0.03, 52 cents each.
NEXT_TO_CENTS = 100.0
# ... and within one: there, the fit divides one resonance between both.
WITHIN_CENTS = 52.0
# A resonance in parallel to a direct path seldom amplifies more: cavities next to the beam of a
# tweeter show 3 to 12 dB. Chosen: the line of the paper's bench has some 10 dB.
MOST_DB = 15.0
# Frequencies around a pole at which its height is looked for, in half widths.
_NEAR = np.linspace(-3, 3, 241)
_DB_PER_NEPER = 20 / np.log(10)
_PARAMETERS = 4


@dataclass(frozen=True)
class ExcitationPeak:
    """A resonance of the drive.

    Attributes
    ----------
    hz, error_hz : float
        Frequency of the pole, and its standard error.
    quality, quality_error : float
        Quality factor.
    ripple_hz, ripple_quality : float
        Part of these two errors that comes from the ripple of the loudspeaker, which is the same
        with every reed.
    height_db, height_error_db : float
        Largest gain by the direct path and this resonance, relative to the direct path alone.
    """

    hz: float
    error_hz: float
    quality: float
    quality_error: float
    ripple_hz: float
    ripple_quality: float
    height_db: float
    height_error_db: float


def find_excitation_peaks(
    drive_hz: Array,
    log_magnitude: Array,
    covariance: Array,
    gain: float = LEAST_GAIN,
    off: Mask | None = None,
) -> list[ExcitationPeak]:
    """Find the resonances of the drive of one sweep.

    Parameters
    ----------
    drive_hz : (k,) float
        Drive frequencies, ascending.
    log_magnitude : (k,) float
        Log magnitude of the drive per volt, in nepers.
    covariance : (k, k) float
        Its covariance.
    gain : float
        Scatter of single holograms, in nepers, in addition to it.
    off : (k,) bool, optional
        Outliers.

    Returns
    -------
    list of ExcitationPeak
        In order of frequency.
    """
    fit = _fit_of(drive_hz, log_magnitude, covariance, gain, off)
    found, tops = _lines(fit)
    ripple = quiet_ripple(drive_hz).covariance
    peaks = _peaks(found, *fit.covariances(found, tops, ripple)) if tops else []
    high = [peak for peak in peaks if peak.height_db > _LEAST_DB]
    return sorted(high, key=lambda peak: peak.hz)


@dataclass(frozen=True)
class DriveLines:
    """Lines of a drive.

    Attributes
    ----------
    parameters : (n, 4) float
        See `log_gain`.
    covariance : (4n, 4n) float
    """

    parameters: Array
    covariance: Array

    def only(self, which: Mask) -> "DriveLines":
        """Return the lines of a mask (n,), whatever values the other lines have."""
        own = np.repeat(which, _PARAMETERS)
        return DriveLines(self.parameters[which], self.covariance[np.ix_(own, own)])

    def gain_covariance(self, hz: Array, factor: float) -> Array:
        """Return the covariance (k, k) of `log_gain` for errors `factor` times as large."""
        slopes = _slopes(self.parameters, hz)
        return np.asarray(factor**2 * slopes @ self.covariance @ slopes.T)

    def log_weight(self, hz: Array, factor: float) -> float:
        """Return the log of the prior density times the volume of errors, for `gain_covariance`.

        With this weight, a fit whose lines have narrow priors can be compared with a fit without
        lines: the lines could have been anywhere in the sweep.
        """
        off = self.parameters[:, 1:] - np.array([_LOG_QUALITY, 0.0, 0.0])
        spread = _SPREAD[1:]
        density = -0.5 * np.sum((off / spread) ** 2) - len(off) * float(
            np.sum(np.log(spread)) + 1.5 * np.log(2 * np.pi) + np.log(np.log(hz[-1] / hz[0]))
        )
        _, volume = np.linalg.slogdet(2 * np.pi * factor**2 * self.covariance)
        return float(density + 0.5 * volume)


def lines_of_drive(
    drive_hz: Array,
    log_magnitude: Array,
    covariance: Array,
    gain: float = LEAST_GAIN,
    off: Mask | None = None,
) -> DriveLines:
    """Return the lines of a drive; see `find_excitation_peaks`."""
    fit = _fit_of(drive_hz, log_magnitude, covariance, gain, off)
    found, tops = _lines(fit)
    errors = fit.covariances(found, tops, quiet_ripple(drive_hz).covariance)[0] if tops else found
    return DriveLines(found, np.asarray(errors).reshape(found.size, found.size))


def _fit_of(
    drive_hz: Array, log_magnitude: Array, covariance: Array, gain: float, off: Mask | None
) -> "_Fit":
    variance = np.full(len(drive_hz), gain**2)
    if off is not None:
        variance[off] += _OFF
    ripple = quiet_ripple(drive_hz).covariance
    root = linalg.cholesky(covariance + ripple + np.diag(variance), lower=True)
    whitening = linalg.solve_triangular(root, np.eye(len(root)), lower=True)
    return _Fit(drive_hz, log_magnitude, whitening)


def _lines(fit: "_Fit") -> tuple[Array, list[float]]:
    """Fit one line after the other, each where it explains most of what is left.

    Returns
    -------
    parameters : (n, 4) float
    tops : list of float
        Frequencies in Hz at which each line was looked for.
    """
    found: Array = np.zeros((0, _PARAMETERS))
    tops: list[float] = []
    least = float(chi2.isf(_BY_CHANCE / len(fit.hz), _PARAMETERS))
    while len(tops) < _MOST_LINES:
        where = [*tops, fit.likeliest_hz(found)]
        tried = fit.with_another(found, where)
        if fit.chi2(found) - fit.chi2(tried) < least:
            break
        found, tops = tried, where
    return found, tops


def log_gain(parameters: Array, hz: Array) -> Array:
    """Return the log magnitude (k,) of the gain by all lines.

    Parameters
    ----------
    parameters : (n, 4) float
        Log frequency, log quality factor, real and imaginary part of the strength of each line.
    hz : (k,) float
    """
    log_hz, log_quality, real, imaginary = parameters.T
    ratio = hz[:, None] / np.exp(log_hz)
    resonance = 1 / (1 - ratio**2 + 1j * ratio * np.exp(-log_quality))
    gain: Array = np.log(np.abs(1 + np.sum((real + 1j * imaginary) * resonance, axis=1)))
    return gain


def _slopes(parameters: Array, hz: Array) -> Array:
    """Return the derivatives (k, 4n) of `log_gain` by the numbers of lines (n, 4)."""
    log_hz, log_quality, real, imaginary = parameters.T
    ratio = hz[:, None] / np.exp(log_hz)
    loss = 1j * ratio * np.exp(-log_quality)
    resonance = 1 / (1 - ratio**2 + loss)
    strength = real + 1j * imaginary
    steep = strength * resonance**2
    slopes = [steep * (loss - 2 * ratio**2), steep * loss, resonance, 1j * resonance]
    whole = 1 + np.sum(strength * resonance, axis=1)
    moved = np.stack([(slope / whole[:, None]).real for slope in slopes], axis=2)
    return np.asarray(moved.reshape(len(hz), -1))


def height_db(line: Array) -> float:
    """Return the largest gain near the pole of a line (4,), relative to the direct path."""
    return float(_DB_PER_NEPER * _height(line))


@dataclass(frozen=True)
class _Fit:
    """The drive that is fitted, and the inverse of the root of its covariance."""

    hz: Array
    log_magnitude: Array
    whitening: Array

    def chi2(self, parameters: Array) -> float:
        """Return the whitened squares of a drive less some lines."""
        return float(np.sum(self._whitened(parameters) ** 2))

    def _whitened(self, parameters: Array) -> Array:
        return np.asarray(self.whitening @ (self.log_magnitude - log_gain(parameters, self.hz)))

    def likeliest_hz(self, found: Array) -> float:
        """Return the frequency at which another weak line explains most of what is left.

        To first order a line of strength c adds ``Re(c h)`` to the log magnitude.
        """
        count = _PER_STEP * len(self.hz)
        grid = np.geomspace(self.hz[0], self.hz[-1], count)
        ratio = self.hz[:, None] / grid
        left, best, least = self._whitened(found), grid[0], -np.inf
        for quality in _LOOKED_FOR:
            resonance = 1 / (1 - ratio**2 + 1j * ratio / quality)
            parts = np.stack([resonance.real, -resonance.imag], axis=2).reshape(len(self.hz), -1)
            seen = (self.whitening @ parts).reshape(len(self.hz), count, 2)
            matrix = np.einsum("kfp,kfq->fpq", seen, seen)
            along = np.einsum("kfp,k->fp", seen, left)
            gained = np.sum(along * np.linalg.solve(matrix, along[..., None])[..., 0], axis=1)
            if gained.max() > least:
                best, least = grid[gained.argmax()], gained.max()
        return float(best)

    def residual(self, flat: Array, tops: Sequence[float]) -> Array:
        """Return whitened residuals of the drive, and of the prior of all lines."""
        parameters = flat.reshape(-1, _PARAMETERS)
        centre = np.array([[np.log(top), _LOG_QUALITY, 0.0, 0.0] for top in tops])
        prior = (parameters - centre) / _SPREAD
        return np.concatenate([self._whitened(parameters), prior.ravel()])

    def jacobian(self, flat: Array, tops: Sequence[float]) -> Array:
        """Return the derivatives of `residual`."""
        slopes = _slopes(flat.reshape(-1, _PARAMETERS), self.hz)
        return np.concatenate([-self.whitening @ slopes, np.diag(1 / np.tile(_SPREAD, len(tops)))])

    def with_another(self, found: Array, tops: Sequence[float]) -> Array:
        """Fit the lines found so far and one more, which is looked for at the last of `tops`."""
        starts = []
        for quality, phase in product(_QUALITIES, _PHASES):
            strength = 2 / quality * np.exp(1j * phase)
            line = [np.log(tops[-1]), np.log(quality), strength.real, strength.imag]
            starts.append(np.concatenate([found.ravel(), line]))
        rough = [self._minimum(start, tops, _EVALUATIONS) for start in starts]
        best = self._minimum(min(rough, key=lambda each: float(each.cost)).x, tops)
        return np.asarray(best.x.reshape(-1, _PARAMETERS))

    def _minimum(
        self, start: Array, tops: Sequence[float], evaluations: int | None = None
    ) -> OptimizeResult:
        return least_squares(
            self.residual,
            start,
            self.jacobian,
            args=(tops,),
            method="lm",
            x_scale="jac",
            max_nfev=evaluations,
            ftol=_CONVERGED,
            xtol=_CONVERGED,
            gtol=_CONVERGED,
        )

    def covariances(
        self, found: Array, tops: Sequence[float], ripple: Array
    ) -> tuple[Array, Array]:
        """Return the covariance (4n, 4n) of all parameters, and its part that ripple causes.

        Parameters
        ----------
        found : (n, 4) float
        tops : sequence of float
        ripple : (k, k) float
            Covariance of the smooth drive.
        """
        jacobian = self.jacobian(found.ravel(), tops)
        covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian))
        # Parameters as linear functions of the log magnitude.
        by_drive = covariance @ jacobian[: len(self.hz)].T @ self.whitening
        return covariance, by_drive @ ripple @ by_drive.T


def _peaks(found: Array, covariance: Array, by_ripple: Array) -> list[ExcitationPeak]:
    """Return frequency, quality factor and height of each line, with standard errors."""
    peaks = []
    for number, line in enumerate(found):
        own = slice(_PARAMETERS * number, _PARAMETERS * (number + 1))
        errors = np.sqrt(np.diag(covariance[own, own]))
        ripple = np.sqrt(np.diag(by_ripple[own, own]))
        step = 1e-3 * errors
        slope = np.array(
            [
                (_height(line + step * unit) - _height(line - step * unit)) / (2 * step @ unit)
                for unit in np.eye(_PARAMETERS)
            ]
        )
        height_error = np.sqrt(slope @ covariance[own, own] @ slope)
        hz, quality = np.exp(line[:2])
        peaks.append(
            ExcitationPeak(
                hz=float(hz),
                error_hz=float(hz * errors[0]),
                quality=float(quality),
                quality_error=float(quality * errors[1]),
                ripple_hz=float(hz * ripple[0]),
                ripple_quality=float(quality * ripple[1]),
                height_db=height_db(line),
                height_error_db=float(_DB_PER_NEPER * height_error),
            )
        )
    return peaks


def _height(line: Array) -> float:
    """Return the largest log gain near a pole."""
    near_hz = np.exp(line[0]) * (1 + _NEAR / (2 * np.exp(line[1])))
    return float(log_gain(line[None], near_hz[near_hz > 0]).max())
