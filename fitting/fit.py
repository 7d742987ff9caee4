"""From run files to a reed's parameters: what `acquire fit` does."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from acquire.runfile import Run
from fitting.errors import FitError, FitInputError
from fitting.forward import ForwardModel, PaperModel, cents_of, finite_element_model
from fitting.fringes import Fringes, count_fringes, misfit_without
from fitting.paper import MEAN_HZ
from fitting.picking import Resonance, likely_components, pick_resonances
from fitting.pictures import Pictures, read_pictures
from fitting.reedfit import ReedParameters, fit_components
from physics.reed.basis import ReducedReed
from physics.reed.cache import reduced_reed
from physics.reed.names import PAPER_MODES
from physics.reed.response import Mode, viscoelastic_mode
from physics.reed.surface import surface_shapes
from physics.reed.viscoelastic import Components, Series, ViscoelasticCane, viscoelastic_cane

Float = NDArray[np.float32]
ModelName = Literal["fem", "paper"]
MODELS: tuple[ModelName, ...] = ("fem", "paper")

# Shapes that pictures are made of: the paper's modes and the next ones up to 20 kHz.
SHAPE_NAMES = (*PAPER_MODES, "T5", "X4", "X5", "X6")
# A picture needs a shape if its misfit without it grows by more than this, as the median with its
# neighbours. On the twin, modes that are there give 2 to 500, modes that are not 0.9 to 1.1.
_NEEDED = 1.5
_SURELY_NEEDED = 3.0
# Resonances of cane are some 50 cents wide.
_BESIDE_CENTS = 40.0
# Fewer modes than this do not tell more of the cane than its population does.
_TELLING_MODES = 4
# The mean of the population, and about where its modes lie.
_MIDDLING = viscoelastic_cane(Components(), Series.A)
_NEAR_HZ = {name: hz for name, (hz, _) in MEAN_HZ.items()} | {
    "T5": 17e3,
    "X4": 17.5e3,
    "X5": 18e3,
    "X6": 19e3,
}


@dataclass(frozen=True)
class SweepFit:
    """Resonances of one run.

    Attributes
    ----------
    path : Path
    reed, series : str
    resonances : dict
        Found modes by name, in order of frequency.
    pictures : Pictures
    fringes : Fringes
        Amplitudes of `SHAPE_NAMES` in every picture.
    """

    path: Path
    reed: str
    series: str
    resonances: dict[str, Resonance]
    pictures: Pictures
    fringes: Fringes


@dataclass(frozen=True)
class ReedFit:
    """What one or two runs of a reed say about it.

    Attributes
    ----------
    sweeps : tuple of SweepFit
    parameters : ReedParameters or None
    reason : str
        Why there are no parameters, if there are none.
    """

    sweeps: tuple[SweepFit, ...]
    parameters: ReedParameters | None
    reason: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the fit with stable keys (documented in ``docs/fit.md``)."""
        runs = [
            {
                "path": str(sweep.path),
                "reed": sweep.reed,
                "series": sweep.series,
                "modes": {
                    name: {
                        "hz": found.frequency_hz,
                        "error_cents": found.error_cents,
                        "step_index": found.step_index,
                        "method": found.method,
                    }
                    for name, found in sweep.resonances.items()
                },
            }
            for sweep in self.sweeps
        ]
        fitted = asdict(self.parameters) if self.parameters else {}
        keys = (
            "components",
            "moduli",
            "rms_cents",
            "reduced_chi2",
            "residual_cents",
            "left_out",
            "at_limit",
            "physical",
            "model",
        )
        parameters = {key: fitted.get(key) for key in keys}
        return {"modes": runs[0]["modes"], **parameters, "reason": self.reason, "runs": runs}


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


def mode_shapes(reed: ReducedReed, pictures: Pictures, cane: ViscoelasticCane = _MIDDLING) -> Float:
    """Deflections (n, m) of `SHAPE_NAMES` at a run's points, largest magnitude 1.

    Each mode has the storage moduli of its own frequency.
    """
    surface = surface_shapes(reed, pictures.x_m, pictures.y_m)
    columns = []
    for name in SHAPE_NAMES:
        mode = _settled_mode(reed, cane, name)
        columns.append(surface[mode.symmetry] @ mode.coordinates.astype(np.float32))
    shapes = np.stack(columns, axis=1)
    normalised: Float = (shapes / np.abs(shapes).max(axis=0)).astype(np.float32)
    return normalised


def _settled_mode(reed: ReducedReed, cane: ViscoelasticCane, name: str) -> Mode:
    """Mode of a cane; of the middling cane if this one has none of that name."""
    for candidate in (cane, _MIDDLING):
        try:
            return viscoelastic_mode(reed, candidate, name, _NEAR_HZ[name])
        except ValueError:
            continue
    raise ValueError(f"not even a middling reed has a mode {name}")


def fit_sweep(run: Run, reed: ReducedReed, model: ForwardModel) -> SweepFit:
    """Find the resonances of one run.

    The shapes are first those of a middling cane, then those of the cane that the resonances so
    found suggest, if they are enough: where two modes come close, their shapes depend on the reed.

    Raises
    ------
    FitError
        If too few pictures are good, or no mode is found in them.
    """
    pictures, series = read_pictures(run), Series.B if run.series == "B" else Series.A
    shapes = mode_shapes(reed, pictures)
    fringes = count_fringes(pictures.brightness, shapes)
    found = _pick(pictures, shapes, fringes, model, series, run.acoustic_lines_hz)
    if not found:
        raise _nothing_shows(run, pictures)
    if len(found) < _TELLING_MODES:
        return SweepFit(run.path, run.reed, run.series, found, pictures, fringes)
    shapes = mode_shapes(reed, pictures, _suggested_cane(found, model, series))
    fringes = count_fringes(pictures.brightness, shapes, fringes)
    found = _pick(pictures, shapes, fringes, model, series, run.acoustic_lines_hz)
    if not found:
        raise _nothing_shows(run, pictures)
    return SweepFit(run.path, run.reed, run.series, found, pictures, fringes)


def _suggested_cane(
    found: dict[str, Resonance], model: ForwardModel, series: Series
) -> ViscoelasticCane:
    """Cane that the resonances fit; where they fix none, the likeliest of the population."""
    try:
        fitted = fit_components({series: found}, model).components
    except FitError:
        return viscoelastic_cane(likely_components(found, model, series), series)
    return viscoelastic_cane(Components(**{n: e.value for n, e in fitted.items()}), series)


def _nothing_shows(run: Run, pictures: Pictures) -> FitError:
    return FitError(
        f"{run.path}: no mode of a clarinet reed shows in {len(pictures.drive_hz)} pictures; "
        "look at the contact sheet that acquire report writes"
    )


def _pick(
    pictures: Pictures,
    shapes: Float,
    fringes: Fringes,
    model: ForwardModel,
    series: Series,
    acoustic_lines_hz: Sequence[float],
) -> dict[str, Resonance]:
    def growth(shape: int, picture: int) -> float:
        without = misfit_without(pictures.brightness, shapes, fringes, shape, picture)
        return without / max(float(fringes.misfit[picture]), 1e-12)

    def needed(shape: int, picture: int) -> bool:
        # At the peak itself fringes may be too fine to be resolved; its neighbours then tell. They
        # may not speak against it where they are too far off to show the same resonance.
        at_peak = growth(shape, picture)
        if at_peak > _SURELY_NEEDED:
            return True
        distance = np.abs(cents_of(pictures.drive_hz) - cents_of(pictures.drive_hz[picture]))
        beside = [k for k in (picture - 1, picture + 1) if 0 <= k < len(distance)]
        together = float(np.median([at_peak, *(growth(shape, k) for k in beside)]))
        far = bool(np.max(distance[beside]) > _BESIDE_CENTS)
        return max(together, at_peak if far else 0.0) > _NEEDED

    return pick_resonances(
        pictures.drive_hz,
        pictures.step_index,
        np.abs(fringes.amplitude_rad),
        SHAPE_NAMES,
        model,
        series,
        needed,
        acoustic_lines_hz,
    )


def fit_runs(
    paths: Sequence[str | Path],
    model: ModelName = "fem",
    announce: Callable[[str], None] | None = None,
) -> ReedFit:
    """Fit one run, or a series A and a series B run of the same reed together.

    Parameters
    ----------
    paths : sequence of path
        Run files.
    model : {'fem', 'paper'}
        Forward model: finite elements, or the paper's Table 9 with its adjustments.
    announce : callable, optional
        Told what takes long.

    Raises
    ------
    FitError
        If a run shows no modes.
    FitInputError
        If the runs do not belong together.
    RunFileError
        If a file cannot be read.
    """
    with ExitStack() as opened:
        runs = [opened.enter_context(Run.open(path)) for path in paths]
        _require_one_reed(runs)
        reed = reduced_reed(announce=announce)
        forward: ForwardModel = PaperModel() if model == "paper" else finite_element_model(reed)
        sweeps = [fit_sweep(run, reed, forward) for run in runs]
    unknown = [s for s in sweeps if s.series not in set(Series)]
    if unknown:
        reason = f"series {unknown[0].series!r} is neither A nor B, whose cane is known (H4)"
        return ReedFit(tuple(sweeps), None, reason)
    try:
        parameters = fit_components({Series(s.series): s.resonances for s in sweeps}, forward)
    except FitError as error:
        return ReedFit(tuple(sweeps), None, str(error))
    return ReedFit(tuple(sweeps), parameters)


def _require_one_reed(runs: Sequence[Run]) -> None:
    """Two runs are fitted together only if they are series A and B of one reed."""
    if len(runs) == 1:
        return
    reeds, series = {run.reed for run in runs}, sorted(run.series for run in runs)
    if len(reeds) > 1 or series != ["A", "B"]:
        told = ", ".join(f"{r.path.name}: reed {r.reed}, series {r.series}" for r in runs)
        raise FitInputError(
            f"runs fitted together must be series A and B of one reed ({told}); fit them one by one"
        )
