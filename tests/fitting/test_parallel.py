"""Work in processes of its own: order, errors, processes that die, and nothing left behind."""

import os
import signal
import struct
import subprocess
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from fitting.errors import FitError
from fitting.parallel import processes as module
from fitting.parallel.processes import map_processes

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="processes are split off on Linux only"
)


@pytest.fixture(autouse=True)
def _two_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    processors(monkeypatch, 2)


def processors(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: set(range(count)))


def test_results_come_in_the_order_of_items_whatever_takes_longest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    processors(monkeypatch, 4)

    def late(item: int) -> tuple[int, int]:
        time.sleep(0.05 * (3 - item))
        return item**2, os.getpid()

    found = list(map_processes(late, [0, 1, 2, 3]))
    assert [square for square, _ in found] == [0, 1, 4, 9]
    assert len({process for _, process in found} | {os.getpid()}) == 5


@pytest.mark.parametrize("count", [1, 2])
def test_what_one_piece_leaves_in_memory_is_nothing_to_another(
    monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    processors(monkeypatch, count)
    seen: list[int] = []

    def remember(item: int) -> list[int]:
        seen.append(item)
        return list(seen)

    assert list(map_processes(remember, [1, 2, 3])) == [[1], [2], [3]]
    assert not seen


def test_an_error_is_raised_where_its_turn_is() -> None:
    def fail(item: int) -> int:
        if item == 1:
            raise FitError("no such thing")
        return item

    results = map_processes(fail, [0, 1, 2])
    assert next(results) == 0
    with pytest.raises(FitError, match="no such thing"):
        next(results)


def test_work_whose_process_dies_is_done_here() -> None:
    parent = os.getpid()

    def die_elsewhere(item: int) -> int:
        if os.getpid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)
        return item

    assert list(map_processes(die_elsewhere, [5, 6])) == [5, 6]


def test_who_stops_asking_leaves_no_process_behind(tmp_path: Path) -> None:
    def wait(item: int) -> int:
        if item:
            (tmp_path / str(item)).write_text(str(os.getpid()))
            time.sleep(60)
        return item

    results = map_processes(wait, [0, 1])
    assert next(results) == 0
    while not (tmp_path / "1").exists() or not (tmp_path / "1").read_text():
        time.sleep(0.01)
    results.close()
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "1").read_text()), 0)


def test_what_cannot_be_handed_back_is_reported() -> None:
    with pytest.raises(RuntimeError, match="cannot be handed back"):
        list(map_processes(lambda item: lambda: item, [1, 2]))


class PathError(Exception):
    """Cannot be read back: its arguments are not what it says."""

    def __init__(self, path: str, why: str) -> None:
        super().__init__(f"{path}: {why}")


def test_errors_that_cannot_be_handed_back_are_reported_in_words() -> None:
    def fail(item: int) -> int:
        raise PathError("some file", f"lacks {item}")

    with pytest.raises(RuntimeError, match="some file: lacks 1"):
        list(map_processes(fail, [1, 2]))


def test_work_whose_process_dies_while_it_answers_is_done_here(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def half(self: Connection, message: bytes) -> None:
        os.write(self.fileno(), struct.pack("!i", len(message)) + message[:3])
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(Connection, "send_bytes", half)
    assert list(map_processes(lambda item: "a" * item, [100, 200])) == ["a" * 100, "a" * 200]


def test_where_there_may_be_no_other_process_all_is_done_here(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused() -> int:
        raise BlockingIOError(11, "too many processes")

    monkeypatch.setattr(os, "fork", refused)
    assert list(map_processes(lambda item: (item, os.getpid()), [1, 2])) == [
        (1, os.getpid()),
        (2, os.getpid()),
    ]


def test_a_process_says_things_without_the_display_that_was_at_work(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    class Locked:
        """Another thread has its locks and does not release them."""

        def write(self, _said: str) -> None:
            time.sleep(60)

        def flush(self) -> None:
            """Nothing was said."""

    monkeypatch.setattr(sys, "stderr", Locked())

    def warn(item: int) -> int:
        sys.stderr.write(f"mind {item}\n")
        return item

    begun = time.monotonic()
    assert list(map_processes(warn, [1, 2])) == [1, 2]
    assert time.monotonic() - begun < 30
    assert {"mind 1", "mind 2"} <= set(capfd.readouterr().err.splitlines())


# A program whose pieces say who they are, and take long.
_PROGRAM = """
import os, signal, sys, time
from pathlib import Path
from fitting.parallel.processes import map_processes

# Who runs tests in the background may have interrupts ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
os.sched_getaffinity = lambda _process: {0, 1}

def slow(item):
    place = Path(sys.argv[1]) / f"{item}.begun"
    place.write_text(str(os.getpid()))
    place.rename(place.with_suffix(".pid"))
    time.sleep(60)
    return "x" * 1_000_000

try:
    list(map_processes(slow, [1, 2]))
except KeyboardInterrupt:
    print("interrupted")
"""


def _begun(folder: Path) -> tuple[subprocess.Popen[str], list[int]]:
    """Start the program in a session of its own; tells its pieces' processes."""
    program = subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        cwd=Path(module.__file__).parents[1],
    )  # fmt: skip
    while len(written := sorted(folder.glob("*.pid"))) < 2:
        assert program.poll() is None, program.communicate()
        time.sleep(0.01)
    return program, [int(path.read_text()) for path in written]


def _gone(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text(encoding="utf-8")
    except FileNotFoundError:
        return True
    return state.rsplit(")", 1)[1].split()[0] == "Z"


def _all_end(processes: list[int]) -> bool:
    until = time.monotonic() + 20
    while time.monotonic() < until:
        if all(_gone(process) for process in processes):
            return True
        time.sleep(0.05)
    return False


def test_an_interrupt_of_all_ends_all_in_one_line(tmp_path: Path) -> None:
    program, pieces = _begun(tmp_path)
    os.killpg(program.pid, signal.SIGINT)
    said, errors = program.communicate(timeout=30)
    assert said == "interrupted\n"
    assert not errors
    assert _all_end(pieces)


def test_pieces_end_with_who_asked_for_them(tmp_path: Path) -> None:
    program, pieces = _begun(tmp_path)
    program.kill()
    program.communicate(timeout=30)
    assert _all_end(pieces)


@pytest.mark.parametrize("items", [[], [3]])
def test_little_work_is_done_here(items: list[int]) -> None:
    assert list(map_processes(lambda _item: os.getpid(), items)) == [os.getpid()] * len(items)


def test_where_no_process_can_be_split_off_all_is_done_here(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_SPLITS", False)
    assert set(map_processes(lambda _item: os.getpid(), [1, 2, 3])) == {os.getpid()}
