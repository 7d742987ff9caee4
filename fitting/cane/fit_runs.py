"""Fit the resonances and the cane of a reed from its run files (`acquire fit`)."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from fitting.amplitudes.peaks import PeakAmplitudes
from fitting.amplitudes.response import Response, joint_response
from fitting.amplitudes.vamp import vamp_points
from fitting.cane.cane_losses import CaneLosses, fit_losses
from fitting.cane.model_errors import model_errors
from fitting.cane.over_density import QUOTED_HZ
from fitting.cane.reed_fit import ReedParameters, fit_components
from fitting.cane.sweep_fit import ReedFit, SweepFit
from fitting.errors import FitError, FitInputError
from fitting.forward import (
    ForwardModel,
    PaperModel,
    basis_of,
    cents_of,
    finite_element_model,
)
from fitting.fringes.fringe_peaks import FringeCurves, likely_components, pick_fringe_peaks
from fitting.fringes.fringes import (
    Fringes,
    count_fringes,
    misfit_without,
)
from fitting.fringes.pictures import Pictures, read_pictures
from fitting.known_bench import known_effects_in
from fitting.modal.identify import fit_jointly, series_of
from fitting.resonance import Resonance
from holography.arrays import Float32Array
from holography.fringes import displacement_m
from physics.errors import ImpossibleReedError
from physics.mechanics import ReedSolver
from physics.parameters.tree import BenchParameters
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.geometry import ReedGeometry, is_even
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.elastic import Mode, elastic_modes, viscoelastic_mode
from physics.reed.reduced.reed import ReducedReed
from physics.reed.surface import surface_shapes
from physics.sized_effect import SizedEffect
from protocols.reed import ReedFile
from runs.reader import Run

ModelName = Literal["fem", "paper"]
MODELS: tuple[ModelName, ...] = ("fem", "paper")
MethodName = Literal["picture", "joint"]
METHODS: tuple[MethodName, ...] = ("picture", "joint")

# Shapes that are fitted to pictures: the modes of the vamp up to this frequency.
_HIGHEST_HZ = 20e3
_VAMP_CLASSES = "FTX"
# A picture needs a shape if its misfit without the shape grows by more than this factor, as the
# median over the picture and its neighbours. On the simulated bench, modes that vibrate give 2 to
# 500, others 0.9 to 1.1.
_NEEDED = 1.5
_SURELY_NEEDED = 3.0
# Neighbours farther away than this may not show the resonance, which is about 50 cents wide.
_BESIDE_CENTS = 40.0
# With fewer modes the cane of the population is as good as a fitted one.
_LEAST_MODES = 4
# Mean cane of the population.
_MIDDLING = viscoelastic_cane(Components(), Series.A)


def method_name(name: str) -> MethodName:
    """Return the name of a method, checked.

    Raises
    ------
    FitInputError
        If there is no such method.
    """
    for known in METHODS:
        if name == known:
            return known
    raise FitInputError(f"there is no method {name!r}; choose one of {', '.join(METHODS)}")


def model_name(name: str) -> ModelName:
    """Return the name of a forward model, checked.

    Raises
    ------
    FitInputError
        If there is no such model.
    """
    for known in MODELS:
        if name == known:
            return known
    raise FitInputError(f"there is no forward model {name!r}; choose one of {', '.join(MODELS)}")


def middling_modes(reed: ReducedReed) -> dict[str, Mode]:
    """Compute the modes of the vamp below 20 kHz of a reed of mean cane: the paper's, then others.

    Each mode is computed with the storage moduli at its own frequency.
    """
    E, G = (
        float(storage_modulus_pa(z, QUOTED_HZ)) for z in (_MIDDLING.young_L, _MIDDLING.shear_LT)
    )
    settled = {}
    for name, mode in elastic_modes(reed, E, G).items():
        if name[0] not in _VAMP_CLASSES:
            continue
        with suppress(ImpossibleReedError):
            settled[name] = viscoelastic_mode(reed, _MIDDLING, name, mode.frequency_hz)
    others = sorted(
        (name for name in settled if name not in PAPER_MODES),
        key=lambda name: settled[name].frequency_hz,
    )
    ordered = [*(name for name in PAPER_MODES if name in settled), *others]
    return {name: settled[name] for name in ordered if settled[name].frequency_hz < _HIGHEST_HZ}


def mode_shapes(
    reed: ReducedReed,
    pictures: Pictures,
    middling: Mapping[str, Mode],
    cane: ViscoelasticCane | None = None,
) -> Float32Array:
    """Return deflections (n, m) of modes at a run's points, largest magnitude 1.

    Parameters
    ----------
    reed : ReducedReed
    pictures : Pictures
    middling : mapping
        The m modes, see `middling_modes`.
    cane : ViscoelasticCane, optional
        Cane of the modes; modes that it does not have keep their mean shape.
    """
    surface = surface_shapes(reed, pictures.x_m, pictures.y_m)
    columns = []
    for name, mode in middling.items():
        if cane is not None:
            with suppress(ImpossibleReedError):
                mode = viscoelastic_mode(reed, cane, name, mode.frequency_hz)
        columns.append(surface[mode.part] @ mode.coordinates.astype(np.float32))
    shapes = np.stack(columns, axis=1)
    normalised: Float32Array = (shapes / np.abs(shapes).max(axis=0)).astype(np.float32)
    return normalised


def fit_sweep(run: Run, reed: ReducedReed, model: ForwardModel) -> SweepFit:
    """Find the resonances of one run.

    The shapes are first those of mean cane, then those of the cane that is fitted to the resonances
    found so far, if these are enough: the shapes of two close modes depend on the reed.

    Raises
    ------
    FitError
        If too few pictures are good, or no mode is found in them.
    """
    pictures, series = read_pictures(run), series_of(run)
    middling = middling_modes(reed)
    names = tuple(middling)
    shapes = mode_shapes(reed, pictures, middling)
    fringes = count_fringes(pictures.brightness, shapes)
    found = _pick(pictures, names, shapes, fringes, model, series, run.acoustic_resonances_hz)
    if len(found) >= _LEAST_MODES:
        shapes = mode_shapes(reed, pictures, middling, _suggested_cane(found, model, series))
        fringes = count_fringes(pictures.brightness, shapes, fringes)
        found = _pick(pictures, names, shapes, fringes, model, series, run.acoustic_resonances_hz)
    if not found:
        raise _nothing_shows(run, pictures)
    response = _fringe_response(run, pictures, names, shapes, fringes)
    found = {
        name: _with_fringe_amplitude(resonance, response, run) for name, resonance in found.items()
    }
    return SweepFit(run.path, run.reed, run.series, run.reed_file(), found, response, {})


def _fringe_response(
    run: Run, pictures: Pictures, names: tuple[str, ...], shapes: Float32Array, fringes: Fringes
) -> Response:
    """Return the displacements of all pictures; the method of the paper states no errors."""
    volts = {step.index: step.volts for step in run if step.order == run.sideband_order}
    moved = np.abs(fringes.amplitude_rad @ shapes.T)
    top = moved.argmax(axis=1)
    wavelength_m = run.reconstruction.transform.wavelength_m
    nm = 1e9 * displacement_m(moved.max(axis=1), wavelength_m)
    unknown = np.full(len(nm), np.nan)
    return Response(
        drive_hz=pictures.drive_hz,
        step_index=pictures.step_index,
        volts=np.array([volts[int(index)] for index in pictures.step_index]),
        names=names,
        amplitude_nm=1e9 * displacement_m(np.abs(fringes.amplitude_rad), wavelength_m),
        peak=PeakAmplitudes(nm, unknown, pictures.x_m[top], pictures.y_m[top]),
        off=np.zeros(len(nm), dtype=bool),
        wavelength_m=wavelength_m,
    )


def _with_fringe_amplitude(found: Resonance, response: Response, run: Run) -> Resonance:
    k = int(np.flatnonzero(response.step_index == found.step_index)[0])
    wavelength_m = run.reconstruction.transform.wavelength_m
    nm = 1e9 * float(displacement_m(found.amplitude_rad, wavelength_m))
    return replace(found, amplitude_nm=nm, nm_per_v=nm / float(response.volts[k]))


def fit_sweep_jointly(run: Run, reed: ReducedReed, model: ForwardModel) -> SweepFit:
    """Find the resonances of one run by a joint fit of all its holograms.

    Raises
    ------
    FitError
        If too few holograms are good or explained, or no mode is
        identified.
    """
    joint = fit_jointly(run, reed, model)
    if not joint.resonances and not joint.not_sure:
        reasons = Counter(joint.not_identified.values()).most_common(1)
        reason = f" ({reasons[0][0]})" if reasons else ""
        raise FitError(
            f"{run.path}: nothing is identified{reason}; look at the contact sheet that acquire "
            "report writes"
        )
    blocks = joint.block_amplitudes
    points = vamp_points(reed, joint.basis, blocks.x_m, blocks.y_m)
    wavelength_m = run.reconstruction.transform.wavelength_m
    response, resonances, not_sure = joint_response(joint, points, wavelength_m)
    return SweepFit(
        run.path,
        run.reed,
        run.series,
        run.reed_file(),
        resonances,
        response,
        joint.not_identified,
        joint,
        not_sure,
    )


def _suggested_cane(
    found: dict[str, Resonance], model: ForwardModel, series: Series
) -> ViscoelasticCane:
    """Fit the cane to the resonances; if they do not determine it, use the likeliest cane."""
    try:
        fitted = fit_components({series: found}, model).components
    except FitError:
        return viscoelastic_cane(likely_components(found, model, series), series)
    return viscoelastic_cane(Components(**{n: e.value for n, e in fitted.items()}), series)


def _nothing_shows(run: Run, pictures: Pictures) -> FitError:
    return FitError(
        f"{run.path}: no mode of a {run.reed_file().name} reed shows in "
        f"{len(pictures.drive_hz)} pictures; look at the contact sheet that acquire report writes"
    )


def _pick(
    pictures: Pictures,
    names: Sequence[str],
    shapes: Float32Array,
    fringes: Fringes,
    model: ForwardModel,
    series: Series,
    acoustic_resonances_hz: Sequence[float],
) -> dict[str, Resonance]:
    def growth(shape: int, picture: int) -> float:
        without = misfit_without(pictures.brightness, shapes, fringes, shape, picture)
        return without / max(float(fringes.misfit[picture]), 1e-12)

    def needed(shape: int, picture: int) -> bool:
        # At the peak itself fringes may be too fine to be resolved: then its neighbours decide, if
        # they are near enough to show the same resonance.
        at_peak = growth(shape, picture)
        if at_peak > _SURELY_NEEDED:
            return True
        distance = np.abs(cents_of(pictures.drive_hz) - cents_of(pictures.drive_hz[picture]))
        neighbours = [k for k in (picture - 1, picture + 1) if 0 <= k < len(distance)]
        together = float(np.median([at_peak, *(growth(shape, k) for k in neighbours)]))
        far = bool(np.max(distance[neighbours]) > _BESIDE_CENTS)
        return max(together, at_peak if far else 0.0) > _NEEDED

    curves = FringeCurves(
        pictures.drive_hz, pictures.step_index, np.abs(fringes.amplitude_rad), names
    )
    return pick_fringe_peaks(curves, model, series, needed, acoustic_resonances_hz)


def fit_runs(
    paths: Sequence[str | Path],
    model: ModelName = "fem",
    announce: Callable[[str], None] | None = None,
    method: MethodName = "joint",
) -> ReedFit:
    """Fit one run, or a series A and a series B run of the same reed together.

    Parameters
    ----------
    paths : sequence of path
        Run files.
    model : {'fem', 'paper'}
        Forward model: finite elements, or the paper's Table 9 with its adjustments.
    announce : callable, optional
        Called with a sentence about each step that takes long.
    method : {'joint', 'picture'}
        Joint fit of all holograms, or the paper's way, by the pictures with most fringes.

    Raises
    ------
    FitError
        If a run shows no modes.
    FitInputError
        If the runs do not belong together, or the paper's model is asked for another reed than
        its own, or this software does not know an effect that the bench is known to have.
    RunFileError
        If a file cannot be read.
    """
    with ExitStack() as opened:
        runs = [opened.enter_context(Run.open(path)) for path in paths]
        _require_one_reed(runs)
        kind = runs[0].reed_file()
        require_model(model, kind)
        reed = basis_of(kind, announce)
        # The matrices are small: threads of linear algebra would mostly wait for each other.
        opened.enter_context(threadpool_limits(limits=1, user_api="blas"))
        forward: ForwardModel = PaperModel() if model == "paper" else finite_element_model(reed)
        sweeps = [FIT_SWEEP[method](run, reed, forward) for run in runs]
        unknown = [s for s in sweeps if s.series not in set(Series)]
        if unknown:
            reason = f"series {unknown[0].series!r} is neither A nor B, whose cane is known (H4)"
            return ReedFit(tuple(sweeps), None, reason)
        try:
            resonances = {Series(s.series): s.resonances for s in sweeps}
            parameters = _parameters(resonances, forward, reed, known_effects_in(runs))
        except (FitError, ImpossibleReedError) as error:
            return ReedFit(tuple(sweeps), None, str(error))
        return ReedFit(tuple(sweeps), parameters, losses=_losses(sweeps, parameters, reed))


def _losses(
    sweeps: Sequence[SweepFit], parameters: ReedParameters, reed: ReducedReed
) -> dict[str, CaneLosses]:
    """Fit the loss factors of the cane in each series that determines them."""
    components = Components(*(each.value for each in parameters.components.values()))
    solver, found = ReedSolver(reed), dict[str, CaneLosses]()
    for sweep in sweeps:
        # Modes that exchange shapes have an unknown fraction of their energy in shear.
        mixed = parameters.left_out.get(sweep.series, [])
        clear = {name: mode for name, mode in sweep.resonances.items() if name not in mixed}
        cane = viscoelastic_cane(components, Series(sweep.series))
        with suppress(FitError, ImpossibleReedError):
            found[sweep.series] = fit_losses(clear, cane, solver)
    return found


def _parameters(
    resonances: Mapping[Series, Mapping[str, Resonance]],
    model: ForwardModel,
    reed: ReducedReed,
    known: Sequence[SizedEffect],
) -> ReedParameters:
    """Fit the components, with what the finite elements do not know of a reed.

    How that moves modes depends on the cane: it is computed for the cane of the population, and
    once more for the cane that is found. The paper's model is as printed, for a bench of which
    nothing is known.
    """
    if isinstance(model, PaperModel) or not is_even(reed.geometry):
        return fit_components(resonances, model)
    solver, nominal = ReedSolver(reed), BenchParameters()
    found = fit_components(resonances, model, model_errors(solver, nominal, PAPER_MODES, known))
    components = Components(**{name: each.value for name, each in found.components.items()})
    # Of a reed of impossible cane nothing can be computed; and other modes may exchange shapes.
    with suppress(ImpossibleReedError, FitError):
        cane = viscoelastic_cane(components, Series.A)
        own = replace(nominal, reed=replace(nominal.reed, cane=cane))
        return fit_components(resonances, model, model_errors(solver, own, PAPER_MODES, known))
    return found


# How the resonances of a run are found, by method.
FIT_SWEEP: Mapping[MethodName, Callable[[Run, ReducedReed, ForwardModel], SweepFit]] = {
    "joint": fit_sweep_jointly,
    "picture": fit_sweep,
}


def require_model(model: ModelName, kind: ReedFile) -> None:
    """Refuse the paper's metamodel for another reed than the paper's.

    Raises
    ------
    FitInputError
    """
    if model == "paper" and kind.geometry() != ReedGeometry():
        raise FitInputError(
            f"the paper's model (Table 9) is that of its clarinet reed, and this is another: "
            f"{kind.name}; choose --model fem"
        )


def _require_one_reed(runs: Sequence[Run]) -> None:
    """Two runs are fitted together only if they are series A and B of one reed."""
    if len(runs) == 1:
        return
    reeds, series = {run.reed for run in runs}, sorted(run.series for run in runs)
    kinds = [run.reed_file() for run in runs]
    if len(reeds) > 1 or series != ["A", "B"] or len({kind.sha256 for kind in kinds}) > 1:
        runs_given = ", ".join(
            f"{r.path.name}: reed {r.reed} ({kind.name}), series {r.series}"
            for r, kind in zip(runs, kinds, strict=True)
        )
        raise FitInputError(
            "runs fitted together must be series A and B of one reed "
            f"({runs_given}); fit them one by one"
        )
