"""Groups of observables: numbers with errors, coordinates, and the law that predicts them.

What a campaign leaves open although the model is right, such as the level of the drive or details
of a reed's profile, is part of the errors. All errors are Gaussian; what is unknown in proportion
to known columns is added to their covariance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy import linalg

from fitting.errors import FitInputError
from holography.arrays import Array
from physics.parameters.tree import BenchParameters


class Observable(StrEnum):
    """Where measurement and model are compared, in the order of the measuring chain."""

    LOG = "log"
    DRIVE = "drive"
    SENSOR = "sensor"
    HOLOGRAM = "hologram"
    FIELD = "field"
    MAPS = "maps"
    RESPONSE = "response"
    MODES = "modes"
    MATERIAL = "material"


# Edges of the frequency bands.
BANDS_HZ = (0.0, 2.8e3, 5.6e3, 8e3, 11e3, 14e3, np.inf)
BANDS = ("to 2.8 kHz", "2.8-5.6 kHz", "5.6-8 kHz", "8-11 kHz", "11-14 kHz", "from 14 kHz")


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of a number; empty where a coordinate does not apply.

    Attributes
    ----------
    quantity : str
        What it is, in words.
    mode, band, region, time, level : str
    """

    quantity: str
    mode: str = ""
    band: str = ""
    region: str = ""
    time: str = ""
    level: str = ""


@dataclass(frozen=True)
class ObservableGroup:
    """n numbers of one observable, compared with one prediction.

    Attributes
    ----------
    name : str
    tap : Observable
    values : (n,) float
    covariance : (n, n) float
    coordinates : tuple of Coordinates
    parts : tuple of str
        Parts of the model that the prediction depends on.
    predict : callable
        ``predict(parameters)`` gives (n,) float.
    whitening : (n, n) float
        ``root @ (values - predicted)`` has unit covariance.
    """

    name: str
    tap: Observable
    values: Array
    covariance: Array
    coordinates: tuple[Coordinates, ...]
    parts: tuple[str, ...]
    predict: Callable[[BenchParameters], Array]
    whitening: Array

    def whitened_residual(self, parameters: BenchParameters) -> Array:
        """Return the whitened residual (n,) of a model."""
        left: Array = self.whitening @ (self.values - self.predict(parameters))
        return left


def observable_group(
    name: str,
    tap: Observable,
    values: Sequence[float] | Array,
    covariance: Array,
    places: Sequence[Coordinates],
    parts: Sequence[str],
    predict: Callable[[BenchParameters], Array],
) -> ObservableGroup:
    """Return a group of observables.

    Parameters
    ----------
    covariance : (n, n) or (n,) float
        Or standard deviations.

    Raises
    ------
    FitInputError
        If a number or its error is not finite.
    """
    numbers = np.asarray(values, dtype=float)
    if covariance.ndim == 1:
        covariance = np.diag(covariance**2)
    valid = np.isfinite(numbers) & np.isfinite(covariance).all(axis=0) & (np.diag(covariance) > 0)
    if not valid.all():
        place = places[int(np.argmin(valid))]
        words = " ".join(filter(None, (place.quantity, place.mode, place.time, place.level)))
        raise FitInputError(
            f"{name}: {words} has no finite value and error; check the runs that it is "
            "from, or leave them out"
        )
    lower = linalg.cholesky(covariance, lower=True)
    root = linalg.solve_triangular(lower, np.eye(len(numbers)), lower=True)
    return ObservableGroup(
        name, tap, numbers, covariance, tuple(places), tuple(parts), predict, root
    )


def band_of(hz: float) -> str:
    """Return the name of the band of a frequency."""
    return BANDS[int(np.searchsorted(BANDS_HZ, hz, side="right")) - 1]


def unknown_directions(*columns: tuple[Array, float]) -> Array:
    """Return the covariance (n, n) of unknown amounts of columns (n,), with their deviations."""
    total = sum(spread**2 * np.multiply.outer(column, column) for column, spread in columns)
    return np.asarray(total)
