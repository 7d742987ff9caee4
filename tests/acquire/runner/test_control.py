"""Orders to runs in work: they wait until they can be obeyed, and do no harm."""

import os
import signal
import threading

import pytest

from acquire.runner.control import (
    control_path,
    controllable,
    order,
)
from acquire.runner.runner import run
from acquire.runner.summary import RunState
from runs.errors import RunFileError
from runs.reader import Run


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.h5"


def test_a_pause_that_is_asked_for_while_the_bench_is_opened_is_obeyed(
    path, tiny_plan, fake_bench, lit
):
    """The run pauses before its first step, and goes on when asked to."""
    plan, bench = tiny_plan(), fake_bench()
    bench.picture = lit(plan)
    proceed = threading.Timer(0.3, order, (path, "continue"))

    def pause_seen(name, count):
        if name == "stop" and count == 1:
            assert "grab" not in bench.names()
            proceed.start()

    bench.before = pause_seen
    with controllable(path) as orders:
        assert order(path, "pause") == os.getpid()
        summary = run(plan, bench.opened(), path, orders=orders)
    proceed.join()
    assert summary.status is RunState.COMPLETE
    with Run.open(path) as measured:
        assert [
            (interruption.kind, interruption.position) for interruption in measured.interruptions
        ] == [("paused", 0)]


def test_an_order_that_comes_too_late_is_lost_and_ends_no_process(path):
    """Nothing here says what to do about the signal, which by itself would end the process."""
    assert signal.getsignal(signal.SIGUSR1) is signal.SIG_DFL
    with controllable(path):
        order(path, "pause")
    assert signal.getsignal(signal.SIGUSR1) is signal.SIG_DFL
    assert not control_path(path).exists()


def test_a_run_on_another_thread_gets_no_order(path):
    said = []

    def measure():
        with controllable(path):
            for what in ("pause", "continue"):
                with pytest.raises(RunFileError) as refused:
                    order(path, what)
                said.append(str(refused.value))
            with pytest.raises(RunFileError, match=r"is being measured by process \d+ .*; wait"):
                controllable(path).__enter__()

    thread = threading.Thread(target=measure)
    thread.start()
    thread.join()
    assert len(said) == 2
    assert all("a thread that gets no signals; " in each for each in said)


def test_a_run_that_is_not_measured_gets_no_orders(path):
    with pytest.raises(RunFileError, match="is not being measured"):
        order(path, "pause")
