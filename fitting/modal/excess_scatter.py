"""By how much a reed is off its model, beside what its resonances are uncertain by."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]

# A misfit that chance alone would give this rarely is taken for one.
_IMPROBABLE = 0.05
# Newton's steps climb to the root from below; each trebles a small start at least.
_STEPS = 60
_SETTLED = 1e-9


def is_misfit(reduced_chi2: Array | float, freedom: Array | int) -> Mask:
    """Whether chance does not explain squares per degree of freedom.

    Parameters
    ----------
    reduced_chi2, freedom : (...) float
        Weighted squares per degree of freedom, and degrees of freedom; NaN is no misfit.
    """
    unlikely: Mask = np.asarray(chdtrc(freedom, reduced_chi2 * freedom) < _IMPROBABLE)
    return unlikely


def added_cents(residual_cents: Array, error_cents: Array, freedom: Array) -> Array:
    """Standard deviation that, added to the errors, makes residuals as large as they should be.

    The variance τ² for which ``Σ r² / (σ² + τ²)`` is the number of freedoms (Paule and Mandel,
    J. Res. Nat. Bur. Standards 87, 1982); 0 if the errors alone make it no more.

    Parameters
    ----------
    residual_cents, error_cents : (n, r) float
        Of r resonances of n reeds; NaN residuals are none.
    freedom : (n,) float

    Returns
    -------
    (n,) float
    """
    square = np.where(np.isnan(residual_cents), 0.0, residual_cents) ** 2
    variance, added = error_cents**2, np.zeros(len(square))
    climbing = np.ones(len(square), dtype=bool)
    for _ in range(_STEPS):
        share = square / (variance + added[:, None])
        excess = share.sum(axis=1) - freedom
        slope = (share / (variance + added[:, None])).sum(axis=1)
        step = np.divide(excess, slope, out=np.zeros_like(added), where=climbing & (excess > 0))
        added = added + step
        # One that has arrived stays: it does not feel the others, to the last bit.
        climbing &= step > _SETTLED * added
        if not climbing.any():
            break
    root: Array = np.sqrt(added)
    return root
