"""Remember which trials of other fringes have failed."""

import numpy as np

from fitting.holograms.right_fringes.trials import same_fringe
from holography.arrays import ComplexArray


class FailedTrials:
    """Trials that have explained nothing better.

    From starts in the same fringes they would fail again, in the same light and with the same
    scatter of gains.
    """

    def __init__(self) -> None:
        self._holograms: dict[int, ComplexArray] = {}
        self._groups: dict[int, ComplexArray] = {}

    def add_hologram(self, number: int, starts: ComplexArray) -> None:
        """Remember that a hologram found nothing better from starts (s, j)."""
        self._holograms[number] = starts

    def has_hologram(self, number: int, starts: ComplexArray) -> bool:
        """Whether a hologram failed with a start in the same fringe as each of these (s, j)."""
        known = self._holograms.get(number)
        if known is None:
            return False
        return bool(np.all(same_fringe(known[:, None], starts).any(axis=0)))

    def add_group(self, first: int, amplitude: ComplexArray) -> None:
        """Remember that consecutive holograms of amplitudes (g, j) found nothing better."""
        self._groups[first] = amplitude

    def has_group(self, first: int, amplitude: ComplexArray) -> bool:
        """Whether a group failed that had these holograms, among others, in the same fringes."""
        return any(
            _contains(known, first - begins, amplitude) for begins, known in self._groups.items()
        )


def _contains(group: ComplexArray, first: int, amplitude: ComplexArray) -> bool:
    """Whether consecutive holograms, of which `first` is the first, are as they were in a group."""
    before = group[first : first + len(amplitude)] if first >= 0 else group[:0]
    return len(before) == len(amplitude) and bool(np.all(same_fringe(before, amplitude)))
