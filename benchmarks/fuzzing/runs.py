"""Mutated run files are read in a process of their own, with limits.

Two small runs are measured on the simulated bench, one that keeps holograms and one that keeps
frames, which are packed. Copies of them are damaged byte by byte, or changed object by object with
h5py. A child process reads each of them as `acquire show`, `list`, `fit` and `resume` do; what it
read must be what the original holds, unless values were changed on purpose.
"""

import ctypes
import json
import os
import random
import resource
import select
import shutil
import signal
import time
from functools import partial
from pathlib import Path

from benchmarks.fuzzing.judging import Outcome, Tally, judged
from benchmarks.fuzzing.run_files import Mutant, compare, decoy_of, originals, shown
from benchmarks.fuzzing.run_objects import mutant_of

# Chosen: the originals take 0.1 s; a child that says nothing is given up after some hundred times
# that, on a machine that others use too.
LIMIT_S = 30.0
# Chosen: the originals need 30 MiB besides the program.
LIMIT_MIB = 300
# Chosen: what no request of a small file comes near, so that one of terabytes fails.
_ADDRESS_SPACE = 16 << 30
# How many files one child reads, unless it dies.
_BATCH = 40


_IN_OPEN, _IN_NONBLOCK = 0x20, 0o4000


class _Watch:
    """Says whether files were opened, through Linux' inotify."""

    def __init__(self, files: list[Path]) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self._descriptor = libc.inotify_init1(_IN_NONBLOCK)
        for file in files:
            libc.inotify_add_watch(self._descriptor, os.fsencode(file), _IN_OPEN)

    def opened(self) -> bool:
        """Whether any was opened since the last question."""
        try:
            return bool(os.read(self._descriptor, 4096))
        except BlockingIOError:
            return False


def _child(mutants: list[Mutant], first: int, said: int) -> None:
    """Read mutants from the `first` on; say what became of each, in a line of JSON."""
    decoys = {decoy_of(mutant.original) for mutant in mutants}
    watch = _Watch([*decoys, *(decoy.with_suffix(".raw") for decoy in decoys)])
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    for number in range(first, len(mutants)):
        mutant = mutants[number]
        os.write(said, f"{number}\n".encode())
        outcome = judged(partial(compare, mutant), mutant.path.name, LIMIT_MIB)
        if watch.opened():
            outcome = Outcome("wrong", f"{mutant.what}: another file was opened", outcome.said)
        line = json.dumps([outcome.kind, outcome.what, outcome.said])
        os.write(said, f"{line}\n".encode())


def read_by_children(mutants: list[Mutant]) -> list[tuple[Outcome, float]]:
    """Outcome of each mutant, and the seconds that it took; a child that dies shows which one."""
    outcomes: list[tuple[Outcome, float]] = []
    while len(outcomes) < len(mutants):
        outcomes += _read_by_child(mutants, len(outcomes))
    return outcomes


def _read_by_child(mutants: list[Mutant], first: int) -> list[tuple[Outcome, float]]:
    heard, said = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(heard)
        try:
            _child(mutants, first, said)
        finally:
            os._exit(0)
    os.close(said)
    outcomes: list[tuple[Outcome, float]] = []
    rest, began = b"", time.perf_counter()
    while True:
        ready, _, _ = select.select([heard], [], [], LIMIT_S)
        data = os.read(heard, 65_536) if ready else b""
        if not data:
            break
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            if line.startswith(b"["):
                outcomes.append((Outcome(*json.loads(line)), time.perf_counter() - began))
            began = time.perf_counter()
    os.close(heard)
    if not ready:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if first + len(outcomes) < len(mutants):
        mutant = mutants[first + len(outcomes)]
        ending = "hangs" if not ready else f"the process ends with {_ending(status)}"
        outcomes.append((Outcome("wrong", f"{mutant.what}: {ending}"), time.perf_counter() - began))
    return outcomes


def _ending(status: int) -> str:
    if os.WIFSIGNALED(status):
        return signal.Signals(os.WTERMSIG(status)).name
    return f"exit status {os.WEXITSTATUS(status)}"


def fuzz_runs(count: int, seed: int, folder: Path, kept: Path | None = None) -> Tally:
    """Read `count` mutated run files.

    Parameters
    ----------
    count, seed : int
    folder : Path
        Where files are written.
    kept : Path, optional
        Where those with a wrong outcome are kept.
    """
    tally, rng, start = Tally("run"), random.Random(f"run {seed}"), time.perf_counter()
    made = originals(folder)
    for original in made:
        decoy = decoy_of(original)
        shutil.copy(original.path, decoy)
        decoy.with_suffix(".raw").write_bytes(decoy.read_bytes())
    while tally.cases < count:
        size = min(_BATCH, count - tally.cases)
        mutants = [
            mutant_of(folder / f"mutant-{tally.cases + number:05}.h5", rng.choice(made), rng)
            for number in range(size)
        ]
        for mutant, (outcome, took_s) in zip(mutants, read_by_children(mutants), strict=True):
            if took_s > tally.slowest_s:
                tally.slowest_s, tally.slowest = took_s, f"{mutant.path.name} {mutant.what}"
            tally.add(outcome, partial(shown, mutant))
            if outcome.kind == "wrong" and kept:
                shutil.copy(mutant.path, kept)
            mutant.path.unlink()
    tally.seconds = time.perf_counter() - start
    return tally
