"""Find resonances by one joint fit of all holograms of a sweep."""

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from fitting.forward import (
    ForwardModel,
)
from fitting.holograms.block_amplitudes import (
    BlockAmplitudes,
    UnshiftedLight,
    read_block_amplitudes,
)
from fitting.holograms.displacement import (
    Displacements,
    fit_displacements,
    refit_displacements,
)
from fitting.holograms.shape_basis import ShapeBasis
from fitting.modal.fit import fit_modes
from fitting.modal.modal_fit import ModalFit
from fitting.modal.start_frequencies import middling_shapes, start_frequencies
from fitting.resonance import Resonance
from holography.arrays import Array, ComplexArray
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    viscoelastic_cane,
)
from physics.reed.reduced.reed import ReducedReed
from runs.reader import Run

METHOD = "joint"
# A mode is identified if its amplitude exceeds this multiple of its standard error, and its
# frequency is known within a step of the sweep.
_DEVIATIONS, _WIDEST_CENTS = 5.0, 25.0
# ... and if its shape is still that of its name.
_LEAST_MAC = 0.5
# The peak response of a mode is looked for this near to its resonance.
_PEAK_CENTS = 150.0
# Holograms that may be outliers, for example at an acoustic resonance, before the fit is repeated.
_FEW_OFF = 2
# Fraction of unexplained holograms above which no mode of a sweep is identified.
_MOST_UNREACHED = 0.2
# ... and discrepancy of the model: it is 0.02 for reeds with shape errors of 10 µm, and 0.2 for
# reeds of another kind.
_MOST_DISCREPANCY = 0.08


@dataclass(frozen=True)
class JointFit:
    """Result of the joint fit of a sweep, with all intermediate results.

    Attributes
    ----------
    block_amplitudes : BlockAmplitudes
    basis : ShapeBasis
    displacements : Displacements
    modal : ModalFit
    resonances : dict
        Identified modes by name, in order of frequency.
    not_identified : dict
        Reason for each of the other modes within the sweep, by name.
    """

    block_amplitudes: BlockAmplitudes
    basis: ShapeBasis
    displacements: Displacements
    modal: ModalFit
    resonances: dict[str, Resonance]
    not_identified: dict[str, str]


def fit_jointly(
    run: Run, reed: ReducedReed, model: ForwardModel, unshifted: UnshiftedLight | None = None
) -> JointFit:
    """Fit all holograms of a run at once.

    Parameters
    ----------
    run : Run
    reed : ReducedReed
        Reduced model of the run's kind of reed.
    model : ForwardModel
        Predicts, with the population of canes, where modes may lie.
    unshifted : UnshiftedLight, optional
        Leaked light that is subtracted.

    Raises
    ------
    FitError
        If too few holograms are good, or hardly any can be explained.
    RunFileError
        If a step cannot be read.
    """
    # The matrices are small: threads of linear algebra would mostly wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        return _fitted(run, reed, model, unshifted)


def _fitted(
    run: Run, reed: ReducedReed, model: ForwardModel, unshifted: UnshiftedLight | None
) -> JointFit:
    series = Series.B if run.series == "B" else Series.A
    block_amplitudes = read_block_amplitudes(run, unshifted)
    cane = viscoelastic_cane(Components(), series)
    basis = middling_shapes(reed, cane, block_amplitudes.x_m, block_amplitudes.y_m)
    displacements = fit_displacements(block_amplitudes, basis)
    start_hz = start_frequencies(block_amplitudes, basis, displacements, reed, model, series)
    modal = fit_modes(
        displacements,
        basis,
        block_amplitudes.drive_hz,
        block_amplitudes.volts,
        start_hz,
        most_off=_FEW_OFF,
    )
    if np.count_nonzero(modal.off) > _FEW_OFF:
        # The modes predict these holograms, and so the fringe in which their displacement lies.
        expected_rad = modal.amplitude_rad, _with_smooth_drive(modal, block_amplitudes.drive_hz)
        displacements = refit_displacements(
            block_amplitudes, basis, displacements, expected_rad, modal.off, modal.common_mode_shift
        )
        modal = fit_modes(
            displacements, basis, block_amplitudes.drive_hz, block_amplitudes.volts, start_hz, modal
        )
    return joint_fit_of(modal, block_amplitudes, basis, displacements)


def joint_fit_of(
    modal: ModalFit,
    block_amplitudes: BlockAmplitudes,
    basis: ShapeBasis,
    displacements: Displacements,
) -> JointFit:
    """Decide which modes are identified, and collect the results."""
    doubts = _doubts(modal, basis, displacements)
    found = {
        name: _resonance(modal, m, block_amplitudes, basis)
        for m, name in enumerate(modal.names)
        if not doubts[name]
    }
    return JointFit(
        block_amplitudes=block_amplitudes,
        basis=basis,
        displacements=displacements,
        modal=modal,
        resonances=dict(sorted(found.items(), key=lambda item: item[1].frequency_hz)),
        not_identified={name: reason for name, reason in doubts.items() if reason},
    )


def _with_smooth_drive(modal: ModalFit, drive_hz: Array) -> ComplexArray:
    """Return expected amplitudes (k, j) with the drive of outliers interpolated from the others.

    Beyond 1.84 rad the block amplitudes decrease again. Displacements in a wrong fringe may then
    explain many successive holograms down to the noise, and the fitted drive follows them. The
    modes with an interpolated drive predict the right fringe.
    """
    log_hz, log_drive, good = np.log(drive_hz), np.log(np.abs(modal.drive)), ~modal.off
    smooth = np.interp(log_hz, log_hz[good], log_drive[good])
    expected: ComplexArray = modal.amplitude_rad * np.exp(smooth - log_drive)[:, None]
    return expected


def _doubts(modal: ModalFit, basis: ShapeBasis, displacements: Displacements) -> dict[str, str]:
    """Return the reason why each mode is not identified, by name; empty if it is."""
    unreached = float(np.mean(~displacements.reached))
    if unreached > _MOST_UNREACHED:
        reason = f"{unreached:.0%} of the holograms cannot be explained as vibrations of this reed"
        return dict.fromkeys(modal.names, reason)
    if modal.discrepancy > _MOST_DISCREPANCY:
        reason = (
            f"{modal.discrepancy:.0%} of the vibration is not explained by modes of this kind of "
            "reed; check that reed, clamp and chamber are those of the protocol"
        )
        return dict.fromkeys(modal.names, reason)
    return {
        name: _doubt(modal, m, basis.shapes[basis.names.index(name)])
        for m, name in enumerate(modal.names)
    }


def _doubt(modal: ModalFit, m: int, shape: Array) -> str:
    if modal.participation_error[m] * _DEVIATIONS > abs(modal.participation[m]):
        return f"its amplitude is below {_DEVIATIONS:g} times its standard error"
    if modal.error_cents[m] > _WIDEST_CENTS:
        return f"the standard error of its frequency is {modal.error_cents[m]:.0f} cents"
    similarity = mac(modal.shapes[m], shape)
    if similarity < _LEAST_MAC:
        return f"its shape differs from that of its name (MAC {similarity:.2f})"
    return ""


def mac(one: Array, other: Array) -> float:
    """Return the modal assurance criterion of two shapes (j,) in orthonormal coordinates."""
    return float((one @ other) ** 2 / ((one @ one) * (other @ other)))


def _resonance(
    modal: ModalFit, m: int, block_amplitudes: BlockAmplitudes, basis: ShapeBasis
) -> Resonance:
    hz, name = float(modal.hz[m]), modal.names[m]
    nearest = int(np.abs(np.log(block_amplitudes.drive_hz / hz)).argmin())
    participation = np.abs(modal.participation)
    return Resonance(
        name=name,
        frequency_hz=hz,
        error_cents=float(modal.error_cents[m]),
        step_index=int(block_amplitudes.step_index[nearest]),
        amplitude_rad=float(np.abs(modal.modal_rad[nearest, m])),
        method=METHOD,
        response_hz=_peak_response_hz(block_amplitudes.drive_hz, np.abs(modal.modal_rad[:, m]), hz),
        loss_factor=float(modal.loss_factor[m]),
        loss_error=float(modal.loss_error[m]),
        participation=float(participation[m] / participation.max()),
        similarity=mac(modal.shapes[m], basis.shapes[basis.names.index(name)]),
    )


def _peak_response_hz(drive_hz: Array, amplitude: Array, hz: float) -> float:
    """Return the frequency of the peak response near a resonance, by a parabola."""
    cents = 1200 * np.log2(drive_hz / hz)
    near = np.flatnonzero(np.abs(cents) < _PEAK_CENTS)
    if not near.size:
        return hz
    top = int(near[np.argmax(amplitude[near])])
    if top in (0, len(cents) - 1):
        return float(drive_hz[top])
    three = slice(top - 1, top + 2)
    bend, slope, _ = np.polyfit(cents[three] - cents[top], np.log(amplitude[three]), 2)
    shift = -slope / (2 * bend) if bend < 0 else 0.0
    return float(drive_hz[top] * 2 ** (shift / 1200))
