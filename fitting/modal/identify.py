"""Find resonances by one joint fit of all holograms of a sweep."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from fitting.acoustics.poles import (
    MOST_DB,
    WITHIN_CENTS,
    ExcitationPeak,
    find_excitation_peaks,
)
from fitting.forward import ForwardModel
from fitting.fringes.start_frequencies import middling_shapes, start_frequencies
from fitting.holograms.block_amplitudes import (
    BlockAmplitudes,
    UnshiftedLight,
    read_block_amplitudes,
)
from fitting.holograms.displacement import fit_displacements, refit_displacements
from fitting.holograms.right_fringes.trials import same_fringe
from fitting.holograms.shape_basis import ShapeBasis
from fitting.holograms.solved_sweep import Displacements
from fitting.holograms.unknown_positions import covariance_by_positions
from fitting.modal.fit import fit_modes, fit_roughly
from fitting.modal.modal_fit import ModalFit
from fitting.modal.model import LOSS
from fitting.names.final_names import final_names
from fitting.names.naming import ModeNaming, name_modes, reeds_behind
from fitting.names.places import misplaced_hz, places_of_modes
from fitting.names.reed_posterior import ReedPosterior
from fitting.resonance import Resonance, peak_response_hz
from holography.arrays import Array, ComplexArray
from physics.errors import ImpossibleReedError
from physics.plausible.reeds import PlausibleReeds
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    viscoelastic_cane,
)
from physics.reed.reduced.reed import ReducedReed
from runs.reader import Run

METHOD = "joint"
_CENT = float(np.log(2) / 1200)
# A mode is identified if its amplitude exceeds this multiple of its standard error, and its
# frequency is known within a step of the sweep.
_DEVIATIONS, _WIDEST_CENTS = 5.0, 25.0
# ... if it is more likely a mode of the reed than not, and if its name is sure.
_MOST_SPURIOUS = 0.5
# Outliers that a fit may have, for example holograms at an acoustic resonance.
_FEW_OFF = 2
# How often displacements are fitted again with the common-mode error that the modes show, and the
# part of the displacements that it may be: displacements are then linear in it to half its square,
# 0.05 %, less than shapes leave.
_TURNS, _LINEAR = 2, 0.03
# ... and how often at most while outliers get into other fringes, some at a time (decision 0035).
# Chosen: a bound of the time; the largest group so far, 15 outliers, changed no more after four.
_MOST_TURNS = 8
# Shear of wood loses up to twice as much as bending (Labonnote et al., Wood Sci. Technol. 47, 1033,
# 2013). What loses more than that, against the others, is two resonances (decision 0077).
_MOST_LOSS = 2.0
# Log frequency from a mode to the end of outliers that may hide its resonance: three semitones, as
# far as a mode is sought from where it is expected (`fitting.fringes.start_frequencies`).
_BESIDE = 300 * _CENT
# Fraction of unexplained holograms above which no mode of a sweep is identified.
_MOST_UNREACHED = 0.2
# ... and discrepancy of the model. Chosen: four times that of shape errors of 10 µm.
_MOST_DISCREPANCY = 0.08
_CHECK = "check that reed, clamp and chamber are those of the protocol"


@dataclass(frozen=True)
class MeasuredSweep:
    """A sweep with its displacements and modes, whatever their names are.

    Attributes
    ----------
    block_amplitudes : BlockAmplitudes
    basis : ShapeBasis
    displacements : Displacements
    modal : ModalFit
    start_hz : mapping
        Frequency from which the fit of each mode started, by its name in `modal`.
    """

    block_amplitudes: BlockAmplitudes
    basis: ShapeBasis
    displacements: Displacements
    modal: ModalFit
    start_hz: Mapping[str, float]

    @cached_property
    def drive_peaks(self) -> tuple[ExcitationPeak, ...]:
        """Peaks of the drive: acoustic resonances, or vibration that no mode explains."""
        modal, volts = self.modal, self.block_amplitudes.volts
        found = find_excitation_peaks(
            self.block_amplitudes.drive_hz,
            np.log(np.abs(modal.drive) / volts),
            modal.log_drive_covariance,
            modal.state.gain,
            modal.off,
        )
        return tuple(found)


@dataclass(frozen=True)
class JointFit(MeasuredSweep):
    """Result of the joint fit of a sweep, with all intermediate results.

    Attributes
    ----------
    naming : mapping
        What is known of the name of each measured mode, by its name in `modal`: the name of the
        shape that the fit started from.
    names : tuple of str
        Names of the modes of `modal`, in its order. No two are the same; one that is not sure ends
        in a question mark.
    resonances : dict
        Identified modes by name, in order of frequency.
    not_sure : dict
        Measured modes whose name is not sure, by the most probable name with a question mark.
    not_identified : dict
        Reason for each of the other modes within the sweep, by name.
    """

    naming: Mapping[str, ModeNaming]
    names: tuple[str, ...]
    resonances: dict[str, Resonance]
    not_sure: dict[str, Resonance]
    not_identified: dict[str, str]

    @property
    def visible_hz(self) -> dict[str, float]:
        """Frequencies (Hz) of modes that are measured, or absorbed by the drive, by name."""
        own = {**self.resonances, **self.not_sure}
        measured = {name: mode.frequency_hz for name, mode in own.items()}
        return measured | {self.names[m]: float(self.modal.hz[m]) for m in _absorbed(self)}


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


def series_of(run: Run) -> Series:
    """Return the series, and so the dryness, of a run."""
    return Series.B if run.series == "B" else Series.A


def _fitted(
    run: Run, reed: ReducedReed, model: ForwardModel, unshifted: UnshiftedLight | None
) -> JointFit:
    series = series_of(run)
    block_amplitudes = read_block_amplitudes(run, unshifted)
    cane = viscoelastic_cane(Components(), series)
    basis = middling_shapes(reed, cane, block_amplitudes.x_m, block_amplitudes.y_m)
    displacements = fit_displacements(block_amplitudes, basis)
    start_hz = start_frequencies(block_amplitudes, basis, displacements, reed, model, series)
    reeds = PlausibleReeds.of(reed, series)
    rough = modes_in_turns(block_amplitudes, basis, displacements, start_hz)
    sweep = finished(_with_modes_in_place(rough, reeds))
    return joint_fit_of(sweep, naming_of(sweep, reeds))


def finished(sweep: MeasuredSweep) -> MeasuredSweep:
    """Fit modes and drive of a sweep, starting from the frequencies of its rough fit.

    Its other numbers are no start: they may lead to another optimum (decision 0063).
    """
    blocks, basis, displacements = sweep.block_amplitudes, sweep.basis, sweep.displacements
    modal = fit_modes(displacements, basis, blocks.drive_hz, blocks.volts, _found_hz(sweep))
    # Positions of light within blocks add errors that holograms do not show (decision 0079).
    more = covariance_by_positions(blocks, basis, displacements, modal.influence)
    return replace(sweep, modal=modal.with_errors(more))


def _found_hz(sweep: MeasuredSweep) -> dict[str, float]:
    return dict(zip(sweep.modal.names, sweep.modal.hz.tolist(), strict=True))


def _with_modes_in_place(sweep: MeasuredSweep, reeds: PlausibleReeds) -> MeasuredSweep:
    """Fit a sweep again from where the reed has modes that a rough fit has put elsewhere.

    A start may be nearer to another resonance than to its own. Two modes then share that one, and
    shapes and losses of all others make up for the one that is missing. The reed that the other
    modes show has it within some cents. The fit that explains more is taken.
    """
    hz, fitted_hz = sweep.block_amplitudes.drive_hz, _found_hz(sweep)
    misplaced = misplaced_hz(places_of_modes(_reeds_behind(sweep, reeds)), fitted_hz, hz)
    if not misplaced:
        return sweep
    start_hz, volts = fitted_hz | misplaced, sweep.block_amplitudes.volts
    again = fit_roughly(sweep.displacements, sweep.basis, hz, volts, start_hz)
    if again.discrepancy >= sweep.modal.discrepancy:
        return sweep
    return replace(sweep, modal=again, start_hz=start_hz)


def naming_of(sweep: MeasuredSweep, reeds: PlausibleReeds) -> Mapping[str, ModeNaming]:
    """Name the modes that are measured; there are no names if the sweep or the reed is in doubt."""
    return name_modes(_reeds_behind(sweep, reeds), sweep.modal.names, reeds)


def _reeds_behind(sweep: MeasuredSweep, reeds: PlausibleReeds) -> tuple[ReedPosterior, ...]:
    """Return the reeds that have the modes of a sweep; none if the sweep or the reed is in doubt.

    A reed that is not possible has no names: then all modes are refused.
    """
    if _general_doubt(sweep):
        return ()
    blocks = sweep.block_amplitudes
    index = [m for m, doubt in enumerate(_measurement_doubts(sweep)) if not doubt]
    points_m = blocks.x_m, blocks.y_m
    measured = np.array(index, dtype=np.intp)
    with suppress(ImpossibleReedError):
        return reeds_behind(sweep.modal, sweep.basis, points_m, blocks.drive_hz, measured, reeds)
    return ()


def modes_in_turns(
    block_amplitudes: BlockAmplitudes,
    basis: ShapeBasis,
    displacements: Displacements,
    start_hz: Mapping[str, float],
) -> MeasuredSweep:
    """Fit modes roughly, and displacements again with the common-mode error that they show.

    Parameters
    ----------
    block_amplitudes : BlockAmplitudes
    basis : ShapeBasis
    displacements : Displacements
        Displacements that were fitted without modes.
    start_hz : mapping
        Start frequency of each mode, by name.
    """
    same = basis, block_amplitudes.drive_hz, block_amplitudes.volts, dict(start_hz)
    modal = fit_roughly(displacements, *same)
    tried, moved = np.zeros_like(modal.off), False
    for turn in range(_MOST_TURNS):
        few_off = np.count_nonzero(modal.off) <= _FEW_OFF
        promising = moved or np.any(modal.off & ~tried)
        shifted = turn < _TURNS and _common_mode_part(displacements, modal) > _LINEAR
        if not (promising or shifted):
            break
        before, tried = displacements, modal.off
        # The modes predict the fringe in which outliers lie.
        expected_rad = modal.amplitude_rad, with_smooth_drive(modal, block_amplitudes.drive_hz)
        displacements = refit_displacements(
            block_amplitudes, basis, before, expected_rad, tried, modal.common_mode_shift
        )
        moved = not np.all(
            same_fringe(before.amplitude_rad[tried], displacements.amplitude_rad[tried])
        )
        modal = fit_roughly(displacements, *same, modal if few_off else None)
    return MeasuredSweep(block_amplitudes, basis, displacements, modal, start_hz)


def joint_fit_of(sweep: MeasuredSweep, naming: Mapping[str, ModeNaming]) -> JointFit:
    """Decide which modes are identified, and collect the results; for `naming` see `JointFit`."""
    modal, doubts = sweep.modal, _doubts(sweep, naming)
    names = final_names(modal.names, naming, {label for label, doubt in doubts.items() if doubt})
    found = [
        _resonance(sweep, m, names[m], naming[label])
        for m, label in enumerate(modal.names)
        if not doubts[label]
    ]
    found.sort(key=lambda each: each.frequency_hz)
    return JointFit(
        block_amplitudes=sweep.block_amplitudes,
        basis=sweep.basis,
        displacements=sweep.displacements,
        modal=modal,
        start_hz=sweep.start_hz,
        naming=naming,
        names=names,
        resonances={each.name: each for each in found if not each.name.endswith("?")},
        not_sure={each.name: each for each in found if each.name.endswith("?")},
        not_identified={
            name: doubts[label]
            for name, label in zip(names, modal.names, strict=True)
            if doubts[label]
        },
    )


def _common_mode_part(displacements: Displacements, modal: ModalFit) -> float:
    """Return the common-mode error of a typical hologram as a part of its displacements."""
    error = displacements.common_mode.response @ modal.common_mode_shift[..., None]
    size = np.linalg.norm(displacements.amplitude_rad, axis=1)
    seen = size > 0
    return float(np.median(np.linalg.norm(error[seen, :, 0], axis=1) / size[seen]))


def with_smooth_drive(modal: ModalFit, drive_hz: Array) -> ComplexArray:
    """Return expected amplitudes (k, j) with the drive of outliers interpolated from the others.

    Beyond 1.84 rad the block amplitudes decrease again. Displacements in a wrong fringe may then
    explain many successive holograms down to the noise, and the fitted drive follows them. The
    modes with an interpolated drive predict the right fringe.

    Parameters
    ----------
    modal : ModalFit
    drive_hz : (k,) float
        Drive frequencies.
    """
    log_hz, log_drive, good = np.log(drive_hz), np.log(np.abs(modal.drive)), ~modal.off
    smooth = np.interp(log_hz, log_hz[good], log_drive[good])
    expected: ComplexArray = modal.amplitude_rad * np.exp(smooth - log_drive)[:, None]
    return expected


def _general_doubt(sweep: MeasuredSweep) -> str:
    """Return the reason why no mode of the sweep is identified; empty if there is none."""
    unreached = float(np.mean(~sweep.displacements.reached))
    if unreached > _MOST_UNREACHED:
        return f"{unreached:.0%} of the holograms cannot be explained as vibrations of this reed"
    if sweep.modal.discrepancy > _MOST_DISCREPANCY:
        return (
            f"{sweep.modal.discrepancy:.0%} of the vibration is not explained by modes of this "
            f"kind of reed; {_CHECK}"
        )
    return ""


def _doubts(sweep: MeasuredSweep, naming: Mapping[str, ModeNaming]) -> dict[str, str]:
    """Return the reason why each mode is not identified, by its label; empty if it is."""
    names = sweep.modal.names
    if general := _general_doubt(sweep):
        return dict.fromkeys(names, general)
    doubts = zip(names, _measurement_doubts(sweep), strict=True)
    return {label: doubt or _doubt_of_name(naming, label) for label, doubt in doubts}


def _measurement_doubts(sweep: MeasuredSweep) -> list[str]:
    """Return the reason why each mode is not measured, whatever its name is; empty if it is."""
    doubts = _own_doubts(sweep)
    for m, peak in _absorbed(sweep).items():
        doubts[m] = (
            f"the drive has a peak of {peak.height_db:.0f} dB at {peak.hz:.0f} Hz, which is "
            "probably vibration of this mode"
        )
    return doubts


def _absorbed(sweep: MeasuredSweep) -> dict[int, ExcitationPeak]:
    """Return the modes that the drive has probably absorbed, with the peak of the drive.

    Acoustic resonances are not as high. Within the width of a mode the fit divides one resonance
    between drive and mode, and its standard errors hold for this division only. Next to a line that
    has taken all of its resonance a mode may be found anywhere: lines where it was expected count,
    too.
    """
    found = dict[int, ExcitationPeak]()
    modes = [m for m, doubt in enumerate(_own_doubts(sweep)) if not doubt]
    expected_hz = np.array([sweep.start_hz[sweep.modal.names[m]] for m in modes])
    for peak in sweep.drive_peaks:
        both_hz = np.stack([sweep.modal.hz[modes], expected_hz])
        off = np.min(np.abs(np.log(both_hz / peak.hz)), axis=0) / _CENT
        if peak.height_db > MOST_DB and len(modes) and off.min() < WITHIN_CENTS:
            found[modes[int(off.argmin())]] = peak
    return found


def _own_doubts(sweep: MeasuredSweep) -> list[str]:
    """Return the reason why each mode is not measured, by its own numbers; empty if it is."""
    count = len(sweep.modal.names)
    doubts = [_doubt(sweep.modal, m, sweep.block_amplitudes) for m in range(count)]
    for m, (low_hz, high_hz) in _hidden(sweep).items():
        doubts[m] = doubts[m] or (
            f"all holograms from {low_hz:.0f} to {high_hz:.0f} Hz are in a wrong fringe, or are "
            "not explained: its resonance may be there"
        )
    return doubts


def _hidden(sweep: MeasuredSweep) -> dict[int, tuple[float, float]]:
    """Return the modes nearest to where neighbours are outliers, with the ends of that.

    Single holograms fail by chance. As many neighbours as a resonance is wide hide one, and the fit
    has then put a mode where there is none.
    """
    hz, found = sweep.block_amplitudes.drive_hz, dict[int, tuple[float, float]]()
    steps = np.flatnonzero(sweep.modal.off)
    for run in np.split(hz[steps], np.flatnonzero(np.diff(steps) > 1) + 1):
        if len(run) and run[-1] > run[0] * (1 + LOSS):
            middle_hz = np.sqrt(run[0] * run[-1])
            away = np.abs(np.log(sweep.modal.hz / middle_hz))
            nearest = int(away.argmin())
            if away[nearest] < 0.5 * np.log(run[-1] / run[0]) + _BESIDE:
                found[nearest] = float(run[0]), float(run[-1])
    return found


def _doubt(modal: ModalFit, m: int, block_amplitudes: BlockAmplitudes) -> str:
    """Return the reason why a mode is not measured, by its own numbers; empty if it is."""
    if modal.participation_error[m] * _DEVIATIONS > abs(modal.participation[m]):
        return f"its amplitude is below {_DEVIATIONS:g} times its standard error"
    if modal.error_cents[m] > _WIDEST_CENTS:
        return f"the standard error of its frequency is {modal.error_cents[m]:.0f} cents"
    if (loss := modal.loss_over_others(m)) > _MOST_LOSS:
        return f"its loss factor is {loss:.1f} times that of other modes: it may be two resonances"
    if modal.is_left_out(m, block_amplitudes.drive_hz):
        return "most holograms at its resonance are in a wrong fringe, or are not explained"
    # A resonance shows by the response on both sides of it.
    width = 0.5 * float(modal.loss_factor[m]) + _CENT * float(modal.error_cents[m])
    first, last = float(block_amplitudes.drive_hz[0]), float(block_amplitudes.drive_hz[-1])
    if not first * np.exp(width) < modal.hz[m] < last * np.exp(-width):
        return (
            f"its resonance ({modal.hz[m]:.0f} Hz) is not inside the sweep ({first:.0f} to "
            f"{last:.0f} Hz) by more than half its width"
        )
    return ""


def _doubt_of_name(naming: Mapping[str, ModeNaming], label: str) -> str:
    """Return the reason why a measured mode is no mode of the reed; empty if it may be one."""
    if not naming:
        return f"no reed of this kind has modes like those of this sweep; {_CHECK}"
    if label not in naming:
        return "its name is not known: it was not measured in the first fit of this reed"
    own = naming[label]
    if own.spurious <= _MOST_SPURIOUS:
        return ""
    if own.outside > _MOST_SPURIOUS:
        return (
            "by the other modes, its resonance is outside the sweep (probability "
            f"{own.outside:.0%}): the fit has mistaken something else for it"
        )
    return (
        "a reed with the other modes has none of this frequency and shape (probability "
        f"{own.spurious:.0%}): the fit has mistaken something else for a mode"
    )


def mac(one: Array, other: Array) -> float:
    """Return the modal assurance criterion of two shapes (j,) in orthonormal coordinates."""
    return float((one @ other) ** 2 / ((one @ one) * (other @ other)))


def _resonance(sweep: MeasuredSweep, m: int, name: str, naming: ModeNaming) -> Resonance:
    modal, block_amplitudes, basis = sweep.modal, sweep.block_amplitudes, sweep.basis
    hz = float(modal.hz[m])
    likely = naming.name if naming.name in basis.names else modal.names[m]
    loss_factor, loss_error = float(modal.loss_factor[m]), float(modal.loss_error[m])
    shared = 0.0 if naming.stiffening is None else naming.stiffening.loss_error
    if naming.stiffening is not None:
        assumed = float(basis.stiffening[basis.names.index(modal.names[m])])
        loss_factor *= naming.stiffening.loss_ratio(assumed)
        loss_error = float(np.hypot(loss_error, shared))
    # The drive of an outlier is as wrong as its displacement.
    sure = np.flatnonzero(~modal.off) if not modal.off.all() else np.arange(len(modal.off))
    drive_hz, moved_rad = block_amplitudes.drive_hz[sure], np.abs(modal.modal_rad[sure, m])
    nearest = int(np.abs(np.log(drive_hz / hz)).argmin())
    participation = np.abs(modal.participation)
    return Resonance(
        name=name,
        frequency_hz=hz,
        error_cents=float(modal.error_cents[m]),
        step_index=int(block_amplitudes.step_index[sure[nearest]]),
        amplitude_rad=float(moved_rad[nearest]),
        method=METHOD,
        response_hz=peak_response_hz(drive_hz, moved_rad, hz),
        loss_factor=loss_factor,
        loss_error=loss_error,
        loss_error_shared=shared,
        participation=float(participation[m] / participation.max()),
        similarity=mac(modal.shapes[m], basis.shapes[basis.names.index(likely)]),
        name_probability=naming.probability,
        candidates=naming.candidates,
    )
