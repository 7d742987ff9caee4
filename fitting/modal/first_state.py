"""The state from which the joint fit of a sweep begins, and its first stages."""

from dataclasses import replace

import numpy as np
from scipy import linalg

from fitting.holograms.solved_sweep import Displacements
from fitting.modal.field_drift import FIRST_WALK, FieldDrift, steady
from fitting.modal.losses import expected_shared
from fitting.modal.model import LOSS, TAIL_TERMS, Model, Stage, State, stage_prior, terms
from fitting.modal.noise import Noise, data_of
from fitting.modal.optimiser import minimise_cost
from fitting.modal.rounds import FIRST_SHARING, LAST, Given, Scatter, fixed, shared_at
from holography.arrays import Array, ComplexArray

# Least scale of a participation, relative to the largest.
_LEAST_SCALE = 3e-3
# Discrepancies fall, and priors widen, by factors of about three from stage to stage. Chosen.
_STAGES = (
    Stage(0.3, 0.05, 0.01, 0.05, 3),
    Stage(0.1, 0.3, 0.01, 0.3, 3),
    Stage(0.03, 0.5, 0.01, 1.0, 3),
)
# Scatter before the first residuals are known.
FIRST_SCATTER = Scatter(LAST.discrepancy, FIRST_WALK, FIRST_SHARING)


def participation_scale(model: Model, state: State) -> Array:
    """Return the rms participation (m,) of each mode."""
    p = terms(model, state).participation
    scale = np.sqrt(np.mean(np.abs(p) ** 2, axis=0))
    return np.asarray(np.maximum(scale, _LEAST_SCALE * scale.max()))


def first_state(model: Model, displacements: Displacements, shared: Array) -> tuple[State, Array]:
    """Find the constant participations for which holograms are most nearly multiples of a model.

    `shared` (p,) is what is expected of the parameters that all holograms share.
    """
    known = np.any(displacements.amplitude_rad, axis=1)
    amplitude, information = displacements.amplitude_rad[known], displacements.information[known]
    size, modes = amplitude.shape[1], len(model.reference)
    real, cross, imaginary = (
        information[:, :size, :size],
        information[:, size:, :size] - information[:, :size, size:],
        information[:, size:, size:],
    )
    hermitian = 0.5 * (real + imaginary) + 0.5j * cross
    ratio = (model.hz[known, None] / model.reference_hz) ** (2 - model.stiffening)
    columns = (1 / (1 + 1j * LOSS - ratio))[:, None, :] * model.reference.T
    seen = hermitian @ columns
    force = np.einsum("kij,kj->ki", hermitian, amplitude)
    power = np.einsum("ki,ki->k", amplitude.conj(), force).real
    along = np.einsum("kim,ki->km", columns.conj(), force)
    whole = np.einsum("kim,kin,k->mn", columns.conj(), seen, 1 / power, optimize=True)
    explained = np.einsum("km,kn,k->mn", along, along.conj(), 1 / power**2, optimize=True)
    weak = 1e-5 * np.trace(whole).real / modes * np.eye(modes)
    p = linalg.eigh(whole - explained, whole + weak)[1][:, 0]
    p = p / np.abs(p).max()
    expected = columns @ p
    drive = np.einsum("ki,ki->k", expected.conj(), amplitude)
    drive = drive / np.sum(np.abs(expected) ** 2, axis=1)
    # Holograms without information get the drive of their neighbours.
    log_drive = np.interp(np.log(model.hz), np.log(model.hz[known]), np.log(np.abs(drive))) + 0j
    log_drive[known] = np.log(drive)
    state = State(_constant(model, p), log_drive, shared, np.zeros(len(log_drive)))
    return state, np.maximum(np.abs(p), _LEAST_SCALE)


def _constant(model: Model, p: ComplexArray) -> Array:
    """Return parameters (v, p): constant participations, expected loss factors, no mixing."""
    count, powers = len(model.active), model.powers.shape[1]
    x = np.zeros((count + len(model.reference), model.slots))
    x[:count, 0], x[:count, powers] = p[model.active].real, p[model.active].imag
    x[:count, 2 * powers] = np.log(model.reference_hz[model.active])
    x[:count, 2 * powers + 1] = np.log(LOSS)
    rest = p[model.passive]
    x[count + model.passive, count] = rest.real
    x[count + model.passive, count + TAIL_TERMS] = rest.imag
    return x


def at_level(model: Model, state: State) -> Model:
    """Expect the drive's mean magnitude where it is: what all holograms share is participation."""
    level = float(np.mean(state.log_drive.real - model.log_volts))
    return replace(model, log_volts=model.log_volts + level)


def staged(
    model: Model, displacements: Displacements, noise: Noise, drift: FieldDrift, centre_hz: Array
) -> tuple[Model, State]:
    """Fit with priors that widen from stage to stage, as if the light were steady.

    Nothing of its drift is known before the modes are (decision 0090).

    Parameters
    ----------
    model : Model
    displacements : Displacements
    noise : Noise
    drift : FieldDrift
    centre_hz : (a,) float
        Start frequencies of the active modes.

    Returns
    -------
    Model, State
        The model expects the drive at the level of the state.
    """
    light = steady(drift)
    state, scale = first_state(model, displacements, expected_shared(light))
    model = at_level(model, state)
    for stage in _STAGES:
        prior = stage_prior(model, stage, centre_hz, scale)
        given = Given(displacements, light, noise, prior)
        shared = shared_at(model, given, state, FIRST_WALK)
        deviation = noise.deviation(stage.discrepancy)
        data = data_of(displacements.amplitude_rad, shared, noise, deviation)
        state = minimise_cost(model, data, prior, fixed(prior, state), stage.iterations)
        scale = participation_scale(model, state)
    drifting = expected_shared(drift)
    drifting[: light.parameters] = state.shared
    return model, replace(state, shared=drifting)
