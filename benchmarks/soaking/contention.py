"""Programs that want the same reed, run file or folder at the same moment."""

import multiprocessing
import os
import re
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from acquire.cli.main import app
from benchmarks.kills import finished_steps, is_complete, is_whole
from benchmarks.soaking.leaks import simulated_plan

# Documents of a run before its first step: start and two descriptors.
_DOCUMENTS_OF_START = 3
_STEPS_BEFORE_KILL = 3
# Chosen: far longer than any of these commands takes; whatever still runs then has hung.
_LONGEST_S = 300.0
_SEED = 260_616


@dataclass(frozen=True)
class Command:
    """One `acquire` command in a process of its own.

    Attributes
    ----------
    arguments : tuple of str
    delay_s : float
        How long after the others it begins.
    environment : mapping
    """

    arguments: tuple[str, ...]
    delay_s: float = 0.0
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes
    ----------
    status : int
        Exit status.
    lines : tuple of str
        What it printed, standard error included.
    """

    status: int
    lines: tuple[str, ...]

    @property
    def errors(self) -> tuple[str, ...]:
        """Lines that say why it failed."""
        return tuple(line for line in self.lines if line.startswith("acquire: "))


def at_once(commands: Sequence[Command], folder: Path) -> list[Ended]:
    """Run commands in processes that begin at the same moment; wait for all."""
    context = multiprocessing.get_context("fork")
    gate = context.Barrier(len(commands))
    outs = [folder / f"said-{number}.txt" for number in range(len(commands))]
    processes = [
        context.Process(target=_child, args=(command, out, gate.wait))
        for command, out in zip(commands, outs, strict=True)
    ]
    for process in processes:
        process.start()
    deadline_s = time.monotonic() + _LONGEST_S
    for process in processes:
        process.join(max(0.0, deadline_s - time.monotonic()))
        process.kill()
        process.join()
    ended = [
        Ended(process.exitcode or 0, tuple(out.read_text(encoding="utf-8").splitlines()))
        for process, out in zip(processes, outs, strict=True)
    ]
    for out in outs:
        out.unlink()
    return ended


def _child(command: Command, out: Path, wait: Callable[[], object]) -> None:
    """Run a command in this process, which was forked for it, and end it."""
    status: object = 1
    with out.open("w", encoding="utf-8") as said:
        sys.stdout = sys.stderr = said
        try:
            os.environ.update(command.environment)
            wait()
            time.sleep(command.delay_s)
            app(list(command.arguments))
        except SystemExit as end:
            status = end.code or 0
        except BaseException:  # noqa: BLE001  # whatever it is, it is printed and judged
            traceback.print_exc()
    os._exit(status if isinstance(status, int) else 1)


@dataclass(frozen=True)
class Files:
    """Protocol, campaign and bench files of the small sweep, and what it gives undisturbed.

    Attributes
    ----------
    folder : Path
    steps : dict of int to bytes
        Hashes of pictures, see `benchmarks.kills.finished_steps`.
    parts : dict of str to such dicts
        By part of the campaign.
    duration_s : float
        How long a run takes.
    """

    folder: Path
    steps: dict[int, bytes]
    parts: dict[str, dict[int, bytes]]
    duration_s: float

    @classmethod
    def write(cls, folder: Path) -> "Files":
        """Write the files, and measure undisturbed."""
        plan = simulated_plan()
        (folder / "small.yaml").write_text(plan.protocol.text, encoding="utf-8")
        (folder / "bench.yaml").write_text(plan.bench.text, encoding="utf-8")
        (folder / "campaign.yaml").write_text(_CAMPAIGN, encoding="utf-8")
        files = cls(folder, {}, {}, 0.0)
        # Not timed: the first one computes the reed.
        steps = files._undisturbed("first.h5")
        began_s = time.monotonic()
        files._undisturbed("second.h5")
        return cls(folder, steps, files._campaign(), time.monotonic() - began_s)

    def run(self, path: Path) -> tuple[str, ...]:
        """Arguments of a new run."""
        return (*self._on_bench("small.yaml"), "--reed", "R07", "--no-fit", "--out", str(path))

    def resume(self, path: Path) -> tuple[str, ...]:
        """Arguments that go on with a run."""
        return (*self._on_bench("small.yaml"), "--no-fit", "--resume", str(path))

    def campaign(self, folder: Path) -> tuple[str, ...]:
        """Arguments of a campaign."""
        return (*self._on_bench("campaign.yaml"), "--reed", "R07", "--out", str(folder))

    def _on_bench(self, name: str) -> tuple[str, ...]:
        return ("run", str(self.folder / name), "--bench", str(self.folder / "bench.yaml"))

    def _undisturbed(self, name: str) -> dict[int, bytes]:
        path = self.folder / name
        _require_success(at_once([Command(self.run(path))], self.folder))
        return finished_steps(path)

    def _campaign(self) -> dict[str, dict[int, bytes]]:
        folder = self.folder / "undisturbed"
        _require_success(at_once([Command(self.campaign(folder))], self.folder))
        return {path.stem: finished_steps(path) for path in sorted(folder.glob("*.h5"))}


_CAMPAIGN = """\
name: Small
protocol: small.yaml
parts:
  - name: up
  - name: down
    change: {sweep.direction: down}
"""


def _require_success(ended: Sequence[Ended]) -> None:
    for one in ended:
        if one.status:
            raise SystemExit("\n".join(("soak: an undisturbed run failed:", *one.lines)))


@dataclass(frozen=True)
class ColdCache:
    """Processes that started at once with an empty cache.

    Attributes
    ----------
    processes, complete, identical : int
        Processes; those whose runs are complete; those whose pixels are those of an undisturbed
        run.
    built, waited : int
        Processes that computed the reed, and that said that they wait for another one.
    entries : int
        Files in the cache afterwards.
    """

    processes: int
    complete: int
    identical: int
    built: int
    waited: int
    entries: int

    @property
    def met(self) -> bool:
        """Whether all measured the same and the reed was computed once."""
        return self.processes == self.complete == self.identical and self.built == self.entries == 1


def on_an_empty_cache(processes: int, files: Files) -> ColdCache:
    """Start processes that need the same reed, with an empty cache."""
    with tempfile.TemporaryDirectory() as name:
        folder, cache = Path(name), Path(name, "cache")
        paths = [folder / f"{number}.h5" for number in range(processes)]
        ended = at_once(
            [Command(files.run(p), 0.0, {"REEDBENCH_CACHE": str(cache)}) for p in paths], folder
        )

        def saying(words: str) -> int:
            return sum(any(words in line for line in one.lines) for one in ended)

        return ColdCache(
            processes=processes,
            complete=sum(one.status == 0 for one in ended),
            identical=sum(p.exists() and finished_steps(p) == files.steps for p in paths),
            built=saying("computing the reed"),
            waited=saying("waiting for"),
            entries=len(list(cache.iterdir())),
        )


@dataclass(frozen=True)
class Rivalry:
    """Two programs that wanted the same, several times.

    Attributes
    ----------
    name : str
    rounds : int
    decided : int
        Rounds in which one program ended well, the other with exit status 2.
    explained : int
        Rounds in which the other printed one line of error, which names the file or folder.
    unharmed : int
        Rounds after which all steps are good and in the documents once, the pictures of the
        undisturbed run (or of the killed one) are unchanged, and no other file is left.
    reasons : tuple of str
        What was said, each once, without names of files and numbers of processes.
    """

    name: str
    rounds: int
    decided: int
    explained: int
    unharmed: int
    reasons: tuple[str, ...]

    @property
    def met(self) -> bool:
        """Whether every round went well."""
        return self.rounds == self.decided == self.explained == self.unharmed


@dataclass(frozen=True)
class Prize:
    """What two programs want.

    Attributes
    ----------
    target : Path
        Run file or folder.
    arguments : tuple of str
        Of the command that both give.
    expected : dict
        Hashes of pictures that must be there in the end, by run file.
    """

    target: Path
    arguments: tuple[str, ...]
    expected: Mapping[Path, dict[int, bytes]]


def two_runs(files: Files, folder: Path) -> Prize:
    """Both begin a run with the same ``--out``."""
    path = folder / "run.h5"
    return Prize(path, files.run(path), {path: files.steps})


def two_resumes(files: Files, folder: Path) -> Prize:
    """Both go on with a run that was killed."""
    path = folder / "run.h5"
    while not path.exists() or is_complete(path):
        for left in folder.glob("run.*"):
            left.unlink()
        kill_amid(Command(files.run(path)), path)
    # The noise of the other steps is not that of an undisturbed run.
    return Prize(path, files.resume(path), {path: finished_steps(path)})


def two_campaigns(files: Files, folder: Path) -> Prize:
    """Both begin a campaign with the same ``--out``."""
    target = folder / "campaign"
    expected = {target / f"{part}.h5": steps for part, steps in files.parts.items()}
    return Prize(target, files.campaign(target), expected)


RIVALRIES: dict[str, Callable[[Files, Path], Prize]] = {
    "two runs with one --out": two_runs,
    "two resumes of one run": two_resumes,
    "two campaigns with one --out": two_campaigns,
}


def kill_amid(command: Command, path: Path) -> None:
    """Begin a run, and kill its process when it has recorded some steps."""
    context = multiprocessing.get_context("fork")
    out, documents = path.with_suffix(".txt"), path.with_suffix(".documents.jsonl")
    process = context.Process(target=_child, args=(command, out, lambda: None))
    process.start()
    while process.is_alive() and _lines(documents) < _DOCUMENTS_OF_START + _STEPS_BEFORE_KILL:
        time.sleep(0.002)
    if process.pid is not None:
        os.kill(process.pid, signal.SIGKILL)
    process.join()
    out.unlink()


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def rivalry(name: str, rounds: int, files: Files, seed: int = _SEED) -> Rivalry:
    """Let two programs want the same, the second up to the length of a run later."""
    rng, judged, reasons = np.random.default_rng(seed), [], set()
    for number in range(rounds):
        with tempfile.TemporaryDirectory() as place:
            prize = RIVALRIES[name](files, Path(place))
            # In every other round at the same moment.
            late_s = rng.uniform(0.0, files.duration_s) if number % 2 else 0.0
            said = Path(place, "said")
            said.mkdir()
            ended = at_once([Command(prize.arguments), Command(prize.arguments, late_s)], said)
            said.rmdir()
            verdict, reason = _judged(prize, ended, Path(place))
        judged.append(verdict)
        reasons.add(reason)
    decided, explained, unharmed = map(sum, zip(*judged, strict=True))
    return Rivalry(name, rounds, decided, explained, unharmed, tuple(sorted(reasons)))


def _judged(
    prize: Prize, ended: Sequence[Ended], place: Path
) -> tuple[tuple[bool, bool, bool], str]:
    """Whether a round was decided, explained, and harmed nothing; and the reason that was said."""
    winner, loser = sorted(ended, key=lambda one: one.status)
    reason = " / ".join(loser.errors) or " / ".join(loser.lines[-1:])
    for name in (*map(str, prize.expected), str(prize.target), str(place)):
        reason = reason.replace(name, "…")
    reason = re.sub(r"process \d+", "process N", reason)
    decided = (winner.status, loser.status) == (0, 2)
    explained = len(loser.errors) == 1 and str(prize.target) in loser.errors[0]
    wanted = {
        file for path in prize.expected for file in (path, path.with_suffix(".documents.jsonl"))
    }
    left = {file for file in place.rglob("*") if file.is_file()}
    unharmed = left == wanted and all(_is_right(*each) for each in prize.expected.items())
    return (decided, explained, unharmed), reason


def _is_right(path: Path, steps: dict[int, bytes]) -> bool:
    """Whether a run file can be read, is whole, and has these pictures."""
    try:
        return is_whole(path) and steps.items() <= finished_steps(path).items()
    except (OSError, KeyError):
        return False
