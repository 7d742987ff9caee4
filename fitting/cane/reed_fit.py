"""Components and moduli of a reed's cane from its resonances, with standard errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares

from fitting.cane.excess_scatter import added_cents, is_misfit
from fitting.errors import FitError
from fitting.forward import (
    ForwardModel,
    cents_of,
    name_similarity,
    viscoelastic_cents,
)
from fitting.resonance import Resonance
from holography.arrays import Array
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    storage_modulus_pa,
    viscoelastic_cane,
)

COMPONENTS = ("e1", "e2", "e3", "e4")
# Below this similarity, relative to a pure mode, the mode is mixed with another one.
_LEAST_SIMILARITY = 0.85
# Limits of the components, in standard deviations of the population.
_FARTHEST_SD = 6.0
# A component this close to a limit is at the limit.
_AT_LIMIT_SD = 1e-3
# Residuals beyond this many standard errors have less weight in the first, robust fit.
_OUTLIER = 2.0
# ... in which all errors are at least that of a step of 25 cents (25 / √12).
_EVEN_CENTS = 7.2
# Most iterations of the excess scatter, and relative change at which they end.
_MISFIT_TURNS, _MISFIT_SETTLED = 10, 1e-3
# The paper quotes storage moduli at this frequency (Tables 6 and 7).
QUOTED_HZ = 4000.0


@dataclass(frozen=True)
class ValueWithError:
    """A value with its standard error."""

    value: float
    error: float


@dataclass(frozen=True)
class ReedParameters:
    """Parameters of the cane that were fitted to the resonances.

    Attributes
    ----------
    components : dict
        e1, e2, e3 from series A; e4 too from A and B together.
    moduli : dict
        Per series ("A", "B"): E1, E2, G1, G2 and the storage moduli at 4 kHz, in MPa.
    rms_cents : float
        Root mean square of observed less fitted frequencies.
    residual_cents : dict
        Per series and mode.
    left_out : dict
        Per series, modes that were found but not fitted, because they exchange shapes with a
        neighbour.
    reduced_chi2 : float
        Weighted squares per degree of freedom of the best fit with the stated errors.
    excess_scatter_cents : float
        Excess scatter: standard deviation of the frequencies around the model, in addition to the
        stated errors. It is 0 if `reduced_chi2` passes a χ² test at 5 %.
    at_limit : list of str
        Components that ended at the limits of ±6: the resonances do not determine them, or one has
        a wrong name. Their values are then meaningless.
    physical : bool
        Whether all springs are positive.
    model : str
    """

    components: dict[str, ValueWithError]
    moduli: dict[str, dict[str, ValueWithError]]
    rms_cents: float
    residual_cents: dict[str, dict[str, float]]
    left_out: dict[str, list[str]]
    reduced_chi2: float
    excess_scatter_cents: float
    at_limit: list[str]
    physical: bool
    model: str


def fit_components(
    resonances: Mapping[Series, Mapping[str, Resonance]], model: ForwardModel
) -> ReedParameters:
    """Fit e1…e3 to series A, or e1…e4 to series A and B, by weighted least squares.

    Parameters
    ----------
    resonances : mapping
        Found resonances by name, per series.
    model : ForwardModel

    Raises
    ------
    FitError
        Without series A (e2 and e4 have the same effect on series B), or with fewer resonances than
        components.
    """
    if Series.A not in resonances:
        raise FitError(
            "components need a run of series A: in series B alone e2 and e4 have the same effect; "
            "give the reed's series A run too"
        )
    free = COMPONENTS if Series.B in resonances else COMPONENTS[:3]
    observed = [
        _Observation(series, name, model.modes.index(name), found)
        for series, named in resonances.items()
        for name, found in named.items()
        if name in model.modes
    ]
    # Which modes exchange shapes is known only for a known cane: first a robust fit to all modes.
    _require_enough(observed, len(free))
    errors = np.maximum(_errors_cents(observed), _EVEN_CENTS)
    values, _ = _weighted(observed, errors, model, np.zeros(len(free)), "soft_l1")
    distinct = [o for o in observed if _similarity(o, values, model) >= _LEAST_SIMILARITY]
    _require_enough(distinct, len(free))
    left_out = {
        str(s): [o.name for o in observed if o.series is s and o not in distinct]
        for s in resonances
    }
    return _parameters(distinct, free, list(resonances), left_out, model)


def _parameters(
    distinct: "Sequence[_Observation]",
    free: Sequence[str],
    series: Sequence[Series],
    left_out: dict[str, list[str]],
    model: ForwardModel,
) -> ReedParameters:
    """Fit the free components to observations and collect the results."""
    values, covariance, chi2, misfit = _least_squares(distinct, model, len(free))
    residual = _residual_cents(distinct, values, model)
    return ReedParameters(
        components={
            name: ValueWithError(float(value), float(np.sqrt(variance)))
            for name, value, variance in zip(free, values, np.diag(covariance), strict=True)
        },
        moduli={str(s): _moduli(values, covariance, s) for s in series},
        rms_cents=float(np.sqrt(np.mean(residual**2))),
        residual_cents={
            str(s): {
                o.name: float(r) for o, r in zip(distinct, residual, strict=True) if o.series is s
            }
            for s in series
        },
        left_out=left_out,
        reduced_chi2=chi2,
        excess_scatter_cents=misfit,
        at_limit=[
            name
            for name, value in zip(free, values, strict=True)
            if abs(value) > _FARTHEST_SD - _AT_LIMIT_SD
        ],
        physical=all(_springs_positive(_cane(values, s)) for s in series),
        model=model.name,
    )


@dataclass(frozen=True)
class _Observation:
    """A resonance and its place in the model."""

    series: Series
    name: str
    mode: int
    found: Resonance


def _require_enough(observed: Sequence[_Observation], count: int) -> None:
    if len(observed) <= count:
        raise FitError(
            f"{len(observed)} resonances cannot fix {count} components; "
            "run more steps, or look at the report for what hides the others"
        )


def _errors_cents(observed: Sequence[_Observation]) -> Array:
    return np.array([o.found.error_cents for o in observed])


def _least_squares(
    observed: Sequence[_Observation], model: ForwardModel, count: int
) -> tuple[Array, Array, float, float]:
    """Return components (count,), covariance, χ² per degree of freedom, and excess scatter.

    A reed differs from its model by more than the errors of its frequencies, also at the modes that
    are known best. The residuals show by how much (see `fitting.cane.excess_scatter`).
    """
    errors, freedom = _errors_cents(observed), len(observed) - count
    values, jacobian = _weighted(observed, errors, model, np.zeros(count))
    residual = _residual_cents(observed, values, model)
    chi2, misfit = float(np.sum((residual / errors) ** 2)) / freedom, 0.0
    if is_misfit(chi2, freedom):
        for _ in range(_MISFIT_TURNS):
            before = misfit
            misfit = float(added_cents(residual[None], errors, np.array([freedom]))[0])
            values, jacobian = _weighted(observed, np.hypot(errors, misfit), model, values)
            residual = _residual_cents(observed, values, model)
            if abs(misfit - before) < _MISFIT_SETTLED * misfit:
                break
    return values, np.linalg.inv(jacobian.T @ jacobian), chi2, misfit


def _weighted(
    observed: Sequence[_Observation],
    errors: Array,
    model: ForwardModel,
    start: Array,
    loss: Literal["linear", "soft_l1"] = "linear",
) -> tuple[Array, Array]:
    """Return the best components, and the jacobian of residuals in units of their errors."""

    def weighted(values: Array) -> Array:
        return np.asarray(_residual_cents(observed, values, model) / errors)

    limits = (-_FARTHEST_SD, _FARTHEST_SD)
    solution = least_squares(weighted, start, bounds=limits, loss=loss, f_scale=_OUTLIER)
    return solution.x, np.asarray(solution.jac, dtype=float)


def _residual_cents(observed: Sequence[_Observation], values: Array, model: ForwardModel) -> Array:
    """Return observed minus computed frequencies in cents."""
    computed = {
        s: viscoelastic_cents(model, _cane(values, s), s) for s in {o.series for o in observed}
    }
    return np.array(
        [float(cents_of(o.found.frequency_hz)) - computed[o.series][o.mode] for o in observed]
    )


def _similarity(observation: _Observation, values: Array, model: ForwardModel) -> float:
    cane = _cane(values, observation.series)
    cents = viscoelastic_cents(model, cane, observation.series)
    return float(name_similarity(model, cane, cents)[observation.mode])


def _cane(values: Array, series: Series) -> ViscoelasticCane:
    return viscoelastic_cane(Components(*map(float, values)), series)


def _springs_positive(cane: ViscoelasticCane) -> bool:
    return all(min(z.spring_mpa, z.arm_spring_mpa) > 0 for z in (cane.young_L, cane.shear_LT))


def _moduli(values: Array, covariance: Array, series: Series) -> dict[str, ValueWithError]:
    """Return moduli in MPa with errors, propagated to first order."""

    def moduli(e: Array) -> Array:
        cane = _cane(e, series)
        E, G = cane.young_L, cane.shear_LT
        storage = [1e-6 * float(storage_modulus_pa(z, QUOTED_HZ)) for z in (E, G)]
        return np.array([E.spring_mpa, E.arm_spring_mpa, G.spring_mpa, G.arm_spring_mpa, *storage])

    names = ("E1_mpa", "E2_mpa", "G1_mpa", "G2_mpa", "E_4kHz_mpa", "G_4kHz_mpa")
    step = 1e-4 * np.eye(len(values))
    jacobian = np.stack([(moduli(values + d) - moduli(values - d)) / 2e-4 for d in step], axis=1)
    errors = np.sqrt(np.einsum("ni,ij,nj->n", jacobian, covariance, jacobian))
    return {
        name: ValueWithError(float(value), float(error))
        for name, value, error in zip(names, moduli(values), errors, strict=True)
    }
