"""Groups of observables: numbers with errors, coordinates, and the law that predicts them.

What a campaign leaves open although the model is right, such as the level of the drive, is part of
the errors: as noise, or as unknown amounts of known columns (`GroupNuisances`). All errors are
Gaussian; how large noise and amounts are is itself known within a factor only.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

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


# Standard deviation of the log of a factor on noise that is measured by replicates in the campaign:
# a standard deviation from some twenty numbers is known within 15 % (1/√(2·20)). Chosen.
MEASURED: Final = 0.15
# Standard deviation of the log of a factor on the disorder of one kind. Chosen: benches and reeds
# have between a quarter and four times the usual disorder in 19 of 20 cases.
DISORDER: Final = 0.7


@dataclass(frozen=True)
class GroupNuisances:
    """Unknown amounts of known columns, all on one scale that is known within a factor only.

    Attributes
    ----------
    name : str
    columns : (n, k) float
        What one standard deviation of each amount adds to the numbers of a group.
    freedom : float
        Standard deviation of the log of the factor on these standard deviations.
    source : str
    rare : bool
        Whether few of the amounts are other than 0. Those that are near 0 then say nothing about
        the others: the factor is at least 1.
    """

    name: str
    columns: Array
    freedom: float
    source: str
    rare: bool = False


@dataclass(frozen=True)
class Errors:
    """What numbers of a group may be off by although the model is right.

    Attributes
    ----------
    noise : (n,) or (n, n) float
        Standard deviations, or a covariance.
    nuisances : tuple of GroupNuisances
    noise_freedom : float
        Standard deviation of the log of a factor, of at least 1, on the noise.
    of_fits : bool
        Whether numbers are results of fits, of which each may be wrong.
    """

    noise: Array
    nuisances: tuple[GroupNuisances, ...] = ()
    noise_freedom: float = MEASURED
    of_fits: bool = False

    def covariance(self, nuisances: Iterable[GroupNuisances] = ()) -> Array:
        """Return the covariance (n, n) of noise and some nuisances of usual size."""
        noise = np.diag(self.noise**2) if self.noise.ndim == 1 else self.noise
        columns = [each.columns for each in nuisances]
        return np.asarray(noise + sum((each @ each.T for each in columns), np.zeros(noise.shape)))


@dataclass(frozen=True)
class ObservableGroup:
    """n numbers of one observable, compared with one prediction.

    Attributes
    ----------
    name : str
    tap : Observable
    values : (n,) float
    covariance : (n, n) float
        Of noise and nuisances of usual size.
    coordinates : tuple of Coordinates
    parts : tuple of str
        Parts of the model that the prediction depends on.
    predict : callable
        ``predict(parameters)`` gives (n,) float.
    whitening : (n, n) float
        ``root @ (values - predicted)`` has unit covariance.
    noise_whitening : (n, n) float
        The same for the noise alone.
    errors : Errors
    """

    name: str
    tap: Observable
    values: Array
    covariance: Array
    coordinates: tuple[Coordinates, ...]
    parts: tuple[str, ...]
    predict: Callable[[BenchParameters], Array]
    whitening: Array
    noise_whitening: Array
    errors: Errors

    def whitened_residual(self, parameters: BenchParameters) -> Array:
        """Return the whitened residual (n,) of a model."""
        left: Array = self.whitening @ (self.values - self.predict(parameters))
        return left


def observable_group(
    name: str,
    tap: Observable,
    values: Sequence[float] | Array,
    errors: Array | Errors,
    places: Sequence[Coordinates],
    parts: Sequence[str],
    predict: Callable[[BenchParameters], Array],
) -> ObservableGroup:
    """Return a group of observables.

    Parameters
    ----------
    errors : (n,) or (n, n) float, or Errors
        Standard deviations, or a covariance, of noise alone; or all errors.

    Raises
    ------
    FitInputError
        If a number or its error is not finite.
    """
    numbers = np.asarray(values, dtype=float)
    errors = errors if isinstance(errors, Errors) else Errors(errors)
    noise, covariance = errors.covariance(), errors.covariance(errors.nuisances)
    valid = np.isfinite(numbers) & np.isfinite(covariance).all(axis=0) & (np.diag(noise) > 0)
    if not valid.all():
        place = places[int(np.argmin(valid))]
        words = " ".join(filter(None, (place.quantity, place.mode, place.time, place.level)))
        raise FitInputError(
            f"{name}: {words} has no finite value and error; check the runs that it is "
            "from, or leave them out"
        )
    return ObservableGroup(
        name, tap, numbers, covariance, tuple(places), tuple(parts), predict,
        _whitening(covariance), _whitening(noise), errors,
    )  # fmt: skip


def with_noise(group: ObservableGroup, factor: float) -> ObservableGroup:
    """Return a group whose noise is larger by a factor."""
    noise = group.errors.noise * (factor if group.errors.noise.ndim == 1 else factor**2)
    return observable_group(
        group.name, group.tap, group.values, replace(group.errors, noise=noise),
        group.coordinates, group.parts, group.predict,
    )  # fmt: skip


def _whitening(covariance: Array) -> Array:
    lower = linalg.cholesky(covariance, lower=True)
    root: Array = linalg.solve_triangular(lower, np.eye(len(lower)), lower=True)
    return root


def band_of(hz: float) -> str:
    """Return the name of the band of a frequency."""
    return BANDS[int(np.searchsorted(BANDS_HZ, hz, side="right")) - 1]


def unknown_directions(*columns: tuple[Array, float]) -> Array:
    """Return the covariance (n, n) of unknown amounts of columns (n,), with their deviations."""
    total = sum(spread**2 * np.multiply.outer(column, column) for column, spread in columns)
    return np.asarray(total)
