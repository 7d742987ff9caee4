"""Shapes that are not in phase, because shear loses more than normal strain.

If all strain lost the same part of its energy, modes would be real. Shear of wood loses up to twice
as much as bending (Labonnote et al., Wood Sci. Technol. 47, 1033, 2013). To first order in the
difference Δη of both loss factors, mode m is

    T_m + iΔη Σ_n C_mn T_n,    C_mn = G_mn / (λ_m − λ_n)

where G_mn is the part of the stiffness between both modes that belongs to shear, and λ = (2πf)². A
fit with real shapes compensates this by wrong loss factors: 2 % for T2 and 7 % for F2 of a reed
with Δη = 0.025 (decision 0039). Δη is fitted as one more parameter of the common-mode error.
"""

from dataclasses import replace

import numpy as np

from fitting.holograms.displacement import Displacements
from fitting.holograms.object_field import CommonModeError
from fitting.modal.field_drift import FieldDrift, field_drift
from fitting.modal.model import Model, State, terms
from fitting.modal.normal_equations import parts
from holography.arrays import Array

# Prior standard deviation of Δη, around zero: shear loses up to twice as much, and dry cane 0.03.
_SPREAD = 0.03


def drift_with_losses(displacements: Displacements) -> FieldDrift:
    """Return how the common-mode error drifts, with Δη as the last of its constant parameters."""
    drift = field_drift(displacements.common_mode, displacements.recording_rank)
    return replace(drift, constant=drift.constant + 1)


def with_losses(common_mode: CommonModeError, column: Array) -> CommonModeError:
    """Return a common-mode error with Δη as its last value; `column` (k, 2j) is its response."""
    response = np.concatenate([common_mode.response, column[..., None]], axis=2)
    precision = np.zeros((len(response), response.shape[2], response.shape[2]))
    precision[:, :-1, :-1] = common_mode.precision
    # The sum over holograms is the prior.
    precision[:, -1, -1] = _SPREAD**-2 / len(response)
    pull = np.pad(common_mode.pull, ((0, 0), (0, 1)))
    return CommonModeError(response, precision, pull)


def loss_response(model: Model, state: State) -> Array:
    """Return the response (k, 2j) of the displacements to Δη, in the sense of `CommonModeError`."""
    now = terms(model, state)
    moved = now.modal @ (model.loss_mixing @ now.shapes)
    # An error of displacements moves them the other way.
    return -parts(1j * moved)
