"""What strikes a whole process that measures: signals, full disks, kills, other programs."""

import ctypes
import multiprocessing
import os
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import acquire
from benchmarks.striking import struck
from benchmarks.striking.fault_list import NO_FAULT, Fault
from benchmarks.striking.struck import Outcome, measured, outcome_of, planned
from drivers.context import BenchContext
from drivers.emulators.instruments import EmulatedSiglent
from holography.errors import BenchError
from protocols.bench import Generator
from protocols.plan import Plan
from runs.reader import Run

_PATIENCE_S = 0.5
# Linux' flags of unshare.
_NEW_MOUNTS, _NEW_USER = 0x00020000, 0x10000000
_STRUCK = "REEDBENCH_BENCHMARK_SIGNAL"
# A signal is no timing: on a busy machine, answers are as late as they like.
PATIENT = replace(
    NO_FAULT,
    bench={f"instruments.{role}.options.timeout_s": 20.0 for role in ("synthesizers", "generator")},
)
FRAMES = replace(PATIENT, name="frames kept", protocol={"keep": "frames"})
# One step is spoilt, and measured again after the last.
REPEATED = replace(PATIENT, name="a step again", faults={"drop_frame_at": [3]})

PHASES = ("opening", "sweep", "pause", "repeat", "packing")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class StruckSiglent(EmulatedSiglent):
    """The generator of the emulated bench; a signal strikes its process while it is opened."""

    def __init__(self, entry: Generator, context: BenchContext) -> None:
        os.kill(os.getpid(), int(os.environ[_STRUCK]))
        super().__init__(entry, context)


def _strike(number: int) -> None:
    os.kill(os.getpid(), number)


def _phase_arguments(number: int, phase: str) -> tuple[Fault, acquire.Callbacks]:
    """Return the sweep, and what to hand to `measured`, for a signal to strike in a phase."""
    match phase:
        case "sweep":
            return replace(PATIENT, amid=lambda _: _strike(number)), acquire.Callbacks()
        case "pause":
            paused = replace(PATIENT, amid=lambda _: _strike(signal.SIGUSR1))
            return paused, acquire.Callbacks(
                announce=lambda said: _strike(number) if "paused" in said else None
            )
        case "repeat":
            return REPEATED, acquire.Callbacks(
                step=lambda step: _strike(number) if step.attempt == 2 else None
            )
        case "packing":
            return FRAMES, acquire.Callbacks(packing=lambda _: _strike(number))
    os.environ[_STRUCK] = str(int(number))
    return replace(PATIENT, name="opening"), acquire.Callbacks()


def _signalled(number: int, phase: str, path: Path, report: Any) -> None:
    fault, calls = _phase_arguments(number, phase)
    if phase == "opening":

        def struck_plan(asked: Fault) -> Plan:
            plan = planned(asked)
            driver = f"{StruckSiglent.__module__}:{StruckSiglent.__name__}"
            bench = plan.bench.replace({"instruments.generator.driver": driver})
            return acquire.plan(plan.protocol, bench).plan

        with patch.object(struck, "planned", struck_plan):
            report.send(measured(fault, path, callbacks=calls))
        return
    report.send(measured(fault, path, callbacks=calls))


def signalled(number: int, phase: str, folder: Path) -> Outcome:
    """Send a signal to a process that measures, in one phase of its run.

    Returns
    -------
    Outcome
        ``off`` is that of the laboratory in that process.
    """
    path = folder / f"{signal.Signals(number).name} {phase}.h5"
    fault = {"repeat": REPEATED, "packing": FRAMES}.get(phase, PATIENT)
    return outcome_of(fault, path, _in_a_process(_signalled, number, phase, path))


def _in_a_process(work: Callable[..., None], *arguments: Any) -> Any:
    """Do something in a process of its own, and return what it reports."""
    reports, sends = multiprocessing.Pipe(duplex=False)
    context = multiprocessing.get_context("fork")
    process = context.Process(target=_worked, args=(work, arguments, sends))
    process.start()
    sends.close()
    try:
        return reports.recv()
    except EOFError:
        raise SystemExit(f"{work.__name__}{arguments}: the process ended without a word") from None
    finally:
        process.join()


def _worked(work: Callable[..., None], arguments: tuple[Any, ...], sends: Any) -> None:
    work(*arguments, sends)
    # Not by way of HDF5, which would complain of what it cannot write to a disk that is full.
    os._exit(0)


# --- Two signals while every reply is slow -----------------------------------------------------

# Slow, but within the two seconds for which the drivers wait.
_SLOW_S, _TIMEOUT_S = 1.0, 2.0


def _impatient(path: Path, report: Any) -> None:
    """Send two SIGINT while replies are slow; report when the laboratory was off after them."""
    faults = {
        f"{name}_wire": {"slow_s": _SLOW_S, "slow_from": first}
        for name, first in (("synthesizers", 40), ("generator", 100))
    }
    patient = {
        f"instruments.{role}.options.timeout_s": _TIMEOUT_S
        for role in ("synthesizers", "generator")
    }
    struck_s: list[float] = []

    def twice(bench: Any) -> None:
        # Amid the setting of the next step, whose replies are slow.
        time.sleep(_PATIENCE_S)
        _strike(signal.SIGINT)
        # The system makes one signal of two that come at the same moment.
        time.sleep(0.1)
        struck_s.append(bench.clock.now_s())
        _strike(signal.SIGINT)

    twin = {"pace": "realtime"}
    fault = replace(NO_FAULT, faults=faults, bench=patient, twin=twin, amid=twice)
    _, left, truth = measured(fault, path)
    off_s = [
        time_s
        for time_s, state in truth.changes
        if time_s > struck_s[0] and not (state.rf_on or state.drive_v)
    ]
    report.send((min(off_s, default=np.inf) - struck_s[0], truth.off, left))


def impatience(folder: Path) -> tuple[float, bool, tuple[str, ...]]:
    """Seconds from the second SIGINT until all was off, whether it was, and what is unconfirmed."""
    seconds, off, left = _in_a_process(_impatient, folder / "impatient.h5")
    return seconds, off, left


# --- Disks -------------------------------------------------------------------------------------


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


def _on_a_small_disk(phase: str, path: Path, report: Any) -> None:
    """Measure while another program fills the disk: at the beginning, amid, or while packing."""
    disk_bytes = planned(FRAMES).largest_size_bytes + 3_000_000
    if phase == "packing":
        disk_bytes *= 2
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        if not _mount_small_disk(name, disk_bytes):
            report.send(None)
            return
        filler, place = Path(name, "filler"), Path(name, path.name)
        fault, calls = FRAMES, acquire.Callbacks()
        if phase == "beginning":
            _fill_disk(filler)
        elif phase == "amid":
            fault = replace(FRAMES, amid=lambda _: _fill_disk(filler))
        else:
            calls = acquire.Callbacks(packing=lambda _: _fill_disk(filler))
        ended = measured(fault, place, callbacks=calls)
        if place.exists():
            path.write_bytes(place.read_bytes())
        report.send(ended)


def full_disk(folder: Path, phase: str = "amid") -> Outcome | None:
    """Let another program fill the disk; None where no disk can be made for that."""
    path = folder / f"full {phase}.h5"
    ended = _in_a_process(_on_a_small_disk, phase, path)
    return ended and outcome_of(FRAMES, path, ended)


# --- Clocks, other programs, kills -------------------------------------------------------------


def _set_clock_back(path: Path, report: Any) -> None:
    right = time.time

    def back(_: Any) -> None:
        time.time = lambda: right() - 3600.0

    report.send(measured(replace(NO_FAULT, amid=back), path))


def clock_set_back(folder: Path) -> Outcome:
    """Set the computer's clock back by an hour during a run; time stamps are for people only."""
    path = folder / "clock.h5"
    return outcome_of(NO_FAULT, path, _in_a_process(_set_clock_back, path))


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
    def begin(cls, fault: Fault, path: Path, resume: bool = False) -> "Process":
        """Start a sweep, and return once its bench is open."""
        reports, sends = multiprocessing.Pipe(duplex=False)
        process = multiprocessing.get_context("fork").Process(
            target=_child, args=(fault, path, resume, sends)
        )
        process.start()
        sends.close()
        reports.recv()
        return cls(fault, path, process, reports)

    def wait_till_amid(self) -> None:
        """Wait until the fourth step is kept."""
        self._reports.recv()

    def kill(self) -> None:
        """End the process without a chance to do anything."""
        os.kill(self._process.pid, signal.SIGKILL)

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


def _child(fault: Fault, path: Path, resume: bool, report: Any) -> None:
    """Run a sweep in this process, and send how it ended."""

    def tell_and_wait(_: Any) -> None:
        # The sweep waits for its pictures to be kept: time to disturb it.
        report.send("amid")
        time.sleep(_PATIENCE_S)

    struck = replace(fault, strike=lambda _: report.send("measuring"), amid=tell_and_wait)
    report.send(measured(struck, path, resume))
    os._exit(0)


def locked(folder: Path) -> tuple[str, Outcome]:
    """Try to go on with a run that another process measures; return what is said of that."""
    process = Process.begin(NO_FAULT, folder / "locked.h5")
    process.wait_till_amid()
    said = ""
    try:
        acquire.resume(planned(NO_FAULT), process.path)
    except BenchError as error:
        said = str(error)
    outcome = process.outcome()
    if outcome is None:
        raise SystemExit("a process ended without a word")
    return said, outcome


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
    left : int
        Files of the killed runs that are there after they were completed, besides the run file and
        its documents.
    """

    kills: int
    resumed: int
    finished: tuple[int, ...]
    damaged: int
    wrong: int
    bad: int
    left: int


def killed(kills: int, folder: Path, seed: int = 0) -> Kills:
    """Kill runs at random instants, and go on with each of them."""
    rng, finished = np.random.default_rng(seed), []
    damaged = wrong = bad = resumed = left = 0
    started_s = time.monotonic()
    expected = {fault.name: _undisturbed(fault, folder) for fault in (NO_FAULT, FRAMES)}
    longest_s = 0.5 * (time.monotonic() - started_s)
    for number in range(kills):
        fault = FRAMES if number % 2 else NO_FAULT
        process = Process.begin(fault, folder / f"killed{number}.h5")
        if number < 2:
            process.wait_till_amid()
        else:
            time.sleep(rng.uniform(0.0, longest_s))
        process.kill()
        process.outcome()
        if not process.path.exists():
            # Killed before its file had its name; the name is free all the same.
            acquire.run(planned(fault), process.path, reed="faults", seed=1)
        before = _good_fields(process.path)
        finished.append(len(before))
        with Run.open(process.path) as opened:
            complete = opened.status == "complete"
        if not complete:
            outcome = Process.begin(fault, process.path, resume=True).outcome()
            if outcome is None:
                raise SystemExit("a process ended without a word")
            resumed += outcome.ending == "complete"
            # Of the killed process nothing is known but that what it kept is undisturbed.
            wrong, bad = wrong + outcome.wrong - len(before), bad + outcome.bad
        after = _good_fields(process.path)
        damaged += sum(not np.array_equal(expected[fault.name][k], after[k]) for k in before)
        mine = {process.path, process.path.with_suffix(".documents.jsonl")}
        left += len(set(folder.glob(f"*killed{number}.*")) - mine)
    return Kills(kills, resumed, tuple(finished), damaged, wrong, bad, left)


def _undisturbed(fault: Fault, folder: Path) -> dict[int, Any]:
    path = folder / f"undisturbed {fault.name}.h5"
    measured(fault, path)
    return _good_fields(path)


def _good_fields(path: Path) -> dict[int, Any]:
    with Run.open(path) as opened:
        return {k: opened.field(k) for k, good in enumerate(opened.good) if good}
