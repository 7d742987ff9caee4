"""What a caller can be called back for while a run is measured."""

from collections.abc import Callable
from dataclasses import dataclass

from acquire.runner.recorder import StepReport
from protocols.campaign import Task
from protocols.plan import Plan

Announce = Callable[[str], None]
"""Called with one line of text."""
Progress = Callable[[str, float], None]
"""Called with the name of a stage and the fraction of it that is done, from 0 to 1."""


def ignore(*_: object) -> None:
    """Do nothing: the default of every callback."""


@dataclass(frozen=True)
class Callbacks:
    """Functions that a run calls while it measures.

    Attributes
    ----------
    step : callable
        Called with a `StepReport` after every recorded step, on the recorder's thread. An exception
        that it raises stops the run.
    packing : callable
        Called with the fraction of the frames that is compressed, from 0 to 1.
    announce : callable
        Called with one line of text about pauses, and about instruments that failed and came back.
    part : callable
        Called with each part of a campaign and its plan before that part is measured.
    wait_for : callable
        Called with what a person must do at the bench before the next part of a campaign; returns
        when it is done. Only on benches that cannot do it by themselves.
    """

    step: Callable[[StepReport], None] = ignore
    packing: Callable[[float], None] = ignore
    announce: Announce = ignore
    part: Callable[[Task, Plan], None] = ignore
    wait_for: Callable[[str], None] = ignore
