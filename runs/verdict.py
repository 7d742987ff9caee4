"""The verdict on a step, and what the instruments said that they played."""

from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction


class Verdict(StrEnum):
    """What became of a step.

    Attributes
    ----------
    OK : the step can be used.
    DROPPED : frames are missing between the first and the last.
    DISORDERED : frames came twice or in another order, or their time stamps jump.
    PARTIAL : a frame is not filled to its end.
    STALE : an exposure began before the setting had settled, or was seen before.
    SETTINGS : what the instruments played changed during the frames, or is not what was asked for.
    LIGHT : one frame, or all four, have another brightness than those around them.
    LOCK : what was played, the real frame rate or the light itself misses the sideband.
    UNSTEADY : the four frames do not fit one steadily turning image.
    SATURATED : too many pixels are at their limit.
    NO_SIGNAL : the reed's region holds no more light than an empty one.
    UNPROVEN : nothing is wrong, but too little light shows that the lock held, and the synthesizers
        only repeat what they were told.
    PENDING : the step was not measured yet.
    INTERRUPTED : the step was begun and given up; it holds no data.
    SKIPPED : an instrument failed at this step and the run went on without it; it holds no data.
    """

    OK = "ok"
    DROPPED = "dropped"
    DISORDERED = "disordered"
    PARTIAL = "partial"
    STALE = "stale"
    SETTINGS = "settings"
    LIGHT = "light"
    LOCK = "lock"
    UNSTEADY = "unsteady"
    SATURATED = "saturated"
    NO_SIGNAL = "no_signal"
    UNPROVEN = "unproven"
    PENDING = "pending"
    INTERRUPTED = "interrupted"
    SKIPPED = "skipped"

    @property
    def measured(self) -> bool:
        """Whether a step of this verdict holds data, good or bad."""
        return self not in (Verdict.PENDING, Verdict.INTERRUPTED, Verdict.SKIPPED)


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict, and one sentence that says why and what to do."""

    verdict: Verdict
    sentence: str


@dataclass(frozen=True, slots=True)
class ReadBack:
    """What the instruments said that they were playing during a step.

    Attributes
    ----------
    aom1_hz, aom2_hz, drive_hz : Fraction
    volts : float
        Peak volts at the load.
    """

    aom1_hz: Fraction
    aom2_hz: Fraction
    drive_hz: Fraction
    volts: float
