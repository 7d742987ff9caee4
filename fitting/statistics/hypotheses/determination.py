"""How well a population determines what a hypothesis leaves free, and which directions it does not.

Coefficients and adjustments are looked at where the components are fitted along with them.
"""

from dataclasses import dataclass, replace

import numpy as np

from fitting.statistics.hypotheses.joint import HypothesisFit
from holography.arrays import Array


@dataclass(frozen=True, eq=False)
class Determination:
    """What data and priors say about the free coefficients and adjustments.

    Attributes
    ----------
    names : tuple of str
        Of the q free numbers: coefficients, then adjustments as ``F1 a0`` (combinations of the
        terms of Eq. 1 where all are adjusted, see `prediction.Adjustment`).
    standard_errors : (q,) float
        Data and priors together, in the unit of each.
    yardsticks : (q,) float
        What counts as much for each: the coefficient's size, or the prior's cents.
    information : (q,) float
        Of the data alone along each of the `directions`, ascending: the squared ratio of one
        yardstick to the standard error.
    directions : (q, q) float
        In columns, orthonormal in units of the yardsticks.
    """

    names: tuple[str, ...]
    standard_errors: Array
    yardsticks: Array
    information: Array
    directions: Array

    @property
    def open_directions(self) -> int:
        """Directions that the data determine no better than to one yardstick."""
        return int(np.count_nonzero(self.information < 1))

    def weakest(self, rank: int = 0, count: int = 4) -> dict[str, float]:
        """Greatest fractions, by name, of the direction that is determined least but `rank`."""
        direction = self.directions[:, rank]
        greatest = np.argsort(-np.abs(direction))[:count]
        return {self.names[i]: float(direction[i]) for i in greatest}


def determination(fit: HypothesisFit, *, yardstick_cents: float = 100.0) -> Determination:
    """Linear error analysis at the end of a fit.

    The noise is that of the residuals over the degrees of freedom.

    Parameters
    ----------
    fit : HypothesisFit
    yardstick_cents : float
        Yardstick of the adjustments; that of a coefficient is its size.
    """
    population, point = fit.population, fit.population.point(fit.unknowns)
    variance = fit.residual_sd_cents**2
    free = replace(population, prior_weights=np.zeros_like(population.prior_weights))
    information = free.normal_equations(point).information_on_shared()
    prior = np.diag((population.prior_weights / population.noise_cents) ** 2)
    posterior = np.linalg.inv(information / variance + prior)
    adjustments = len(point.shared) - len(population.sizes)
    yardsticks = np.concatenate([population.sizes, np.full(adjustments, yardstick_cents)])
    # The problem's unknowns count coefficients in their sizes, adjustments in cents.
    within = np.concatenate([np.ones(len(population.sizes)), yardsticks[len(population.sizes) :]])
    relative = information * np.outer(within, within) / variance
    values, directions = np.linalg.eigh((relative + relative.T) / 2)
    return Determination(
        names=_names(fit),
        standard_errors=np.sqrt(np.diag(posterior)) * yardsticks / within,
        yardsticks=yardsticks,
        information=values,
        directions=directions,
    )


def _names(fit: HypothesisFit) -> tuple[str, ...]:
    modes = fit.population.model.metamodel.modes
    each = fit.unknowns.adjustments_cents.shape[1]
    return (
        *fit.structure.coefficients,
        *(f"{mode} a{q}" for mode in modes for q in range(each)),
    )
