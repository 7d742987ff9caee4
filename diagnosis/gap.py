"""The gap between a fitted run and the nominal twin, mode by mode, and what an effect takes off it.

The first form of the diagnosis: one tap (the resonances), one effect at a time, in sample.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from fitting.errors import FitError
from fitting.fit import ReedFit
from fitting.forward import ForwardModel, basis_of, finite_element_model
from fitting.reedfit import ReedParameters, fit_components
from physics.effects import air_load
from physics.mechanics import Workshop
from physics.reed.basis import BasisSettings, ReducedReed
from physics.reed.cache import anatomy
from physics.reed.viscoelastic import Series
from physics.twin import Twin

Array = NDArray[np.floating[Any]]

# Numerical floor of the twin: what a finer mesh moves its modes by.
MESH_CENTS = 8.0
# Effects are tried at up to this multiple of their nominal size.
_LARGEST_SHARE = 2.0


@dataclass(frozen=True)
class GapCell:
    """One mode of one series.

    Attributes
    ----------
    series, mode : str
    gap_cents : float
        Observed less computed, after the cane was fitted.
    floor_cents : float
        What data and numerics leave uncertain; a gap below it is not resolvable.
    """

    series: str
    mode: str
    gap_cents: float
    floor_cents: float


@dataclass(frozen=True)
class EffectTrial:
    """What one effect takes off the gap.

    Attributes
    ----------
    effect, stage : str
    share : float
        Best multiple of the effect's nominal size.
    rms_before_cents, rms_after_cents : float
    kappa : float
        Part of the resolvable gap that the effect closes; NaN if none is resolvable.
    """

    effect: str
    stage: str
    share: float
    rms_before_cents: float
    rms_after_cents: float
    kappa: float


@dataclass(frozen=True)
class Diagnosis:
    """Cells of the gap, worst first, and the trials of the effects."""

    cells: tuple[GapCell, ...]
    trials: tuple[EffectTrial, ...]
    rms_cents: float
    floor_cents: float

    @property
    def resolvable(self) -> bool:
        """Whether the gap as a whole stands above its floor."""
        return self.rms_cents > self.floor_cents

    def to_json(self) -> dict[str, Any]:
        """Return the diagnosis with stable keys; NaN becomes null."""
        answer = asdict(self) | {"resolvable": self.resolvable}
        for trial in answer["trials"]:
            trial["kappa"] = None if np.isnan(trial["kappa"]) else trial["kappa"]
        return answer


@dataclass(frozen=True)
class ShiftedModel:
    """A forward model with every mode shifted by so many cents (m,)."""

    base: ForwardModel
    shift_cents: Array
    name: str

    @property
    def modes(self) -> tuple[str, ...]:
        """Modes of the base."""
        return self.base.modes

    @property
    def iterations(self) -> int:
        """Iterations of the base."""
        return self.base.iterations

    def start_hz(self, series: Series) -> Array:
        """Start of the base."""
        return self.base.start_hz(series)

    def elastic_cents(self, E_L_pa: Array, G_LT_pa: Array) -> Array:
        """Cents of the base, shifted."""
        return self.base.elastic_cents(E_L_pa, G_LT_pa) + self.shift_cents

    def likeness(self, E_L_pa: Array, G_LT_pa: Array) -> Array:
        """Likeness of the base: a uniform shift changes no shape."""
        return self.base.likeness(E_L_pa, G_LT_pa)


def diagnose(fit: ReedFit, announce: Callable[[str], None] | None = None) -> Diagnosis:
    """Compare a fitted reed with the nominal twin and try the known effects.

    Raises
    ------
    FitError
        If the runs give no parameters to compare at.
    """
    if fit.parameters is None:
        raise FitError(f"nothing to compare the twin with: {fit.reason}")
    reed = basis_of(fit.sweeps[0].reed_file, announce)
    model = finite_element_model(reed)
    found = {Series(sweep.series): sweep.resonances for sweep in fit.sweeps}
    nominal = fit_components(found, model)
    cells = sorted(_cells(nominal, fit), key=lambda c: -abs(c.gap_cents) / c.floor_cents)
    floor = float(np.sqrt(np.mean([cell.floor_cents**2 for cell in cells])))
    trials = []
    for effect, (stage, shifts) in _effects(reed, model.modes, announce).items():
        trials.append(_try(effect, stage, shifts, found, model, nominal, floor))
    return Diagnosis(tuple(cells), tuple(trials), nominal.rms_cents, floor)


def _cells(parameters: ReedParameters, fit: ReedFit) -> list[GapCell]:
    errors = {
        (sweep.series, name): found.error_cents
        for sweep in fit.sweeps
        for name, found in sweep.resonances.items()
    }
    return [
        GapCell(series, name, gap, float(np.hypot(errors[series, name], MESH_CENTS)))
        for series, residuals in parameters.residual_cents.items()
        for name, gap in residuals.items()
    ]


def _effects(
    reed: ReducedReed, modes: tuple[str, ...], announce: Callable[[str], None] | None
) -> dict[str, tuple[str, Array]]:
    """Shift (m,) in cents of every known effect at its nominal size, with its stage."""
    laid_open = anatomy(reed.geometry, settings=BasisSettings(cane=reed.cane), announce=announce)
    workshop, bare = Workshop(laid_open), Twin()
    loaded = air_load.EFFECT.change(bare, {"share": 1.0})
    before, after = (workshop.modes(twin.reed) for twin in (bare, loaded))
    shifts = [1200 * np.log2(after[name].hz / before[name].hz) for name in modes]
    return {"air load": (str(air_load.EFFECT.stage), np.array(shifts))}


def _try(
    effect: str,
    stage: str,
    shifts: Array,
    found: Mapping[Series, Any],
    model: ForwardModel,
    nominal: ReedParameters,
    floor: float,
) -> EffectTrial:
    """Fit the cane anew with the effect at its best size."""

    def rms_cents(share: float) -> float:
        return fit_components(found, ShiftedModel(model, share * shifts, effect)).rms_cents

    best = minimize_scalar(rms_cents, bounds=(0.0, _LARGEST_SHARE), method="bounded")
    share, after = float(best.x), float(best.fun)
    before = nominal.rms_cents
    if after >= before:
        share, after = 0.0, before
    resolvable = before - floor
    kappa = (before - max(after, floor)) / resolvable if resolvable > 0 else float("nan")
    return EffectTrial(effect, stage, share, before, after, kappa)
