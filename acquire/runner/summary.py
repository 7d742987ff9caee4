"""How a run stands, and how it ended."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Literal

from runs.verdict import Verdict


class RunState(StrEnum):
    """Where a run stands."""

    IDLE = "idle"
    OPENING = "opening"
    STEPPING = "stepping"
    PAUSED = "paused"
    CLOSING = "closing"
    COMPLETE = "complete"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class RunSummary:
    """How a run ended.

    Attributes
    ----------
    path : Path
        Of the run file.
    status : {'complete', 'interrupted'}
        A run that failed raises instead.
    reason : str
        Why it was interrupted; empty if it is complete.
    ended_by : {'', 'person', 'policy'}
        Who ended it early: somebody, or the protocol's policy.
    counts : mapping of Verdict to int
        Of the steps that were measured.
    steps : int
        That were planned.
    retaken : int
        Takes besides one of each step, those of an earlier process included.
    duration_s : float
        On the wall.
    unconfirmed : tuple of str
        What the bench did not confirm while it was switched off; a person has to look.
    remarks : tuple of str
        What is worth knowing of the run as a whole.
    """

    path: Path
    status: RunState
    reason: str
    ended_by: Literal["", "person", "policy"]
    counts: Mapping[Verdict, int]
    steps: int
    retaken: int
    duration_s: float
    unconfirmed: tuple[str, ...]
    remarks: tuple[str, ...] = ()
