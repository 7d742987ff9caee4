"""Excess scatter of resonances around a model, in addition to their standard errors."""

import numpy as np
from scipy.special import chdtrc

from holography.arrays import Array, Mask

# Significance level of the χ² test.
_IMPROBABLE = 0.05
# Newton steps increase towards the root; each at least triples a small start.
_STEPS = 60
_SETTLED = 1e-9


def is_misfit(reduced_chi2: Array | float, freedom: Array | int) -> Mask:
    """Test whether χ² is too large to be explained by the standard errors.

    Parameters
    ----------
    reduced_chi2, freedom : (...) float
        Weighted squares per degree of freedom, and degrees of freedom; NaN is no misfit.
    """
    unlikely: Mask = np.asarray(chdtrc(freedom, reduced_chi2 * freedom) < _IMPROBABLE)
    return unlikely


def added_cents(residual_cents: Array, error_cents: Array, freedom: Array) -> Array:
    """Return the excess scatter of each reed (Paule and Mandel, J. Res. Nat. Bur. Stand. 87, 1982).

    It is the standard deviation τ for which ``Σ r² / (σ² + τ²)`` is the number of degrees of
    freedom; 0 if the standard errors alone explain the residuals.

    Parameters
    ----------
    residual_cents, error_cents : (n, r) float
        Residuals of r resonances of n reeds (NaN where missing), and their standard errors.
    freedom : (n,) float
        Degrees of freedom.

    Returns
    -------
    (n,) float
    """
    square = np.where(np.isnan(residual_cents), 0.0, residual_cents) ** 2
    variance, added = error_cents**2, np.zeros(len(square))
    climbing = np.ones(len(square), dtype=bool)
    for _ in range(_STEPS):
        weighted = square / (variance + added[:, None])
        excess = weighted.sum(axis=1) - freedom
        decrease = (weighted / (variance + added[:, None])).sum(axis=1)
        step = np.divide(excess, decrease, out=np.zeros_like(added), where=climbing & (excess > 0))
        added = added + step
        # A reed that has converged stays: its result must not depend on the other reeds.
        climbing &= step > _SETTLED * added
        if not climbing.any():
            break
    root: Array = np.sqrt(added)
    return root
