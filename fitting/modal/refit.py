"""Fit another sweep of a reed, or the same holograms less unshifted light, from an earlier fit."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0
from threadpoolctl import threadpool_limits

from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import (
    BlockAmplitudes,
    UnshiftedLight,
    read_block_amplitudes,
)
from fitting.holograms.displacement import refit_displacements
from fitting.holograms.object_field import CommonModeError
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements
from fitting.holograms.unknown_positions import covariance_by_positions
from fitting.modal.fit import fit_modes_with_known_drive
from fitting.modal.identify import (
    JointFit,
    MeasuredSweep,
    finished,
    joint_fit_of,
    modes_in_turns,
    naming_of,
    with_smooth_drive,
)
from fitting.modal.modal_fit import ModalFit
from holography.arrays import ComplexArray
from physics.plausible.reeds import PlausibleReeds
from physics.reed.cane.viscoelastic import Series
from physics.reed.reduced.reed import ReducedReed
from runs.reader import Run

# Iterations over object field and phases of holograms.
_FIELD_TURNS = 12


def fit_same_reed(
    run: Run, before: JointFit, reed: ReducedReed, unshifted: UnshiftedLight | None = None
) -> JointFit:
    """Fit a sweep of a reed, starting from the fit of another sweep of the same reed.

    This takes a third of the time of `fit_jointly`: the vibration starts from that of the other
    sweep, scaled by the volts. Phases of block amplitudes, leading singular vectors, are arbitrary
    in each run, so that the object field is new also in the same clamping. The blocks lie where
    this run shows the reed: a hand may have moved it, and each run measures its place.

    Parameters
    ----------
    run : Run
    before : JointFit
        Fit of another run of the reed.
    reed : ReducedReed
        Reduced model of the runs' kind of reed.
    unshifted : UnshiftedLight, optional
        Leaked light that is subtracted.

    Raises
    ------
    FitError
        As `fit_jointly`.
    RunFileError
        If a step cannot be read.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        block_amplitudes = read_block_amplitudes(run, unshifted)
        basis = before.basis.at(reed, block_amplitudes.x_m, block_amplitudes.y_m)
        displacements, start_hz, known = _from_before(block_amplitudes, before, basis)
        # The lines of the drive stay, so that no mode can be absorbed by a new line.
        modal = fit_modes_with_known_drive(
            displacements, basis, block_amplitudes.drive_hz, start_hz, known
        )
        # What this sweep says of the forms of the drive must not count again when the other is
        # fitted from this one.
        modal = replace(modal, drive_forms=known.drive_forms)
        same = block_amplitudes, basis, displacements
        modal = modal.with_errors(covariance_by_positions(*same, modal.influence))
        return joint_fit_of(MeasuredSweep(*same, modal, start_hz), before.naming)


def fit_without_unshifted(before: JointFit, reed: ReducedReed, series: Series) -> JointFit:
    """Fit a sweep again with unshifted light subtracted as the vibration changes it.

    Unshifted light is proportional to J₀ of the vibration, which is known only after a fit.

    Parameters
    ----------
    before : JointFit
        Fit with unshifted light subtracted as if nothing vibrated.
    reed : ReducedReed
        Reduced model of the run's kind of reed.
    series : Series

    Raises
    ------
    FitError
        As `fit_same_reed`.
    """
    block_amplitudes = before.block_amplitudes
    if block_amplitudes.subtracted is None:
        return before
    # Outliers may have led the drive astray: they are in other fringes than modes expect.
    likely_rad = with_smooth_drive(before.modal, block_amplitudes.drive_hz)
    moved_rad = np.abs(likely_rad @ before.basis.functions.T).T
    light = (block_amplitudes.subtracted * j0(moved_rad)).astype(np.complex64)
    with threadpool_limits(limits=1, user_api="blas"):
        less = replace(block_amplitudes, value=block_amplitudes.recorded - light, subtracted=light)
        # Unshifted light may have misled the modes, but hardly the displacements: only these are a
        # start. The modes predict the fringe in which outliers lie.
        none = np.zeros_like(before.modal.common_mode_shift)
        expected_rad = before.modal.amplitude_rad, likely_rad
        start, off = before.displacements, before.modal.off
        found = refit_displacements(less, before.basis, start, expected_rad, off, none)
        sweep = finished(modes_in_turns(less, before.basis, found, before.start_hz))
        return joint_fit_of(sweep, naming_of(sweep, PlausibleReeds.of(reed, series)))


def _from_before(
    block_amplitudes: BlockAmplitudes, before: JointFit, basis: ShapeBasis
) -> tuple[Displacements, dict[str, float], ModalFit]:
    """Fit displacements from an earlier fit; also return its modes, and the fit at these steps."""
    known = _moved(before.modal, before.block_amplitudes, block_amplitudes)
    start = _as_before(block_amplitudes, before, known, basis)
    everything = np.ones(len(block_amplitudes.drive_hz), dtype=bool)
    none = np.zeros(start.common_mode.precision.shape[:2])
    displacements = refit_displacements(
        block_amplitudes, basis, start, (start.amplitude_rad,), everything, none
    )
    start_hz = dict(zip(before.modal.names, before.modal.hz.tolist(), strict=True))
    return displacements, start_hz, known


def _as_before(
    block_amplitudes: BlockAmplitudes, before: JointFit, known: ModalFit, basis: ShapeBasis
) -> Displacements:
    """Predict the displacements of a sweep: those of the fit of another one, at these steps."""
    old, count = before.displacements, len(block_amplitudes.drive_hz)
    size = known.amplitude_rad.shape[1]
    return Displacements(
        amplitude_rad=known.amplitude_rad,
        information=np.zeros((count, 2 * size, 2 * size)),
        common_mode=CommonModeError(
            np.zeros((count, 2 * size, old.common_mode.response.shape[2])),
            np.zeros((count, *old.common_mode.precision.shape[1:])),
            np.zeros((count, old.common_mode.pull.shape[1])),
        ),
        recording_rank=block_amplitudes.recording_rank,
        misfit=np.full(count, np.inf),
        gain=np.zeros(count),
        gain_nepers=old.gain_nepers,
        object_field=_new_object_field(block_amplitudes, known.amplitude_rad, basis),
        field_variance=None,
        change=None,
        reached=np.zeros(count, dtype=bool),
    )


def _new_object_field(
    block_amplitudes: BlockAmplitudes, a: ComplexArray, basis: ShapeBasis
) -> NDArray[np.complex64]:
    """Fit the object field (n,) to holograms of known displacements (k, j).

    The phase of each hologram is free; phases and object field are fitted in turns.
    """
    u = a.astype(np.complex64) @ basis.functions.T
    fringes = (u * BesselTable().tensor(np.abs(u))[0]).T
    power = np.sum(np.abs(fringes) ** 2, axis=1)
    matched = block_amplitudes.value * fringes.conj()
    phase = np.ones(fringes.shape[1], np.complex64)
    # Start from the phase differences of neighbouring holograms.
    neighbours = np.sum(matched[:, 1:] * matched[:, :-1].conj(), axis=0)
    phase[1:] = np.cumprod(neighbours / np.maximum(np.abs(neighbours), 1e-12))
    for _ in range(_FIELD_TURNS):
        object_field = matched @ phase.conj() / np.maximum(power, 1e-12)
        towards = object_field.conj() @ matched
        phase = towards / np.maximum(np.abs(towards), 1e-12)
    found: NDArray[np.complex64] = object_field.astype(np.complex64)
    return found


def _moved(modal: ModalFit, before: BlockAmplitudes, now: BlockAmplitudes) -> ModalFit:
    """Transfer a modal fit to the frequencies and volts of another sweep."""
    place = np.interp(np.log(now.drive_hz), np.log(before.drive_hz), np.arange(len(before.volts)))
    at = np.rint(place).astype(int)
    louder = now.volts / before.volts[at]
    return replace(
        modal,
        drive=modal.drive[at] * louder,
        amplitude_rad=modal.amplitude_rad[at] * louder[:, None],
        modal_rad=modal.modal_rad[at] * louder[:, None],
        log_drive_covariance=modal.log_drive_covariance[np.ix_(at, at)],
        drive_forms=tuple(form.at(at, louder) for form in modal.drive_forms),
        participations=modal.participations[at],
        off=np.zeros(len(at), dtype=bool),
        state=replace(
            modal.state,
            log_drive=modal.state.log_drive[at] + np.log(louder),
            scatter=modal.state.scatter[at],
        ),
    )
