"""Regression of resonances on the factors of a principal component analysis: H10 and H11.

Neither cane nor metamodel is used: this is the best that a linear model with the same number of
components for each reed can do (paper, appendix on reconstructing by multiple regression).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.linalg import expm, expm_frechet
from scipy.optimize import least_squares

from fitting.errors import FitInputError
from fitting.statistics.factors import reconstruct
from holography.arrays import Array

_FACTORS = 4


@dataclass(frozen=True, eq=False)
class Regression:
    """Resonances linear in the factors.

    Attributes
    ----------
    name : str
    weights : (2, m, K + 1) float
        Cents of series A and B per 1, factor 1 … K.
    residual_cents : (n, 2, m) float
        Observed less computed; NaN where nothing was observed.
    coefficients : mapping
        Those of M̌ for series B, by name; none in H10.
    rotation : (K, K) float
        Of the factors, before they are weighed; the identity in H10.
    free_weights : int
        How many weights were fitted ("other coefficients").
    """

    name: str
    weights: Array
    residual_cents: Array
    coefficients: Mapping[str, float]
    rotation: Array
    free_weights: int

    @property
    def rmsd_cents(self) -> float:
        """Root mean square deviation over what was observed (paper, Eq. eq5d)."""
        return float(np.sqrt(np.nanmean(self.residual_cents**2)))


def regress_on_factors(observed_cents: Array, factors: Array) -> Regression:
    """Hypothesis H10: ``r[n, s] = W[s] (1, factor[n])`` (paper, Eq. eq14a).

    Parameters
    ----------
    observed_cents : (n, 2, m) float
        NaN where a mode was not identified.
    factors : (n, K) float

    Raises
    ------
    FitInputError
        Where a mode was identified on too few reeds in a series, or the arrays do not fit.
    """
    observed, factors = _checked(observed_cents, factors)
    by_variable = reconstruct(observed.reshape(len(observed), -1), factors)
    weights = by_variable.coefficients.reshape(*observed.shape[1:], -1)
    return Regression(
        name="H10",
        weights=weights,
        residual_cents=observed - by_variable.cents.reshape(observed.shape),
        coefficients={},
        rotation=np.eye(factors.shape[1]),
        free_weights=weights.size,
    )


def regress_with_drying(observed_cents: Array, factors: Array) -> Regression:
    """Hypothesis H11: ``r[n, s] = Ŵ M̌[s] (1, g[n])`` with ``g = R factor`` (paper, Eq. eq15a).

    Series A takes g1, g2 and g3 as they are, series B ``c10 + g1``, ``c20 + c22 (g2 + g4)`` and
    ``c30 + g3``: M̌ of Eq. eq10 with c24 = c22 as in H4, which makes the four coefficients that the
    paper counts. The rotation R that brings drying into g4 is fitted too, but for turning g1 and
    g3 into each other, which changes nothing.

    Ŵ follows from the rest by linear least squares and is eliminated (variable projection).

    Parameters
    ----------
    observed_cents : (n, 2, m) float
        NaN where a mode was not identified.
    factors : (n, 4) float
        Of mean 0, SD 1 and no correlation, in any order and orientation.

    Raises
    ------
    FitInputError
        As `regress_on_factors`, and where there are not four factors.
    """
    observed, factors = _checked(observed_cents, factors)
    if factors.shape[1] != _FACTORS:
        raise FitInputError(
            f"H11 needs {_FACTORS} factors, one of them for drying; {factors.shape[1]} were given"
        )
    modes = list(observed.reshape(-1, observed.shape[-1]).T)
    base, start = _drying_start(regress_on_factors(observed, factors).weights)

    def residual(at: Array) -> Array:
        design = drying_design(at, factors, base)[0]
        return np.concatenate([_projected(design, mode)[0] for mode in modes])

    def jacobian(at: Array) -> Array:
        design, by = drying_design(at, factors, base)
        return np.concatenate([_projected_jacobian(design, by, mode) for mode in modes])

    found = least_squares(residual, start, jacobian, xtol=1e-10, ftol=1e-10, gtol=1e-10)
    design = drying_design(found.x, factors, base)[0]
    hat = np.stack([_projected(design, mode)[1] for mode in modes])
    rotation = _turn(found.x[4:]) @ base
    with_constant = np.eye(_FACTORS + 1)
    with_constant[1:, 1:] = rotation
    return Regression(
        name="H11",
        weights=hat @ _check_matrices(found.x[:4]) @ with_constant,
        residual_cents=observed - (design @ hat.T).reshape(observed.shape),
        coefficients=dict(zip(("c10", "c20", "c30", "c22"), map(float, found.x[:4]), strict=True)),
        rotation=rotation,
        free_weights=hat.size,
    )


def drying_design(at: Array, factors: Array, base: Array) -> tuple[Array, Array]:
    """What Ŵ weighs in H11, with derivatives.

    Parameters
    ----------
    at : (9,) float
        c10, c20, c30, c22, and angles of a further rotation, rad.
    factors : (n, 4) float
    base : (4, 4) float
        Rotation to begin with.

    Returns
    -------
    design : (2 n, 4) float
        Rows of reed 0 in series A and B, reed 1, ….
    jacobian : (9, 2 n, 4) float
    """
    check, turned = _check_matrices(at[:4]), factors @ (_turn(at[4:]) @ base).T
    with_one = np.concatenate([np.ones((len(factors), 1)), turned], axis=1)
    by_coefficient = np.einsum("psak,nk->pnsa", _CHECK_JACOBIAN, with_one)
    exponent = np.tensordot(at[4:], _GENERATORS, axes=1)
    by_turned = np.stack(
        [factors @ (expm_frechet(exponent, g, compute_expm=False) @ base).T for g in _GENERATORS]
    )
    by_angle = np.einsum("sak,pnk->pnsa", check[..., 1:], by_turned)
    design = np.einsum("sak,nk->nsa", check, with_one).reshape(-1, _FACTORS)
    return design, np.concatenate([by_coefficient, by_angle]).reshape(-1, *design.shape)


def _generators() -> Array:
    """Infinitesimal rotations (5, 4, 4) in all planes but that of g1 and g3."""
    planes = [plane for plane in combinations(range(_FACTORS), 2) if plane != (0, 2)]
    turns = np.zeros((len(planes), _FACTORS, _FACTORS))
    for turn, (i, k) in zip(turns, planes, strict=True):
        turn[i, k], turn[k, i] = 1, -1
    return turns


def _check_jacobian() -> Array:
    """Derivatives of M̌ of series A and B with respect to c10, c20, c30, c22, (4, 2, 4, 5)."""
    jacobian = np.zeros((4, 2, _FACTORS, _FACTORS + 1))
    for rank in range(3):
        jacobian[rank, 1, 1 + rank, 0] = 1
    jacobian[3, 1, 2, [2, 4]] = 1
    return jacobian


_GENERATORS, _CHECK_JACOBIAN = _generators(), _check_jacobian()


def _check_matrices(coefficients: Array) -> Array:
    """M̌ of series A and B (2, 4, 5), paper Eq. eq10."""
    own = np.zeros((2, _FACTORS, _FACTORS + 1))
    own[:, range(_FACTORS), range(_FACTORS)] = 1
    own[1, 2, 2] = 0
    return np.asarray(own + np.tensordot(coefficients, _CHECK_JACOBIAN, axes=1))


def _turn(angles: Array) -> Array:
    return np.asarray(expm(np.tensordot(angles, _GENERATORS, axes=1)))


def _drying_start(weights: Array) -> tuple[Array, Array]:
    """Rotation (4, 4) and unknowns (9,) to begin with, from the weights (2, m, 5) of H10.

    g4 acts least on series A; on series B it acts as some direction, g2, acts on series A.
    """
    in_a, in_b = weights[..., 1:]
    directions = np.linalg.svd(in_a)[2]
    drying, others = directions[-1], directions[:-1]
    like_drying = np.linalg.lstsq(in_a @ others.T, in_b @ drying, rcond=None)[0] @ others
    # The signs of g2 and g4 hang together; of the two ways the one with g2 like factor 2.
    sign = 1.0 if like_drying[1] >= 0 else -1.0
    g2, g4 = sign * like_drying / np.linalg.norm(like_drying), sign * drying
    rest = np.linalg.svd(np.stack([g2, g4]))[2][2:]
    # Of all ways to choose g1 and g3, the closest to the first and third factor.
    left, _, right = np.linalg.svd(rest[:, [0, 2]])
    g1, g3 = (left @ right).T @ rest
    base = np.stack([g1, g2, g3, g4])
    if np.linalg.det(base) < 0:
        base[0] *= -1
    shift = np.linalg.lstsq(in_a @ base[:3].T, weights[1, :, 0] - weights[0, :, 0], rcond=None)[0]
    return base, np.array([*shift, np.linalg.norm(like_drying), *np.zeros(len(_GENERATORS))])


def _projected(design: Array, mode_cents: Array) -> tuple[Array, Array]:
    """Residuals of the best weights, zero where nothing was observed, and these weights."""
    weights = _least_squares(design, mode_cents)
    return np.nan_to_num(mode_cents - design @ weights), weights


def _projected_jacobian(design: Array, jacobian: Array, mode_cents: Array) -> Array:
    """Derivatives (2 n, 9) of `_projected`, the weights' own change left out (Kaufman).

    The gradient of the sum of squares is exact.
    """
    seen = ~np.isnan(mode_cents)
    changed = np.where(seen[:, None], (jacobian @ _least_squares(design, mode_cents)).T, 0)
    basis = np.linalg.qr(np.where(seen[:, None], design, 0))[0]
    return np.asarray(basis @ (basis.T @ changed) - changed)


def _least_squares(design: Array, cents: Array) -> Array:
    """Weights (K,) of the columns of a design (rows, K) where `cents` (rows,) is known."""
    seen = ~np.isnan(cents)
    return np.asarray(np.linalg.lstsq(design[seen], cents[seen], rcond=None)[0])


def _checked(observed_cents: Array, factors: Array) -> tuple[Array, Array]:
    observed, factors = np.asarray(observed_cents, float), np.asarray(factors, float)
    if observed.ndim != 3 or observed.shape[1] != 2 or factors.shape[:1] != observed.shape[:1]:
        raise FitInputError(
            f"observed cents {observed.shape} and factors {factors.shape} do not belong together; "
            "give (reeds, 2 series, modes) and (reeds, factors)"
        )
    fewest = int(np.count_nonzero(~np.isnan(observed), axis=0).min())
    if fewest <= factors.shape[1]:
        raise FitInputError(
            f"a mode was identified on {fewest} reeds only in one series, too few for "
            f"{factors.shape[1]} factors and a mean; leave it out"
        )
    return observed, factors
