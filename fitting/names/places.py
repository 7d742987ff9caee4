"""Where the reed behind a fit has its modes, those too that the fit has not found."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.holograms.shape_basis import ShapeBasis
from fitting.modal.modal_fit import ModalFit
from fitting.names.measured import measured_modes
from fitting.names.naming import visible_coordinates
from fitting.names.reed_posterior import reed_posterior
from holography.arrays import Array
from physics.plausible.reeds import PlausibleReeds
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


def places_of_modes(
    modal: ModalFit,
    basis: ShapeBasis,
    points_m: tuple[Array, Array],
    drive_hz: Array,
    index: NDArray[np.intp],
    reeds: PlausibleReeds,
) -> dict[str, Place]:
    """Return where the reed that a fit shows has each of its modes, by name.

    Parameters
    ----------
    modal : ModalFit
    basis : ShapeBasis
    points_m : ((n,) float, (n,) float)
        Points x and y of the functions of the basis.
    drive_hz : (k,) float
        Drive frequencies of the sweep.
    index : (a,) int
        Modes that are measured well enough.
    reeds : PlausibleReeds

    Raises
    ------
    ImpossibleReedError
        If no possible reed has such modes.
    """
    if not len(index):
        return {}
    visible = visible_coordinates(reeds.reed, basis, *points_m)
    ends_hz = float(drive_hz[0]), float(drive_hz[-1])
    found = reed_posterior(reeds, visible, measured_modes(modal, index), ends_hz)
    best = max(found, key=lambda each: each.log_evidence)
    hz, mixing = best.nearby.modes(best.mean)
    slopes, _ = best.nearby.slopes(best.mean)
    errors = np.sqrt(np.einsum("mp,pq,mq->m", slopes, best.covariance, slopes))
    order = np.argsort(hz)
    names = [each.name for each in names_of(best.nearby.descriptors(mixing[:, order]))]
    return {
        name: Place(float(hz[m]), float(errors[m])) for name, m in zip(names, order, strict=True)
    }
