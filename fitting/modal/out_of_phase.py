"""Modes that are not in phase, because losses connect them.

If all strain lost the same part of its energy, and nothing else lost any, modes would be real. What
else connects them moves mode m by what mode n does, to first order:

    a_m = −i h_m B_mn a_n

with h of the model's equation. Three causes have such a B:

**Shear.** In wood it loses up to twice as much as bending (Labonnote et al., Wood Sci. Technol. 47,
1033, 2013). With G_mn, the part of the stiffness between both modes that belongs to shear, and the
difference Δη of both loss factors, B_mn = Δη G_mn / λ_m where λ = (2πf)². A fit with real shapes
compensates this by wrong loss factors: 2 % for T2 and 7 % for F2 of a reed with Δη = 0.025
(decision 0039).

**Clamp.** The elastic beds of the strips lose another part of their energy than the cane. They have
the energy that a yielding clamp takes from the modes: with F the forces that hold the strips of a
rigid clamp, S their area and c the compliance of the beds, G = c Fᵀ S⁻¹ F; Δη is the loss factor of
the beds less that of cane. If this is left out, beds that lose nothing make the loss factor of F2
3 % too small (decision 0062). Only the product of c and Δη is known: Δη is that for a usual c.

**Sound.** The sound that a mode n sends out moves mode m, with the resistance R_mn between them:
B_mn = ω R_mn / λ_m. F modes send out most. Without this, F3 was up to 54 cents off (decision 0055).

Both Δη, and the sound relative to that of a free plate, are fitted as three more parameters that
all holograms share. G and R are those of the modes as they are, not those of the finite elements:
where an F mode and a T mode exchange shapes, what only one of them loses connects them
(decision 0084).
"""

from dataclasses import replace

import numpy as np
from scipy import linalg
from scipy.interpolate import CubicSpline

from fitting.holograms.object_field import CommonModeError
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements
from fitting.modal.field_drift import FieldDrift, field_drift
from fitting.modal.model import OUT_OF_PHASE, Forms, Model, State
from holography.arrays import Array

# Expectation and standard deviation of both Δη: dry cane loses 0.03, shear up to twice as much, and
# the bed of a clamp between nothing and twice as much. The same of the sound: a mouthpiece guides
# the air more than a free plate does and less than a wall (decision 0026).
_EXPECTED, _SPREAD = np.array([0.0, 0.0, 1.0]), np.array([0.03, 0.03, 0.5])


def forms_of(basis: ShapeBasis, hz: Array, drive_hz: Array) -> Forms:
    """Return how losses and sound connect the shapes of a basis.

    Beyond the frequencies that the basis has, the resistance of sound stays as it is at their end.

    Parameters
    ----------
    basis : ShapeBasis
    hz : (m,) float
        Eigenfrequencies.
    drive_hz : (k,) float
    """
    at_hz = np.clip(drive_hz, basis.sound_hz[0], basis.sound_hz[-1])
    resistance = CubicSpline(np.log(basis.sound_hz), basis.sound)(np.log(at_hz))
    own, omega = 2 * np.pi * hz, 2 * np.pi * drive_hz
    sound = omega[:, None, None] * resistance / np.outer(own, own)
    return Forms(basis.shares, sound, basis.largest / own)


def between_modes(forms: Forms, mixed: Array) -> tuple[Array, Array]:
    """Return B of losses (2, m, m) and of sound (k, m, m) between modes; 0 for a mode with itself.

    What a mode loses by itself is part of its loss factor.

    Parameters
    ----------
    forms : Forms
    mixed : (m, m) float
        How much each mode has of each shape S. Modes are orthogonal: as perturbations are only
        nearly so, the nearest orthogonal ones are taken.
    """
    scale = forms.scale
    turned, _ = linalg.polar(mixed * scale[:, None] / scale)
    own = 1 - np.eye(len(scale))
    losses, sound = (
        own * (turned @ each @ turned.T) * scale[:, None] / scale
        for each in (forms.shares, forms.sound)
    )
    return losses, sound


def connected(model: Model, state: State) -> Model:
    """Connect modes as those of a state are."""
    count, mixed = len(model.active), np.eye(len(model.reference))
    mixed[model.active] += state.x[count:, :count].T
    losses, sound = between_modes(model.forms, mixed)
    return replace(model, losses=losses, sound=sound)


def shared_drift(displacements: Displacements) -> FieldDrift:
    """Return how what holograms share drifts; those out of phase are the first, and constant."""
    drift = field_drift(displacements.common_mode, displacements.recording_rank)
    return replace(
        drift, constant=drift.constant + OUT_OF_PHASE, drifting=drift.drifting + OUT_OF_PHASE
    )


def expected_shared(drift: FieldDrift) -> Array:
    """Return the expected parameters (p,) of what drifts as `shared_drift` says."""
    expected = np.zeros(drift.parameters)
    expected[:OUT_OF_PHASE] = _EXPECTED
    return expected


def with_out_of_phase(common_mode: CommonModeError) -> CommonModeError:
    """Return a common-mode error that has these parameters as its first values.

    Displacements do not respond to them: they are part of the model.
    """
    holograms, _, own = common_mode.response.shape
    # The sum over holograms is the prior.
    held = _SPREAD**-2 / holograms
    precision = np.zeros((holograms, own + OUT_OF_PHASE, own + OUT_OF_PHASE))
    precision[:, :OUT_OF_PHASE, :OUT_OF_PHASE] = np.diag(held)
    precision[:, OUT_OF_PHASE:, OUT_OF_PHASE:] = common_mode.precision
    pull = np.concatenate([np.tile(held * _EXPECTED, (holograms, 1)), common_mode.pull], axis=1)
    return CommonModeError(common_mode.response, precision, pull)
