"""The verdict on a step, and the settings that the instruments reported."""

from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction


class Verdict(StrEnum):
    """Result of a step: whether its data can be used, or what is wrong.

    Attributes
    ----------
    OK : the step can be used.
    DROPPED : frames are missing between the first and the last.
    DISORDERED : frames came twice or in the wrong order, or their time stamps jump.
    PARTIAL : a frame is incomplete.
    STALE : an exposure began before the setting had settled, or a frame was returned before.
    SETTINGS : the instruments' settings changed during the frames, or differ from the plan.
    LIGHT : the brightness of one frame, or of all four, differs from that of neighbouring frames.
    LOCK : the synthesizers, the real frame rate or the light itself miss the frequency lock.
    UNSTEADY : the four frames do not fit one uniformly rotating image.
    SATURATED : too many pixels are saturated.
    NO_SIGNAL : the reed's region holds no more light than an empty region.
    UNPROVEN : nothing is wrong, but there is too little light to prove the frequency lock, and the
        synthesizers only return the settings that were sent to them.
    PENDING : the step is not measured yet.
    INTERRUPTED : the step was started but not finished; it holds no data.
    SKIPPED : an instrument failed at this step and the run continued; the step holds no data.
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
        """Return whether a step with this verdict holds data, good or bad."""
        return self not in (Verdict.PENDING, Verdict.INTERRUPTED, Verdict.SKIPPED)


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict, and one sentence that says why and what to do."""

    verdict: Verdict
    sentence: str


@dataclass(frozen=True, slots=True)
class ReadBack:
    """Settings that the instruments reported during a step.

    Attributes
    ----------
    aom1_hz, aom2_hz, drive_hz : Fraction
        Frequencies of the two synthesizer channels and of the generator.
    volts : float
        Peak volts at the load.
    """

    aom1_hz: Fraction
    aom2_hz: Fraction
    drive_hz: Fraction
    volts: float
