"""Sweeps on the emulated bench that something strikes, and what the laboratory really played."""

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import acquire
from acquire.runner import run_session
from acquire.runner.recorder import StepReport
from acquire.runner.summary import RunSummary
from benchmarks.striking.fault_list import Fault
from drivers.registry import open_bench
from drivers.roles import Bench
from drivers.simulated.lab import SimulatedLab
from holography.errors import BenchError
from physics.bench import BenchState
from protocols.bench import BenchFile
from protocols.plan import Plan
from runs.reader import Run
from runs.records import StepRecord
from runs.verdict import Verdict

# A step's volts as the generator can say them, six digits.
_VOLTS_SHARE = 1e-5
_SMALL = {"camera.width": 160, "camera.height": 128, "sweep.first": 14, "sweep.last": 32}
_AMID_STEPS = 4


@dataclass(frozen=True)
class Outcome:
    """What became of a run.

    Attributes
    ----------
    ending : str
    reason : str
        Why it stopped; empty if it did not.
    good, bad, repeated : int
        Steps by verdict, and attempts that were measured again.
    wrong : int
        Steps marked good whose exposures were not those of the plan. More than 0 is never right.
    sentences : tuple of str
        Verdicts and sentences of all attempts that are not good.
    off : bool
        Whether nothing is played at the end.
    unconfirmed : tuple of str
        What the run said that it could not confirm.
    """

    ending: str
    reason: str
    good: int
    bad: int
    repeated: int
    wrong: int
    sentences: tuple[str, ...]
    off: bool
    unconfirmed: tuple[str, ...]


def planned(fault: Fault) -> Plan:
    """Plan of the sweep that a fault strikes."""
    twin = {"mesh": "coarse", **fault.twin, "faults": dict(fault.faults)}
    bench = BenchFile.from_file("emulated").replace({"twin": twin})
    # The software of a camera maker is no part of what is tried here.
    bench = bench.replace(
        {
            "instruments.camera.driver": "simulated",
            "instruments.synthesizers.options.timeout_s": 0.5,
            "instruments.generator.options.timeout_s": 0.8,
            **fault.bench,
        }
    )
    return acquire.plan(acquire.load("quick").replace({**_SMALL, **fault.protocol}), bench).plan


@dataclass(frozen=True)
class Truth:
    """What the laboratory really played, and when.

    Attributes
    ----------
    changes : list of (float, BenchState)
    exposed_s : dict
        When each frame began, by its number and time stamp.
    """

    changes: list[tuple[float, BenchState]] = field(default_factory=list)
    exposed_s: dict[tuple[int, float], float] = field(default_factory=dict)

    @classmethod
    def of(cls, lab: SimulatedLab | None) -> "Truth":
        """Take it from a laboratory."""
        return cls(lab.changes, lab.exposed_s) if lab else cls()

    @property
    def off(self) -> bool:
        """Whether nothing is played at the end."""
        return not self.changes or not (self.changes[-1][1].rf_on or self.changes[-1][1].drive_v)

    def during(self, start_s: float, end_s: float) -> set[BenchState]:
        """All settings that there were in a stretch of time."""
        before = [state for time_s, state in self.changes if time_s <= start_s]
        return {before[-1], *(s for time_s, s in self.changes if start_s < time_s < end_s)}


Ended = tuple[RunSummary | str, tuple[str, ...], Truth]
Report = Callable[[StepReport], None]


def measured(
    fault: Fault, path: Path, resume: bool = False, callbacks: acquire.Callbacks | None = None
) -> Ended:
    """Run a sweep; return its summary or why it stopped, what is not confirmed, and the truth.

    Parameters
    ----------
    fault : Fault
    path : Path
    resume : bool
    callbacks : Callbacks, optional
        As for `acquire.run`.
    """
    labs: list[SimulatedLab] = []
    given = callbacks or acquire.Callbacks()

    def reported(step: StepReport) -> None:
        if fault.amid and step.done == _AMID_STEPS and step.attempt == 1:
            fault.amid(benches[-1])
        given.step(step)

    benches: list[Bench] = []
    calls = replace(given, step=reported)
    ended: RunSummary | str
    with _benches_seen(fault, benches, labs):
        try:
            if resume:
                ended = acquire.resume(planned(fault), path, callbacks=calls).summary
            else:
                plan = planned(fault)
                ended = acquire.run(plan, path, reed="faults", seed=1, callbacks=calls).summary
            notes = ended.unconfirmed
        except BenchError as error:
            ended, notes = str(error), error.unconfirmed
    return ended, notes, Truth.of(labs[-1] if labs else None)


@contextmanager
def _benches_seen(fault: Fault, benches: list[Bench], labs: list[SimulatedLab]) -> Any:
    """Let a fault strike every bench that a script opens, and remember its laboratory."""

    def opening(*asked: Any, **more: Any) -> Bench:
        bench = open_bench(*asked, **more)
        camera: Any = bench.camera
        benches.append(bench)
        labs.append(camera.lab)
        if fault.strike:
            fault.strike(bench)
        return bench

    with patch.object(run_session, "open_bench", opening):
        yield


def struck(fault: Fault, folder: Path) -> Outcome:
    """Run a sweep, let the fault strike, and ask the laboratory what really was."""
    path = folder / f"{abs(hash(fault.name))}.h5"
    return outcome_of(fault, path, measured(fault, path))


def outcome_of(fault: Fault, path: Path, what: Ended) -> Outcome:
    """Compare what a run file says with the truth."""
    ended, unconfirmed, truth = what
    steps: tuple[StepRecord, ...] = ()
    earlier_attempts: tuple[StepRecord, ...] = ()
    if path.exists():
        with Run.open(path) as opened:
            steps, earlier_attempts = opened.steps, opened.earlier_attempts
    good = [step for step in steps if step.verdict is Verdict.OK]
    bad = [step for step in steps if step.verdict not in (Verdict.OK, Verdict.PENDING)]
    exposure_s = float(planned(fault).protocol.exposure_s)
    complete = isinstance(ended, RunSummary) and ended.status == "complete"
    return Outcome(
        ending="complete" if complete else "stopped",
        reason=ended if isinstance(ended, str) else ended.reason,
        good=len(good),
        bad=len(bad),
        repeated=len(earlier_attempts),
        wrong=sum(not as_planned(step, truth, exposure_s) for step in good),
        sentences=tuple(f"{step.verdict}: {step.sentence}" for step in (*earlier_attempts, *bad)),
        off=truth.off,
        unconfirmed=unconfirmed,
    )


def as_planned(step: StepRecord, truth: Truth, exposure_s: float) -> bool:
    """Whether the laboratory played a step's settings, and no others, during all its exposures."""
    frames = zip(step.frame_ids, step.timestamps_s, strict=True)
    began_s = [truth.exposed_s.get(frame) for frame in frames]
    if None in began_s:
        return False
    states = {
        s
        for start_s in began_s
        for s in truth.during(start_s or 0.0, (start_s or 0.0) + exposure_s)
    }
    if len(states) != 1:
        return False
    (state,) = states
    return (
        state.difference_hz == step.difference_hz
        and state.drive_hz == step.drive_hz
        and abs(state.drive_v - step.volts) <= _VOLTS_SHARE * step.volts
        and state.rf_on
    )


def as_expected(fault: Fault, outcome: Outcome) -> bool:
    """Whether a fault had the outcome that the table expects."""
    said = (outcome.reason, *outcome.sentences)
    complete = outcome.ending == "complete"
    return (
        outcome.wrong == 0
        and outcome.ending == fault.ending
        and (not fault.said or any(fault.said in sentence for sentence in said))
        and (outcome.bad == 0 or not complete or not fault.all_good)
        and (outcome.off or fault.unconfirmed)
        and bool(outcome.unconfirmed) == fault.unconfirmed
    )


def calm_like(fault: Fault) -> Fault:
    """Return a fault that does nothing, for a sweep with the settings of another."""
    return replace(fault, said="", faults={}, unconfirmed=False, strike=None, amid=None)
