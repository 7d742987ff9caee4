"""Remember light and brightness of the last steps, to recognise a step that differs from them."""

from collections import deque
from fractions import Fraction
from typing import Final

import numpy as np

from acquire.runner.quality import Usual

# Steps whose light is remembered. Chosen: the optical table and the laser change within minutes,
# which is about a hundred steps; the median of 64 steps has an error of a sixth of the scatter.
_REMEMBERED: Final = 64
# Steps whose brightness is remembered, for each exposure. Chosen: the laser drifts within minutes,
# so only the last few steps count.
_NEIGHBOURS: Final = 5
# Ratio of standard deviation and median absolute deviation of a Gaussian: 1/Φ⁻¹(3/4).
_GAUSSIAN: Final = 1.4826


class History:
    """Light and brightness of the last steps of one run, in the order of measurement."""

    def __init__(self) -> None:
        self._turns: deque[tuple[float, float]] = deque(maxlen=_REMEMBERED)
        self._brightness: dict[Fraction, deque[float]] = {}

    def add_turn(self, turn_rad: float, unexplained: float) -> None:
        """Remember the phase turn of the light of a step; ignore a step without light.

        Parameters
        ----------
        turn_rad, unexplained : float
            `error_rad` and `unexplained` of `holography.phase.SteadyTurn`; NaN without light.
        """
        if np.isfinite(turn_rad) and np.isfinite(unexplained):
            self._turns.append((turn_rad, unexplained))

    def add_brightness(self, exposure_s: Fraction, brightness_dn: float) -> None:
        """Remember the brightness of the frames of a step, for its exposure."""
        recent = self._brightness.setdefault(exposure_s, deque(maxlen=_NEIGHBOURS))
        recent.append(brightness_dn)

    def usual(self, exposure_s: Fraction | None = None) -> Usual:
        """Return the usual values of the remembered steps.

        Parameters
        ----------
        exposure_s : Fraction, optional
            Exposure for which the usual brightness is wanted; without it, brightness is NaN.
        """
        recent = () if exposure_s is None else self._brightness.get(exposure_s, ())
        brightness_dn = float(np.median(recent)) if recent else np.nan
        if not self._turns:
            return Usual(neighbours=len(recent), brightness_dn=brightness_dn)
        turns_rad, unexplained = np.array(self._turns).T
        centre_rad = float(np.median(turns_rad))
        return Usual(
            steps=len(turns_rad),
            turn_rad=centre_rad,
            turn_scatter_rad=_GAUSSIAN * float(np.median(np.abs(turns_rad - centre_rad))),
            unexplained=float(np.median(unexplained)),
            neighbours=len(recent),
            brightness_dn=brightness_dn,
        )
