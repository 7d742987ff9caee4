"""Results of planning and measuring."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.errors import FAILED, INTERRUPTED
from acquire.results.base import Result, label_axes, new_axes
from acquire.runner.summary import RunState, RunSummary
from protocols.campaign import Task
from protocols.plan import Plan
from protocols.step import Step, Violation
from runs.verdict import Verdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False)
class SweepPlan(Result):
    """Every step of a sweep on a bench, before an instrument is opened.

    Attributes
    ----------
    plan : Plan
        With everything that the runner uses.
    """

    plan: Plan

    @property
    def steps(self) -> tuple[Step, ...]:
        """Settings of each step, in the order of the protocol."""
        return self.plan.steps

    @property
    def duration_s(self) -> float:
        """Time that the sweep takes at the frame rate of the camera."""
        return self.plan.duration_s

    @property
    def violations(self) -> tuple[Violation, ...]:
        """Limits of the bench that the sweep exceeds; empty if it can be measured."""
        return self.plan.violations

    @property
    def title(self) -> str:
        """One line that says what this is."""
        state = f"{len(self.violations)} limits exceeded" if self.violations else "can be measured"
        return (
            f"{self.plan.protocol.name} on {self.plan.bench.name}: {len(self.steps)} steps, "
            f"{self.duration_s:.0f} s, {self.plan.file_size_bytes / 1e6:.0f} MB, {state}"
        )

    def rows(self) -> list[dict[str, Any]]:
        """Return index, frequencies in Hz, volts and settling time of every step."""
        return [
            {
                "index": step.index,
                "order": step.order,
                "asked_hz": float(step.asked_hz),
                "drive_hz": float(step.drive_hz),
                "aom1_hz": float(step.aom1_hz),
                "aom2_hz": float(step.aom2_hz),
                "lock_residual_hz": float(step.lock_residual_hz),
                "volts": step.volts,
                "settle_s": float(step.settle_s),
                "exposure_s": float(step.exposure_s),
            }
            for step in self.steps
        ]

    def to_json(self) -> dict[str, Any]:
        """Return what ``acquire plan --json`` prints."""
        return self.plan.to_json()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the volts of the tweeter against the drive frequency."""
        axes = new_axes(ax)
        axes.plot(
            [float(step.drive_hz) for step in self.steps],
            [step.volts for step in self.steps],
            marker=".",
        )
        label_axes(axes, self.title, "drive frequency (Hz)", "tweeter (V peak)")
        return axes


@dataclass(frozen=True, repr=False)
class CampaignPlan(Result):
    """Every part of a campaign on a bench, before an instrument is opened.

    Attributes
    ----------
    tasks : tuple of Task
    plans : tuple of Plan
        One for each task.
    """

    tasks: tuple[Task, ...]
    plans: tuple[Plan, ...]

    @property
    def title(self) -> str:
        """One line that says what this is."""
        steps, seconds = (
            sum(len(p.steps) for p in self.plans),
            sum(p.duration_s for p in self.plans),
        )
        return f"campaign: {len(self.tasks)} parts, {steps} steps, {seconds:.0f} s"

    def rows(self) -> list[dict[str, Any]]:
        """Return name, kind, steps, seconds and bytes of every part."""
        return [
            {
                "part": task.part.name,
                "kind": task.protocol.calibration.kind if task.protocol.calibration else "sweep",
                "do": task.part.do,
                "clamping": task.clamping,
                "steps": len(plan.steps),
                "duration_s": plan.duration_s,
                "file_size_bytes": plan.file_size_bytes,
            }
            for task, plan in zip(self.tasks, self.plans, strict=True)
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the parts that ``acquire plan CAMPAIGN --json`` prints."""
        return {
            "parts": [
                {"part": task.part.name, "do": task.part.do, "clamping": task.clamping}
                | plan.to_json()
                for task, plan in zip(self.tasks, self.plans, strict=True)
            ]
        }

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw when each part is measured."""
        axes, begin_s = new_axes(ax), 0.0
        for task, plan in zip(self.tasks, self.plans, strict=True):
            axes.barh(task.part.name, plan.duration_s, left=begin_s)
            begin_s += plan.duration_s
        axes.invert_yaxis()
        label_axes(axes, self.title, "time (s)")
        return axes


@dataclass(frozen=True, repr=False)
class RunResult(Result):
    """How a run ended.

    Attributes
    ----------
    summary : RunSummary
    """

    summary: RunSummary

    @property
    def path(self) -> Path:
        """The run file."""
        return self.summary.path

    @property
    def status(self) -> RunState:
        """Complete or interrupted; a run that fails raises an exception instead."""
        return self.summary.status

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """Outputs that are not confirmed off: a person must look at the bench."""
        return self.summary.unconfirmed

    @property
    def counts(self) -> Mapping[Verdict, int]:
        """Number of measured steps by verdict."""
        return self.summary.counts

    @property
    def exit_status(self) -> int:
        """Exit status of ``acquire run`` for this run: 0, 1 or 130."""
        if self.summary.unconfirmed or self.summary.ended_by == "policy":
            return FAILED
        return INTERRUPTED if self.summary.ended_by == "person" else 0

    @property
    def title(self) -> str:
        """One line that says what this is."""
        good = self.counts.get(Verdict.OK, 0)
        return f"{self.path}: {self.status}, {good} of {self.summary.steps} steps good"

    def rows(self) -> list[dict[str, Any]]:
        """Return the number of steps by verdict."""
        return [{"verdict": str(verdict), "steps": n} for verdict, n in self.counts.items()]

    def to_json(self) -> dict[str, Any]:
        """Return the part of what ``acquire run --json`` prints that is about the run."""
        return {
            "run": str(self.path),
            "status": str(self.status),
            "reason": self.summary.reason,
            "unconfirmed": list(self.unconfirmed),
            "remarks": list(self.summary.remarks),
            "verdicts": {str(verdict): n for verdict, n in self.counts.items()},
        }

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the number of steps by verdict."""
        axes = new_axes(ax)
        axes.barh([str(verdict) for verdict in self.counts], list(self.counts.values()))
        label_axes(axes, self.title, "steps")
        return axes


@dataclass(frozen=True, repr=False)
class CampaignResult(Result):
    """How the parts of a campaign ended.

    Attributes
    ----------
    folder : Path
        Holds one run file for each part.
    parts : tuple of RunResult
        Those that were measured, in order.
    """

    folder: Path
    parts: tuple[RunResult, ...]

    @property
    def exit_status(self) -> int:
        """Exit status of ``acquire run`` for this campaign: that of the last part."""
        return self.parts[-1].exit_status

    @property
    def title(self) -> str:
        """One line that says what this is."""
        return f"{self.folder}: {len(self.parts)} parts measured, last {self.parts[-1].status}"

    def rows(self) -> list[dict[str, Any]]:
        """Return name, status and number of good steps of every part."""
        return [
            {
                "part": part.path.stem,
                "status": str(part.status),
                "steps": part.summary.steps,
                "good": part.counts.get(Verdict.OK, 0),
            }
            for part in self.parts
        ]

    def to_json(self) -> dict[str, Any]:
        """Return what ``acquire run CAMPAIGN --json`` prints."""
        last = self.parts[-1]
        return {
            "folder": str(self.folder),
            "status": str(last.status),
            "reason": last.summary.reason,
            "unconfirmed": list(last.unconfirmed),
            "parts": {
                part.path.stem: {str(verdict): n for verdict, n in part.counts.items()}
                for part in self.parts
            },
        }

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the number of good steps of every part."""
        axes, rows = new_axes(ax), self.rows()
        axes.barh([row["part"] for row in rows], [row["good"] for row in rows])
        axes.invert_yaxis()
        label_axes(axes, self.title, "good steps")
        return axes
