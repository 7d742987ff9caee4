"""Work in processes of its own: order, errors, processes that die, and nothing left behind."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from fitting import side_by_side as module
from fitting.errors import FitError
from fitting.side_by_side import side_by_side

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="processes are split off on Linux only"
)


def test_results_come_in_the_order_of_items_whatever_takes_longest() -> None:
    def late(item: int) -> tuple[int, int]:
        time.sleep(0.05 * (3 - item))
        return item**2, os.getpid()

    found = list(side_by_side(late, [0, 1, 2, 3], 4))
    assert [square for square, _ in found] == [0, 1, 4, 9]
    assert len({process for _, process in found} | {os.getpid()}) == 5


def test_what_one_piece_leaves_in_memory_is_nothing_to_another() -> None:
    seen: list[int] = []

    def remember(item: int) -> list[int]:
        seen.append(item)
        return list(seen)

    for at_once in (1, 2):
        assert list(side_by_side(remember, [1, 2, 3], at_once)) == [[1], [2], [3]]
    assert not seen


def test_an_error_is_raised_where_its_turn_is() -> None:
    def fail(item: int) -> int:
        if item == 1:
            raise FitError("no such thing")
        return item

    results = side_by_side(fail, [0, 1, 2], 2)
    assert next(results) == 0
    with pytest.raises(FitError, match="no such thing"):
        next(results)


def test_work_whose_process_dies_is_done_here() -> None:
    parent = os.getpid()

    def die_elsewhere(item: int) -> int:
        if os.getpid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)
        return item

    assert list(side_by_side(die_elsewhere, [5, 6], 2)) == [5, 6]


def test_who_stops_asking_leaves_no_process_behind(tmp_path: Path) -> None:
    def wait(item: int) -> int:
        if item:
            (tmp_path / str(item)).write_text(str(os.getpid()))
            time.sleep(60)
        return item

    results = side_by_side(wait, [0, 1], 2)
    assert next(results) == 0
    while not (tmp_path / "1").exists() or not (tmp_path / "1").read_text():
        time.sleep(0.01)
    results.close()
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "1").read_text()), 0)


def test_an_interrupt_ends_all_work(tmp_path: Path) -> None:
    def slow(item: int) -> int:
        (tmp_path / str(item)).touch()
        time.sleep(60)
        return item

    def interrupt() -> None:
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        list(side_by_side(slow, [1, 2], 2))
    assert time.monotonic() - begun < 30


@pytest.mark.parametrize("items", [[], [3]])
def test_little_work_is_done_here(items: list[int]) -> None:
    assert list(side_by_side(lambda _item: os.getpid(), items)) == [os.getpid()] * len(items)


def test_where_no_process_can_be_split_off_all_is_done_here(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_SPLITS", False)
    assert set(side_by_side(lambda _item: os.getpid(), [1, 2, 3])) == {os.getpid()}
