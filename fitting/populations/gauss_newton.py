"""Gauss-Newton steps for a block of reeds: frequencies, their jacobian, and normal equations.

A mode has the moduli of its own frequency: its cents c solve ``c = f(ln E'(p, c), ln G'(p, c))``.
With ``κ = ∂f/∂c`` the solution depends on the components p as ``dc/dp = (∂f/∂p) / (1 - κ)``
(implicit function theorem), and Newton's correction of a c that does not solve it is
``(f - c) / (1 - κ)``. Each evaluation makes one such correction of the c that dc/dp predicts for
the step, so that its error is of fourth order in the step.

Reeds are the last axis of all arrays, so that each operation serves a block of them.
"""

from dataclasses import dataclass, fields
from functools import reduce

import numpy as np

from holography.arrays import Array, Mask
from physics.reed.cane.viscoelastic import Series, StorageModulus, h4_matrix, storage_modulus
from physics.reed.reduction.metamodel import REFERENCE_HZ, Metamodel

# Components that one series, or both, can tell apart (see `fitting.cane.reed_fit`).
SERIES_COMPONENTS = {1: 3, 2: 4}
# A step shorter than this, in standard errors, is the last: the remaining error is 1 % of it.
_SHORT_STEP = 0.01
# Largest shift of an observed mode in a step: the error of the prediction after one correction is
# then far below a cent.
_FARTHEST_STEP_CENTS = 150.0
# Factor on a step that does not decrease χ².
_CUT = 0.25
# Relative and absolute increase of χ² that may be rounding.
_ROUNDING = 1e-9
# Start of the frequencies of the mean reed, and number of corrections until they converge.
_START_CENTS, _START_EVALUATIONS = 2400.0, 10
# Replacement for impossible moduli in calls of the metamodel; the result is not used.
_HARMLESS_PA = (1e10, 1e9)
# Added to the diagonal of normal matrices, relative to their largest element, so that singular ones
# can be inverted.
_RIDGE = 1e-12
_CENT = np.log(2) / 1200


@dataclass(frozen=True)
class PopulationEvaluation:
    """Frequencies of n reeds at given components, with derivatives.

    Attributes
    ----------
    cents : (m, s, n) float
    jacobian : K arrays of (m, s, n) float
        Derivatives with respect to the components.
    possible : (m, s, n) bool
        Whether the mode has moduli that a mode can have.
    """

    cents: Array
    jacobian: tuple[Array, ...]
    possible: Mask


@dataclass(frozen=True)
class PopulationProblem:
    """Quantities that all reeds have in common.

    Attributes
    ----------
    metamodel : Metamodel
    matrices : (6, s, 1 + K) float
        From (1, e1 … eK) to (E1, E2, E3, G1, G2, G3), see `h4_matrix`.
    start : PopulationEvaluation
        Evaluation at the mean reed (n = 1).
    """

    metamodel: Metamodel
    matrices: Array
    start: PopulationEvaluation

    @property
    def count(self) -> int:
        """Components K."""
        return len(self.start.jacobian)


def problem_of(metamodel: Metamodel, series: int) -> PopulationProblem:
    """Set up the problem for series A (`series` = 1), or A and B (2)."""
    count = SERIES_COMPONENTS[series]
    matrices = np.stack([h4_matrix(s)[:, : 1 + count] for s in list(Series)[:series]], axis=1)
    cents = np.full((len(metamodel.modes), series, 1), _START_CENTS)
    for _ in range(_START_EVALUATIONS):
        evaluation = _evaluate_reeds(metamodel, matrices, np.zeros((count, 1)), cents)
        cents = evaluation.cents
    return PopulationProblem(metamodel, matrices, evaluation)


def zener_mpa(matrices: Array, components: Array) -> Array:
    """Return E1, E2, E3, G1, G2, G3 (6, s, n) in MPa and MPa·s for components (K, n)."""
    # Summed term by term: the last bit of a matrix product may depend on a reed's position.
    zener = matrices[..., :1]
    for k, component in enumerate(components, start=1):
        zener = zener + matrices[..., k, None] * component
    return zener


def storage_moduli(zener: Array, cents: Array) -> tuple[StorageModulus, StorageModulus]:
    """Return E' and G' in MPa at frequencies (m, s, n)."""
    hz = REFERENCE_HZ * np.exp2(cents / 1200)
    E1, E2, E3, G1, G2, G3 = zener
    return storage_modulus(E1, E2, E3, hz), storage_modulus(G1, G2, G3, hz)


def _evaluate_reeds(
    metamodel: Metamodel, matrices: Array, components: Array, cents: Array
) -> PopulationEvaluation:
    """Evaluate reeds with components (K, n), from approximate frequencies `cents` (m, s, n)."""
    E, G = storage_moduli(zener_mpa(matrices, components), cents)
    E_pa, G_pa = 1e6 * E.value_mpa, 1e6 * G.value_mpa
    possible = (E_pa > 0) & (G_pa > 0)
    if not possible.all():
        E_pa[~possible], G_pa[~possible] = _HARMLESS_PA
    f, by_E, by_G = _evaluate(metamodel, E_pa, G_pa)
    by_E, by_G = 1e6 * by_E / E_pa, 1e6 * by_G / G_pa
    by_itself = _CENT * (by_E * E.by_ln_frequency_mpa + by_G * G.by_ln_frequency_mpa)
    corrected = cents + (f - cents) / (1 - by_itself)
    by_E, by_G = by_E / (1 - by_itself), by_G / (1 - by_itself)
    by_parameters = (
        *(by_E, by_E * E.by_arm_spring, by_E * E.by_arm_dashpot_per_s),
        *(by_G, by_G * G.by_arm_spring, by_G * G.by_arm_dashpot_per_s),
    )
    if not possible.all():
        # Impossible modes are not used, but must not spread NaN to the others.
        corrected[~possible] = f[~possible]
        for derivative in by_parameters:
            derivative[~possible] = 0.0
    return PopulationEvaluation(corrected, _by_components(matrices, by_parameters), possible)


def _evaluate(metamodel: Metamodel, E_pa: Array, G_pa: Array) -> tuple[Array, ...]:
    """Evaluate the metamodel at moduli (m, s, n): cents and derivatives of that shape."""
    results = metamodel.evaluate(np.moveaxis(E_pa, 0, -1), np.moveaxis(G_pa, 0, -1))
    return tuple(np.moveaxis(result, -1, 0) for result in results)


def _by_components(matrices: Array, by_parameters: tuple[Array, ...]) -> tuple[Array, ...]:
    """Slopes with respect to each component from those with respect to E1 … G3."""
    jacobian = []
    for column in np.moveaxis(matrices, -1, 0)[1:]:
        moved = (row for row in range(len(by_parameters)) if column[row].any())
        jacobian.append(
            reduce(np.add, (column[row][:, None] * by_parameters[row] for row in moved))
        )
    return tuple(jacobian)


@dataclass(frozen=True)
class Best:
    """The best evaluation of each of the n reeds of a block, and the next step.

    Attributes
    ----------
    components, step : (K, n) float
    cents, shift : (m, s, n) float
        Frequencies, and their change with the step.
    normal : (K, K, n) float
    chi2 : (n,) float
    settled : (n,) bool
        Whether the step is so short that it is the last.
    """

    components: Array
    step: Array
    cents: Array
    shift: Array
    normal: Array
    chi2: Array
    settled: Mask


def gauss_newton(
    problem: PopulationProblem, observed: Array, weights: Array, evaluations: int
) -> Best:
    """Damped Gauss-Newton steps for a block of reeds, (m, s, n) each.

    A step is cut short until the fit improves and every observed mode has possible moduli.
    """
    size, used = observed.shape[-1], weights > 0
    mean = np.zeros((problem.count, size))
    best, length = _step_from(mean, _spread(problem.start, size), observed, weights), np.ones(size)
    for _ in range(evaluations - 1):
        if best.settled.all():
            break
        farthest = np.where(used, np.abs(best.shift), 0.0).max(axis=(0, 1))
        part = length * np.minimum(1.0, _FARTHEST_STEP_CENTS / farthest)
        trial = best.components + part * best.step
        cents = best.cents + part * best.shift
        evaluation = _evaluate_reeds(problem.metamodel, problem.matrices, trial, cents)
        found = _step_from(trial, evaluation, observed, weights)
        # Comparisons with NaN are false: what overflowed is no improvement.
        better = found.chi2 <= best.chi2 * (1 + _ROUNDING) + _ROUNDING
        better &= (evaluation.possible | ~used).all(axis=(0, 1)) & ~best.settled
        for field in fields(Best):
            np.copyto(getattr(best, field.name), getattr(found, field.name), where=better)
        length = np.where(better, 1.0, _CUT * length)
    return best


def _spread(evaluation: PopulationEvaluation, size: int) -> PopulationEvaluation:
    """Repeat the evaluation of one reed for many."""
    return PopulationEvaluation(
        np.repeat(evaluation.cents, size, axis=-1),
        tuple(np.repeat(column, size, axis=-1) for column in evaluation.jacobian),
        np.repeat(evaluation.possible, size, axis=-1),
    )


def _step_from(
    components: Array, evaluation: PopulationEvaluation, observed: Array, weights: Array
) -> Best:
    """Compute χ², normal equations and their solution at given components."""
    residual = weights * (observed - evaluation.cents)
    weighted = [weights * column for column in evaluation.jacobian]
    count, size = components.shape
    normal, gradient = np.empty((count, count, size)), np.empty((count, size))
    for k in range(count):
        gradient[k] = np.einsum("msn,msn->n", weighted[k], residual)
        for j in range(k + 1):
            normal[k, j] = normal[j, k] = np.einsum("msn,msn->n", weighted[k], weighted[j])
    step = np.linalg.solve(regularised(normal), gradient.T[..., None])[..., 0].T
    chi2 = np.einsum("msn,msn->n", residual, residual)
    # In standard errors that include the excess scatter.
    misfit = np.maximum(1.0, chi2 / (np.count_nonzero(weights, axis=(0, 1)) - count))
    squared_length = np.einsum("kn,kn->n", step, gradient)
    return Best(
        components=components,
        step=step,
        cents=evaluation.cents,
        shift=reduce(
            np.add, (column * s for column, s in zip(evaluation.jacobian, step, strict=True))
        ),
        normal=normal,
        chi2=chi2,
        settled=squared_length <= _SHORT_STEP**2 * misfit,
    )


def regularised(normal: Array) -> Array:
    """Return normal matrices (K, K, n) as invertible matrices (n, K, K)."""
    count = len(normal)
    scale = np.einsum("kkn->kn", normal).max(axis=0)
    usable = np.isfinite(normal).all(axis=(0, 1)) & (scale > 0)
    ridge = np.where(usable, _RIDGE * scale, 1.0)
    matrices = np.moveaxis(np.where(usable, normal, 0.0), -1, 0)
    return np.asarray(matrices + ridge[:, None, None] * np.eye(count))
