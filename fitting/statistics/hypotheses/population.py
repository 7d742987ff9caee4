"""All unknowns of a population under one hypothesis, as a least-squares problem.

The squares of observed less computed cents, what was not observed left out (paper, Eq. eq5d), and
rows of weak priors; the orthonormality of the components over the reeds (Eq. eq.ortho) as exact
constraints.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from fitting.paper.constants import H4_MISFIT_CENTS
from fitting.statistics.factors import orthonormal
from fitting.statistics.hypotheses.arrow import ArrowEquations, ArrowPoint
from fitting.statistics.hypotheses.prediction import (
    Adjustment,
    Prediction,
    ResonanceModel,
    predict,
)
from fitting.statistics.hypotheses.structure import PARAMETER_SIZES, Structure
from holography.arrays import Array


@dataclass(frozen=True)
class Priors:
    """Gaussian priors for what the data leave open; `numpy.inf` takes one away.

    Attributes
    ----------
    noise_cents : float
        What a prior is weighed against: the standard deviation of an observation about the model.
    adjustment_cents : float
        Standard deviation of every adjustment about 0, that is of the true reed about the
        metamodel. Without it adjustments can stand for mean moduli, and drift far with them
        ("some constraints have however to be introduced", says the paper).
    coefficient_share : float
        Standard deviation of a coefficient about its start, for structures whose coefficients
        are `held`, in units of `coefficient_sizes`.
    parameter_share : float
        Standard deviation of a reed's parameter about the population's mean, for structures
        whose components are not orthonormal (H9), as a fraction of the parameter's size.
    """

    noise_cents: float = H4_MISFIT_CENTS
    adjustment_cents: float = 100.0
    coefficient_share: float = 0.1
    parameter_share: float = 0.5


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Everything that a fit determines.

    Attributes
    ----------
    coefficients : (p,) float
        Named by the structure.
    adjustments_cents : (m, r) float
        Of each mode's metamodel.
    components : (n, K) float
    """

    coefficients: Array
    adjustments_cents: Array
    components: Array


def coefficient_sizes(structure: Structure, coefficients: Array) -> Array:
    """Change (p,) of each coefficient that changes some element of M by a parameter's own size."""
    relative = np.abs(structure.jacobian(coefficients)) / PARAMETER_SIZES[:, None]
    greatest = relative.max(axis=(1, 2, 3), initial=0.0)
    return np.asarray(np.divide(1.0, greatest, out=np.ones_like(greatest), where=greatest > 0))


@dataclass(frozen=True, eq=False)
class Population:
    """The least-squares problem (an `ArrowProblem`).

    The shared unknowns are the coefficients in units of their sizes, then the adjustments in
    cents; the reeds' own are their components.

    Attributes
    ----------
    observed_cents : (n, 2, m) float
        NaN where nothing was observed.
    structure : Structure
    model : ResonanceModel
    adjustment : Adjustment
    sizes : (p,) float
    prior_weights : (p + m r,) float
        Cents per unit of a shared unknown.
    prior_centre : (p + m r,) float
    own_weight_cents : float
        The same for every component, about 0.
    noise_cents : float
        What the priors are weighed against.
    """

    observed_cents: Array
    structure: Structure
    model: ResonanceModel
    adjustment: Adjustment
    sizes: Array
    prior_weights: Array
    prior_centre: Array
    own_weight_cents: float
    noise_cents: float

    @classmethod
    def posed(
        cls,
        observed_cents: Array,
        structure: Structure,
        model: ResonanceModel,
        priors: Priors,
        adjustment: Adjustment,
        coefficients: Array,
    ) -> "Population":
        """Pose the problem; `coefficients` (p,) set the units and the centre of their prior."""
        sizes = coefficient_sizes(structure, coefficients)
        modes, each = observed_cents.shape[-1], adjustment.to_equation_1.shape[-1]
        held = priors.noise_cents / priors.coefficient_share if structure.held else 0.0
        adjusted = priors.noise_cents / priors.adjustment_cents
        own = 0.0 if structure.orthonormal else priors.noise_cents / priors.parameter_share
        weights = np.repeat([held, adjusted], [len(sizes), modes * each])
        centre = np.concatenate([coefficients / sizes, np.zeros(modes * each)])
        return cls(
            observed_cents,
            structure,
            model,
            adjustment,
            sizes,
            weights,
            centre,
            own,
            priors.noise_cents,
        )

    def point(self, unknowns: Unknowns) -> ArrowPoint:
        """Unknowns in the order and units of the problem."""
        coefficients = unknowns.coefficients / self.sizes
        adjustments = unknowns.adjustments_cents.ravel()
        return ArrowPoint(np.concatenate([coefficients, adjustments]), unknowns.components)

    def unknowns(self, at: ArrowPoint) -> Unknowns:
        """Inverse of `point`."""
        coefficients, adjustments = np.split(at.shared, [len(self.sizes)])
        modes = self.observed_cents.shape[-1]
        return Unknowns(self.sizes * coefficients, adjustments.reshape(modes, -1), at.own)

    def residual_cents(self, at: ArrowPoint) -> Array:
        """Observed less computed (n, 2, m); NaN where nothing was observed."""
        return np.asarray(self.observed_cents - self._predict(self.unknowns(at)).cents)

    def cost(self, at: ArrowPoint) -> float:
        """Sum of squares, priors included; infinite where a storage modulus is not positive."""
        return self._cost(at, self._predict(self.unknowns(at)))

    def normal_equations(self, at: ArrowPoint) -> ArrowEquations:
        """See `ArrowProblem.normal_equations`."""
        unknowns = self.unknowns(at)
        prediction = self._predict(unknowns)
        seen = ~np.isnan(self.observed_cents)
        residual = np.where(seen, self.observed_cents - prediction.cents, 0).reshape(len(seen), -1)
        by_own, by_shared = self._jacobian(unknowns, prediction, seen)
        prior = self.prior_weights**2
        own_prior = self.own_weight_cents**2
        return ArrowEquations(
            cost=self._cost(at, prediction),
            own=np.swapaxes(by_own, 1, 2) @ by_own + own_prior * np.eye(by_own.shape[-1]),
            cross=np.swapaxes(by_own, 1, 2) @ by_shared,
            shared=np.tensordot(by_shared, by_shared, axes=([0, 1], [0, 1])) + np.diag(prior),
            own_descent=np.einsum("nxk,nx->nk", by_own, residual) - own_prior * at.own,
            shared_descent=np.tensordot(residual, by_shared, axes=2)
            - prior * (at.shared - self.prior_centre),
            constraints=self.constraints(at.own),
        )

    def onto_constraints(self, near: ArrowPoint) -> ArrowPoint:
        """The same coefficients and adjustments, with components made orthonormal."""
        if not self.structure.orthonormal or not self.structure.components:
            return near
        return ArrowPoint(near.shared, orthonormal(near.own))

    def _predict(self, unknowns: Unknowns) -> Prediction:
        parameters = self.structure.parameters(unknowns.coefficients, unknowns.components)
        return predict(self.model, self.adjustment, unknowns.adjustments_cents, parameters)

    def _cost(self, at: ArrowPoint, prediction: Prediction) -> float:
        seen = ~np.isnan(self.observed_cents)
        squares = np.sum((self.observed_cents - prediction.cents)[seen] ** 2)
        squares += np.sum((self.prior_weights * (at.shared - self.prior_centre)) ** 2)
        squares += np.sum((self.own_weight_cents * at.own) ** 2)
        return float(squares) if np.isfinite(squares) else np.inf

    def _jacobian(
        self, unknowns: Unknowns, prediction: Prediction, seen: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Derivatives of the computed cents, (n, 2 m, K) and (n, 2 m, p + m r)."""
        n, series, modes = seen.shape
        by_parameter = np.where(seen[..., None], prediction.by_parameter, 0)
        matrices = self.structure.matrices(unknowns.coefficients)
        by_own = np.einsum("nsmj,sjk->nsmk", by_parameter, matrices[..., 1:])
        with_one = np.concatenate([np.ones((n, 1)), unknowns.components], axis=1)
        by_element = np.einsum("nsmj,nk->snmjk", by_parameter, with_one)
        by_coefficient = np.einsum(
            "snmx,psx->nsmp",
            by_element.reshape(series, n, modes, -1),
            _flat(self.structure.jacobian(unknowns.coefficients)) * self.sizes[:, None, None],
            optimize=True,
        )
        terms = np.where(seen[..., None], prediction.by_adjustment, 0)
        by_adjustment = np.einsum("nsmr,mk->nsmkr", terms, np.eye(modes))
        by_shared = np.concatenate(
            [by_coefficient, by_adjustment.reshape(n, series, modes, -1)], axis=-1
        )
        rows = (n, series * modes)
        return by_own.reshape(*rows, by_own.shape[-1]), by_shared.reshape(*rows, -1)

    def constraints(self, components: Array) -> Array:
        """Directions that steps of the components must not take, (n, K, c).

        Those that change means, SDs or correlations, and rotations among the rotatable.
        """
        n, K = components.shape
        if not self.structure.orthonormal:
            return np.empty((n, K, 0))
        columns = list(np.eye(K)[:, None, :].repeat(n, axis=1))
        for i, k in combinations_with_replacement(range(K), 2):
            one, other = np.zeros((2, n, K))
            one[:, k], other[:, i] = components[:, i], components[:, k]
            rotate = i != k and {i, k} <= set(self.structure.rotatable)
            columns += [one, other] if rotate else [one + other]
        return np.stack(columns, axis=-1) if columns else np.empty((n, K, 0))


def _flat(jacobian: Array) -> Array:
    """(p, 2, 6, K + 1) → (p, 2, 6 (K + 1)), also for p = 0."""
    return jacobian.reshape(*jacobian.shape[:2], jacobian.shape[2] * jacobian.shape[3])
