"""Tables of plans, campaigns, and the run files of a folder."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from protocols.campaign import Task
from protocols.plan import Plan
from protocols.units import exact_decimal
from reports.tables import Column, Table

# Exact frequencies are shown with all their digits.
_PLAN_COLUMNS: Final = (
    Column("step", "k", "", str),
    Column("asked_hz", "asked", "Hz", ".3f"),
    Column("drive_hz", "frequency", "Hz", exact_decimal),
    Column("aom1_hz", "AOM1", "Hz", exact_decimal),
    Column("difference_hz", "AOM1 − AOM2", "Hz", exact_decimal),
    Column("lock_residual_hz", "residual", "Hz", exact_decimal),
    Column("volts", "voltage", "V", ".3f"),
    Column("carrier_leak", "leak", "", ".2%"),
)


def plan_table(plan: Plan) -> Table:
    """Return every step of a plan, narrow enough for 80 columns."""
    title = f"{plan.protocol.name} on the {plan.bench.name}"
    if plan.steps:
        title += f", AOM2 at {exact_decimal(plan.steps[0].aom2_hz)} Hz"
    several = len(plan.protocol.sideband.selected) > 1
    rows = tuple(
        (
            f"{step.index}/{step.order}" if several else step.index,
            float(step.asked_hz),
            step.drive_hz,
            step.aom1_hz,
            step.difference_hz,
            step.lock_residual_hz,
            step.volts,
            step.carrier_leak,
        )
        for step in plan.steps
    )
    note = (
        f"k: step{', and the sideband n that is measured' if several else ''}. residual: frequency "
        "by which the synthesizers miss the lock. leak: amplitude of the carrier in the hologram, "
        "relative to that of an equal sideband."
    )
    return Table(_PLAN_COLUMNS, rows, title, note)


_CAMPAIGN_COLUMNS: Final = (
    Column("part", "part"),
    Column("kind", "kind"),
    Column("steps", "steps", "", "d"),
    Column("duration_s", "time", "s", ".0f"),
    Column("size_mb", "size", "MB", ".0f"),
    Column("do", "do this before"),
)


def campaign_table(tasks: Sequence[Task], plans: Sequence[Plan]) -> Table:
    """Return every part of a campaign, with what to do before it."""
    rows = tuple(
        (
            task.part.name,
            "sweep" if task.protocol.calibration is None else task.protocol.calibration.kind,
            len(plan.steps),
            plan.duration_s,
            plan.file_size_bytes / 1e6,
            task.part.do,
        )
        for task, plan in zip(tasks, plans, strict=True)
    )
    return Table(_CAMPAIGN_COLUMNS, rows)


_RUN_COLUMNS: Final = (
    Column("path", "run"),
    Column("reed", "reed"),
    Column("strength", "strength", "", "g"),
    Column("series", "series"),
    Column("status", "status"),
    Column("good", "good steps", "", str),
    Column("note", "note"),
)


def runs_table(runs: Sequence[Mapping[str, Any]]) -> Table:
    """Return the runs of a folder.

    Parameters
    ----------
    runs : sequence of mapping
        Entries with the keys of ``acquire list --json``.
    """
    rows = tuple(
        (
            run["path"],
            run["reed"],
            run["strength"],
            run["series"],
            status_words(run),
            f"{run['good']}/{run['steps']}",
            run["note"],
        )
        for run in runs
    )
    return Table(_RUN_COLUMNS, rows)


def status_words(entry: Mapping[str, Any]) -> str:
    """Return the status of a run, and the process that writes to it."""
    running = entry["status"] == "running"
    if not entry["in_work"]:
        return "stopped without an end; continue it with --resume" if running else entry["status"]
    process = entry["process"]
    worker = "a process on another computer" if process is None else f"process {process}"
    return (
        f"being measured by {worker}" if running else f"{entry['status']}, being packed by {worker}"
    )
