"""What a hypothesis says of the cane: how few numbers make all its parameters.

The parameters v = (E1, E2, E3, G1, G2, G3) of a reed in a series, MPa and MPa·s, are linear in the
reed's components (paper, appendix on the simplified model, Eqs eq.LRE and eq5k):

    v = M[s] (1, e1 … eK),    M[s] = M̂ M̌[s]

M̂, the matrices of both moduli one above the other, is common to the series; M̌[s] brings the
components of a series to a common basis. Both are affine in the free coefficients.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fitting.errors import FitInputError
from holography.arrays import Array
from physics.reed.cane.viscoelastic import Series, h4_matrix

PARAMETERS = ("E1", "E2", "E3", "G1", "G2", "G3")
# What each parameter is about: the means of hypothesis H4 in series A.
PARAMETER_SIZES: Array = h4_matrix(Series.A)[:, 0]


@dataclass(frozen=True, eq=False)
class AffineMatrix:
    """A matrix whose elements are constants plus multiples of free coefficients.

    Attributes
    ----------
    constant : (..., rows, columns) float
    jacobian : (p, ..., rows, columns) float
    """

    constant: Array
    jacobian: Array

    def at(self, coefficients: Array) -> Array:
        """Matrix (..., rows, columns) where the coefficients are (p,)."""
        return np.asarray(self.constant + np.tensordot(coefficients, self.jacobian, axes=1))


@dataclass(frozen=True, eq=False)
class Structure:
    """One hypothesis.

    Attributes
    ----------
    name : str
    coefficients : tuple of str
        p names of the free ("active") coefficients.
    start : (p,) float
        Where a fit without better knowledge begins.
    hat : AffineMatrix
        M̂, (6, r).
    check : AffineMatrix
        M̌ of series A and B, (2, r, K + 1).
    rotatable : tuple of int
        Components, counted from 0, that may be rotated among themselves without any change in
        what the hypothesis can describe: the coefficients make up for it.
    orthonormal : bool
        Whether the components have mean 0, SD 1 and no correlation over the reeds.
    held : bool
        Whether some coefficients act so little on frequencies that a prior has to hold them.
    all_of_equation_1 : bool
        Whether a_m0 … a_m5 of each mode are adjusted, or only a_m0.
    """

    name: str
    coefficients: tuple[str, ...]
    start: Array
    hat: AffineMatrix
    check: AffineMatrix
    rotatable: tuple[int, ...] = ()
    orthonormal: bool = True
    held: bool = False
    all_of_equation_1: bool = False

    @property
    def components(self) -> int:
        """Number of components K of each reed."""
        return int(self.check.constant.shape[-1]) - 1

    def matrices(self, coefficients: Array) -> Array:
        """M of series A and B, (2, 6, K + 1), where the coefficients are (p,)."""
        return np.asarray(self.hat.at(coefficients) @ self.check.at(coefficients))

    def jacobian(self, coefficients: Array) -> Array:
        """Derivatives of `matrices` with respect to the coefficients, (p, 2, 6, K + 1)."""
        hat, check = self.hat.at(coefficients), self.check.at(coefficients)
        return np.asarray(self.hat.jacobian[:, None] @ check + hat @ self.check.jacobian)

    def parameters(self, coefficients: Array, components: Array) -> Array:
        """Zener parameters (n, 2, 6) of reeds with components (n, K)."""
        with_one = np.concatenate([np.ones((len(components), 1)), components], axis=1)
        return np.asarray(np.einsum("sjk,nk->nsj", self.matrices(coefficients), with_one))


def written(
    name: str,
    hat: Sequence[str],
    check: tuple[Sequence[str], Sequence[str]],
    start: Mapping[str, float],
    **what_else: Any,
) -> Structure:
    """Take a structure from matrices written as the paper prints them.

    Parameters
    ----------
    name : str
    hat : sequence of str
        Rows of M̂: numbers, coefficients, or multiples of one (``2*d12``, ``-d12``).
    check : pair of sequences of str
        Rows of M̌ of series A and B.
    start : mapping
        Value of each coefficient to begin with.
    **what_else
        See `Structure`.

    Raises
    ------
    ValueError
        Where `start` and the matrices do not name the same coefficients.
    """
    names = tuple(start)
    elements = [_factor_and_name(e) for rows in (hat, *check) for row in rows for e in row.split()]
    named = {of for _, of in elements if of}
    if named != set(names):
        raise ValueError(
            f"{name}: the matrices name {sorted(named)}, start values are given for "
            f"{sorted(names)}; give one for each"
        )
    a, b = (_affine(rows, names) for rows in check)
    both = AffineMatrix(
        np.stack([a.constant, b.constant]), np.stack([a.jacobian, b.jacobian], axis=1)
    )
    values = np.array(list(start.values()), dtype=float)
    return Structure(name, names, values, _affine(hat, names), both, **what_else)


def coefficients_within(outer: Structure, inner: Structure, coefficients: Array) -> Array:
    """Coefficients of `outer` with which it says just what the narrower `inner` says.

    Parameters
    ----------
    outer, inner : Structure
    coefficients : (p_inner,) float

    Returns
    -------
    (p_outer,) float

    Raises
    ------
    FitInputError
        Where `inner` is no special case of `outer`.
    """
    matrices = inner.matrices(coefficients)
    if outer.hat.constant.shape == inner.hat.constant.shape:
        hat, check = inner.hat.at(coefficients), inner.check.at(coefficients)
    else:
        hat, check = np.eye(len(PARAMETERS)), matrices
    if (outer.hat.constant.shape, outer.check.constant.shape) == (hat.shape, check.shape):
        parts = ((outer.hat, hat), (outer.check, check))
        wanted = np.concatenate([(at - part.constant).ravel() for part, at in parts])
        jacobian = np.concatenate(
            [part.jacobian.reshape(len(part.jacobian), -1) for part, _ in parts], 1
        )
        found = np.asarray(np.linalg.lstsq(jacobian.T, wanted, rcond=None)[0])
        missed = (outer.matrices(found) - matrices) / PARAMETER_SIZES[:, None]
        if np.abs(missed).max() < 1e-9:
            return found
    raise FitInputError(
        f"{inner.name} is no special case of {outer.name}, which therefore cannot start from it; "
        "start from a narrower hypothesis or from none"
    )


def _affine(rows: Sequence[str], names: tuple[str, ...]) -> AffineMatrix:
    elements = [[_factor_and_name(element) for element in row.split()] for row in rows]
    constant = np.zeros((len(elements), len(elements[0])))
    jacobian = np.zeros((len(names), *constant.shape))
    for i, row in enumerate(elements):
        for k, (factor, name) in enumerate(row):
            if name:
                jacobian[names.index(name), i, k] = factor
            else:
                constant[i, k] = factor
    return AffineMatrix(constant, jacobian)


def _factor_and_name(element: str) -> tuple[float, str]:
    """Take ``-2*d12`` apart; a plain number has no name."""
    factor, star, name = element.rpartition("*")
    if star:
        return float(factor), name
    if element.lstrip("-")[0].isalpha():
        return (-1.0, element[1:]) if element.startswith("-") else (1.0, element)
    return float(element), ""
