"""A population fitted to one hypothesis: coefficients, adjustments and components at once."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FitInputError
from fitting.statistics.hypotheses.arrow import ArrowPoint, Minimum, minimise
from fitting.statistics.hypotheses.population import (
    Population,
    Priors,
    Unknowns,
)
from fitting.statistics.hypotheses.prediction import (
    Adjustment,
    ResonanceModel,
    full_adjustment,
    intercept_adjustment,
    no_adjustment,
    paper_resonances,
)
from fitting.statistics.hypotheses.structure import Structure, coefficients_within
from holography.arrays import Array

_DEFAULT_PRIORS = Priors()
# First guesses of components are cut off here, more where a reed's stiffness would be negative.
_FARTHEST_GUESS_SD = (2.0, 1.0)
# A reed's block of the normal matrix with eigenvalues farther apart leaves a component open.
_SINGULAR = 1e-13


@dataclass(frozen=True, eq=False)
class HypothesisFit:
    """A population fitted to one hypothesis.

    Attributes
    ----------
    population : Population
        The problem that was solved.
    unknowns : Unknowns
        Its solution.
    parameters : (n, 2, 6) float
        E1, E2, E3, G1, G2, G3 of each reed in both series, MPa and MPa·s.
    residual_cents : (n, 2, m) float
        Observed less computed; NaN where nothing was observed.
    cost : float
        What was minimised: squares of residuals and priors, cents².
    iterations : int
    converged : bool
    """

    population: Population
    unknowns: Unknowns
    parameters: Array
    residual_cents: Array
    cost: float
    iterations: int
    converged: bool

    @property
    def structure(self) -> Structure:
        """The hypothesis."""
        return self.population.structure

    @property
    def rmsd_cents(self) -> float:
        """Root mean square deviation over what was observed (paper, Eq. eq5d)."""
        return float(np.sqrt(np.nanmean(self.residual_cents**2)))

    @property
    def degrees_of_freedom(self) -> int:
        """Observations less what was fitted to them; directions held by priors count as fitted."""
        point = self.population.point(self.unknowns)
        constraints = self.population.constraints(point.own).shape[-1]
        fitted = point.shared.size + point.own.size - constraints
        return int(np.count_nonzero(~np.isnan(self.residual_cents)) - fitted)

    @property
    def residual_sd_cents(self) -> float:
        """Root of the sum of squared residuals over the degrees of freedom."""
        return float(np.sqrt(np.nansum(self.residual_cents**2) / self.degrees_of_freedom))

    @property
    def coefficients(self) -> Mapping[str, float]:
        """The free ("active") coefficients by name."""
        names = self.structure.coefficients
        return dict(zip(names, map(float, self.unknowns.coefficients), strict=True))

    @property
    def equation_1_changes(self) -> Mapping[str, Array]:
        """Changes of a_m0 … a_m5, (6,), by mode."""
        changes = self.unknowns.adjustments_cents @ self.population.adjustment.to_equation_1.T
        return dict(zip(self.population.model.metamodel.modes, changes, strict=True))

    @property
    def physical(self) -> NDArray[np.bool_]:
        """Whether the cane of a reed in a series can exist, (n, 2).

        Springs must be positive, in the Maxwell arms not negative, dashpots not negative.
        """
        springs, arms = self.parameters[..., [0, 3]], self.parameters[..., [1, 2, 4, 5]]
        return np.asarray((springs > 0).all(axis=-1) & (arms >= 0).all(axis=-1))


def fit_hypothesis(
    observed_cents: Array,
    structure: Structure,
    *,
    start: Unknowns | None = None,
    model: ResonanceModel | None = None,
    priors: Priors = _DEFAULT_PRIORS,
    tolerance: float = 1e-4,
    most_iterations: int = 200,
) -> HypothesisFit:
    """Fit a population to a hypothesis by one least squares.

    Where the hypothesis leaves the rotation of components free, no step rotates them: they keep
    the directions that the start gave them.

    Parameters
    ----------
    observed_cents : (n, 2, m) float
        Resonances of n reeds in series A and B in cents above F6, in the order of the model's
        modes; NaN where a mode was not identified.
    structure : Structure
    start : Unknowns, optional
        By default the structure's own coefficients, the components that go with them, and
        adjustments that are freed only once both have settled.
    model : ResonanceModel, optional
        By default `paper_resonances`.
    priors : Priors
    tolerance : float
        The search ends where no step promises to lower the sum of squares by more, in units of
        the noise's variance.
    most_iterations : int
        The result says whether they sufficed.

    Raises
    ------
    FitInputError
        Where the arrays do not fit the model or each other, or reeds or their observations are
        too few.
    """
    model = paper_resonances() if model is None else model
    observed = _checked(observed_cents, structure, model)
    adjustment = full_adjustment() if structure.all_of_equation_1 else intercept_adjustment()
    variance = priors.noise_cents**2
    if start is None:
        unadjusted = no_adjustment(), structure.start
        plain = Population.posed(observed, structure, model, priors, *unadjusted)
        start = _without_adjustments(plain, variance, most_iterations)
    _require_shapes(start, structure, observed)
    start = replace(start, adjustments_cents=_widened(start.adjustments_cents, adjustment))
    population = Population.posed(
        observed, structure, model, priors, adjustment, start.coefficients
    )
    point = _startable(population, population.point(start))
    found = minimise(
        population, point, tolerance=tolerance * variance, most_iterations=most_iterations
    )
    return _joint_fit(population, found)


def _joint_fit(population: Population, found: Minimum) -> HypothesisFit:
    unknowns = population.unknowns(found.point)
    return HypothesisFit(
        population=population,
        unknowns=unknowns,
        parameters=population.structure.parameters(unknowns.coefficients, unknowns.components),
        residual_cents=population.residual_cents(found.point),
        cost=found.cost,
        iterations=found.iterations,
        converged=found.converged,
    )


def continued(fit: HypothesisFit, wider: Structure) -> Unknowns:
    """Start for a wider hypothesis: what it says where it says the same as a fitted one.

    Raises
    ------
    FitInputError
        Where the fitted hypothesis is no special case of the wider one.
    """
    coefficients = coefficients_within(wider, fit.structure, fit.unknowns.coefficients)
    return replace(fit.unknowns, coefficients=coefficients)


def _without_adjustments(
    problem: Population, noise_variance: float, most_iterations: int
) -> Unknowns:
    """Fit coefficients and components, roughly, to the metamodel as it is."""
    reeds, _, modes = problem.observed_cents.shape
    K = problem.structure.components
    mean = Unknowns(problem.structure.start, np.empty((modes, 0)), np.zeros((reeds, K)))
    at = problem.point(mean)
    here = problem.normal_equations(at)
    # Components are N(0, 1): with that as a prior one linear step is a fair first guess.
    known = here.own + noise_variance * np.eye(K)
    guess = np.linalg.solve(known, here.own_descent[..., None])[..., 0]
    for farthest in _FARTHEST_GUESS_SD:
        start = problem.onto_constraints(replace(at, own=np.clip(guess, -farthest, farthest)))
        if np.isfinite(problem.cost(start)):
            break
    start = _startable(problem, start)
    found = minimise(problem, start, tolerance=noise_variance, most_iterations=most_iterations)
    return problem.unknowns(found.point)


def _widened(adjustments_cents: Array, adjustment: Adjustment) -> Array:
    """The same adjustments, followed by zeros for the combinations that were not adjusted yet."""
    modes, have = adjustments_cents.shape
    wanted = adjustment.to_equation_1.shape[-1]
    return np.concatenate([adjustments_cents, np.zeros((modes, wanted - have))], axis=1)


def _checked(observed_cents: Array, structure: Structure, model: ResonanceModel) -> Array:
    observed = np.asarray(observed_cents, dtype=float)
    modes = model.metamodel.modes
    if observed.ndim != 3 or observed.shape[1:] != (2, len(modes)):
        raise FitInputError(
            f"observed cents have the shape {observed.shape}; give (reeds, 2 series, "
            f"{len(modes)} modes), the modes in the order {', '.join(modes)}"
        )
    if structure.orthonormal and len(observed) < structure.components + 2:
        raise FitInputError(
            f"{len(observed)} reeds cannot have {structure.components} uncorrelated components "
            f"({structure.name}); give at least {structure.components + 2}"
        )
    if np.isinf(observed).any():
        raise FitInputError("an observed resonance is infinite; mark what is missing by NaN")
    for name, column in zip(modes, np.moveaxis(observed, -1, 0), strict=True):
        if np.isnan(column).all():
            raise FitInputError(
                f"mode {name} was identified on no reed; leave it out of the model's modes"
            )
    return observed


def _require_shapes(start: Unknowns, structure: Structure, observed: Array) -> None:
    given = (start.coefficients.shape, start.components.shape, len(start.adjustments_cents))
    reeds, _, modes = observed.shape
    wanted = ((len(structure.coefficients),), (reeds, structure.components), modes)
    if given != wanted:
        raise FitInputError(
            f"the start of {structure.name} has coefficients {given[0]}, components {given[1]} and "
            f"adjustments of {given[2]} modes; give {wanted[0]}, {wanted[1]} and {wanted[2]}"
        )


def _startable(population: Population, point: ArrowPoint) -> ArrowPoint:
    """The point, on the constraints.

    Raises
    ------
    FitInputError
        Where the model has no answer there, or a reed's observations leave a component open.
    """
    start = population.onto_constraints(point)
    name = population.structure.name
    if not np.isfinite(population.cost(start)):
        raise FitInputError(
            f"{name} begins with a reed whose storage modulus is not positive; "
            "start from other coefficients or components"
        )
    own = population.normal_equations(start).own
    if own.size:
        spread = np.linalg.eigvalsh(own)
        for reed in np.flatnonzero(spread[:, 0] <= _SINGULAR * spread[:, -1]):
            seen = np.count_nonzero(~np.isnan(population.observed_cents[reed]))
            raise FitInputError(
                f"reed {reed} (counted from 0) has {seen} resonances, which do not determine its "
                f"{own.shape[-1]} components ({name}); leave it out"
            )
    return start
