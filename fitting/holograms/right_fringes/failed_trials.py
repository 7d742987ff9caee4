"""Remember which trials of other fringes have failed."""

from dataclasses import dataclass

import numpy as np

from fitting.holograms.right_fringes.trials import same_fringe
from holography.arrays import ComplexArray

# A trial is repeated once holograms scatter less in brightness by this factor: what a wrong fringe
# needs of another brightness then costs twice as much. Chosen.
_STEADIER = 0.7


@dataclass(frozen=True)
class _Trial:
    """A trial that has failed.

    Attributes
    ----------
    amplitude : (s, j) complex
        Its starts, or the holograms of its group.
    gain_nepers : float
        Scatter of gains.
    """

    amplitude: ComplexArray
    gain_nepers: float

    def counts(self, gain_nepers: float) -> bool:
        """Whether wrong fringes cost as little as in this trial."""
        return gain_nepers > _STEADIER * self.gain_nepers


class FailedTrials:
    """Trials that have explained nothing better.

    From starts in the same fringes they would fail again.
    """

    def __init__(self) -> None:
        self._holograms: dict[int, _Trial] = {}
        self._groups: dict[int, _Trial] = {}

    def add_hologram(self, number: int, starts: ComplexArray, gain_nepers: float) -> None:
        """Remember that a hologram found nothing better from starts (s, j)."""
        self._holograms[number] = _Trial(starts, gain_nepers)

    def has_hologram(self, number: int, starts: ComplexArray, gain_nepers: float) -> bool:
        """Whether a hologram failed with a start in the same fringe as each of these (s, j)."""
        known = self._holograms.get(number)
        if known is None or not known.counts(gain_nepers):
            return False
        near = same_fringe(known.amplitude[:, None], starts)
        return bool(np.all(near.any(axis=0)))

    def add_group(self, first: int, amplitude: ComplexArray, gain_nepers: float) -> None:
        """Remember that consecutive holograms of amplitudes (g, j) found nothing better."""
        self._groups[first] = _Trial(amplitude, gain_nepers)

    def has_group(self, first: int, amplitude: ComplexArray, gain_nepers: float) -> bool:
        """Whether a group failed that had these holograms, among others, in the same fringes."""
        return any(
            known.counts(gain_nepers) and _contains(known.amplitude, first - begins, amplitude)
            for begins, known in self._groups.items()
        )


def _contains(group: ComplexArray, first: int, amplitude: ComplexArray) -> bool:
    """Whether consecutive holograms, of which `first` is the first, are as they were in a group."""
    before = group[first : first + len(amplitude)] if first >= 0 else group[:0]
    return len(before) == len(amplitude) and bool(np.all(same_fringe(before, amplitude)))
