"""Data of one measured step, ready to be written to a run file."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.roles import Frame
from runs.verdict import Judgement, ReadBack


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredStep:
    """Frames, field and quality figures of one step.

    Attributes
    ----------
    read_back : ReadBack
        Settings that the instruments reported during the step.
    changed_s : float
        Time of the last change of a setting on the camera's clock, in s.
    frames : sequence of Frame
    field : (height, width) complex64
        Object field in the region around the reed, in dn.
    signal_to_noise : float
        Mean ``|H|²`` in the reed's region, divided by `noise_level`.
    noise_level : float
        Mean ``|H|²`` of an empty pixel, in dn².
    saturated_share : float
        Fraction of pixels that are saturated.
    brightness_dn : float
        Median of the mean values of the frames, in dn; above that of a dark frame if the bench
        file states that.
    lock_error_hz, lock_error_se_hz : float
        Deviation of f_AOM1 − f_AOM2 from the frequency lock, measured in the frames, and its
        standard error, in Hz.
    unexplained : float
        Fraction of the power of the image that does not rotate uniformly from frame to frame.
    judgement : Judgement
        Verdict on the step.
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
