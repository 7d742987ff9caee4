"""What the command line shows of plans and runs: tables, progress and closing words."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol as Role

from rich.box import SIMPLE
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from acquire.plan import Plan, Step
from acquire.quality import Verdict
from acquire.quantities import exact_decimal
from acquire.recorder import StepReport
from acquire.runfile import Run
from acquire.runner import RunSummary


class Listener(Role):
    """Takes the reports of a run as they come."""

    def __call__(self, report: StepReport) -> None:
        """Show one report."""


def plan_table(plan: Plan) -> Table:
    """Every step of a plan, narrow enough for 80 columns without losing a digit."""
    title = f"{plan.protocol.name} on the {plan.bench.name}"
    if plan.steps:
        title += f", AOM2 at {exact_decimal(plan.steps[0].aom2_hz)} Hz"
    # Text, because what people wrote may hold what rich takes for markup.
    table = Table(title=Text(title), box=SIMPLE, pad_edge=False, padding=(0, 0, 0, 1))
    heads = ("k", "asked Hz", "drive Hz", "AOM1 Hz", "AOM1 − AOM2", "residual")
    rows = [_plan_row(step) for step in plan.steps]
    for column, head in enumerate((*heads, "volts", "leak")):
        widest = max((len(row[column]) for row in rows), default=0)
        table.add_column(head, justify="right", min_width=widest)
    for row in rows:
        table.add_row(*row)
    return table


def _plan_row(step: Step) -> tuple[str, ...]:
    return (
        str(step.index),
        f"{float(step.asked_hz):.3f}",
        exact_decimal(step.drive_hz),
        exact_decimal(step.aom1_hz),
        exact_decimal(step.difference_hz),
        exact_decimal(step.lock_residual_hz),
        f"{step.volts:.3f}",
        f"{step.carrier_leak:.2%}",
    )


def plan_summary(plan: Plan) -> list[str]:
    """Duration, size and limit violations of a plan, a line each."""
    minutes, seconds = divmod(round(plan.duration_s), 60)
    lines = [
        f"{len(plan.steps)} steps, {minutes} min {seconds:02d} s at the camera's pace, "
        f"{plan.file_size_bytes / 1e6:.0f} MB"
    ]
    if not plan.violations:
        return [*lines, "no limit is violated"]
    lines += [f"violation: {v.key}: {v.message}" for v in plan.violations]
    return lines


@contextmanager
def sweep_progress(console: Console, steps: int) -> Iterator[Listener]:
    """Live bar of a sweep: step, frequency, volts, verdict and time left."""
    columns = (
        TextColumn("step {task.completed:.0f}/{task.total:.0f}"),
        BarColumn(),
        TextColumn("{task.fields[setting]}"),
        TextColumn("{task.fields[verdict]}"),
        TextColumn("{task.fields[left]}"),
    )
    progress = Progress(*columns, console=console)
    task = progress.add_task("sweep", total=steps, setting="", verdict="", left="")
    try:

        def show(report: StepReport) -> None:
            # The bar appears with the first step: what is said before stands alone.
            if not progress.live.is_started:
                progress.start()
            minutes, seconds = divmod(round(report.seconds_left), 60)
            colour = "green" if report.verdict is Verdict.OK else "red"
            progress.update(
                task,
                completed=report.done,
                setting=f"{report.drive_hz:8.1f} Hz {report.volts:6.2f} V",
                verdict=f"[{colour}]{report.verdict}[/{colour}]",
                left=f"{minutes}:{seconds:02d} left",
            )

        yield show
    finally:
        if progress.live.is_started:
            progress.stop()


def run_summary(summary: RunSummary, troubles: Sequence[str]) -> list[str]:
    """How a run ended, a line each.

    Parameters
    ----------
    summary : RunSummary
    troubles : sequence of str
        Sentences of the steps that are not ok.
    """
    measured = sum(summary.counts.values())
    lines = [
        f"{summary.status}: {measured} of {summary.steps} steps in {summary.duration_s:.0f} s, "
        f"{summary.counts.get(Verdict.OK, 0)} good"
    ]
    bad = {v: n for v, n in summary.counts.items() if v is not Verdict.OK}
    if bad:
        listed = ", ".join(f"{n} {v}" for v, n in bad.items())
        lines.append(f"not good: {listed}; for example: {troubles[0]}" if troubles else listed)
    lines += [f"NOT CONFIRMED, please look: {what}" for what in summary.unconfirmed]
    return lines


def troubles_of(run: Run) -> list[str]:
    """Sentences of a run's steps that are not ok, first first."""
    bad = [s for s in run.steps if s.verdict is not Verdict.OK and s.sentence]
    return [f"step {step.index}: {step.sentence}" for step in bad]


def runs_table(runs: Sequence[dict[str, object]]) -> Table:
    """Table of the runs of a folder (see `catalogue_entry`)."""
    table = Table()
    for head in ("run", "reed", "strength", "series", "status", "good", "note"):
        # Names of files must be whole to be of use.
        table.add_column(head, overflow="fold")
    for run in runs:
        good = f"{run['good']}/{run['steps']}"
        strength = "" if run["strength"] is None else f"{run['strength']:g}"
        cells = (run["path"], run["reed"], strength, run["series"], run["status"])
        # Text, because what people wrote may hold what rich takes for markup.
        table.add_row(*map(Text, map(str, (*cells, good, run["note"]))))
    return table


def catalogue_entry(run: Run) -> dict[str, object]:
    """Return what tells a run from others, with stable keys."""
    return {
        "path": str(run.path),
        "start": run.start_time,
        "reed": run.reed,
        "strength": run.labels.strength,
        "series": run.series,
        "operator": run.labels.operator,
        "note": run.labels.note,
        "status": run.status,
        "steps": len(run),
        "good": int(run.good.sum()),
    }
