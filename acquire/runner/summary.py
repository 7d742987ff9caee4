"""State of a run while it is measured, and summary of a run that ended."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Literal

from runs.verdict import Verdict


class RunState(StrEnum):
    """State of a run; `acquire.runner.runner.Runner` shows the transitions."""

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
    """Summary of a run that ended.

    Attributes
    ----------
    path : Path
        Path of the run file.
    status : {'complete', 'interrupted'}
        A run that fails raises an error and has no summary.
    reason : str
        Why the run was interrupted; empty if it is complete.
    ended_by : {'', 'person', 'policy'}
        Who ended the run early: the operator, or the policy of the protocol.
    counts : mapping of Verdict to int
        Number of measured steps with each verdict.
    steps : int
        Number of planned steps.
    repeated : int
        Number of attempts beyond one for each step, including attempts of an earlier process.
    duration_s : float
        Duration of the run in s.
    unconfirmed : tuple of str
        Outputs that were not confirmed off at the end; the operator has to check them.
    remarks : tuple of str
        Remarks about the whole run.
    """

    path: Path
    status: RunState
    reason: str
    ended_by: Literal["", "person", "policy"]
    counts: Mapping[Verdict, int]
    steps: int
    repeated: int
    duration_s: float
    unconfirmed: tuple[str, ...]
    remarks: tuple[str, ...] = ()
