"""What becomes of a run on the wire bench when something goes wrong: a table of faults.

Every fault strikes in the middle of a small sweep that runs through the real drivers of Novatech
and Siglent (``benches/wire.yaml``). Afterwards the laboratory itself is asked what it really
played during each exposure: a step that is marked good must have had the frequencies and the volts
of the plan from the first frame to the last. Then either the sweep is complete, or it stopped with
all off (or said what could not be confirmed) and told why.

    python -m benchmarks.faults [--json]
"""

import argparse
import ctypes
import json
import multiprocessing
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from acquire import script
from acquire.bench_file import BenchFile
from acquire.plan import Plan
from acquire.quality import Verdict
from acquire.recorder import StepReport
from acquire.runfile import Run, StepRecord
from acquire.runner import RunSummary, run
from drivers.registry import open_bench
from drivers.roles import Bench
from drivers.simulated.lab import SimulatedLab
from holography.errors import BenchError
from physics.bench import BenchState

# A step's volts as the generator can say them, six digits.
_VOLTS_SHARE = 1e-5
_SMALL = {"camera.width": 160, "camera.height": 128, "sweep.first": 14, "sweep.last": 32}

Ending = Literal["complete", "stopped"]


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong, and what is to become of the run.

    Attributes
    ----------
    name : str
    ending : {'complete', 'stopped'}
        Whether the sweep is to be completed, or to stop and say why.
    told : str
        Words of the reason of a run that stopped, or of the verdict of a step that was mended.
    faults : mapping
        Of the twin, see `drivers.simulated.twin.Faults`.
    protocol : mapping
        Changes of the protocol by key path.
    unconfirmed : bool
        Whether switching off cannot be confirmed, and has to say so.
    strike, amid : callable, optional
        Done to the open bench before the run, and after its fourth step.
    """

    name: str
    ending: Ending
    told: str
    faults: Mapping[str, Any] = field(default_factory=dict)
    protocol: Mapping[str, Any] = field(default_factory=dict)
    unconfirmed: bool = False
    strike: Callable[[Bench], None] | None = None
    amid: Callable[[Bench], None] | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of a run.

    Attributes
    ----------
    ending : str
    reason : str
        Why it stopped; empty if it did not.
    good, bad, retaken : int
        Steps by verdict, and takes that were taken again.
    wrong : int
        Steps marked good whose exposures were not those of the plan. More than 0 is never right.
    sentences : tuple of str
        Verdicts and sentences of all takes that are not good.
    off : bool
        Whether nothing is played at the end.
    unconfirmed : tuple of str
        What the run said that it could not confirm.
    """

    ending: str
    reason: str
    good: int
    bad: int
    retaken: int
    wrong: int
    sentences: tuple[str, ...]
    off: bool
    unconfirmed: tuple[str, ...]


def _wire(name: str, **faults: Any) -> dict[str, Any]:
    return {f"{name}_wire": faults}


def _clamp(bench: Bench) -> None:
    """Let the simulated generator clamp where the sweep has not come to yet, without a word."""
    generator: Any = bench.generator
    generator.device.clamp_at(0.6)


def _trip(bench: Bench) -> None:
    """Let the generator's protection take its output off."""
    generator: Any = bench.generator
    generator.device.trip()


RETRY = {"policy.instrument_error": {"retry": 2, "then": "stop"}}
SKIP = {"policy.instrument_error": {"retry": 0, "then": "skip"}}
# Commands and answers are counted from the opening on; these lie amid the sweep, behind the ramp.
AMID, AMID_GENERATOR = 40, 100
# Commands of the generator that set a frequency and volts, and are answered by no one.
SETTING = 116
_AMID_STEPS = 4
_PATIENCE_S = 0.5
# Linux' flags of unshare.
_NEW_MOUNTS, _NEW_USER = 0x00020000, 0x10000000

FAULTS = (
    Fault("nothing", "complete", ""),
    Fault("synthesizers: reply lost", "complete", "", _wire("synthesizers", lose_answer_at=[AMID])),
    Fault(
        "synthesizers: command lost", "complete", "", _wire("synthesizers", lose_command_at=[AMID])
    ),
    Fault(
        "synthesizers: reply garbled",
        "complete",
        "",
        _wire("synthesizers", garble_answer_at=[AMID, AMID + 7]),
    ),
    Fault(
        "synthesizers: reply late",
        "complete",
        "",
        _wire("synthesizers", late_answer_at=[AMID], late_s=0.8),
    ),
    Fault("synthesizers: echo on", "complete", "", _wire("synthesizers", echo=True)),
    Fault("synthesizers: wrong baud", "stopped", "baud", _wire("synthesizers", wrong_baud=True)),
    Fault(
        "synthesizers: port unplugged",
        "stopped",
        "synthesizers",
        _wire("synthesizers", unplug_at=AMID),
        unconfirmed=True,
    ),
    Fault(
        "generator: reply lost", "complete", "", _wire("generator", lose_answer_at=[AMID_GENERATOR])
    ),
    Fault(
        "generator: question lost",
        "complete",
        "",
        _wire("generator", lose_command_at=[SETTING + 1]),
    ),
    Fault(
        "generator: command lost", "stopped", "says", _wire("generator", lose_command_at=[SETTING])
    ),
    Fault(
        "generator: command lost, policy retry",
        "complete",
        "",
        _wire("generator", lose_command_at=[SETTING]),
        RETRY,
    ),
    Fault(
        "generator: reply garbled",
        "complete",
        "",
        _wire("generator", garble_answer_at=[AMID_GENERATOR]),
    ),
    Fault(
        "generator: reply late",
        "complete",
        "",
        _wire("generator", late_answer_at=[AMID_GENERATOR], late_s=1.2),
    ),
    Fault(
        "generator: cable pulled",
        "stopped",
        "generator",
        _wire("generator", unplug_at=AMID_GENERATOR),
        unconfirmed=True,
    ),
    Fault("generator: silent clamp", "stopped", "limit itself", strike=_clamp),
    Fault("generator: output trips", "stopped", "its output is off", amid=_trip),
    Fault("frame dropped", "complete", "dropped", {"drop_frame_at": [4]}),
    Fault("frame duplicated", "complete", "dropped", {"duplicate_frame_at": [4]}),
    Fault("frames reordered", "complete", "disordered", {"reorder_frames_at": [4]}),
    Fault("frame half filled", "complete", "partial", {"partial_frame_at": [4]}),
    Fault("frame late", "complete", "disordered", {"late_frame_at": [4]}),
    Fault("frames stale", "complete", "stale", {"stale_frame_at": [4]}),
    Fault("camera's clock jumps ahead", "complete", "disordered", {"clock_jump_at": 4}),
    Fault(
        "camera's clock jumps back",
        "complete",
        "disordered",
        {"clock_jump_at": 4, "clock_jump_s": -0.5},
    ),
    Fault("trigger missing", "stopped", "trigger", {"no_frame_from": 4}),
    Fault("trigger missing, policy skip", "complete", "skipped", {"no_frame_from": 9}, SKIP),
)


def planned(fault: Fault) -> Plan:
    """Plan of the sweep that a fault strikes."""
    twin = {"mesh": "coarse", "faults": dict(fault.faults)}
    bench = BenchFile.from_file("wire").replace({"twin": twin})
    # The software of a camera maker is no part of what is tried here.
    bench = bench.replace(
        {
            "instruments.camera.driver": "simulated",
            "instruments.synthesizers.options.timeout_s": 0.5,
            "instruments.generator.options.timeout_s": 0.8,
        }
    )
    return script.plan(script.load("quick").replace({**_SMALL, **fault.protocol}), bench)


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

    @property
    def off(self) -> bool:
        """Whether nothing is played at the end."""
        return not self.changes or not (self.changes[-1][1].rf_on or self.changes[-1][1].drive_v)

    def during(self, start_s: float, end_s: float) -> set[BenchState]:
        """All settings that there were in a stretch of time."""
        before = [state for time_s, state in self.changes if time_s <= start_s]
        return {before[-1], *(s for time_s, s in self.changes if start_s < time_s < end_s)}


Ended = tuple[RunSummary | str, tuple[str, ...], Truth]


def measured(fault: Fault, path: Path, resume: bool = False) -> Ended:
    """Run a sweep; return its summary or why it stopped, what is not confirmed, and the truth."""
    plan, lab = planned(fault), None
    ended: RunSummary | str
    notes: tuple[str, ...]
    try:
        with open_bench(plan.bench, plan.preparation("faults"), seed=1) as bench:
            lab = _lab_of(bench)
            if fault.strike:
                fault.strike(bench)
            reported = partial(_amid, fault, bench)
            ended = run(plan, bench, path, progress=reported, resume=resume)
            notes = ended.unconfirmed
    except BenchError as error:
        said = getattr(error, "__notes__", ())
        ended, notes = str(error), tuple(n for n in said if n.startswith("not confirmed"))
    return ended, notes, Truth(lab.changes, lab.exposed_s) if lab else Truth()


def _amid(fault: Fault, bench: Bench, report: StepReport) -> None:
    if fault.amid and report.done == _AMID_STEPS and report.take == 1:
        fault.amid(bench)


def _lab_of(bench: Bench) -> SimulatedLab:
    camera: Any = bench.camera
    lab: SimulatedLab = camera.lab
    return lab


def struck(fault: Fault, folder: Path) -> Outcome:
    """Run a sweep, let the fault strike, and ask the laboratory what really was."""
    path = folder / f"{FAULTS.index(fault)}.h5"
    return outcome_of(fault, path, measured(fault, path))


def outcome_of(fault: Fault, path: Path, what: Ended) -> Outcome:
    """Set what a run file says beside the truth."""
    ended, unconfirmed, truth = what
    steps: tuple[StepRecord, ...] = ()
    retakes: tuple[StepRecord, ...] = ()
    if path.exists():
        with Run.open(path) as opened:
            steps, retakes = opened.steps, opened.retakes
    good = [step for step in steps if step.verdict is Verdict.OK]
    bad = [step for step in steps if step.verdict not in (Verdict.OK, Verdict.PENDING)]
    exposure_s = float(planned(fault).protocol.exposure_s)
    complete = isinstance(ended, RunSummary) and ended.status == "complete"
    return Outcome(
        ending="complete" if complete else "stopped",
        reason=ended if isinstance(ended, str) else "",
        good=len(good),
        bad=len(bad),
        retaken=len(retakes),
        wrong=sum(not as_planned(step, truth, exposure_s) for step in good),
        sentences=tuple(f"{step.verdict}: {step.sentence}" for step in (*retakes, *bad)),
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


# --- Faults that strike a whole process --------------------------------------------------------


def _child(fault: Fault, path: Path, disk_bytes: int | None, resume: bool, report: Any) -> None:
    """Run a sweep in this process, and send how it ended."""
    # The wires' far ends are threads of this process, and there may be no others before it forks.

    def tell(what: str) -> Callable[[Bench], None]:
        return lambda _: report.send(what)

    def tell_and_wait(bench: Bench) -> None:
        if fault.amid is not None:
            fault.amid(bench)
        # The sweep waits for its pictures to be kept: time for somebody to do something to it.
        report.send("amid")
        time.sleep(_PATIENCE_S)

    struck = replace(fault, strike=tell("measuring"), amid=tell_and_wait)
    if disk_bytes is None:
        report.send(measured(struck, path, resume))
    else:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
            if not _mount_small_disk(name, disk_bytes):
                report.send("measuring")
                os._exit(0)
            filled = replace(struck, amid=lambda _: _fill_disk(Path(name, "filler")))
            ended = measured(filled, Path(name, path.name))
            shutil.copy(Path(name, path.name), path)
            report.send(ended)
    # Not by way of HDF5, which would complain of what it cannot write to a disk that is full.
    os._exit(0)


def _fill_disk(path: Path) -> None:
    """Write until the disk is full, as another program might."""
    with suppress(OSError), path.open("wb", buffering=0) as file:
        while file.write(bytes(65536)):
            pass


def _mount_small_disk(folder: str, size_bytes: int) -> bool:
    """Put a disk of a size on a folder, for this process alone; return whether that is allowed."""
    library, user, group = ctypes.CDLL(None, use_errno=True), os.getuid(), os.getgid()
    if library.unshare(_NEW_MOUNTS | _NEW_USER):
        return False
    with suppress(OSError):
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
        Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    options = f"size={size_bytes}".encode()
    return bool(library.mount(b"tmpfs", folder.encode(), b"tmpfs", 0, options) == 0)


@dataclass
class Process:
    """A sweep in a process of its own.

    Attributes
    ----------
    fault : Fault
    path : Path
        Of its run file.
    """

    fault: Fault
    path: Path
    _process: Any
    _reports: Any

    @classmethod
    def begin(
        cls, fault: Fault, path: Path, disk_bytes: int | None = None, resume: bool = False
    ) -> "Process":
        """Start a sweep, and return once its bench is open."""
        reports, sends = multiprocessing.Pipe(duplex=False)
        process = multiprocessing.get_context("fork").Process(
            target=_child, args=(fault, path, disk_bytes, resume, sends)
        )
        process.start()
        sends.close()
        reports.recv()
        return cls(fault, path, process, reports)

    def wait_till_amid(self) -> None:
        """Wait until the fourth step is kept."""
        self._reports.recv()

    def signal(self, number: signal.Signals) -> None:
        """Send the process a signal."""
        os.kill(self._process.pid, number)

    def outcome(self) -> Outcome | None:
        """Wait for the end; None if it was killed."""
        ended: Any = "amid"
        while isinstance(ended, str):
            try:
                ended = self._reports.recv()
            except EOFError:
                ended = None
        self._process.join()
        return outcome_of(self.fault, self.path, ended) if ended else None


def _set_clock_back(_: Bench) -> None:
    """Let this process's clock on the wall be an hour slow from now on."""
    right = time.time
    time.time = lambda: right() - 3600.0


CALM = FAULTS[0]
FRAMES = replace(CALM, protocol={"keep": "frames"})


def clock_set_back(folder: Path) -> Outcome:
    """Set the computer's clock back by an hour during a run; time stamps are for people only."""
    return _required(
        Process.begin(replace(CALM, amid=_set_clock_back), folder / "clock.h5").outcome()
    )


def signalled(number: signal.Signals, folder: Path) -> Outcome:
    """Send a signal to a process that measures."""
    process = Process.begin(CALM, folder / f"{number.name}.h5")
    process.wait_till_amid()
    process.signal(number)
    return _required(process.outcome())


def full_disk(folder: Path) -> Outcome | None:
    """Let another program fill the disk during a run; None where no disk can be made for that."""
    disk_bytes = planned(FRAMES).largest_size_bytes + 3_000_000
    return Process.begin(FRAMES, folder / "full.h5", disk_bytes).outcome()


def locked(folder: Path) -> tuple[str, Outcome]:
    """Try to go on with a run that another process measures; return what is said of that."""
    process = Process.begin(CALM, folder / "locked.h5")
    process.wait_till_amid()
    said = ""
    try:
        script.resume(planned(CALM), process.path)
    except BenchError as error:
        said = str(error)
    return said, _required(process.outcome())


@dataclass(frozen=True)
class Kills:
    """What became of runs whose process was killed, and that another went on with.

    The first two were killed amid the sweep, the others at random instants.

    Attributes
    ----------
    kills, resumed : int
        Runs killed; those that had begun and were completed afterwards.
    finished : tuple of int
        Steps that each of them had when it was killed.
    damaged, wrong, bad : int
        Steps of before that are not, bit for bit, those of an undisturbed run; steps of afterwards
        marked good but not as planned; steps that are not good.
    """

    kills: int
    resumed: int
    finished: tuple[int, ...]
    damaged: int
    wrong: int
    bad: int


def killed(kills: int, folder: Path, seed: int = 0) -> Kills:
    """Kill runs at random instants, and go on with each of them."""
    rng, finished = np.random.default_rng(seed), []
    damaged = wrong = bad = resumed = 0
    started_s = time.monotonic()
    expected = {fault.name: _undisturbed(fault, folder) for fault in (CALM, FRAMES)}
    longest_s = 0.5 * (time.monotonic() - started_s)
    for number in range(kills):
        fault = FRAMES if number % 2 else CALM
        process = Process.begin(fault, folder / f"killed{number}.h5")
        if number < 2:
            process.wait_till_amid()
        else:
            time.sleep(rng.uniform(0.0, longest_s))
        process.signal(signal.SIGKILL)
        process.outcome()
        if not process.path.exists():
            continue
        before = _good_fields(process.path)
        finished.append(len(before))
        with Run.open(process.path) as opened:
            if opened.status == "complete":
                continue
        outcome = _required(Process.begin(fault, process.path, resume=True).outcome())
        resumed += outcome.ending == "complete"
        after = _good_fields(process.path)
        damaged += sum(not np.array_equal(expected[fault.name][k], after[k]) for k in before)
        # Of the process that was killed nothing is known but that what it kept is undisturbed.
        wrong, bad = wrong + outcome.wrong - len(before), bad + outcome.bad
    return Kills(kills, resumed, tuple(finished), damaged, wrong, bad)


def _undisturbed(fault: Fault, folder: Path) -> dict[int, Any]:
    path = folder / f"undisturbed {fault.name}.h5"
    measured(fault, path)
    return _good_fields(path)


def _good_fields(path: Path) -> dict[int, Any]:
    with Run.open(path) as opened:
        return {k: opened.field(k) for k, good in enumerate(opened.good) if good}


def _required(outcome: Outcome | None) -> Outcome:
    if outcome is None:
        raise SystemExit("a process ended without a word")
    return outcome


# --- All of it ---------------------------------------------------------------------------------


def as_expected(fault: Fault, outcome: Outcome) -> bool:
    """Whether a fault had the outcome that the table expects."""
    said = (outcome.reason, *outcome.sentences)
    return (
        outcome.wrong == 0
        and outcome.ending == fault.ending
        and (not fault.told or any(fault.told in sentence for sentence in said))
        and (outcome.off or fault.unconfirmed)
        and bool(outcome.unconfirmed) == fault.unconfirmed
    )


def process_faults(folder: Path) -> dict[str, tuple[Fault, Outcome]]:
    """Faults that strike a whole process, with what is expected of them."""
    ended = replace(CALM, ending="stopped", told="")
    said, calm = locked(folder)
    full, filled = replace(CALM, ending="stopped", told="make room"), full_disk(folder)
    rows = {
        "SIGINT": (ended, signalled(signal.SIGINT, folder)),
        "SIGTERM": (ended, signalled(signal.SIGTERM, folder)),
        "computer's clock set back": (CALM, clock_set_back(folder)),
        f"file locked ({said.rpartition('; ')[2]})": (CALM, calm),
    }
    return rows if filled is None else rows | {"disk full": (full, filled)}


def benchmark(kills: int) -> dict[str, Any]:
    """Let every fault strike; the result is what ``--json`` prints."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = {fault.name: (fault, struck(fault, folder)) for fault in FAULTS}
        rows |= process_faults(folder)
        after_kills = killed(kills, folder)
    return {
        "faults": [
            {"fault": name, "as_expected": as_expected(*row), **asdict(row[1])}
            for name, row in rows.items()
        ],
        "kills": asdict(after_kills),
        "met": all(as_expected(*row) for row in rows.values())
        and after_kills.damaged == after_kills.wrong == after_kills.bad == 0,
    }


def print_report(report: dict[str, Any]) -> None:
    """Print a benchmark for people."""
    print(
        f"{'fault':38} {'ending':9} {'good':>4} {'bad':>4} {'again':>5} {'WRONG':>5}  what was said"
    )
    for row in report["faults"]:
        said = row["reason"] or "; ".join(row["sentences"]) or "-"
        mark = " " if row["as_expected"] else "!"
        print(
            f"{row['fault']:38.38}{mark}{row['ending']:9} {row['good']:4} {row['bad']:4} "
            f"{row['retaken']:5} {row['wrong']:5}  {said:.120}"
        )
        for line in row["unconfirmed"]:
            print(f"{'':40}not confirmed: {line:.110}")
    kills = report["kills"]
    print(
        f"SIGKILL at {kills['kills']} random instants, on every second run with frames kept: "
        f"{len(kills['finished'])} files, all open; {kills['resumed']} gone on with to the end; "
        f"steps damaged: {kills['damaged']}, marked good but wrong: {kills['wrong']}"
    )
    print(f"every outcome as expected, no wrong data marked good: {_verdict(report['met'])}")


def _verdict(met: bool) -> str:
    return "met" if met else "missed"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="What becomes of runs when things go wrong.")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    report = benchmark(arguments.kills)
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_report(report)


if __name__ == "__main__":
    main()
