"""Where the reed behind a fit has its modes, those too that the fit has not found."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fitting.names.reed_posterior import ReedPosterior
from physics.reed.mode_classification import names_of


@dataclass(frozen=True)
class Place:
    """Where the most probable reed has a mode.

    Attributes
    ----------
    hz : float
    error : float
        Standard error of the logarithm of the frequency.
    """

    hz: float
    error: float


def places_of_modes(found: Sequence[ReedPosterior]) -> dict[str, Place]:
    """Return where the most probable of some reeds has each of its modes, by name.

    Parameters
    ----------
    found : sequence of ReedPosterior
        See `fitting.names.naming.reeds_behind`.
    """
    if not found:
        return {}
    best = max(found, key=lambda each: each.log_evidence)
    hz, mixing = best.nearby.modes(best.mean)
    slopes, _ = best.nearby.slopes(best.mean)
    errors = np.sqrt(np.einsum("mp,pq,mq->m", slopes, best.covariance, slopes))
    order = np.argsort(hz)
    names = [each.name for each in names_of(best.nearby.descriptors(mixing[:, order]))]
    return {
        name: Place(float(hz[m]), float(errors[m])) for name, m in zip(names, order, strict=True)
    }
