"""Many runs in one process, and what memory, files and threads it has after each."""

import contextlib
import ctypes
import gc
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import acquire
from benchmarks.striking.fault_list import NO_FAULT, Fault
from benchmarks.striking.struck import planned
from fitting.cane.fit_runs import fit_runs
from holography.errors import BenchError
from protocols.bench import BenchFile
from protocols.plan import Plan

WARM_UP = 5
# Growth per run that counts as a leak. Memory: chosen, a sixth of the frames of one of these runs
# (1.6 MB), and 1 % of what the process has after a thousand of them. Files and threads are whole
# numbers: one that is left in 20 runs is seen.
LIMITS = {"memory_bytes": 250e3, "files": 0.02, "threads": 0.02, "tasks": 0.02}
# A slope is a leak if it is above its limit by more than this many standard errors: chosen, one
# series in 40 would be by chance.
_ERRORS = 2.0
# A thread that was joined may still be listed by Linux for some microseconds.
_GRACE_S = 0.02
_SEED = 260_616
# Steps enough for two modes, so that there is something to fit.
_FITTED = {"sweep.last": 107}


@dataclass(frozen=True)
class Usage:
    """What this process has.

    Attributes
    ----------
    memory_bytes : int
        That lie in memory.
    files : int
        Open file descriptors, of sockets and wires too.
    threads, tasks : int
        Threads that Python knows, and that Linux knows.
    """

    memory_bytes: int
    files: int
    threads: int
    tasks: int

    @classmethod
    def now(cls) -> "Usage":
        """Look at this process, once it has given back what it does not use.

        Threads come and go in every run, and glibc keeps pages that they freed in arenas of their
        own for the next ones: by chance some megabytes more or less, and no leak.
        """
        time.sleep(_GRACE_S)
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):
            # malloc_trim(3); other C libraries have none.
            ctypes.CDLL(None).malloc_trim(0)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return cls(
            memory_bytes=pages * os.sysconf("SC_PAGE_SIZE"),
            files=len(os.listdir("/proc/self/fd")),
            threads=len(threading.enumerate()),
            tasks=len(os.listdir("/proc/self/task")),
        )


@dataclass(frozen=True)
class Series:
    """What a process had after each of many runs.

    Attributes
    ----------
    name : str
    usages : tuple of Usage
        After each run that came after those to warm up.
    """

    name: str
    usages: tuple[Usage, ...]

    def values(self, name: str) -> list[int]:
        """One figure after each run."""
        return [getattr(usage, name) for usage in self.usages]

    @property
    def slopes(self) -> dict[str, tuple[float, float]]:
        """Growth of each figure per run, and its standard error."""
        return {name: slope(self.values(name)) for name in LIMITS}

    @property
    def leaks(self) -> list[str]:
        """Figures that grow."""
        return [
            name
            for name, (per_run, error) in self.slopes.items()
            if per_run - _ERRORS * error > LIMITS[name]
        ]


def slope(values: Sequence[float]) -> tuple[float, float]:
    """Fit a line by least squares; return its slope per value and the standard error of that.

    Parameters
    ----------
    values : sequence of float
        At least three.
    """
    y = np.asarray(values, dtype=float)
    x = np.arange(len(y)) - 0.5 * (len(y) - 1)
    per_value = float(x @ y / (x @ x))
    residual = y - y.mean() - per_value * x
    return per_value, float(np.sqrt(residual @ residual / (len(y) - 2) / (x @ x)))


def series(name: str, work: Callable[[], object], runs: int, warm_up: int = WARM_UP) -> Series:
    """Do something many times, and look at this process after each time."""
    usages = []
    for number in range(warm_up + runs):
        work()
        if number >= warm_up:
            usages.append(Usage.now())
    return Series(name, tuple(usages))


def simulated_plan(changes: Mapping[str, Any] | None = None) -> Plan:
    """Plan the small sweep of `benchmarks.striking.struck` on the simulated bench."""
    bench = BenchFile.from_file().replace({"twin": {"mesh": "coarse"}})
    return acquire.plan(planned(NO_FAULT).protocol.replace(dict(changes or {})), bench).plan


def works(folder: Path) -> dict[str, Callable[[], object]]:
    """What is done many times, by name; files go into a folder and are removed."""
    simulated, wire, failing = simulated_plan(), planned(NO_FAULT), failing_plans(folder)
    fitted = folder / "fitted.h5"

    def fit() -> None:
        if not fitted.exists():
            acquire.run(simulated_plan(_FITTED), fitted, reed="R07")
        fit_runs([fitted])

    def fail() -> None:
        for plan in failing:
            _require_failure(plan, folder)

    return {
        "runs on the simulated bench": lambda: _measure(simulated, folder),
        "runs on the emulated bench": lambda: _measure(wire, folder),
        "runs that fail": fail,
        "fits": fit,
    }


def failing_plans(folder: Path) -> tuple[Plan, ...]:
    """Plans of runs that fail: while the bench is opened, amid the sweep, and at its first step."""
    undisturbed = planned(NO_FAULT)
    unknown_port = {
        "instruments.synthesizers.driver": "novatech-409b",
        "instruments.synthesizers.options.port": str(folder / "no-such-port"),
    }
    return (
        acquire.plan(undisturbed.protocol, undisturbed.bench.replace(unknown_port)).plan,
        planned(Fault("cable", "stopped", "generator", {"generator_wire": {"unplug_at": 100}})),
        planned(Fault("trigger", "stopped", "trigger", {"no_frame_from": 1})),
    )


def _measure(plan: Plan, folder: Path) -> None:
    path = folder / "soak.h5"
    try:
        acquire.run(plan, path, reed="R07", seed=_SEED)
    finally:
        for left in folder.glob("soak.*"):
            left.unlink()


def _require_failure(plan: Plan, folder: Path) -> None:
    try:
        _measure(plan, folder)
    except BenchError:
        return
    raise SystemExit("soak: a run that was to fail did not")
