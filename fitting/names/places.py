"""Where the reed behind a fit has its modes, those too that the fit has not found."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fitting.modal.model import LOSS
from fitting.names.reed_posterior import ReedPosterior
from holography.arrays import Array
from physics.reed.mode_classification import names_of

# A mode is elsewhere than the reed has it if that is farther than the width of a resonance, and
# than this multiple of the standard error of that place. Chosen: three, usual for normal errors.
_MISPLACED = 3.0


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


def misplaced_hz(
    places: Mapping[str, Place], fitted_hz: Mapping[str, float], drive_hz: Array
) -> dict[str, float]:
    """Return the frequencies (Hz) that modes should have, by name, for those found elsewhere.

    Parameters
    ----------
    places : mapping
        Place of each mode, by name.
    fitted_hz : mapping
        Frequency of each fitted mode, by name.
    drive_hz : (k,) float
        Drive frequencies, rising: modes outside the sweep are not found.
    """
    return {
        name: place.hz
        for name, place in places.items()
        if name in fitted_hz
        and drive_hz[0] < place.hz < drive_hz[-1]
        and abs(np.log(fitted_hz[name] / place.hz)) > max(LOSS, _MISPLACED * place.error)
    }
