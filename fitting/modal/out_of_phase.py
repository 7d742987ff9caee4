"""Modes that are not in phase, because losses connect them.

If all strain lost the same part of its energy, and nothing else lost any, modes would be real.

**Shear.** In wood it loses up to twice as much as bending (Labonnote et al., Wood Sci. Technol. 47,
1033, 2013). To first order in the difference Δη of both loss factors, mode m is

    T_m + iΔη Σ_n C_mn T_n,    C_mn = G_mn / (λ_m − λ_n)

where G_mn is the part of the stiffness between both modes that belongs to shear, and λ = (2πf)². A
fit with real shapes compensates this by wrong loss factors: 2 % for T2 and 7 % for F2 of a reed
with Δη = 0.025 (decision 0039).

**Clamp.** The elastic beds of the strips lose another part of their energy than the cane. They have
the energy that a yielding clamp takes from the modes: with F the forces that hold the strips of a
rigid clamp, S their area and c the compliance of the beds, G = c Fᵀ S⁻¹ F; Δη is the loss factor of
the beds less that of cane. If this is left out, beds that lose nothing make the loss factor of F2
3 % too small (decision 0062). Only the product of c and Δη is known: Δη is that for a usual c.

**Sound.** The sound that a mode n sends out moves mode m, with the resistance R_mn between them:

    a_m = −iω R_mn h_m / λ_m a_n

with h of the model's equation. F modes send out most. Without this, F3 was up to 54 cents off
(decision 0055).

Both Δη, and the sound relative to that of a free plate, are fitted as three more parameters that
all holograms share.
"""

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from fitting.holograms.object_field import CommonModeError
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements
from fitting.modal.field_drift import FieldDrift, field_drift
from fitting.modal.model import OUT_OF_PHASE
from holography.arrays import Array

# Expectation and standard deviation of both Δη: dry cane loses 0.03, shear up to twice as much, and
# the bed of a clamp between nothing and twice as much. The same of the sound: a mouthpiece guides
# the air more than a free plate does and less than a wall (decision 0026).
_EXPECTED, _SPREAD = np.array([0.0, 0.0, 1.0]), np.array([0.03, 0.03, 0.5])


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
