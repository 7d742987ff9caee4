"""How fast the stiffness of measured modes grows with frequency, in the reed that they show.

Near a resonance a response is ``1 / (iη - (2 - γ) ln(f/f₀))``: only η/(2 - γ) is seen, where γ is
the exponent by which the stiffness of the mode grows with frequency. The fit of modes takes that of
mean cane; frequencies of many modes tell that of the reed, and how well it is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.names.reed_posterior import ReedPosterior
from holography.arrays import Array
from physics.plausible.reeds import PlausibleReeds
from physics.reed.reduced.derivatives import DENSITY, PARAMETERS, derivatives
from physics.reed.reduced.dynamics import E_L, G_LT
from physics.reed.reduced.vibrations import Vibrations

# Step of central differences in log frequency. Chosen: exponents are then exact to a thousandth.
_LOG_STEP = 0.01


@dataclass(frozen=True)
class Stiffening:
    """Exponent of the growth of a mode's stiffness with frequency near its resonance."""

    exponent: float
    error: float

    def loss_ratio(self, assumed: float) -> float:
        """Return the factor on a loss factor that was fitted with another exponent."""
        return (2 - self.exponent) / (2 - assumed)

    @property
    def loss_error(self) -> float:
        """Relative standard error of a loss factor that comes from this one."""
        return self.error / (2 - self.exponent)


def averaged(weights: Array, each: Sequence["Stiffening | None"]) -> Stiffening | None:
    """Return the mean of those that there are, by their weights (n,); none if there is none."""
    there = [(weight, one) for weight, one in zip(weights.tolist(), each, strict=True) if one]
    total = sum(weight for weight, _ in there)
    if total <= 0:
        return None
    mean = sum(weight * one.exponent for weight, one in there) / total
    squares = [weight * (one.error**2 + (one.exponent - mean) ** 2) for weight, one in there]
    return Stiffening(mean, float(np.sqrt(sum(squares) / total)))


def stiffening_of(reeds: PlausibleReeds, posterior: ReedPosterior) -> list[Stiffening | None]:
    """Return the stiffening of each of the a measured modes; none for one that is not the reed's.

    Parameters
    ----------
    reeds : PlausibleReeds
    posterior : ReedPosterior
    """
    hz, mode = np.exp(posterior.measured.ln_hz), posterior.mode
    _, mixing = posterior.nearby.modes(posterior.mean)
    parts = (mixing**2 / np.sum(mixing**2, axis=0)).T @ shares(posterior.nearby.found)

    def exponents(parameters: Array) -> Array:
        return np.asarray(np.sum(parts[mode] * growth(reeds, parameters, hz), axis=1))

    found = np.stack([exponents(each) for each in _around(posterior, reeds.moduli)])
    return [
        Stiffening(float(value), float(error)) if number >= 0 else None
        for value, error, number in zip(found.mean(axis=0), found.std(axis=0), mode, strict=True)
    ]


def _around(posterior: ReedPosterior, own: NDArray[np.intp]) -> Array:
    """Return parameters (2n, p) with mean and covariance of those n, symmetric around the mean.

    What is not linear in them over their range is seen, too: the unscented transform (S. J. Julier
    & J. K. Uhlmann 1997, Proc. SPIE 3068:182).
    """
    sizes, axes = np.linalg.eigh(posterior.covariance[np.ix_(own, own)])
    steps = np.zeros((len(own), len(posterior.mean)))
    steps[:, own] = (axes * np.sqrt(len(own) * np.maximum(sizes, 0.0))).T
    return np.asarray(posterior.mean + np.concatenate([steps, -steps]))


def shares(found: Vibrations) -> Array:
    """Return by which part of a relative change of E_L, and of G_LT, each mode is stiffer (m, 2).

    In vacuum. A change of density by one part moves a mode by -1/(2 - γ).
    """
    values = derivatives(found).ln_hz
    moduli = [PARAMETERS.index(name) for name in ("ln E_L_pa", "ln G_LT_pa")]
    return np.asarray(-values[:, moduli] / values[:, [DENSITY]])


def growth(reeds: PlausibleReeds, parameters: Array, hz: Array) -> Array:
    """Return the exponents (m, 2) by which E_L and G_LT grow near frequencies (m,)."""
    law = reeds.law(parameters)
    ahead, behind = (
        np.log(law.constants_at(hz * np.exp(step))[:, [E_L, G_LT]])
        for step in (_LOG_STEP, -_LOG_STEP)
    )
    return np.asarray((ahead - behind) / (2 * _LOG_STEP))
