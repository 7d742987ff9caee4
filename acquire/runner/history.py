"""What the steps of a run have been like: by it a step that is unlike the others is known."""

from collections import deque
from fractions import Fraction
from typing import Final

import numpy as np

from acquire.runner.quality import Usual

# Chosen: a table and a laser change within minutes, which are some hundred steps; a median of this
# many is known to a sixth of the scatter.
_REMEMBERED: Final = 64
_NEIGHBOURS: Final = 5
# Standard deviation of a Gaussian per median absolute deviation.
_GAUSSIAN: Final = 1.4826


class History:
    """The last steps of one run, in the order in which they were taken."""

    def __init__(self) -> None:
        self._turns: deque[tuple[float, float]] = deque(maxlen=_REMEMBERED)
        self._brightness: dict[Fraction, deque[float]] = {}

    def add_turn(self, turn_rad: float, unexplained: float) -> None:
        """Remember how the light of a step turned; steps without light tell nothing.

        Parameters
        ----------
        turn_rad, unexplained : float
            See `holography.phase.SteadyTurn`.
        """
        if np.isfinite(turn_rad) and np.isfinite(unexplained):
            self._turns.append((turn_rad, unexplained))

    def add_brightness(self, exposure_s: Fraction, brightness_dn: float) -> None:
        """Remember how bright the frames of a step were."""
        recent = self._brightness.setdefault(exposure_s, deque(maxlen=_NEIGHBOURS))
        recent.append(brightness_dn)

    def usual(self, exposure_s: Fraction | None = None) -> Usual:
        """Return what the steps have been like; their brightness only for an exposure."""
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
