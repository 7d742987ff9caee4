"""Resonances by one joint fit of a sweep, from its holograms: phasors, displacement, modes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0
from threadpoolctl import threadpool_limits

from fitting.errors import FitError
from fitting.forward import (
    ForwardModel,
    cents_of,
    viscoelastic_cents,
)
from fitting.fringes.picking import (
    Resonance,
    likely_components,
    pick_resonances,
)
from fitting.holograms.bessel import BesselTable
from fitting.holograms.block_amplitudes import (
    Phasors,
    Unshifted,
    read_phasors,
)
from fitting.holograms.displacement import (
    Displacements,
    fit_displacements,
    refit_displacements,
)
from fitting.holograms.object_field import (
    SharedError,
    light_factor,
    smooth_functions,
)
from fitting.holograms.shape_basis import ShapeBasis, shape_basis
from fitting.modal.fit import fit_modes
from fitting.modal.modal_fit import ModalFit
from fitting.modal.model import KNOWN_LINES
from physics.reed.basis import ReducedReed
from physics.reed.names import PAPER_MODES, is_symmetric
from physics.reed.response import viscoelastic_modes
from physics.reed.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    storage_modulus_pa,
    viscoelastic_cane,
)
from runs.reader import Run

Array = NDArray[np.floating[Any]]
Amplitudes = NDArray[np.complexfloating[Any, Any]]

METHOD = "joint"
# Moduli in the middle of the sweep, in which shapes are computed.
SHAPES_HZ = 4000.0
# Frequencies by this ratio apart tell how moduli grow.
_STEP = 1.01
# Modes whose resonance lies beyond the sweep by no more than this still bend its end.
_BEYOND = 1.03
# Shapes up to here may take part in the first look at which mode is lively where.
_LOOK_HZ = 24e3
# Resonances of reeds that are not shaped as the finite elements are: of such as 10 µm are off.
_MISFIT_CENTS = 60.0
# A lively hologram counts as a mode's own if the cane that all of them tell of agrees to this share
# of the distance to the next mode of its symmetry, within limits.
_ROOM, _AGREE_CENTS = 0.4, (80.0, 300.0)
# A mode is identified if its amplitude stands out of its error by this factor, and its frequency is
# known to a step of the sweep.
_DEVIATIONS, _WIDEST_CENTS = 5.0, 25.0
# ... and if its shape is still that of its name.
_LEAST_MAC = 0.5
# A mode is liveliest this near to its resonance, if anywhere.
_PEAK_CENTS = 150.0
# So few holograms that show something else, such as a line of the air, are left alone.
_FEW_OFF = 2
# Holograms that may stay off their noise before nothing is believed of a sweep.
_MOST_UNREACHED = 0.2
# ... and what modes may leave of the vibration: reeds that are 10 µm off in shape leave 0.02, those
# of another kind 0.2.
_MOST_DISCREPANCY = 0.08
# Turns in which light and the phases of holograms settle.
_LIGHT_TURNS = 12


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


def fit_jointly(
    run: Run, reed: ReducedReed, model: ForwardModel, unshifted: Unshifted | None = None
) -> JointFit:
    """Fit all holograms of a run at once.

    Parameters
    ----------
    run : Run
    reed : ReducedReed
        Of the run's kind of reed.
    model : ForwardModel
        Says, with the population of canes, where modes may lie.
    unshifted : Unshifted, optional
        Light that is known to leak in, to be taken off.

    Raises
    ------
    FitError
        If too few holograms are good, or hardly any can be explained.
    RunFileError
        If a step cannot be read.
    """
    # Matrices are small: threads of linear algebra would wait for each other more than compute.
    with threadpool_limits(limits=1, user_api="blas"):
        return _fitted(run, reed, model, unshifted)


def _fitted(
    run: Run, reed: ReducedReed, model: ForwardModel, unshifted: Unshifted | None
) -> JointFit:
    series = Series.B if run.series == "B" else Series.A
    phasors = read_phasors(run, unshifted)
    basis = _basis(reed, viscoelastic_cane(Components(), series), phasors)
    displacements = fit_displacements(phasors, basis)
    start_hz = _starts(phasors, basis, displacements, reed, model, series)
    modal = fit_modes(
        displacements, basis, phasors.drive_hz, phasors.volts, start_hz, most_off=_FEW_OFF
    )
    if np.count_nonzero(modal.off) > _FEW_OFF:
        # Modes know what these holograms should show, and so in which fringes to look.
        expected_rad = modal.amplitude_rad, _with_usual_drive(modal, phasors.drive_hz)
        displacements = refit_displacements(
            phasors, basis, displacements, expected_rad, modal.off, modal.together
        )
        modal = fit_modes(displacements, basis, phasors.drive_hz, phasors.volts, start_hz, modal)
    return _told(modal, phasors, basis, displacements)


def _told(
    modal: ModalFit, phasors: Phasors, basis: ShapeBasis, displacements: Displacements
) -> JointFit:
    """Say which modes are identified, and why others are not."""
    doubts = _doubts(modal, basis, displacements)
    found = {
        name: _resonance(modal, m, phasors, basis)
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


def fit_again(
    run: Run, before: JointFit, *, moved: bool = False, unshifted: Unshifted | None = None
) -> JointFit:
    """Fit another sweep of the same reed from what one has told.

    A third of the work of `fit_jointly`: vibration and light are looked for where they were, driven
    by as many volts more or less.

    Parameters
    ----------
    run : Run
    before : JointFit
        Of another run, in which the reed has the same places in the image.
    moved : bool
        Whether the reed has been taken out of its clamp since: its speckle is another one.
    unshifted : Unshifted, optional
        Light that is known to leak in, to be taken off.

    Raises
    ------
    FitError
        As `fit_jointly`, and if the runs do not show the reed in the same places.
    RunFileError
        If a step cannot be read.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        phasors = read_phasors(run, unshifted)
        if phasors.x_m.shape != before.phasors.x_m.shape:
            raise FitError(
                f"{run.path}: shows the reed in {len(phasors.x_m)} places, another run of it in "
                f"{len(before.phasors.x_m)}; fit it by itself"
            )
        return _from_before(phasors, before, moved=moved)


def fit_less(before: JointFit) -> JointFit:
    """Fit a sweep once more, less the unshifted light that its vibration leaves.

    What of it is left goes by J₀ of the vibration, which nobody knows before a fit.

    Raises
    ------
    FitError
        As `fit_again`.
    """
    phasors = before.phasors
    if phasors.taken_off is None:
        return before
    moved_rad = np.abs(before.modal.amplitude_rad @ before.basis.functions.T).T
    off = (phasors.taken_off * j0(moved_rad)).astype(np.complex64)
    with threadpool_limits(limits=1, user_api="blas"):
        less = replace(phasors, value=phasors.recorded - off, taken_off=off)
        return _from_before(less, before, moved=False)


def _from_before(phasors: Phasors, before: JointFit, *, moved: bool) -> JointFit:
    start = _as_before(phasors, before)
    if moved:
        start = replace(start, light=_new_light(phasors, start.amplitude_rad, before.basis))
    everything = np.ones(len(phasors.drive_hz), dtype=bool)
    none = np.zeros(len(start.shared.precision))
    displacements = refit_displacements(
        phasors, before.basis, start, (start.amplitude_rad,), everything, none
    )
    start_hz = dict(zip(before.modal.names, before.modal.hz.tolist(), strict=True))
    known = _moved(before.modal, before.phasors, phasors)
    # A drive has the lines that it had: else modes would be free to be taken for lines anew.
    modal = fit_modes(
        displacements,
        before.basis,
        phasors.drive_hz,
        np.abs(known.drive),
        start_hz,
        known,
        lines=KNOWN_LINES,
    )
    return _told(modal, phasors, before.basis, displacements)


def _as_before(phasors: Phasors, before: JointFit) -> Displacements:
    """What displacements a sweep should show by another one."""
    known = _moved(before.modal, before.phasors, phasors)
    old, count = before.displacements, len(phasors.drive_hz)
    # Modes have told what all displacements, and so the light, were off together.
    smooth = smooth_functions(before.phasors.x_m, before.phasors.y_m)
    light = old.light * light_factor(smooth, before.modal.together)
    size = known.amplitude_rad.shape[1]
    return Displacements(
        amplitude_rad=known.amplitude_rad,
        information=np.zeros((count, 2 * size, 2 * size)),
        shared=SharedError(
            np.zeros((count, 2 * size, old.shared.response.shape[2])), old.shared.precision
        ),
        misfit=np.full(count, np.inf),
        gain=np.zeros(count),
        light=light,
        reached=np.zeros(count, dtype=bool),
    )


def _new_light(phasors: Phasors, a: Amplitudes, basis: ShapeBasis) -> NDArray[np.complex64]:
    """Light (n,) with which holograms are most nearly those of displacements (k, j).

    The phase of each hologram is free: found in turns with the light.
    """
    u = a.astype(np.complex64) @ basis.functions.T
    fringes = (u * BesselTable().tensor(np.abs(u))[0]).T
    told = np.sum(np.abs(fringes) ** 2, axis=1)
    matched = phasors.value * fringes.conj()
    phase = np.ones(fringes.shape[1], np.complex64)
    # Begin with the phase of each hologram beside the one after it.
    neighbours = np.sum(matched[:, 1:] * matched[:, :-1].conj(), axis=0)
    phase[1:] = np.cumprod(neighbours / np.maximum(np.abs(neighbours), 1e-12))
    for _ in range(_LIGHT_TURNS):
        light = matched @ phase.conj() / np.maximum(told, 1e-12)
        towards = light.conj() @ matched
        phase = towards / np.maximum(np.abs(towards), 1e-12)
    found: NDArray[np.complex64] = light.astype(np.complex64)
    return found


def _moved(modal: ModalFit, before: Phasors, now: Phasors) -> ModalFit:
    """Modes of a sweep at the frequencies and volts of another one."""
    place = np.interp(np.log(now.drive_hz), np.log(before.drive_hz), np.arange(len(before.volts)))
    at = np.rint(place).astype(int)
    louder = now.volts / before.volts[at]
    return replace(
        modal,
        drive=modal.drive[at] * louder,
        amplitude_rad=modal.amplitude_rad[at] * louder[:, None],
        modal_rad=modal.modal_rad[at] * louder[:, None],
        participations=modal.participations[at],
        off=np.zeros(len(at), dtype=bool),
        state=replace(modal.state, log_drive=modal.state.log_drive[at] + np.log(louder)),
    )


def _with_usual_drive(modal: ModalFit, drive_hz: Array) -> Amplitudes:
    """Amplitudes (k, j) that holograms would show if those that are off were driven as the others.

    Fringes of the first order fold: beyond 1.84 rad phasors fall again, and displacements may take
    the one for the other in many holograms in a row, down to the noise. Modes know better, if the
    drive that follows such displacements is not asked.
    """
    log_hz, log_drive, told = np.log(drive_hz), np.log(np.abs(modal.drive)), ~modal.off
    usual = np.interp(log_hz, log_hz[told], log_drive[told])
    expected: Amplitudes = modal.amplitude_rad * np.exp(usual - log_drive)[:, None]
    return expected


def _basis(reed: ReducedReed, cane: ViscoelasticCane, phasors: Phasors) -> ShapeBasis:
    """Shapes of a reed of middling cane."""

    def moduli_pa(hz: float) -> Array:
        return np.array([storage_modulus_pa(z, hz) for z in (cane.young_L, cane.shear_LT)])

    def growth(hz: float) -> tuple[float, float]:
        E, G = np.log(moduli_pa(hz * _STEP) / moduli_pa(hz / _STEP)) / (2 * np.log(_STEP))
        return float(E), float(G)

    E_pa, G_pa = moduli_pa(SHAPES_HZ)
    return shape_basis(reed, float(E_pa), float(G_pa), phasors.x_m, phasors.y_m, growth)


def _starts(
    phasors: Phasors,
    basis: ShapeBasis,
    displacements: Displacements,
    reed: ReducedReed,
    model: ForwardModel,
    series: Series,
) -> dict[str, float]:
    """Where each mode within the sweep is to be looked for, by name.

    Liveliest holograms of the paper's modes tell of the cane, and the cane of all other modes.
    Where a mode outweighs all others in its liveliest hologram, it is looked for there: a reed need
    not have the shape of its kind.
    """
    look = basis.hz < _LOOK_HZ
    modal = np.abs(displacements.amplitude_rad @ np.linalg.pinv(basis.shapes[look]))
    names = [name for name, counts in zip(basis.names, look, strict=True) if counts]
    weighty = _outweighing(modal * np.linalg.norm(basis.shapes[look], axis=1), names)
    picked = pick_resonances(
        phasors.drive_hz,
        phasors.step_index,
        modal,
        names,
        model,
        series,
        lambda _shape, _picture: True,
        misfit_cents=_MISFIT_CENTS,
    )
    components = likely_components(picked, model, series, _MISFIT_CENTS)
    try:
        expected = _expected_hz(basis, reed, viscoelastic_cane(components, series))
    except ValueError:
        # What was picked speaks for no possible cane: look where the mean of all canes has modes.
        components = Components()
        expected = _expected_hz(basis, reed, viscoelastic_cane(components, series))
    paper_cents = dict(
        zip(
            model.modes,
            viscoelastic_cents(model, viscoelastic_cane(components, series), series),
            strict=True,
        )
    )
    starts = dict(expected)
    for name in expected:
        if name not in PAPER_MODES or name not in paper_cents:
            continue
        seen_hz = [phasors.drive_hz[k] for k in weighty[name]]
        if name in picked:
            seen_hz.append(picked[name].frequency_hz)
        # What was seen may be another mode's peak, or a line: it counts if the cane agrees.
        apart = [abs(float(cents_of(hz)) - paper_cents[name]) for hz in seen_hz]
        if apart and min(apart) < _room_cents(name, paper_cents):
            starts[name] = float(seen_hz[int(np.argmin(apart))])
    first, last = phasors.drive_hz[0], phasors.drive_hz[-1]
    return {n: hz for n, hz in starts.items() if first / _BEYOND < hz < last * _BEYOND}


def _outweighing(weight: Array, names: Sequence[str]) -> dict[str, list[int]]:
    """Holograms in which a mode is livelier than in their neighbours, and outweighs the others.

    Parameters
    ----------
    weight : (k, m) float
        Of each mode in each hologram.
    """
    inner, before, after = weight[1:-1], weight[:-2], weight[2:]
    most = inner.argmax(axis=1)
    return {
        name: [
            int(k) + 1
            for k in np.flatnonzero(
                (inner[:, m] > before[:, m]) & (inner[:, m] > after[:, m]) & (most == m)
            )
        ]
        for m, name in enumerate(names)
    }


def _room_cents(name: str, cents: Mapping[str, float]) -> float:
    """How far a mode may be from where it is expected and be no other of its symmetry."""
    others = [
        abs(at - cents[name])
        for other, at in cents.items()
        if other != name and is_symmetric(other) == is_symmetric(name)
    ]
    least, most = _AGREE_CENTS
    return float(np.clip(_ROOM * min(others, default=np.inf), least, most))


def _expected_hz(basis: ShapeBasis, reed: ReducedReed, cane: ViscoelasticCane) -> dict[str, float]:
    """Eigenfrequencies of a cane, of the modes that it has."""
    modes = viscoelastic_modes(reed, cane)
    return {
        name: modes[name].frequency_hz
        for name, hz in zip(basis.names, basis.hz, strict=True)
        if hz < _LOOK_HZ and name in modes
    }


def _doubts(modal: ModalFit, basis: ShapeBasis, displacements: Displacements) -> dict[str, str]:
    """Why each mode is not identified, by name; empty if it is."""
    unreached = float(np.mean(~displacements.reached))
    if unreached > _MOST_UNREACHED:
        reason = f"{unreached:.0%} of the holograms cannot be explained as vibrations of this reed"
        return dict.fromkeys(modal.names, reason)
    if modal.discrepancy > _MOST_DISCREPANCY:
        reason = (
            f"modes of such a reed leave {modal.discrepancy:.0%} of the vibration unexplained: "
            "another reed, clamp or chamber than the protocol says?"
        )
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


def _resonance(modal: ModalFit, m: int, phasors: Phasors, basis: ShapeBasis) -> Resonance:
    hz, name = float(modal.hz[m]), modal.names[m]
    nearest = int(np.abs(np.log(phasors.drive_hz / hz)).argmin())
    participation = np.abs(modal.participation)
    return Resonance(
        name=name,
        frequency_hz=hz,
        error_cents=float(modal.error_cents[m]),
        step_index=int(phasors.step_index[nearest]),
        amplitude_rad=float(np.abs(modal.modal_rad[nearest, m])),
        method=METHOD,
        response_hz=_liveliest_hz(phasors.drive_hz, np.abs(modal.modal_rad[:, m]), hz),
        loss_factor=float(modal.loss_factor[m]),
        loss_error=float(modal.loss_error[m]),
        participation=float(participation[m] / participation.max()),
        likeness=mac(modal.shapes[m], basis.shapes[basis.names.index(name)]),
    )


def _liveliest_hz(drive_hz: Array, amplitude: Array, hz: float) -> float:
    """Where an amplitude (k,) has its maximum near a resonance, between holograms by a parabola."""
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
