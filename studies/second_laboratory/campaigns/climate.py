"""What wanders slowly over a campaign: temperature, moisture, powers, gains."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

# Chosen: far longer than any campaign, with hands that are slow and steps that are repeated.
_LASTS_S, _STEP_S = 7200.0, 5.0


class Wander:
    """A random walk that is drawn back to 0 (an Ornstein–Uhlenbeck process), known at all times.

    Parameters
    ----------
    rng : numpy.random.Generator
    sd : float
        Standard deviation over long times.
    time_s : float
        Time over which it forgets.
    """

    def __init__(self, rng: np.random.Generator, sd: float, time_s: float) -> None:
        count = round(_LASTS_S / _STEP_S)
        kept = np.exp(-_STEP_S / time_s)
        values = rng.standard_normal(count)
        values[1:] *= np.sqrt(1 - kept**2)
        walk = lfilter([1.0], [1.0, -kept], values)
        self._times_s, self._values = _STEP_S * np.arange(count), sd * walk

    def __call__(self, time_s: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the value at a time since the start of the campaign."""
        return np.asarray(np.interp(time_s, self._times_s, self._values))


@dataclass(frozen=True)
class Climate:
    """State of the air and of the cane at one time.

    Attributes
    ----------
    temperature_c : float
    moisture : float
        Water of the cane above its equilibrium, in per cent of the mass.
    """

    temperature_c: float
    moisture: float
