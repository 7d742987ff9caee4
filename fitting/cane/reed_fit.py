"""Components and moduli of a reed's cane from its resonances, with standard errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import truncnorm

from fitting.cane.excess_scatter import added_cents, is_misfit
from fitting.cane.model_errors import CANE, ModelErrors, cane_shift
from fitting.cane.over_density import (
    MODULI,
    cane_of,
    components_over_density,
    moduli_mpa,
)
from fitting.errors import FitError
from fitting.forward import (
    ForwardModel,
    cents_of,
    name_similarity,
    viscoelastic_cents,
)
from fitting.resonance import Resonance
from holography.arrays import Array, IndexArray, Mask
from physics.reed.cane.viscoelastic import Series, ViscoelasticCane

COMPONENTS = ("e1", "e2", "e3", "e4")
# Below this similarity, relative to a pure mode, the mode is mixed with another one.
_LEAST_SIMILARITY = 0.85
# Limits of the components, in standard deviations of the population.
_FARTHEST_SD = 6.0
# Standard error of components of which resonances say nothing. Chosen: far more than reeds differ.
_UNKNOWN_SD = 100.0
# A component this close to a limit is at the limit.
_AT_LIMIT_SD = 1e-3
# Step of numeric derivatives, small next to how components bend frequencies and large next to the
# rounding of the iteration over frequencies.
_DIFFERENCE_SD = 1e-3
# Residuals beyond this many standard errors have less weight in the first, robust fit.
_OUTLIER = 2.0
# ... in which all errors are at least that of a step of 25 cents (25 / √12).
_EVEN_CENTS = 7.2
# Causes leave at least this fraction of the squares that residuals should have. Chosen: the excess
# scatter is then at most three times what it is without causes.
_LEAST_LEFT = 0.1
# Most iterations of the excess scatter, and relative change at which they end.
_MISFIT_TURNS, _MISFIT_SETTLED = 10, 1e-3


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
        Per series ("A", "B"): E1, E2, G1, G2 and the storage moduli at 4 kHz, in MPa. They and the
        components are those of cane of the drawing's density (`fitting.cane.over_density`).
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
    resonances: Mapping[Series, Mapping[str, Resonance]],
    model: ForwardModel,
    unknown: ModelErrors | None = None,
) -> ReedParameters:
    """Fit e1…e3 to series A, or e1…e4 to series A and B, by generalised least squares.

    Parameters
    ----------
    resonances : mapping
        Found resonances by name, per series.
    model : ForwardModel
    unknown : ModelErrors, optional
        What the model does not know of the reed, and what is known of the bench. Causes are
        fitted, too, each with a prior of one standard deviation; the covariance of the components
        contains them.

    Raises
    ------
    FitError
        Without series A (e2 and e4 have the same effect on series B), or with fewer resonances than
        components.
    """
    observed = [
        _Observation(series, name, model.modes.index(name), found, *_of_mode(unknown, name))
        for series, named in resonances.items()
        for name, found in named.items()
        if name in model.modes
    ]
    # Which modes exchange shapes is known only for a known cane: first a robust fit to all modes.
    free = _free(observed)
    _require_enough(observed, len(free))
    errors = np.maximum(_errors_cents(observed), _EVEN_CENTS)
    problem = _problem(observed, model, len(free), unknown)
    values = problem.fitted(errors, problem.start, "soft_l1")[0][: len(free)]
    distinct = [o for o in observed if _similarity(o, values, model) >= _LEAST_SIMILARITY]
    free = _free(distinct)
    _require_enough(distinct, len(free))
    left_out = {
        str(s): [o.name for o in observed if o.series is s and o not in distinct]
        for s in resonances
    }
    problem = _problem(distinct, model, len(free), unknown)
    return _parameters(problem, free, left_out)


def _parameters(
    problem: "_Problem",
    free: Sequence[str],
    left_out: dict[str, list[str]],
) -> ReedParameters:
    """Fit the free components to observations and collect the results."""
    distinct, model = problem.observed, problem.model
    series = sorted({o.series for o in distinct})
    everything, whole_covariance, chi2, misfit = _least_squares(problem)
    residual, values = problem.residual_cents(everything), everything[: len(free)]
    components, moduli = _over_density(problem, series, everything, whole_covariance)
    return ReedParameters(
        components=dict(zip(free, components, strict=True)),
        moduli={str(s): dict(zip(MODULI, moduli[s], strict=True)) for s in series},
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
        physical=all(_springs_positive(cane_of(values, s)) for s in series),
        model=model.name,
    )


@dataclass(frozen=True)
class _Observation:
    """A resonance and its place in the model."""

    series: Series
    name: str
    mode: int
    found: Resonance
    own_cents: float = 0.0
    known_cents: float = 0.0


@dataclass(frozen=True)
class _Problem:
    """Resonances, and unknown causes.

    Attributes
    ----------
    observed : sequence of _Observation
        The n resonances.
    model : ForwardModel
    count : int
        Number of components.
    patterns : (n, q) float
        By which causes move resonances, in cents.
    positive : (q,) bool
    cane : (q, 5) float
        See `ModelErrors`.
    """

    observed: Sequence[_Observation]
    model: ForwardModel
    count: int
    patterns: Array
    positive: Mask
    cane: Array

    @property
    def start(self) -> Array:
        """Zeros for components and causes."""
        return np.zeros(self.count + self.patterns.shape[1])

    def residual_cents(self, values: Array) -> Array:
        """Return observed minus computed frequencies in cents, for components and causes."""
        components, causes = values[: self.count], values[self.count :]
        return _residual_cents(self.observed, components, self.model) - self.patterns @ causes

    def fitted(
        self, errors: Array, start: Array, loss: Literal["linear", "soft_l1"] = "linear"
    ) -> tuple[Array, Array]:
        """Return the best components and causes, and the jacobian of weighted residuals."""

        def weighted(values: Array) -> Array:
            own = self.residual_cents(values) / errors
            return np.concatenate([own, values[self.count :]])

        def slopes(values: Array) -> Array:
            """Causes move modes in proportion: only components need differences."""
            step = _DIFFERENCE_SD * np.eye(len(start))[: self.count]
            moved = [
                self.residual_cents(values + d) - self.residual_cents(values - d) for d in step
            ]
            own = np.hstack([np.stack(moved, axis=1) / (2 * _DIFFERENCE_SD), -self.patterns])
            return np.vstack([own / errors[:, None], np.eye(len(start))[self.count :]])

        farthest = np.full(len(start), np.inf)
        farthest[: self.count] = _FARTHEST_SD
        limits = (-farthest, farthest)
        solution = least_squares(
            weighted, start, slopes, bounds=limits, loss=loss, f_scale=_OUTLIER
        )
        return solution.x, np.asarray(solution.jac, dtype=float)


def _of_mode(unknown: ModelErrors | None, name: str) -> tuple[float, float]:
    """Return the error of one mode, and the shift that is known of it, in cents."""
    if unknown is None:
        return 0.0, 0.0
    mode = unknown.modes.index(name)
    return float(unknown.own_cents[mode]), float(unknown.known_cents[mode])


def _problem(
    observed: Sequence[_Observation], model: ForwardModel, count: int, unknown: ModelErrors | None
) -> _Problem:
    """Put resonances and causes together: a cause that belongs to a clamping, in each series."""
    if unknown is None:
        none, nothing = np.zeros(0, dtype=bool), np.zeros((0, len(CANE)))
        return _Problem(observed, model, count, np.zeros((len(observed), 0)), none, nothing)
    rows = [unknown.modes.index(o.name) for o in observed]
    each, series = unknown.cents[:, rows].T, sorted({o.series for o in observed})
    shared, clamped = np.flatnonzero(~unknown.of_clamping), np.flatnonzero(unknown.of_clamping)
    own = [each[:, clamped] * np.array([[o.series is one] for o in observed]) for one in series]
    causes = np.concatenate([shared, *[clamped] * len(series)])
    patterns = np.hstack([each[:, shared], *own])
    return _Problem(
        observed, model, count, patterns, unknown.positive[causes], unknown.cane[causes]
    )


def _free(observed: Sequence[_Observation]) -> Sequence[str]:
    """Return the components that resonances determine: e4 only with some of series B."""
    series = {o.series for o in observed}
    if series and Series.A not in series:
        raise FitError(
            "components need resonances of series A: in series B alone e2 and e4 have the same "
            "effect; give the reed's series A run too, or look at its report for what hides modes"
        )
    return COMPONENTS if Series.B in series else COMPONENTS[:3]


def _require_enough(observed: Sequence[_Observation], count: int) -> None:
    if len(observed) <= count:
        raise FitError(
            f"{len(observed)} resonances cannot fix {count} components; "
            "run more steps, or look at the report for what hides the others"
        )


def _errors_cents(observed: Sequence[_Observation]) -> Array:
    return np.array([np.hypot(o.found.error_cents, o.own_cents) for o in observed])


def _least_squares(problem: _Problem) -> tuple[Array, Array, float, float]:
    """Return components and causes, covariance, χ² per degree of freedom, and excess scatter.

    A reed may differ from its model by more than the errors of its frequencies and the known
    causes. The residuals show by how much (see `fitting.cane.excess_scatter`).
    """
    errors, freedom = _errors_cents(problem.observed), len(problem.observed) - problem.count
    values, jacobian = problem.fitted(errors, problem.start)

    def squares(values: Array) -> tuple[Array, float]:
        """Residuals, and what the causes take of the squares that are expected."""
        return problem.residual_cents(values), float(np.sum(values[problem.count :] ** 2))

    residual, taken = squares(values)
    chi2, misfit = (float(np.sum((residual / errors) ** 2)) + taken) / freedom, 0.0
    if is_misfit(chi2, freedom):
        for _ in range(_MISFIT_TURNS):
            before, left = misfit, max(freedom - taken, _LEAST_LEFT * freedom)
            misfit = float(added_cents(residual[None], errors, np.array([left]))[0])
            values, jacobian = problem.fitted(np.hypot(errors, misfit), values)
            residual, taken = squares(values)
            if abs(misfit - before) < _MISFIT_SETTLED * misfit:
                break
    # Where the model ends, components change nothing: they are unknown then.
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.eye(len(values)) / _UNKNOWN_SD**2)
    positive = problem.count + np.flatnonzero(problem.positive)
    return *_never_negative(values, covariance, positive), chi2, misfit


def _never_negative(values: Array, covariance: Array, positive: IndexArray) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) of normal values of which some are never negative.

    For one of them this is exact; several are cut one after the other.
    """
    for k in positive.tolist():
        along, sd = covariance[:, k], float(np.sqrt(covariance[k, k]))
        # In standard deviations from the value before.
        mean, variance = map(float, truncnorm.stats(-values[k] / sd, np.inf))
        values = values + along * (mean / sd)
        covariance = covariance - np.outer(along, along) * ((1 - variance) / sd**2)
    return values, covariance


def _residual_cents(observed: Sequence[_Observation], values: Array, model: ForwardModel) -> Array:
    """Return observed minus computed frequencies in cents."""
    computed = {
        s: viscoelastic_cents(model, cane_of(values, s), s) for s in {o.series for o in observed}
    }
    return np.array(
        [
            float(cents_of(o.found.frequency_hz)) - o.known_cents - computed[o.series][o.mode]
            for o in observed
        ]
    )


def _similarity(observation: _Observation, values: Array, model: ForwardModel) -> float:
    cane = cane_of(values, observation.series)
    cents = viscoelastic_cents(model, cane, observation.series)
    return float(name_similarity(model, cane, cents)[observation.mode])


def _springs_positive(cane: ViscoelasticCane) -> bool:
    return all(min(z.spring_mpa, z.arm_spring_mpa) > 0 for z in (cane.young_L, cane.shear_LT))


def _over_density(
    problem: _Problem, series: Sequence[Series], values: Array, covariance: Array
) -> tuple[list[ValueWithError], dict[Series, list[ValueWithError]]]:
    """Return components, and moduli per series, with errors, propagated to first order.

    Parameters
    ----------
    problem : _Problem
    series : sequence of Series
        Series of the resonances.
    values : (c + q,) float
        Components and causes.
    covariance : (c + q, c + q) float
    """
    hz = {
        s: np.array([o.found.frequency_hz for o in problem.observed if o.series is s])
        for s in series
    }
    count = problem.count

    def reported(values: Array) -> Array:
        e = values[:count]
        shift = cane_shift(values[count:], problem.cane)
        moduli = [moduli_mpa(e, shift, s, hz[s]) for s in series]
        return np.concatenate([components_over_density(e, shift, hz), *moduli])

    step = 1e-4 * np.eye(len(values))
    jacobian = np.stack([(reported(values + d) - reported(values - d)) / 2e-4 for d in step], 1)
    errors = np.sqrt(np.einsum("ni,ij,nj->n", jacobian, covariance, jacobian))
    found = [
        ValueWithError(float(value), float(error))
        for value, error in zip(reported(values), errors, strict=True)
    ]
    moduli = (found[count + k * len(MODULI) :][: len(MODULI)] for k in range(len(series)))
    return found[:count], dict(zip(series, moduli, strict=True))
