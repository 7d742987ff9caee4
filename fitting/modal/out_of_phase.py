"""Modes that are not in phase, because losses connect them.

If all strain lost the same part of its energy, and nothing else lost any, modes would be real.

**Shear.** In wood it loses up to twice as much as bending (Labonnote et al., Wood Sci. Technol. 47,
1033, 2013). To first order in the difference Δη of both loss factors, mode m is

    T_m + iΔη Σ_n C_mn T_n,    C_mn = G_mn / (λ_m − λ_n)

where G_mn is the part of the stiffness between both modes that belongs to shear, and λ = (2πf)². A
fit with real shapes compensates this by wrong loss factors: 2 % for T2 and 7 % for F2 of a reed
with Δη = 0.025 (decision 0039).

**Sound.** The sound that a mode n sends out moves mode m, with the resistance R_mn between them:

    a_m = −iω R_mn h_m / λ_m a_n

with h of the model's equation. F modes send out most. Without this, F3 was up to 54 cents off
(decision 0055).

Δη, and the sound relative to that of a free plate, are fitted as two more parameters of the
common-mode error.
"""

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from fitting.holograms.displacement import Displacements
from fitting.holograms.object_field import CommonModeError
from fitting.holograms.shape_basis import ShapeBasis
from fitting.modal.field_drift import FieldDrift, field_drift
from fitting.modal.model import Model, State, terms
from fitting.modal.normal_equations import parts
from holography.arrays import Array

# Expectation and standard deviation of Δη: shear loses up to twice as much, and dry cane 0.03. The
# same of the sound: a mouthpiece guides the air more than a free plate does and less than a wall
# (decision 0026).
_EXPECTED, _SPREAD = np.array([0.0, 1.0]), np.array([0.03, 0.5])


def sound_between_modes(basis: ShapeBasis, hz: Array, drive_hz: Array) -> Array:
    """Return ω R_mn / λ_m (k, m, n) of modes (m,) at drive frequencies (k,); 0 for m = n.

    What a mode loses by its own sound is part of its loss factor. Beyond the frequencies that the
    basis has, the resistance stays as it is at their end.

    Parameters
    ----------
    basis : ShapeBasis
    hz : (m,) float
        Eigenfrequencies.
    drive_hz : (k,) float
    """
    at_hz = np.clip(drive_hz, basis.sound_hz[0], basis.sound_hz[-1])
    resistance = CubicSpline(np.log(basis.sound_hz), basis.sound)(np.log(at_hz))
    between: Array = resistance * (drive_hz[:, None] / (2 * np.pi * hz**2))[..., None]
    return between * (1 - np.eye(len(hz)))


def drift_with_losses(displacements: Displacements) -> FieldDrift:
    """Return how the common-mode error drifts; its last constant parameters are those of losses."""
    drift = field_drift(displacements.common_mode, displacements.recording_rank)
    return replace(drift, constant=drift.constant + len(_SPREAD))


def expected_shift(drift: FieldDrift) -> Array:
    """Return the expected parameters (p,) of an error that drifts as `drift_with_losses` says."""
    shift = np.zeros(drift.parameters)
    shift[drift.constant - len(_EXPECTED) : drift.constant] = _EXPECTED
    return shift


def with_losses(common_mode: CommonModeError, columns: Array) -> CommonModeError:
    """Return a common-mode error with both parameters as its last values.

    `columns` (k, 2j, 2) is the response to them.
    """
    own = common_mode.response.shape[2]
    response = np.concatenate([common_mode.response, columns], axis=2)
    precision = np.zeros((len(response), response.shape[2], response.shape[2]))
    precision[:, :own, :own] = common_mode.precision
    # The sum over holograms is the prior.
    held = _SPREAD**-2 / len(response)
    precision[:, own:, own:] = np.diag(held)
    pull = np.concatenate([common_mode.pull, np.tile(held * _EXPECTED, (len(response), 1))], axis=1)
    return CommonModeError(response, precision, pull)


def loss_response(model: Model, state: State) -> Array:
    """Return the response (k, 2j, 2) of displacements to both, as `CommonModeError` has it."""
    now = terms(model, state)
    by_shear = now.modal @ (model.loss_mixing @ now.shapes)
    sent = (model.sound @ now.modal[..., None])[..., 0]
    by_sound = -(now.resonance * sent) @ now.shapes
    # An error of displacements moves them the other way.
    return np.stack([-parts(1j * moved) for moved in (by_shear, by_sound)], axis=2)
