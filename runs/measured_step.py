"""What one step gave, ready to be written."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.roles import Frame
from runs.verdict import (
    Judgement,
    ReadBack,
)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredStep:
    """What one acquisition gave.

    Attributes
    ----------
    read_back : ReadBack
    changed_s : float
        When the last setting was changed, on the camera's clock.
    frames : sequence of Frame
    field : (height, width) complex64
        Around the reed.
    signal_to_noise, noise_level : float
        Mean ``|H|²`` in the reed's region over that of an empty pixel, and the latter, in dn².
    saturated_share : float
    brightness_dn : float
        Median of the frames' mean numbers, over that of a dark frame where the bench file says it.
    lock_error_hz, lock_error_se_hz : float
        By how much f_AOM1 − f_AOM2 missed the lock, as the frames show it, and its standard error.
    unexplained : float
        Power of the image that does not turn steadily, per power of the image.
    judgement : Judgement
    """

    read_back: ReadBack
    changed_s: float
    frames: Sequence[Frame]
    field: npt.NDArray[np.complex64]
    signal_to_noise: float
    noise_level: float
    saturated_share: float
    brightness_dn: float
    lock_error_hz: float
    lock_error_se_hz: float
    unexplained: float
    judgement: Judgement
