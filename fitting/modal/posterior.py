"""Joint covariance of the parameters of the joint model and of the drive of all holograms."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.modal.model import Model, Prior, State, Terms, drive_prior_at
from fitting.modal.normal_equations import Equations
from holography.arrays import Array


@dataclass(frozen=True)
class Posterior:
    """Covariance of the free parameters, the common-mode error and the drive.

    Attributes
    ----------
    covariance : (q, q) float
        Of the free parameters, then of the common-mode error.
    response : (q, 2k) float
        Coupling of `Equations` times the inverse of the drive's block.
    given : (2k, 2k) float
        Covariance of the drive (log magnitude, then phase) for given parameters.
    """

    covariance: Array
    response: Array
    given: Array

    @classmethod
    def of(cls, here: Equations, covariance: Array, factor: float) -> "Posterior":
        """Set up the covariance from the normal equations.

        Parameters
        ----------
        here : Equations
        covariance : (q, q) float
            Inverse of the equations with the drive eliminated.
        factor : float
            Factor on all variances.
        """
        inverse = linalg.inv(here.drive_matrix + 1e-9 * np.eye(len(here.drive_matrix)))
        given = 0.5 * factor * (inverse + inverse.T)
        return cls(factor * covariance, here.coupling @ inverse, given)

    def of_combinations(self, by_parameters: Array, by_drive: Array) -> Array:
        """Return the covariance (r, r) of linear combinations of all unknowns.

        Parameters
        ----------
        by_parameters : (r, q) float
        by_drive : (r, 2k) float
        """
        alone = by_parameters - by_drive @ self.response.T
        found: Array = alone @ self.covariance @ alone.T + by_drive @ self.given @ by_drive.T
        return found

    @property
    def with_log_magnitude(self) -> Array:
        """Covariance (q, k) of the parameters with the log magnitude of the drive."""
        found: Array = -self.covariance @ self.response[:, : len(self.given) // 2]
        return found

    @property
    def log_magnitude(self) -> Array:
        """Covariance (k, k) of the log magnitude of the drive."""
        count = len(self.given) // 2
        moved = self.response[:, :count]
        found: Array = moved.T @ self.covariance @ moved + self.given[:count, :count]
        return found

    def with_ripple(self, model: Model, state: State) -> tuple[Array, Array]:
        """Return derivatives by the n log sizes of the ripple.

        Returns
        -------
        parameters : (q, n) float
        log_magnitude : (k, n) float
        """
        ripple, curvature = model.ripple, drive_prior_at(model, state).curvature
        pulled = curvature @ (state.log_drive.real - model.log_volts)
        by_size = ripple.weights * (ripple.finer @ pulled)[:, None]
        by_size += ripple.finer @ (ripple.weights * pulled[:, None])
        by_size = curvature @ by_size
        return self.with_log_magnitude @ by_size, self.log_magnitude @ by_size

    def shared(self, count: int) -> Array:
        """Return the covariance (q, q) of the `count` parameters that all holograms share."""
        first = len(self.covariance) - count
        return self.covariance[first:, first:]


@dataclass(frozen=True)
class ResonantDisplacements:
    """Displacements of all modes, each alone and driven at its own eigenfrequency.

    Attributes
    ----------
    amplitude_rad : (a, j) float
        Coordinates of each mode's phase amplitude in the `ShapeBasis`.
    covariance : (a, j, j) float
    """

    amplitude_rad: Array
    covariance: Array


def resonant_displacements(
    model: Model, prior: Prior, state: State, now: Terms, posterior: Posterior
) -> ResonantDisplacements:
    """Return the displacement of each mode at its resonance, with its covariance.

    It is ``|d(f_m) p_m(f_m)| / η_m T_m``. The logarithms of drive and participation are
    interpolated between the two holograms next to the resonance. Frequency, loss factor,
    participation, drive, shape and the common-mode error all add to the covariance.
    """
    count, size = len(model.active), now.shapes.shape[1]
    powers, free = model.powers.shape[1], prior.free
    number = np.full(free.shape, -1)
    number[free] = np.arange(np.count_nonzero(free))
    amplitude, covariance = np.zeros((count, size)), np.zeros((count, size, size))
    log_hz, moved = np.log(model.hz), np.exp(state.log_drive)[:, None] * now.participation
    for a, m in enumerate(model.active):
        log_f = float(np.clip(state.x[a, 2 * powers], log_hz[0], log_hz[-1]))
        k = int(np.clip(np.searchsorted(log_hz, log_f), 1, len(log_hz) - 1))
        pair = np.array([k - 1, k])
        weight = np.interp(log_f, log_hz[pair], [0.0, 1.0])
        weights = np.array([1 - weight, weight])
        logs = np.log(np.abs(moved[pair, m]))
        own = np.exp(weights @ logs) / now.loss[m] * now.shapes[m]
        # Derivatives of the log amplitude, then of all coordinates.
        by_log, by_drive = np.zeros(posterior.covariance.shape[0]), np.zeros(2 * len(log_hz))
        by_drive[pair] = weights
        turned = weights / now.participation[pair, m].conj() @ model.powers[pair]
        by_log[number[a, :powers]] = turned.real
        by_log[number[a, powers : 2 * powers]] = turned.imag
        by_log[number[a, 2 * powers]] = np.diff(logs)[0] / np.diff(log_hz[pair])[0]
        by_log[number[a, 2 * powers + 1]] = -1.0
        by_parameters = np.multiply.outer(own, by_log)
        mixes = np.flatnonzero(free[count:, a])
        scale = np.exp(weights @ logs) / now.loss[m]
        by_parameters[:, number[count + mixes, a]] += scale * model.reference[mixes].T
        amplitude[a] = own
        covariance[a] = posterior.of_combinations(by_parameters, np.multiply.outer(own, by_drive))
    return ResonantDisplacements(amplitude, covariance)


def participation_error(
    model: Model, prior: Prior, covariance: Array, nearest: NDArray[np.intp]
) -> Array:
    """Return standard errors (a,) of participations at the holograms nearest to the modes."""
    number = np.full(prior.centre.shape, -1)
    number[prior.free] = np.arange(np.count_nonzero(prior.free))
    powers, errors = model.powers.shape[1], []
    for a, k in enumerate(nearest):
        variance = 0.0
        for part in (0, powers):
            which = number[a, part : part + powers]
            at = model.powers[k]
            variance += float(at @ covariance[np.ix_(which, which)] @ at)
        errors.append(np.sqrt(variance))
    return np.array(errors)
