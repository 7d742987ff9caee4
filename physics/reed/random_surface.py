"""Random deviations of a surface that was cut: smooth, and different from reed to reed."""

import numpy as np

from holography.arrays import Array
from physics.reed.reduced.changes import Function

# Waves that are added. Chosen: with 400 the mean fourth power is 0.4 % below that of a Gaussian
# field (it is 3 (1 - 1/(2 n)) for n waves), and a map takes some milliseconds.
_WAVES = 400


def random_surface(seed: int, correlation_x_m: float, correlation_y_m: float) -> Function:
    """Return a Gaussian random function of the plan.

    Over many seeds its mean is 0, its mean square is 1, and its correlation at a distance (Δx, Δy)
    is ``exp(−(Δx/correlation_x)² − (Δy/correlation_y)²)``.

    Parameters
    ----------
    seed : int
        Same seed, same function.
    correlation_x_m, correlation_y_m : float
        Distances at which the correlation falls to 1/e, along and across the reed.

    Returns
    -------
    callable
        ``surface(x_m, y_m)``, with float arrays of one shape.

    Examples
    --------
    >>> surface = random_surface(1, 8e-3, 4e-3)
    >>> surface(np.zeros(3), np.zeros(3)).shape
    (3,)
    """
    rng = np.random.default_rng(seed)
    # The spectrum of such a correlation is Gaussian, too, with a variance of 2 / length².
    lengths_m = np.array([correlation_x_m, correlation_y_m])
    wavenumbers = rng.standard_normal((_WAVES, 2)) * np.sqrt(2) / lengths_m
    phases = rng.uniform(0.0, 2 * np.pi, _WAVES)

    def surface(x_m: Array, y_m: Array) -> Array:
        waves = np.cos(
            np.multiply.outer(x_m, wavenumbers[:, 0])
            + np.multiply.outer(y_m, wavenumbers[:, 1])
            + phases
        )
        height: Array = np.sqrt(2 / _WAVES) * waves.sum(axis=-1)
        return height

    return surface
