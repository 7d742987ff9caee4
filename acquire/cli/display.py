"""What the command line shows of plans and runs: progress bars, summaries and details."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from statistics import median
from typing import Any
from typing import Protocol as Role

from rich.box import SIMPLE
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from acquire.runner.control import control_path
from acquire.runner.recorder import StepReport
from acquire.runner.summary import RunSummary
from drivers.exclusive import holder_of
from protocols.plan import Plan
from reports.plain_text import plain
from reports.run_tables import status_words
from runs.packing import Packing
from runs.reader import Run
from runs.records import StepRecord
from runs.verdict import Verdict


class Listener(Role):
    """Receives the reports of a run while it is measured."""

    def step(self, report: StepReport) -> None:
        """Show that a step was recorded."""

    def packing(self, fraction: float) -> None:
        """Show the fraction of the frames that is packed, from 0 to 1."""


class _SweepBar:
    """Live bar of a sweep, and then of its frames being packed."""

    def __init__(self, progress: Progress, steps: int) -> None:
        self._progress, self._steps = progress, steps
        self._task = progress.add_task("sweep", total=steps, setting="", verdict="", left="")

    def step(self, report: StepReport) -> None:
        """Show step, frequency, volts, verdict and time left."""
        # The bar appears with the first step, below the messages that come before it.
        if not self._progress.live.is_started:
            self._progress.start()
        minutes, seconds = divmod(round(report.seconds_left), 60)
        colour = "green" if report.verdict is Verdict.OK else "red"
        again = f" attempt {report.attempt}" if report.attempt > 1 else ""
        self._progress.update(
            self._task,
            completed=report.done,
            setting=f"{report.drive_hz:8.1f} Hz {report.volts:6.2f} V{again}",
            verdict=f"[{colour}]{report.verdict}[/{colour}]",
            left=f"{minutes}:{seconds:02d} left",
        )

    def packing(self, fraction: float) -> None:
        """Show the fraction of the frames that is packed, in steps."""
        self._progress.update(
            self._task,
            completed=fraction * self._steps,
            setting="packing the frames",
            verdict="",
            left="",
        )


def plan_summary(plan: Plan) -> list[str]:
    """Return duration, file size, known effects and exceeded limits of a plan, in lines."""
    minutes, seconds = divmod(round(plan.duration_s), 60)
    lines = [
        f"{len(plan.steps)} steps, {minutes} min {seconds:02d} s at the frame rate of the camera, "
        f"{_sizes(plan)}",
        *_known_words(plan.bench.known or {}),
    ]
    if not plan.violations:
        return [*lines, "all limits are met"]
    lines += [f"limit exceeded: {v.key}: {v.message}" for v in plan.violations]
    return lines


def _known_words(known: Mapping[str, Mapping[str, float | str]]) -> list[str]:
    """Return a line about what the bench is known to have; none if it is nothing."""
    each = [
        f"{name} ({', '.join(f'{size} {value}' for size, value in sizes.items())})"
        for name, sizes in known.items()
    ]
    if not each:
        return []
    return [f"known of this bench, in its simulation, fit and diagnosis: {', '.join(each)}"]


def _sizes(plan: Plan) -> str:
    size, largest, packed = (
        f"{(size or 0) / 1e6:.0f} MB"
        for size in (plan.file_size_bytes, plan.largest_size_bytes, plan.packed_size_bytes)
    )
    words = (
        size if size == largest else f"{size} (at most {largest}, if many steps are measured again)"
    )
    return words if plan.packed_size_bytes is None else f"{words}; about {packed} after packing"


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
    try:
        yield _SweepBar(progress, steps)
    finally:
        if progress.live.is_started:
            progress.stop()


@contextmanager
def stage_progress(console: Console) -> Iterator[Callable[[str, float], None]]:
    """Live bars of a computation: one for each stage, with the fraction that is done."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    progress = Progress(*columns, console=console)
    tasks: dict[str, TaskID] = {}

    def show(stage: str, fraction: float) -> None:
        # A bar appears with its first report: most often there is nothing to wait for.
        if not progress.live.is_started:
            progress.start()
        if stage not in tasks:
            tasks[stage] = progress.add_task(stage, total=1.0)
        progress.update(tasks[stage], completed=fraction)

    try:
        yield show
    finally:
        if progress.live.is_started:
            progress.stop()


def run_summary(summary: RunSummary, bad_steps: Sequence[str]) -> list[str]:
    """Return how a run ended, as lines.

    Parameters
    ----------
    summary : RunSummary
    bad_steps : sequence of str
        Sentences about the steps that are not ok.
    """
    measured = sum(summary.counts.values())
    because = f" ({summary.reason})" if summary.reason else ""
    lines = [
        f"{summary.status}{because}: {measured} of {summary.steps} steps in "
        f"{summary.duration_s:.0f} s, {summary.counts.get(Verdict.OK, 0)} good"
    ]
    bad = {v: n for v, n in summary.counts.items() if v is not Verdict.OK}
    if bad:
        listed = ", ".join(f"{n} {v}" for v, n in bad.items())
        lines.append(f"not good: {listed}; for example: {bad_steps[0]}" if bad_steps else listed)
    if summary.repeated:
        lines.append(f"measured again: {summary.repeated} steps")
    lines += [f"remark: {remark}" for remark in summary.remarks]
    lines += [f"NOT CONFIRMED OFF, check the instrument: {what}" for what in summary.unconfirmed]
    return lines


def bad_steps_of(run: Run) -> list[str]:
    """Return a sentence about each step that is not ok, in the order of the sweep."""
    bad = [s for s in run.steps if s.verdict is not Verdict.OK and s.sentence]
    return [f"step {step.index}: {step.sentence}" for step in bad]


def run_details(run: Run) -> dict[str, object]:
    """Return everything in a run file except its pictures, with stable keys."""
    good = [step for step in run.steps if step.verdict is Verdict.OK]
    errors = [abs(step.lock_error_hz) for step in good if math.isfinite(step.lock_error_hz)]
    counts = Counter(str(step.verdict) for step in run.steps)
    return catalogue_entry(run) | {
        "end": run.end_time,
        "title": run.title,
        "kind": run.reed_file().name,
        "chamber": run.chamber,
        "bench": run.bench_name,
        "bench_fingerprint": run.bench_fingerprint,
        "protocol_sha256": run.protocol_sha256,
        "instruments": run.identities,
        "seed": run.seed,
        "keep": run.keep,
        "git_revision": run.git_revision,
        "verdicts": dict(counts),
        "lock_error_hz": {
            "median": float(median(errors)) if errors else None,
            "largest": max(errors, default=None),
        },
        "earlier_attempts": [_taken(step) for step in run.earlier_attempts],
        "bad": [_taken(step) for step in run.steps if step.verdict is not Verdict.OK],
        "interruptions": [asdict(interruption) for interruption in run.interruptions],
    }


def _taken(step: StepRecord) -> dict[str, object]:
    return {"index": step.index, "verdict": str(step.verdict), "sentence": step.sentence}


def details_table(details: Mapping[str, Any]) -> Table:
    """Return the table that `acquire show` prints of `run_details`."""
    table = Table(box=SIMPLE, show_header=False, pad_edge=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")

    def row(head: str, value: object) -> None:
        if value not in ("", None):
            table.add_row(head, plain(value))

    strength = f", strength {details['strength']:g}" if details["strength"] else ""
    row("run", details["path"])
    end = details["end"] or ("now" if details["in_work"] else "(no end)")
    row("measured", f"{details['start']} to {end}, {status_words(details)}")
    row("protocol", f"{details['title']} ({details['protocol_sha256'][:12]})")
    row("reed", f"{details['reed']} ({details['kind']}){strength}, series {details['series']}")
    row("note", details["note"])
    row("operator", details["operator"])
    row("bench", f"{details['bench']} ({details['bench_fingerprint'][:12]})")
    for role, identity in details["instruments"].items():
        row(role, identity)
    row("steps", ", ".join(f"{n} {verdict}" for verdict, n in details["verdicts"].items()))
    lock = details["lock_error_hz"]
    if lock["median"] is not None:
        row("lock error", f"{lock['median']:.2g} Hz median, {lock['largest']:.2g} Hz at most")
    for key, word in (("earlier_attempts", "measured again"), ("bad", "not good")):
        for step in details[key]:
            row(word, f"step {step['index']}: {step['verdict']}: {step['sentence']}")
    for each in details["interruptions"]:
        where = f"{each['kind']} at measurement {each['position'] + 1}"
        row("interruption", f"{where}: {each['reason']}")
    return table


def packing_line(run: str, packed: Packing) -> str:
    """Return the line that `acquire pack` prints about one run."""
    size = f"{packed.before_bytes / 1e6:.1f} MB"
    if packed.reason:
        return f"{run}: {packed.reason} ({size})"
    return f"{run}: {size} → {packed.after_bytes / 1e6:.1f} MB ({packed.ratio:.0%})"


def packing_to_json(run: str, packed: Packing) -> dict[str, object]:
    """Return the result of packing a run, with stable keys."""
    return {
        "run": run,
        "packed": not packed.reason,
        "reason": packed.reason,
        "before_bytes": packed.before_bytes,
        "after_bytes": packed.after_bytes,
        "ratio": packed.ratio,
    }


def catalogue_entry(run: Run) -> dict[str, object]:
    """Return the labels and the state of a run, with stable keys."""
    held, holder = holder_of(control_path(run.path))
    return {
        "path": str(run.path),
        "start": run.start_time,
        "reed": run.reed,
        "strength": run.labels.strength,
        "series": run.series,
        "operator": run.labels.operator,
        "note": run.labels.note,
        "status": run.status,
        "in_work": held,
        "process": holder.pid if holder else None,
        "steps": len(run),
        "good": int(run.good.sum()),
    }
