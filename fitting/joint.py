"""Resonances by one joint fit of a sweep, from its holograms: phasors, displacement, modes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquire.runfile import Run
from fitting.displacement import Displacements, fit_displacements
from fitting.forward import ForwardModel, cents_of, viscoelastic_cents
from fitting.modal import ModalFit, fit_modes
from fitting.phasors import Phasors, read_phasors
from fitting.picking import Resonance, likely_components, pick_resonances
from fitting.shapes import ShapeBasis, shape_basis
from physics.reed.basis import ReducedReed
from physics.reed.names import PAPER_MODES
from physics.reed.response import viscoelastic_mode
from physics.reed.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    storage_modulus_pa,
    viscoelastic_cane,
)

Array = NDArray[np.floating[Any]]
Amplitudes = NDArray[np.complexfloating[Any, Any]]

METHOD = "joint"
# Moduli in the middle of the sweep, in which shapes are computed.
_SHAPES_HZ = 4000.0
# Modes whose resonance lies beyond the sweep by no more than this still bend its end.
_BEYOND = 1.03
# Shapes up to here may take part in the first look at which mode is lively where.
_LOOK_HZ = 24e3
# A lively hologram counts as a mode's own if the cane that all of them tell of agrees to this.
_AGREE_CENTS = 80.0
# A mode is identified if its amplitude stands out of its error by this factor, and its frequency is
# known to a step of the sweep.
_DEVIATIONS, _WIDEST_CENTS = 5.0, 25.0
# ... and if its shape is still that of its name.
_LEAST_MAC = 0.5
# Holograms that may stay off their noise before nothing is believed of a sweep.
_MOST_UNREACHED = 0.2


@dataclass(frozen=True)
class JointFit:
    """A sweep fitted jointly, with everything between holograms and resonances.

    Attributes
    ----------
    phasors : Phasors
    basis : ShapeBasis
    displacements : Displacements
    modal : ModalFit
    resonances : dict
        Identified modes by name, in order of frequency.
    not_identified : dict
        Why each of the other modes within the sweep is not, by name.
    """

    phasors: Phasors
    basis: ShapeBasis
    displacements: Displacements
    modal: ModalFit
    resonances: dict[str, Resonance]
    not_identified: dict[str, str]


def fit_jointly(run: Run, reed: ReducedReed, model: ForwardModel) -> JointFit:
    """Fit all holograms of a run at once.

    Parameters
    ----------
    run : Run
    reed : ReducedReed
        Of the run's kind of reed.
    model : ForwardModel
        Says, with the population of canes, where modes may lie.

    Raises
    ------
    FitError
        If too few holograms are good, or none is calm enough to begin with.
    RunFileError
        If a step cannot be read.
    """
    series = Series.B if run.series == "B" else Series.A
    phasors = read_phasors(run)
    basis = shape_basis(reed, *_moduli_pa(Components(), series), phasors.x_m, phasors.y_m)
    displacements = fit_displacements(phasors, basis)
    start_hz = _starts(phasors, basis, displacements, reed, model, series, run.acoustic_lines_hz)
    modal = fit_modes(displacements, basis, phasors.drive_hz, phasors.volts, start_hz)
    doubts = _doubts(modal, basis, displacements)
    found = {
        name: _resonance(modal, m, phasors)
        for m, name in enumerate(modal.names)
        if not doubts[name]
    }
    return JointFit(
        phasors=phasors,
        basis=basis,
        displacements=displacements,
        modal=modal,
        resonances=dict(sorted(found.items(), key=lambda item: item[1].frequency_hz)),
        not_identified={name: reason for name, reason in doubts.items() if reason},
    )


def _moduli_pa(components: Components, series: Series) -> tuple[float, float]:
    cane = viscoelastic_cane(components, series)
    E, G = (float(storage_modulus_pa(z, _SHAPES_HZ)) for z in (cane.young_L, cane.shear_LT))
    return E, G


def _starts(
    phasors: Phasors,
    basis: ShapeBasis,
    displacements: Displacements,
    reed: ReducedReed,
    model: ForwardModel,
    series: Series,
    acoustic_lines_hz: Sequence[float],
) -> dict[str, float]:
    """Where each mode within the sweep is to be looked for, by name.

    Liveliest holograms of the paper's modes tell of the cane, and the cane of all other modes.
    """
    look = basis.hz < _LOOK_HZ
    modal = displacements.amplitude_rad @ np.linalg.pinv(basis.shapes[look])
    picked = pick_resonances(
        phasors.drive_hz,
        phasors.step_index,
        np.abs(modal),
        [name for name, counts in zip(basis.names, look, strict=True) if counts],
        model,
        series,
        lambda _shape, _picture: True,
        acoustic_lines_hz,
    )
    components = likely_components(picked, model, series)
    expected = _expected_hz(basis, reed, viscoelastic_cane(components, series))
    paper_cents = viscoelastic_cents(model, viscoelastic_cane(components, series), series)
    starts = {}
    for name, hz in expected.items():
        starts[name] = hz
        # What was picked may be another mode's peak: it counts if the cane agrees.
        if name in picked and name in PAPER_MODES:
            cents = paper_cents[model.modes.index(name)]
            if abs(cents_of(picked[name].frequency_hz) - cents) < _AGREE_CENTS:
                starts[name] = picked[name].frequency_hz
    first, last = phasors.drive_hz[0], phasors.drive_hz[-1]
    return {n: hz for n, hz in starts.items() if first / _BEYOND < hz < last * _BEYOND}


def _expected_hz(basis: ShapeBasis, reed: ReducedReed, cane: ViscoelasticCane) -> dict[str, float]:
    """Eigenfrequencies of a cane, of the modes that it has."""
    expected = {}
    for name, hz in zip(basis.names, basis.hz, strict=True):
        if hz < _LOOK_HZ:
            try:
                expected[name] = viscoelastic_mode(reed, cane, name, float(hz)).frequency_hz
            except ValueError:
                continue
    return expected


def _doubts(modal: ModalFit, basis: ShapeBasis, displacements: Displacements) -> dict[str, str]:
    """Why each mode is not identified, by name; empty if it is."""
    unreached = float(np.mean(~displacements.reached))
    if unreached > _MOST_UNREACHED:
        reason = f"{unreached:.0%} of the holograms cannot be explained as vibrations of this reed"
        return dict.fromkeys(modal.names, reason)
    return {
        name: _doubt(modal, m, basis.shapes[basis.names.index(name)])
        for m, name in enumerate(modal.names)
    }


def _doubt(modal: ModalFit, m: int, shape: Array) -> str:
    if modal.participation_error[m] * _DEVIATIONS > abs(modal.participation[m]):
        return "its amplitude does not stand out of its error"
    if modal.error_cents[m] > _WIDEST_CENTS:
        return f"its frequency is known to {modal.error_cents[m]:.0f} cents only"
    likeness = mac(modal.shapes[m], shape)
    if likeness < _LEAST_MAC:
        return f"its shape is not that of its name any more (MAC {likeness:.2f})"
    return ""


def mac(one: Array, other: Array) -> float:
    """Modal assurance criterion of two shapes (j,) in coordinates of uncorrelated functions."""
    return float((one @ other) ** 2 / ((one @ one) * (other @ other)))


def _resonance(modal: ModalFit, m: int, phasors: Phasors) -> Resonance:
    hz = float(modal.hz[m])
    nearest = int(np.abs(np.log(phasors.drive_hz / hz)).argmin())
    return Resonance(
        name=modal.names[m],
        frequency_hz=hz,
        error_cents=float(modal.error_cents[m]),
        step_index=int(phasors.step_index[nearest]),
        amplitude_rad=float(np.abs(modal.modal_rad[nearest, m])),
        method=METHOD,
    )


def modal_amplitudes_rad(fit: JointFit) -> Mapping[str, Array]:
    """Largest deflection (k,) of every mode in every hologram, by name."""
    return {name: np.abs(fit.modal.modal_rad[:, m]) for m, name in enumerate(fit.modal.names)}
