"""Joint covariance of the parameters of the joint model and of the drive of all holograms."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.modal.expected.prior import Prior
from fitting.modal.model import (
    Model,
    State,
    Terms,
    drive_prior_at,
    forces_by_logs,
    forces_by_losses,
    scalars,
    terms,
)
from fitting.modal.normal_equations import Equations
from holography.arrays import Array, ComplexArray


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

    def moved_by(self, by_parameters: Array, by_drive: Array) -> tuple[Array, Array]:
        """Return the covariance of linear combinations with all unknowns.

        For the arguments see `of_combinations`.

        Returns
        -------
        parameters : (r, q) float
        drive : (r, 2k) float
        """
        own = (by_parameters - by_drive @ self.response.T) @ self.covariance
        return own, by_drive @ self.given - own @ self.response

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
    log_by_parameters : (a, q) float
        Derivatives of the log of each mode's amplitude, along its shape, by the parameters.
    log_by_drive : (a, 2k) float
        ... by the drive (log magnitude, then phase).
    """

    amplitude_rad: Array
    covariance: Array
    log_by_parameters: Array
    log_by_drive: Array

    def with_errors(self, more: Array) -> "ResonantDisplacements":
        """Return the same with further errors of the logs of all amplitudes, of variance (a,)."""
        along = self.amplitude_rad[:, :, None] * self.amplitude_rad[:, None]
        return replace(self, covariance=self.covariance + more[:, None, None] * along)


def resonant_displacements(
    model: Model,
    prior: Prior,
    state: State,
    now: Terms,
    posterior: Posterior,
    off: NDArray[np.bool_] | None = None,
) -> ResonantDisplacements:
    """Return the displacement of each mode at its resonance, with its covariance.

    It is ``|d(f_m) p_m(f_m)| / η_m T_m``, with what other modes add to the participation. The
    logarithms of drive and participation are interpolated between the two holograms next to the
    resonance. Frequency, loss factor, participation, drive, shape and the common-mode error all add
    to the covariance.

    The drive of a hologram that contradicts the modes follows its displacement, which is wrong:
    holograms that are `off` (k,) are not interpolated between, unless hardly any other is left.
    """
    count, size = len(model.active), now.shapes.shape[1]
    powers, number = model.powers.shape[1], prior.positions
    log_by_parameters = np.zeros((count, posterior.covariance.shape[0]))
    log_by_drive = np.zeros((count, 2 * len(model.hz)))
    amplitude, covariance = np.zeros((count, size)), np.zeros((count, size, size))
    log_hz, moved = np.log(model.hz), now.alone * now.modal
    sure = np.flatnonzero(~off) if off is not None else np.arange(len(log_hz))
    if len(sure) < 2:
        sure = np.arange(len(log_hz))
    for a, m in enumerate(model.active):
        log_f = float(np.clip(state.x[a, 2 * powers], log_hz[0], log_hz[-1]))
        k = int(np.clip(np.searchsorted(log_hz[sure], log_f), 1, len(sure) - 1))
        pair = sure[[k - 1, k]]
        weight = np.interp(log_f, log_hz[pair], [0.0, 1.0])
        weights = np.array([1 - weight, weight])
        logs = np.log(np.abs(moved[pair, m]))
        scale = np.exp(weights @ logs) / now.loss[m]
        # Derivatives of the log amplitude, then of all coordinates.
        by_log, by_drive = np.zeros(posterior.covariance.shape[0]), np.zeros(2 * len(log_hz))
        by_drive[pair] = weights
        for each, at in zip(weights, pair.tolist(), strict=True):
            by_force = _by_parameters(model, prior, state, now, a, at)
            by_log[: len(by_force)] += each * (by_force / moved[at, m]).real
        by_log[number[a, 2 * powers]] += np.diff(logs)[0] / np.diff(log_hz[pair])[0]
        by_log[number[a, 2 * powers + 1]] -= 1.0
        by_parameters = scale * np.multiply.outer(now.shapes[m], by_log)
        mixes = np.flatnonzero(prior.free[count:, a])
        by_parameters[:, number[count + mixes, a]] += scale * model.reference[mixes].T
        amplitude[a] = scale * now.shapes[m]
        log_by_parameters[a] = amplitude[a] @ by_parameters / (amplitude[a] @ amplitude[a])
        log_by_drive[a] = by_drive
        covariance[a] = posterior.of_combinations(
            by_parameters, scale * np.multiply.outer(now.shapes[m], by_drive)
        )
    return ResonantDisplacements(amplitude, covariance, log_by_parameters, log_by_drive)


@dataclass(frozen=True)
class Participations:
    """Participations at the holograms nearest to modes, with standard errors, for a given drive.

    Attributes
    ----------
    received : (a,) complex
        With what other modes add (`Terms.received`).
    received_error : (a,) float
    by_pressure : (a,) complex
        Without.
    by_pressure_error : (a,) float
    """

    received: ComplexArray
    received_error: Array
    by_pressure: ComplexArray
    by_pressure_error: Array


def participations(
    model: Model, prior: Prior, state: State, covariance: Array, hz: Array
) -> Participations:
    """Return the participations of modes at their frequencies (a,).

    `covariance` (q, q) is that of the parameters for a given drive.
    """
    now, drive, active = terms(model, state), np.exp(state.log_drive), model.active
    nearest = model.nearest(hz)
    errors = []
    for a, k in enumerate(nearest.tolist()):
        slopes = _by_parameters(model, prior, state, now, a, k) / drive[k]
        own = covariance[: len(slopes), : len(slopes)]
        errors.append(np.sqrt((slopes.conj() @ own @ slopes).real))
    number, powers = prior.positions, model.powers.shape[1]
    among = number[: len(active), : 2 * powers].reshape(-1, 2, powers)
    parts, at = covariance[among[..., None], among[..., None, :]], model.powers[nearest]
    variance = np.sum((parts @ at[:, None, :, None])[..., 0] * at[:, None], axis=(1, 2))
    return Participations(
        now.received(state)[nearest, active],
        np.array(errors),
        now.participation[nearest, active],
        np.sqrt(variance),
    )


def _by_parameters(
    model: Model, prior: Prior, state: State, now: Terms, a: int, k: int
) -> ComplexArray:
    """Return derivatives (q,) of the force on an active mode in a hologram, with that by others.

    Those by the free parameters, then by the numbers of losses.
    """
    active, count, powers = model.active, len(model.active), model.powers.shape[1]
    m = active[a]
    unit = np.zeros(len(now.shapes))
    unit[m] = 1
    by_forces = now.alone[k, m] * np.linalg.solve(now.dynamic[k].T, unit)
    by_vector = np.concatenate([by_forces[active], by_forces])
    slopes = scalars(model, state, now)[k] * by_vector[:, None]
    slopes[count:, :count] = 0
    # The dynamic stiffness of the mode itself is not that force.
    for slot, force in enumerate(forces_by_logs(model, now), start=2 * powers):
        slopes[a, slot] -= force[k, a]
    return np.concatenate([slopes[prior.free], forces_by_losses(model, now)[:, k] @ by_forces])
