"""How the outcome of reading one mutated file is judged, counted and shown."""

import difflib
import resource
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import yaml

from benchmarks.fuzzing.plausibility import Implausible, is_seen
from drivers.errors import BenchSetupError
from holography.errors import BenchError

# Chosen: the largest shipped campaign takes 1.5 s of one of our processors and a plan of as many
# steps as are allowed 7 s, all else 0.2 s.
LIMIT_S = 10.0
# Chosen: what waits and does nothing is given up after ten times that; others use the machine too.
LIMIT_WAITING_S = 100.0
# Chosen: a shipped file takes less than 20 MiB, a plan of as many steps as are allowed 60 MiB.
LIMIT_MIB = 200
# As the tests of refusals have it: five lines of a terminal.
LONGEST_MESSAGE = 400
_ROOT = Path(__file__).parents[2]


class Unnoticed(Exception):  # noqa: N818  # an outcome of a benchmark, not an error of a program
    """A file whose values were changed was read as if in order, and nothing in it could tell."""


class TooLong(BaseException):
    """A case took longer than `LIMIT_S`; no `except Exception` of the program is to catch it."""


@dataclass(frozen=True)
class Outcome:
    """What became of one case.

    Attributes
    ----------
    kind : {'accepted', 'unnoticed', 'refused', 'wrong'}
    what : str
        Of a wrong one, what tells it from others that are wrong.
    said : str
        Message.
    """

    kind: str
    what: str = ""
    said: str = ""


@dataclass
class Wrong:
    """A distinct wrong outcome, with the smallest example seen."""

    what: str
    count: int = 0
    said: str = ""
    example: str = ""


@dataclass
class Tally:
    """Outcomes of one kind of file."""

    kind: str
    cases: int = 0
    accepted: int = 0
    unnoticed: int = 0
    refused: int = 0
    wrong: int = 0
    seconds: float = 0.0
    slowest_s: float = 0.0
    slowest: str = ""
    distinct: dict[str, Wrong] = field(default_factory=dict)

    def add(self, outcome: Outcome, example: Callable[[], str]) -> None:
        """Count an outcome; `example` shows how to get it."""
        self.cases += 1
        setattr(self, outcome.kind, getattr(self, outcome.kind) + 1)
        if outcome.kind != "wrong":
            return
        wrong = self.distinct.setdefault(outcome.what, Wrong(outcome.what))
        wrong.count += 1
        if wrong.count <= 3:
            shown = example()
            if not wrong.example or len(shown) < len(wrong.example):
                wrong.example, wrong.said = shown, outcome.said


# --- Judging -----------------------------------------------------------------------------------


@contextmanager
def at_most(seconds: float, waiting_s: float) -> Iterator[None]:
    """Raise `TooLong` in what takes more of the processor, or of the day."""

    def ring(_signal: int, _frame: FrameType | None) -> None:
        raise TooLong

    clocks = {
        signal.ITIMER_PROF: (signal.SIGPROF, seconds),
        signal.ITIMER_REAL: (signal.SIGALRM, waiting_s),
    }
    before = {number: signal.signal(number, ring) for number, _ in clocks.values()}
    for clock, (_, limit_s) in clocks.items():
        signal.setitimer(clock, limit_s)
    try:
        yield
    finally:
        for clock, (number, _) in clocks.items():
            signal.setitimer(clock, 0)
            signal.signal(number, before[number])


def judged(call: Callable[[], object], source: str, limit_mib: float = LIMIT_MIB) -> Outcome:
    """Run what reads one case, and judge what became of it.

    Parameters
    ----------
    call : callable
    source : str
        Name of the file, which a message has to say.
    limit_mib : float
        Most memory that it may take.
    """
    before_mib = _peak_mib()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        outcome = _outcome(call, source)
    if outcome.kind == "wrong":
        return outcome
    if warned:
        first = warned[0]
        where = Path(first.filename).name
        return Outcome(
            "wrong",
            f"warning {first.category.__name__} in {where}:{first.lineno}",
            str(first.message),
        )
    grown_mib = _peak_mib() - before_mib
    if grown_mib > limit_mib:
        return Outcome("wrong", f"more than {limit_mib:g} MiB", f"{grown_mib:.0f} MiB")
    return outcome


def _outcome(call: Callable[[], object], source: str) -> Outcome:
    try:
        with at_most(LIMIT_S, LIMIT_WAITING_S):
            call()
    except BenchError as error:
        return _refusal(error, source)
    except Implausible as error:
        return Outcome("wrong", error.what, str(error))
    except Unnoticed:
        return Outcome("unnoticed")
    except TooLong as error:
        return Outcome("wrong", f"longer than {LIMIT_S:g} s of a processor in {_place(error)}")
    except Exception as error:  # noqa: BLE001  # any other exception is what is looked for
        return Outcome("wrong", f"{type(error).__name__} in {_place(error)}", str(error)[:300])
    return Outcome("accepted")


def _refusal(error: BenchError, source: str) -> Outcome:
    said = str(error)
    # What drivers say names the bench, or the key.
    faults = {
        f"exit status {error.exit_status}": error.exit_status != 2,
        "a message that cannot be printed": not is_seen(said),
        f"a message of more than {LONGEST_MESSAGE} characters": len(said) > LONGEST_MESSAGE,
        "a message that does not name the file": source not in said
        and not isinstance(error, BenchSetupError),
    }
    for what, holds in faults.items():
        if holds:
            return Outcome(
                "wrong", f"{what}: {type(error).__name__} in {_place(error)}", said[:500]
            )
    return Outcome("refused", said=said)


def _place(error: BaseException) -> str:
    """Innermost line of this project that an exception passed."""
    frames = traceback.extract_tb(error.__traceback__)
    places = [(Path(f.filename), f.name) for f in frames]
    own = [(p.relative_to(_ROOT), name) for p, name in places if p.is_relative_to(_ROOT)]
    own = [(place, name) for place, name in own if place.parts[0] != "benchmarks"]
    return f"{own[-1][0]}:{own[-1][1]}" if own else "?"


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


# --- Examples ---------------------------------------------------------------------------------


def difference(original: bytes, changed: bytes) -> str:
    """First lines that differ; of trees that were written again, of the same spelling."""
    lines = _different_lines(original, changed)
    with suppress(yaml.YAMLError, ValueError, RecursionError):
        trees = [yaml.safe_load(data) for data in (original, changed)]
        spelt = [yaml.safe_dump(tree, sort_keys=False, width=200).encode() for tree in trees]
        if isinstance(trees[1], dict):
            lines = min(lines, _different_lines(*spelt), key=lambda each: len(each) or 99)
    return "\n".join(lines[:8] + ["…"] * (len(lines) > 8))


def _different_lines(original: bytes, changed: bytes) -> list[str]:
    before, after = (repr(data)[2:-1].split("\\n") for data in (original, changed))
    return [
        f"{line[:160]}{'…' if len(line) > 160 else ''}"
        for line in difflib.unified_diff(before, after, n=0, lineterm="")
        if not line.startswith(("---", "+++", "@@"))
    ]
