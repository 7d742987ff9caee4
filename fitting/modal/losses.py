"""What modes lose, and how losses connect them so that they are not in phase.

If all strain lost the same part of its energy, and nothing else lost any, modes would be real. What
else is lost connects them, by B of the model's equation. It has three causes:

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

G and R are those of the modes as they are, not those of the finite elements: where an F mode and a
T mode exchange shapes, what only one of them loses connects them (decision 0084).

What a mode loses by itself has the same causes: with g = G_mm / λ_m of shear and c that of the
clamp, and s times the sound R of a free plate,

    η_m = (η + g Δη + c Δη') (f / f₀)^γ + s R_mm / 2πf

within 15 %. The two Δη, s, η and γ are five more parameters that all holograms share. Loss factors
know Δη better than phases do (decision 0085).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg
from scipy.interpolate import CubicSpline
from scipy.optimize import linear_sum_assignment

from fitting.holograms.object_field import CommonModeError
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements
from fitting.modal.field_drift import FieldDrift, field_drift
from fitting.modal.model import (
    CONNECTING,
    LOSS,
    LOSS_PARAMETERS,
    Forms,
    Model,
    State,
    own_resonances,
)
from holography.arrays import Array
from physics.effects.frequency_dependent_damping import EFFECT as FREQUENCY_DEPENDENT_DAMPING

# Width at half power of a mode of dry cane, in log frequency.
_WIDTH = LOSS
# Expectation and standard deviation of both Δη: dry cane loses 0.03, shear up to twice as much, and
# the bed of a clamp between nothing and twice as much. Of the sound: a mouthpiece guides the air
# more than a free plate does and less than a wall (decision 0026). Of cane: 0.02 to 0.05 is
# plausible. Of the growth: see the effect.
(_GROWTH,) = FREQUENCY_DEPENDENT_DAMPING.parameters
_EXPECTED = np.array([0.0, 0.0, 1.0, LOSS, 0.0])
_SPREAD = np.array([0.03, 0.03, 0.5, 0.4 * LOSS, _GROWTH.spread])


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


def between_modes(forms: Forms, turned: Array) -> tuple[Array, Array]:
    """Return B of losses (2, m, m) and of sound (k, m, m) between modes.

    Parameters
    ----------
    forms : Forms
    turned : (m, m) float
        Orthogonal: modes from shapes, all of unit elastic energy.
    """
    scale = forms.scale
    losses, sound = (
        (turned @ each @ turned.T) * scale[:, None] / scale for each in (forms.shares, forms.sound)
    )
    return losses, sound


def turned_shapes(mixing: Array, scale: Array, hz: Array) -> Array:
    """Return how modes (m,) that are close are turned from shapes (m, m) of unit energy.

    Two modes that exchange shapes have as much of each other's energy, with opposite signs. Wrong
    shapes are mixed, too, about as much in either: the angle is that of least squares. For modes
    that are more than two widths apart wrong shapes are most of it, and losses do little there.

    Parameters
    ----------
    mixing : (m, m) float
        Part of each shape S (last axis) in each mode.
    scale : (m,) float
        See `Forms`.
    hz : (m,) float
    """
    ratio = scale / scale[:, None]
    tangent = (ratio * mixing - mixing.T / ratio) / (ratio**2 + ratio**-2.0)
    apart = np.abs(np.subtract.outer(np.log(hz), np.log(hz))) / (2 * _WIDTH)
    return np.asarray(linalg.expm(np.arctan(tangent) / (1 + apart**2)))


def connected(model: Model, state: State) -> Model:
    """Connect modes as those of a state are."""
    count, mixing = len(model.active), np.zeros((len(model.reference),) * 2)
    mixing[model.active] = state.x[count:, :count].T
    hz, _ = own_resonances(model, state)
    return connected_by(model, turned_shapes(mixing, model.forms.scale, hz))


def connected_by(model: Model, turned: Array) -> Model:
    """Connect modes that are turned from shapes (m, m)."""
    losses, sound = between_modes(model.forms, turned)
    # What a mode loses by itself is part of its loss factor.
    others, modes = 1 - np.eye(len(turned)), np.arange(len(turned))
    at = model.nearest(model.reference_hz)
    own = np.concatenate([losses[:, modes, modes], sound[None, at, modes, modes]])
    return replace(model, losses=losses * others, sound=sound * others, own_losses=own)


@dataclass(frozen=True)
class Resonances:
    """Resonances of modes that losses connect.

    Attributes
    ----------
    logs : (2a,) float
        Log frequencies and log loss factors.
    slopes : (2a, 2a + 3) float
        Their derivatives by those of modes alone, and by the numbers of losses that connect them.
    """

    logs: Array
    slopes: Array


def resonances(model: Model, state: State) -> Resonances:
    """Return the resonances of connected modes: (2πf)² (1 + iη) are eigenvalues.

    Losses that connect two modes repel their loss factors, and attract their frequencies.
    """
    hz, loss = own_resonances(model, state)
    at, connecting = model.nearest(hz), state.loss_parameters[:CONNECTING]
    sound = model.sound[at, np.arange(len(hz))]
    between = 1j * hz[:, None] ** 2 * np.concatenate([model.losses, sound[None]])
    matrix = np.tensordot(connecting, between, axes=1) + np.diag(hz**2 * (1 + 1j * loss))
    values, left, right = linalg.eig(matrix, left=True)
    energy = np.abs(right / model.forms.scale[:, None]) ** 2
    modes, found = linear_sum_assignment(-energy / energy.sum(axis=0))
    order = found[modes.argsort()][model.active]
    values, left, right = values[order], left[:, order].conj(), right[:, order]
    left = left / np.sum(left * right, axis=0)
    both = (left * right)[model.active]
    moved = [
        2 * values * both,
        1j * (hz**2 * loss)[model.active, None] * both,
        np.stack([np.sum(left * (each @ right), axis=0) for each in between]),
    ]
    relative = np.concatenate(moved).T
    by_hz = relative.real / (2 * values.real)[:, None]
    by_loss = relative.imag / values.imag[:, None] - 2 * by_hz
    logs = np.concatenate([0.5 * np.log(values.real), np.log(values.imag / values.real)])
    return Resonances(logs, np.concatenate([by_hz, by_loss]))


def shared_drift(displacements: Displacements) -> FieldDrift:
    """Return how what holograms share drifts; the numbers of losses are the first, and constant."""
    drift = field_drift(displacements.common_mode, displacements.recording_rank)
    return replace(
        drift, constant=drift.constant + LOSS_PARAMETERS, drifting=drift.drifting + LOSS_PARAMETERS
    )


def expected_shared(drift: FieldDrift) -> Array:
    """Return the expected parameters (p,) of what drifts as `shared_drift` says."""
    expected = np.zeros(drift.parameters)
    expected[:LOSS_PARAMETERS] = _EXPECTED
    return expected


def with_loss_parameters(common_mode: CommonModeError) -> CommonModeError:
    """Return a common-mode error that has these parameters as its first values.

    Displacements do not respond to them: they are part of the model.
    """
    holograms, _, own = common_mode.response.shape
    # The sum over holograms is the prior.
    held = _SPREAD**-2 / holograms
    precision = np.zeros((holograms, own + LOSS_PARAMETERS, own + LOSS_PARAMETERS))
    precision[:, :LOSS_PARAMETERS, :LOSS_PARAMETERS] = np.diag(held)
    precision[:, LOSS_PARAMETERS:, LOSS_PARAMETERS:] = common_mode.precision
    pull = np.concatenate([np.tile(held * _EXPECTED, (holograms, 1)), common_mode.pull], axis=1)
    return CommonModeError(common_mode.response, precision, pull)
