"""Joint fits of the sweeps of a campaign: modes, drive and light, and their residuals."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from diagnosis.campaign import CampaignRun
from diagnosis.readings.templates import templates
from fitting.errors import FitError
from fitting.forward import basis_of, finite_element_model
from fitting.holograms.block_amplitudes import UnshiftedLight
from fitting.holograms.right_fringes.trials import SAME_FRINGE
from fitting.modal.identify import JointFit, fit_jointly, series_of
from fitting.modal.modal_fit import ModalFit
from fitting.modal.refit import fit_same_reed, fit_without_unshifted
from fitting.parallel.processes import map_processes
from holography.arrays import Array, ComplexArray
from runs.reader import Run
from runs.records import StepRecord

# Beyond this frequency modes are too dense to be separated.
_HIGHEST_HZ = 17e3
# Modes so far away in log frequency count half as much or less.
_NEAR = 0.2
# Fewest modes of a sweep, and share of its holograms that may be in another fringe: chosen.
_FEWEST_MODES, _WRONG = 7, 0.05
# Bends of a drive, nepers, and how much it usually has of them, per hologram.
_BEND, _SMOOTH = 0.01, 0.45
# Share of the work that the search is.
_SEARCH = 0.4
# Sweeps are of one level if their loudness, log of volts, differs by no more.
SAME_LEVEL = 0.1


@dataclass(frozen=True)
class SweepReading:
    """One sweep, fitted.

    Attributes
    ----------
    name : str
        Of the part.
    clamping : int
    names : tuple of str
        Of the a identified modes.
    hz, loss_factor : (a,) float
    doubtful : (d, 2) float
        Frequency and loss factor of each mode of the fit that is not identified.
    stiffening : (a,) float
        Exponent by which stiffness grows with frequency, as the loss factors assume it. Only the
        loss factor over 2 less this exponent is seen (decision 0029).
    covariance : (2a, 2a) float
        Of log frequencies, then of log losses.
    force_rad : (a,) complex
        Modal amplitude per volt that each mode would have at its own frequency without being
        resonant: drive times participation.
    force_error : (a,) float
        Relative.
    mixing, mixing_error, mixing_spread : (m, a) float
        See `fitting.modal.modal_fit.ModalFit`, of the m modes `shape_names`.
    shape_names : tuple of str
    shape_hz : (m,) float
    shape_peak_m, shape_peak : (m, 2), (m,) float
        Where each shape is largest, and its value there, 1 or -1.
    drive_hz, volts, time_s : (k,) float
        Of every hologram; times since the campaign began.
    log_drive : (k,) float
        Per volt, in nepers, with what all participations have in common: drive and participations
        may be exchanged.
    log_drive_covariance : (k, k) float
        Covariance of the drive's logarithm, by the fit.
    amplitude_rad : (k,) float
        Root mean square over the reed.
    deepest_rad : (k,) float
        Largest over the reed.
    brightness : (k,) float
        Log of the light's amplitude, dn.
    signal : (k,) float
        Log of vibration times light: at small amplitude fringes determine no more than that.
    noise_dn2 : (k,) float
        Next to the image.
    fringe_dn2 : (k,) float
        Of the fringes, mean over all pixels of the sensor.
    misfit : (k,) float
        Mean square of what phasors leave, noise is 1.
    off : (k,) bool
        Holograms that show something else.
    template : (4, k) complex
        Amplitude of each of `TEMPLATES` in every hologram, in units of the sideband's.
    template_variance : (4, k) float
    discrepancy : float
        See `fitting.modal.modal_fit.ModalFit`.
    taken_off : float
        Amplitude of unshifted light that was taken off, in units of the light at rest.
    """

    name: str
    clamping: int
    names: tuple[str, ...]
    hz: Array
    loss_factor: Array
    doubtful: Array
    stiffening: Array
    covariance: Array
    force_rad: ComplexArray
    force_error: Array
    mixing: Array
    mixing_error: Array
    mixing_spread: Array
    shape_names: tuple[str, ...]
    shape_hz: Array
    shape_peak_m: Array
    shape_peak: Array
    drive_hz: Array
    volts: Array
    time_s: Array
    log_drive: Array
    log_drive_covariance: Array
    amplitude_rad: Array
    deepest_rad: Array
    brightness: Array
    signal: Array
    noise_dn2: Array
    fringe_dn2: Array
    misfit: Array
    off: NDArray[np.bool_]
    template: ComplexArray
    template_variance: Array
    discrepancy: float
    taken_off: float = 0.0

    @property
    def loudness(self) -> float:
        """Mean log of the volts."""
        return loudness(self.volts)


def read_sweeps(
    parts: Sequence[CampaignRun],
    progress: Callable[[float], None] | None = None,
    unshifted: Mapping[str, UnshiftedLight] | None = None,
) -> tuple[list[SweepReading], list[str]]:
    """Fit all sweeps: one by itself, and the others from it.

    Parameters
    ----------
    parts : sequence of CampaignRun
    progress : callable, optional
        Called with the fraction that is done.
    unshifted : dict of UnshiftedLight, optional
        Light that is known to leak into sweeps, by their names.

    Returns
    -------
    readings : list of SweepReading
    refused : list of str
        Why each of the others could not be fitted.
    """
    report = progress or (lambda _share: None)
    lights = unshifted or {}
    fits = _Fits(parts[0].run, lights)
    first = parts[0].clamping
    loud = sorted(parts, key=lambda part: (part.clamping != first, -_run_loudness(part.run)))
    quiet = sorted(parts, key=lambda part: (part.clamping != first, _run_loudness(part.run)))
    # A loud sweep shows more, but its fringes may fold; one that is calmer, or of another speckle,
    # then shows the way.
    tried = list(dict.fromkeys([loud[0], quiet[0], loud[-1], *loud[1:2]]))
    root, doubt = _root(fits, tried)
    report(_SEARCH)
    if root is None or doubt:
        _handed_on(fits, [*dict.fromkeys([quiet[0], loud[0], *loud]), loud[0]], root, report)
    else:
        _each_from(fits, [part for part in loud if part is not root], root, report)
    fitted = [part for part in parts if part.name in fits.found]
    readings = map_processes(
        lambda part: _reading(part, fits.settled(part), _taken_off(lights.get(part.name))), fitted
    )
    read = {part.name: reading for part, reading in zip(fitted, readings, strict=True) if reading}
    empty = {part.name: f"{part.run.path}: nothing is identified" for part in parts}
    refused = [(empty | fits.refused)[part.name] for part in parts if part.name not in read]
    return list(read.values()), refused


class _Fits:
    """Fits of a campaign's sweeps, as they are found.

    Parameters
    ----------
    run : Run
        One of them.
    unshifted : dict of UnshiftedLight
    """

    def __init__(self, run: Run, unshifted: Mapping[str, UnshiftedLight]) -> None:
        self._reed = basis_of(run.reed_file())
        self._model, self._unshifted = finite_element_model(self._reed), unshifted
        self.found: dict[str, JointFit] = {}
        self.refused: dict[str, str] = {}

    def of(self, part: CampaignRun, known: CampaignRun | None = None) -> JointFit | FitError:
        """Fit a sweep from another one that is known, or by itself; or say why it cannot be."""
        light = self._unshifted.get(part.name)
        try:
            if known is None:
                return fit_jointly(part.run, self._reed, self._model, light)
            return fit_same_reed(part.run, self.found[known.name], self._reed, light)
        except FitError as error:
            return error

    def keep(self, part: CampaignRun, fit: JointFit | FitError) -> bool:
        """Keep a fit; tells whether it is one."""
        if isinstance(fit, FitError):
            self.refused[part.name] = str(fit)
            return False
        self.found[part.name] = fit
        return True

    def settled(self, part: CampaignRun) -> JointFit:
        """Return the fit of a sweep with unshifted light subtracted as the vibration changes it."""
        fit = self.found[part.name]
        if fit.resonances:
            with contextlib.suppress(FitError):
                return fit_without_unshifted(fit, self._reed, series_of(part.run))
        return fit


def _root(fits: _Fits, parts: Sequence[CampaignRun]) -> tuple[CampaignRun | None, int]:
    """Fit sweeps by themselves until one is not in doubt; return the one least in doubt, if any.

    With it comes how far to doubt it, see `_doubt`.
    """
    doubt: dict[str, tuple[int, float]] = {}
    # Most often the first will do.
    with contextlib.closing(map_processes(fits.of, parts[1:])) as others:
        for part, fit in zip(parts, chain([fits.of(parts[0])], others), strict=True):
            if fits.keep(part, fit):
                doubt[part.name] = _doubt(fits.found[part.name])
                if not doubt[part.name][0]:
                    break
    fitted = [part for part in parts if part.name in doubt]
    least = min(fitted, key=lambda part: doubt[part.name], default=None)
    return least, 0 if least is None else doubt[least.name][0]


def _each_from(
    fits: _Fits, parts: Sequence[CampaignRun], root: CampaignRun, report: Callable[[float], None]
) -> None:
    """Fit sweeps each from one that is not in doubt.

    Handed on from sweep to sweep, what a quiet one does not show would be lost.
    """
    found = map_processes(lambda part: fits.of(part, root), parts)
    for number, (part, fit) in enumerate(zip(parts, found, strict=True), 1):
        fits.keep(part, fit)
        report(_SEARCH + (1 - _SEARCH) * number / len(parts))


def _handed_on(
    fits: _Fits,
    parts: Sequence[CampaignRun],
    last: CampaignRun | None,
    report: Callable[[float], None],
) -> None:
    """Fit sweeps each from the one before: what a fit in doubt begins with settles on the way.

    Parameters
    ----------
    fits : _Fits
    parts : sequence of CampaignRun
        The calmest, then from the loudest on, and the loudest again.
    last : CampaignRun or None
        The first that is handed on.
    report : callable
    """
    turns = [*parts, *(part for part in parts[:1] if part is last)]
    for number, part in enumerate(turns):
        if part is not last and fits.keep(part, fits.of(part, last)):
            last = part
        report(_SEARCH + (1 - _SEARCH) * (number + 1) / len(turns))


def _taken_off(light: UnshiftedLight | None) -> float:
    return float(np.median(np.abs(list(light.fraction.values())))) if light else 0.0


def _bends(fit: JointFit) -> float:
    """How much the drive bends from step to step: where modes are wrong, it takes their part."""
    log = np.log(np.abs(fit.modal.drive) / fit.block_amplitudes.volts)
    return float(np.sum(np.log1p((np.diff(log, 2) / _BEND) ** 2 / 4)))


def _doubt(fit: JointFit) -> tuple[int, float]:
    """How far to doubt a fit: not if few holograms can be in another fringe; and its bends.

    What modes leave of displacements has the size that other fringes of a share of all holograms
    would give. With few identified modes, vibrations of any size would fit.
    """
    bends, holograms = _bends(fit), len(fit.block_amplitudes.volts)
    smooth = bends < _SMOOTH * holograms
    few_off = np.count_nonzero(fit.modal.off) < _WRONG * holograms
    # Real and imaginary parts have the discrepancy each, and what is in another fringe is off by
    # more than what is in the same.
    near = fit.modal.discrepancy < SAME_FRINGE * np.sqrt(_WRONG / 2)
    if len(fit.resonances) < _FEWEST_MODES:
        return 2, bends
    return int(not (smooth or (near and few_off))), bends


def at_highest_level(sweeps: Sequence[SweepReading]) -> list[SweepReading]:
    """Sweeps at the highest level."""
    most = max(sweep.loudness for sweep in sweeps)
    return [sweep for sweep in sweeps if sweep.loudness > most - SAME_LEVEL]


def loudest(sweeps: Sequence[SweepReading]) -> list[SweepReading]:
    """Those of the first clamping that are at its highest level."""
    return at_highest_level([s for s in sweeps if s.clamping == sweeps[0].clamping])


def _run_loudness(run: Run) -> float:
    return loudness(np.array([step.volts for step in run.steps]))


def loudness(volts: Array) -> float:
    """Mean log of the volts of a sweep's holograms, without those at rest."""
    driven = volts[volts > 0]
    return float(np.mean(np.log(driven))) if driven.size else -np.inf


def _reading(part: CampaignRun, fitted: JointFit, taken_off: float) -> SweepReading | None:
    """Return what a sweep's fit says; None if nothing is identified."""
    if not fitted.resonances:
        return None
    modal, phasors, found = fitted.modal, fitted.block_amplitudes, fitted.displacements
    kept, a = _kept(fitted), len(modal.names)
    both, names = np.concatenate([kept, a + kept]), tuple(modal.names[m] for m in kept)
    by_index = {
        step.index: step for step in part.run.steps if step.order == part.run.sideband_order
    }
    steps = [by_index[int(k)] for k in phasors.step_index]
    log_hz = np.log(phasors.drive_hz)
    own = np.log(modal.hz[kept])
    drive = modal.drive / phasors.volts
    at_own = np.interp(own, log_hz, np.log(np.abs(drive)))
    noise = np.array([step.noise_level for step in steps])
    moved = np.abs(found.amplitude_rad @ fitted.basis.functions.T)
    template, variance = templates(fitted)
    # As modes have it: what all displacements are off together is taken off.
    u = modal.amplitude_rad @ fitted.basis.functions.T
    pixels = part.run.frame_shape[0] * part.run.frame_shape[1]
    fringes = phasors.noise_variance @ (np.abs(phasors.recorded) ** 2 - 1) / pixels
    shapes = fitted.basis.functions @ fitted.basis.shapes.T
    highest = np.argmax(np.abs(shapes), axis=0)
    return SweepReading(
        name=part.name,
        clamping=part.clamping,
        names=names,
        hz=modal.hz[kept],
        loss_factor=modal.loss_factor[kept],
        doubtful=np.stack([modal.hz, modal.loss_factor], axis=1)[_doubtful(fitted)],
        stiffening=fitted.basis.stiffening_of(names),
        covariance=modal.covariance[np.ix_(both, both)],
        force_rad=np.exp(at_own) * modal.by_pressure[kept],
        force_error=modal.by_pressure_error[kept] / np.abs(modal.by_pressure[kept]),
        mixing=modal.mixing[:, kept],
        mixing_error=modal.mixing_error[:, kept],
        mixing_spread=modal.mixing_spread[:, kept],
        shape_names=fitted.basis.names,
        shape_hz=fitted.basis.hz,
        shape_peak_m=np.stack([phasors.x_m, phasors.y_m], axis=1)[highest],
        shape_peak=shapes[highest, np.arange(len(highest))],
        drive_hz=phasors.drive_hz,
        volts=phasors.volts,
        time_s=np.array([_middle_s(step) - part.clock_s for step in steps]),
        log_drive=np.log(np.abs(drive)) + _common(modal, kept, log_hz),
        log_drive_covariance=modal.log_drive_covariance,
        amplitude_rad=np.sqrt(np.mean(np.abs(u) ** 2, axis=1)),
        deepest_rad=np.abs(u).max(axis=1),
        brightness=_log_light(fitted, noise, np.ones_like(moved)),
        signal=_log_light(fitted, noise, moved),
        noise_dn2=noise,
        fringe_dn2=noise * np.maximum(fringes, 0.0),
        misfit=found.misfit,
        off=modal.off,
        template=template,
        template_variance=variance,
        discrepancy=modal.discrepancy,
        taken_off=taken_off,
    )


def _log_light(fitted: JointFit, noise: Array, moved: Array) -> Array:
    """Return the log rms (k,) of light times vibration (k, n), or times 1.

    Block by block: light and vibration may be taken for each other smoothly over the reed.
    """
    found, unit = fitted.displacements, fitted.block_amplitudes.noise_variance
    power = np.mean(unit * (np.abs(found.object_field) * moved) ** 2, axis=1)
    return np.asarray(found.gain + 0.5 * np.log(noise * np.maximum(power, 1e-12)))


def _kept(fitted: JointFit) -> NDArray[np.intp]:
    """Return the numbers of the identified modes.

    A mode with a new name is left out: its mixing is that into the shape of its first name.
    """
    labels = zip(fitted.modal.names, fitted.names, strict=True)
    kept = [m for m, (one, now) in enumerate(labels) if now in fitted.resonances and now == one]
    return np.array(kept, dtype=np.intp)


def _doubtful(fitted: JointFit) -> NDArray[np.bool_]:
    """Mask of the modes that are not identified."""
    return np.array([name not in fitted.resonances for name in fitted.names], dtype=bool)


def _common(modal: ModalFit, kept: NDArray[np.intp], log_hz: Array) -> Array:
    """Log (k,) of what participations do in common around each frequency."""
    own = np.log(modal.hz[kept])
    near = 1 / (1 + ((log_hz[:, None] - own) / _NEAR) ** 2) ** 2
    at_own = np.abs(modal.by_pressure[kept])
    square = (np.abs(modal.participations[:, kept]) / at_own) ** 2
    common: Array = 0.5 * np.log(np.sum(near * square, axis=1) / np.sum(near, axis=1))
    return common


def _middle_s(step: StepRecord) -> float:
    return float(np.mean(step.timestamps_s))


def reference_of(sweeps: Sequence[SweepReading]) -> SweepReading:
    """Return the sweep that names most of the modes that all sweeps but one name."""
    names = [name for sweep in sweeps for name in sweep.names]
    often = {name for name in names if names.count(name) >= max(1, len(sweeps) - 1)}
    return max(sweeps, key=lambda sweep: len(often.intersection(sweep.names)))


def names_in_order(sweeps: Sequence[SweepReading]) -> list[str]:
    """Return the names of all modes by their median frequency, the lowest first."""
    found: dict[str, list[float]] = {}
    for sweep in sweeps:
        for name, hz in zip(sweep.names, sweep.hz.tolist(), strict=True):
            found.setdefault(name, []).append(hz)
    return sorted(found, key=lambda name: float(np.median(found[name])))


def common_modes(sweeps: Sequence[SweepReading]) -> list[str]:
    """Modes that the reference names (`reference_of`), and all other sweeps but one."""
    reference = reference_of(sweeps)
    return [
        name
        for name, hz in zip(reference.names, reference.hz.tolist(), strict=True)
        if sum(name in sweep.names for sweep in sweeps) >= max(1, len(sweeps) - 1)
        and hz < _HIGHEST_HZ
    ]
