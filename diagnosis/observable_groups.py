"""Numbers of one kind that measurement and twin are compared by, each with its error and its place.

What a campaign leaves open without the twin being wrong, such as the level of the drive or the
exact profile of a reed's surface beyond a few functions, is part of the errors: all errors are
Gaussian, and what is unknown in proportion to known columns is added to their covariance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fitting.errors import FitInputError
from physics.twin import Twin

Array = NDArray[np.floating[Any]]


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


# Edges of the bands that frequencies are told in.
BANDS_HZ = (0.0, 2.8e3, 5.6e3, 8e3, 11e3, 14e3, np.inf)
BANDS = ("to 2.8 kHz", "2.8-5.6 kHz", "5.6-8 kHz", "8-11 kHz", "11-14 kHz", "from 14 kHz")


@dataclass(frozen=True)
class Coordinates:
    """Where in the problem a number stands; empty where a coordinate says nothing.

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
    """n numbers of one tap.

    Attributes
    ----------
    name : str
    tap : Observable
    values : (n,) float
    covariance : (n, n) float
    coordinates : tuple of Coordinates
    parts : tuple of str
        Parts of the twin that the prediction depends on.
    predict : callable
        ``predict(twin)`` gives (n,) float.
    whitening : (n, n) float
        ``root @ (values - predicted)`` has unit covariance.
    """

    name: str
    tap: Observable
    values: Array
    covariance: Array
    coordinates: tuple[Coordinates, ...]
    parts: tuple[str, ...]
    predict: Callable[[Twin], Array]
    whitening: Array

    def whitened_residual(self, twin: Twin) -> Array:
        """What a twin leaves (n,), whitened."""
        left: Array = self.whitening @ (self.values - self.predict(twin))
        return left


def observable_group(
    name: str,
    tap: Observable,
    values: Sequence[float] | Array,
    covariance: Array,
    places: Sequence[Coordinates],
    parts: Sequence[str],
    predict: Callable[[Twin], Array],
) -> ObservableGroup:
    """Make a block.

    Parameters
    ----------
    covariance : (n, n) or (n,) float
        Or standard deviations.

    Raises
    ------
    FitInputError
        If a number, or its error, is none.
    """
    numbers = np.asarray(values, dtype=float)
    if covariance.ndim == 1:
        covariance = np.diag(covariance**2)
    told = np.isfinite(numbers) & np.isfinite(covariance).all(axis=0) & (np.diag(covariance) > 0)
    if not told.all():
        place = places[int(np.argmin(told))]
        words = " ".join(filter(None, (place.quantity, place.mode, place.time, place.level)))
        raise FitInputError(
            f"{name}: no number with an error comes of {words}; look at the runs that it is of, or "
            "leave them out"
        )
    lower = linalg.cholesky(covariance, lower=True)
    root = linalg.solve_triangular(lower, np.eye(len(numbers)), lower=True)
    return ObservableGroup(
        name, tap, numbers, covariance, tuple(places), tuple(parts), predict, root
    )


def band_of(hz: float) -> str:
    """Name of the band of a frequency."""
    return BANDS[int(np.searchsorted(BANDS_HZ, hz, side="right")) - 1]


def unknown_directions(*columns: tuple[Array, float]) -> Array:
    """Covariance (n, n) of what is unknown in proportion to columns (n,), with their deviations."""
    total = sum(spread**2 * np.multiply.outer(column, column) for column, spread in columns)
    return np.asarray(total)
