"""Sort the frames of a stream: numbers wrap, frames come late, twice or never."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.roles import Frame

# GigE Vision numbers the frames of a stream with 16 bits: after 65535 comes 1, and 0 is never used.
_NUMBERS: Final = 65_535
# A frame that comes this many numbers after a later one is taken for late, not for the next lap.
LATE_MAX: Final = 64


@dataclass(frozen=True, slots=True, eq=False)
class Delivery:
    """One frame as a camera's stream delivers it.

    Attributes
    ----------
    number : int
        As the camera counts.
    stamp_s : float
        The camera's time stamp, on the camera's own clock.
    image : (ny, nx) array of unsigned int, or None
        None if the frame arrived incomplete. Number and stamp mean nothing then: the packet that
        holds them may be the one that is missing.
    """

    number: int
    stamp_s: float
    image: NDArray[Any] | None


def steps_between(earlier: int, later: int) -> int:
    """Return how many frames after one number another one is; negative if it came late.

    Parameters
    ----------
    earlier, later : int
        Numbers as a camera counts. If both fit 16 bits they may have wrapped in between: what
        looks more than `LATE_MAX` late is taken for early. Whole laps of 65535 frames between the
        two, 88 minutes at 12.4 Hz, go unnoticed.
    """
    steps = later - earlier
    if max(earlier, later) > _NUMBERS:
        return steps
    ahead = steps % _NUMBERS
    return ahead if ahead < _NUMBERS - LATE_MAX else ahead - _NUMBERS


class FrameSequence:
    """The frames since a camera was started, in the order of their exposures, each once.

    Frames that were lost or broken leave gaps in the ids. A frame that comes after later ones were
    handed over is left out.

    Parameters
    ----------
    first_number : int or None
        What the camera calls the first frame since its start, which is frame 0 here. If it counts
        on from earlier starts, frame 0 is the first that arrives.
    """

    def __init__(self, first_number: int | None = None) -> None:
        self._last = None if first_number is None else (first_number, 0)
        self._handed_over: int | None = None
        self._waiting: dict[int, Frame] = {}

    def add(self, number: int, began_s: float, image: NDArray[np.uint16]) -> None:
        """Take in one whole frame.

        Parameters
        ----------
        number : int
            As the camera counts.
        began_s : float
            Start of its exposure on the camera's clock.
        image : (ny, nx) uint16
        """
        id = self._id_of(number)
        if self._handed_over is None or id > self._handed_over:
            self._waiting.setdefault(id, Frame(id, began_s, image))

    @property
    def waiting(self) -> int:
        """Frames that were not handed over yet."""
        return len(self._waiting)

    def take(self, count: int, not_before_s: float, *, incomplete: bool) -> list[Frame] | None:
        """Hand over the next frames, if they are there.

        Frames that began too early are forgotten.

        Parameters
        ----------
        count : int
        not_before_s : float
            Exposures that began earlier are passed over.
        incomplete : bool
            Whether to hand them over if one is missing in between, which may yet come.

        Returns
        -------
        list of Frame, or None
        """
        self._waiting = {
            id: frame for id, frame in self._waiting.items() if frame.timestamp_s >= not_before_s
        }
        ids = sorted(self._waiting)[:count]
        if len(ids) < count or not (incomplete or ids[-1] - ids[0] == count - 1):
            return None
        self._handed_over = ids[-1]
        return [self._waiting.pop(id) for id in ids]

    def _id_of(self, number: int) -> int:
        last_number, last_id = self._last or (number, 0)
        id = last_id + steps_between(last_number, number)
        self._last = (number, id)
        return id
