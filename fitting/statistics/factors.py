"""Factors behind the resonance frequencies of a population: principal components and VARIMAX.

The paper's sections "Principal component analysis" and "Reconstructing observed resonance
frequencies by multiple regression". Variables are resonance frequencies in cents, one column a
mode in a series; reeds are rows; a resonance not found is NaN.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import polar, svd

from fitting.errors import FitError
from holography.arrays import Array

# Two reeds always correlate perfectly.
_FEWEST_PAIRS = 3
# Singular values below this fraction of the largest, and sums of squares or of fourth powers that
# cancel to less than this fraction, are rounding.
_RANK, _ROUNDING = 1e-10, 1e-12
# Plane rotations by less, in radians, are rounding; a dozen sweeps get there.
_SMALLEST_ROTATION, _MOST_SWEEPS = 1e-12, 1000


@dataclass(frozen=True)
class Factors:
    """Uncorrelated factors of a population and their part in the variables.

    Factors are in order of the variance that they explain, and the largest loading of each is
    positive.

    Attributes
    ----------
    scores : (n, k) float
        Of each reed; mean 0, standard deviation 1 (N - 1), uncorrelated.
    loadings : (v, k) float
        Correlations of variables with factors.
    weights : (v,) float
        Share of each variable in the variance analysed: 1/v of a correlation matrix.
    spectrum : (min(n - 1, v),) float
        Shares of variance of all principal components, largest first; they add to 1.
    """

    scores: Array
    loadings: Array
    weights: Array
    spectrum: Array

    @property
    def fractions(self) -> Array:
        """Share of the variance that each factor explains, (k,)."""
        return np.asarray(self.weights @ self.loadings**2)


def complete_variables(values: Array) -> NDArray[np.intp]:
    """Columns found on all reeds: principal components take no others (paper: 14 of 28).

    Parameters
    ----------
    values : (n, v) float
        NaN where a resonance was not found.

    Raises
    ------
    FitError
        With fewer than three reeds or fewer than two such columns.
    """
    reeds, variables = values.shape
    if reeds < _FEWEST_PAIRS:
        raise FitError(f"{reeds} reeds have no factors; give {_FEWEST_PAIRS} or more")
    complete = np.flatnonzero(np.isfinite(values).all(axis=0))
    if len(complete) < 2:
        raise FitError(
            f"{len(complete)} of {variables} variables were found on all {reeds} reeds, factors "
            "need 2; leave out the reeds on which least was found"
        )
    return complete


def principal_factors(
    values: Array, count: int, *, matrix: Literal["correlation", "covariance"] = "correlation"
) -> Factors:
    """Principal components of a population, as standardised factors.

    Parameters
    ----------
    values : (n, v) float
        Complete, see `complete_variables`.
    count : int
        Factors kept, k.
    matrix : {'correlation', 'covariance'}
        Whether each variable counts the same, which is what the paper did (the fractions that
        follow from its Table 2 say so), or after its variance.

    Raises
    ------
    ValueError
        For missing values, a single reed, a variable that is the same on all reeds, or more
        factors than the population has dimensions.
    """
    if not np.isfinite(values).all():
        raise ValueError("values are missing; choose the complete_variables first")
    reeds = len(values)
    if reeds < 2:
        raise ValueError(f"{reeds} reeds have no factors; give {_FEWEST_PAIRS} or more")
    centred = values - values.mean(axis=0)
    sd = centred.std(axis=0, ddof=1)
    constant = np.flatnonzero(sd <= _RANK * np.abs(values).max(axis=0))
    if constant.size:
        raise ValueError(f"variable {constant[0]} is the same on all reeds; leave it out")
    scale = sd if matrix == "correlation" else np.ones_like(sd)
    left, singular, right = svd(centred / scale, full_matrices=False)
    rank = int(np.count_nonzero(singular > _RANK * singular[0]))
    if not 1 <= count <= rank:
        raise ValueError(
            f"{count} factors of a population of {rank} dimensions; ask for 1 to {rank}"
        )
    variance = (sd / scale) ** 2
    loadings = (right.T * singular)[:, :count] / np.sqrt(reeds - 1) * (scale / sd)[:, None]
    return _in_order(
        Factors(
            scores=left[:, :count] * np.sqrt(reeds - 1),
            loadings=loadings,
            weights=variance / variance.sum(),
            spectrum=(singular**2 / (singular**2).sum())[: reeds - 1],
        )
    )


def varimax(loadings: Array, *, kaiser: bool = True) -> Array:
    """Rotation that makes each column of loadings as uneven as it can be made (VARIMAX).

    The sum over factors of the variance of squared loadings is raised to its maximum in one plane
    after another (H. F. Kaiser, Psychometrika 23, 187, 1958), so it never falls. It is a local
    maximum, always the same for the same loadings.

    Parameters
    ----------
    loadings : (v, k) float
    kaiser : bool
        Whether rows are scaled to length 1 for the purpose, which is what the paper did: its
        Table 2, components included, is a fixed point of this rotation and not of the other.

    Returns
    -------
    (k, k) float
        Orthogonal; rotated loadings are ``loadings @ rotation``. Order and signs of factors are
        as they come, see `rotated`.

    Raises
    ------
    FitError
        Without convergence.
    """
    length = np.sqrt((loadings**2).sum(axis=1, keepdims=True))
    scaled = np.divide(loadings, length, out=np.zeros_like(loadings), where=length > 0)
    turned = np.array(scaled if kaiser else loadings, dtype=float)
    rotation = np.eye(loadings.shape[1])
    for _ in range(_MOST_SWEEPS):
        largest = 0.0
        for p, q in zip(*np.triu_indices(len(rotation), 1), strict=True):
            angle = _varimax_angle(turned[:, p], turned[:, q])
            plane = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            turned[:, [p, q]] = turned[:, [p, q]] @ plane
            rotation[:, [p, q]] = rotation[:, [p, q]] @ plane
            largest = max(largest, abs(angle))
        if largest < _SMALLEST_ROTATION:
            return rotation
    raise FitError(f"VARIMAX has not converged in {_MOST_SWEEPS} sweeps; ask for fewer factors")


def _varimax_angle(x: Array, y: Array) -> float:
    """Angle of the plane rotation with the greatest variance of squared loadings."""
    difference, product = x**2 - y**2, 2 * x * y
    sine = 2 * (difference * product).sum() - 2 * difference.sum() * product.sum() / len(x)
    squares = (difference**2 - product**2).sum()
    cosine = squares - (difference.sum() ** 2 - product.sum() ** 2) / len(x)
    # All angles are equally good: one taken from rounding would be another each time.
    if np.hypot(sine, cosine) <= _ROUNDING * (difference**2 + product**2).sum():
        return 0.0
    return float(np.arctan2(sine, cosine)) / 4


def rotated(factors: Factors, rotation: Array) -> Factors:
    """Factors turned by an orthogonal matrix (k, k), then put in order of variance and sign."""
    return _in_order(
        replace(factors, scores=factors.scores @ rotation, loadings=factors.loadings @ rotation)
    )


def varimax_factors(
    factors: Factors, additional: Array | None = None, *, kaiser: bool = True
) -> Factors:
    """Factors rotated by `varimax`.

    Parameters
    ----------
    factors : Factors
    additional : (n, q) float, optional
        More variables of the same reeds that shall load evenly on few factors, although no
        factor was made from them: the components e1…e4 in the paper's Table 2.
    """
    loadings = factors.loadings
    if additional is not None:
        loadings = np.concatenate([loadings, correlations(additional, factors.scores)])
    return rotated(factors, varimax(loadings, kaiser=kaiser))


def _in_order(factors: Factors) -> Factors:
    order = np.argsort(-factors.fractions, kind="stable")
    loadings = factors.loadings[:, order]
    peaks = np.take_along_axis(loadings, np.abs(loadings).argmax(axis=0)[None], axis=0)
    sign = np.where(peaks[0] < 0, -1.0, 1.0)
    return replace(factors, scores=factors.scores[:, order] * sign, loadings=loadings * sign)


def correlations(left: Array, right: Array) -> Array:
    """Correlations between columns, missing observations deleted pair by pair.

    With factor scores on one side they are loadings of variables that no factor was made from.

    Parameters
    ----------
    left, right : (n, p), (n, q) float
        NaN where a resonance was not found.

    Returns
    -------
    (p, q) float
        NaN with fewer than three reeds in common, or where those do not differ.
    """
    (x, in_x), (y, in_y) = _centred(left), _centred(right)
    pairs = in_x.T @ in_y
    safe = np.maximum(pairs, 1)
    sum_x, sum_y = x.T @ in_y, in_x.T @ y
    squares_x, squares_y = (x**2).T @ in_y, in_x.T @ y**2
    variance_x, variance_y = squares_x - sum_x**2 / safe, squares_y - sum_y**2 / safe
    # What is left of reeds that do not differ is rounding.
    differ = (variance_x > _ROUNDING * squares_x) & (variance_y > _ROUNDING * squares_y)
    known = (pairs >= _FEWEST_PAIRS) & differ
    size = np.sqrt(np.where(known, variance_x * variance_y, 1))
    return np.where(known, np.clip((x.T @ y - sum_x * sum_y / safe) / size, -1, 1), np.nan)


def _centred(values: Array) -> tuple[Array, Array]:
    """Values less the mean of their column, 0 where missing; and 1 where known, else 0."""
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0)
    mean = filled.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known, filled - mean, 0.0), known.astype(float)


@dataclass(frozen=True)
class FactorReconstruction:
    """Variables as linear functions of factors (paper, hypothesis H10).

    Attributes
    ----------
    coefficients : (v, k + 1) float
        Constant first; the paper's W.
    cents : (n, v) float
        Reconstructed, also where nothing was observed.
    rmsd_cents : float
        Root mean square of observed less reconstructed over what was observed (paper Eq. 5d).
    """

    coefficients: Array
    cents: Array
    rmsd_cents: float


def reconstruct(observed_cents: Array, scores: Array) -> FactorReconstruction:
    """Regress each variable on factors by least squares, missing observations left out.

    Parameters
    ----------
    observed_cents : (n, v) float
        NaN where a resonance was not found.
    scores : (n, k) float

    Raises
    ------
    FitError
        For a variable known on no more reeds than it has coefficients.
    """
    design = np.column_stack([np.ones(len(scores)), scores])
    known = np.isfinite(observed_cents)
    found, needed = known.sum(axis=0), design.shape[1]
    if (found <= needed).any():
        column = int(np.argmax(found <= needed))
        raise FitError(
            f"variable {column} was found on {found[column]} reeds, which its {needed} "
            "coefficients would fit whatever it was; leave it out"
        )
    coefficients = np.array(
        [
            np.linalg.lstsq(design[rows], column[rows], rcond=None)[0]
            for column, rows in zip(observed_cents.T, known.T, strict=True)
        ]
    )
    cents = design @ coefficients.T
    rmsd = np.sqrt(np.mean((observed_cents - cents)[known] ** 2))
    return FactorReconstruction(coefficients, cents, float(rmsd))


def orthonormal(components: Array) -> Array:
    """Components centred, decorrelated and scaled to standard deviation 1 (paper Eq. eq.ortho).

    Of all such components these are the nearest to those given, in the sense of least squares
    (Löwdin's symmetric orthogonalisation), so that each keeps its meaning.

    Parameters
    ----------
    components : (n, k) float

    Returns
    -------
    (n, k) float
        ``eᵀ e = (n - 1) I``, columns of mean 0.

    Raises
    ------
    ValueError
        Where components follow from one another, or there are no more reeds than components.
    """
    centred = components - components.mean(axis=0)
    singular = svd(centred, compute_uv=False)
    count = components.shape[1]
    if singular[-1] <= _RANK * singular[0]:
        raise ValueError(
            f"{count} components on {len(components)} reeds depend on one another and have no "
            "orthonormal form; give more reeds or fewer components"
        )
    return np.asarray(np.sqrt(len(components) - 1) * polar(centred)[0])
