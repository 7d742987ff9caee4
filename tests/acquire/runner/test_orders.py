"""Signals: each that would end the process is a stop, in every phase of a run."""

import os
import signal
import threading
from dataclasses import replace

import pytest

import acquire
from acquire.runner import run_session
from acquire.runner.orders import Orders, signals_obeyed
from acquire.runner.recorder import Recorder
from acquire.runner.runner import Runner, run
from acquire.runner.summary import RunState
from drivers.errors import OpeningStoppedError
from runs.reader import Run, RunLabels

ENDING = [
    signal.Signals[name]
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGABRT", "SIGALRM", "SIGVTALRM",
                 "SIGPROF", "SIGXCPU", "SIGIO", "SIGPWR", "SIGRTMIN", "SIGRTMAX")
    if hasattr(signal, name)
]  # fmt: skip
PHASES = {
    "before the first step": ("rf_on", 1),
    "setting a step": ("set_sine", 2),
    "ramping": ("ramp_to", 1),
    "taking frames": ("grab", 2),
    "reading back": ("read_pair", 4),
    "taking a step again": ("grab", 6),
    "switching off": ("output_off", 2),
}


def left_safe(fake):
    return not fake.output_on and not fake.rf and not fake.running


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.h5"


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("number", ENDING)
def test_a_signal_stops_a_run_and_leaves_the_bench_off(
    tiny_plan, fake_bench, lit, path, number, phase
):
    plan = tiny_plan(steps=5, **{"policy.bad_step.retries": 1})
    fake = fake_bench(picture=lit(plan), spoilt={2: lambda frames: frames[1:]})
    before = signal.getsignal(number)

    def strike(name, count):
        if (name, count) == PHASES[phase]:
            os.kill(os.getpid(), number)

    fake.before = strike
    summary = run(plan, fake.opened(), path)
    assert left_safe(fake)
    assert summary.unconfirmed == ()
    late = phase in ("switching off", "taking a step again")
    assert (summary.status, summary.ended_by) == (
        (RunState.COMPLETE, "") if late else (RunState.INTERRUPTED, "person")
    )
    with Run.open(path) as measured:
        assert measured.status == str(summary.status)
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTSTP])
def test_a_signal_pauses_a_run_and_another_goes_on(tiny_plan, fake_bench, lit, path, number):
    plan = tiny_plan(steps=4)
    fake, paused = fake_bench(picture=lit(plan)), []

    def strike(name, count):
        if (name, count) == ("grab", 2):
            os.kill(os.getpid(), number)

    def said(words):
        paused.append((words, left_safe(fake)))
        if "paused" in words:
            os.kill(os.getpid(), signal.SIGUSR2)

    fake.before = strike
    assert run(plan, fake.opened(), path, announce=said).status is RunState.COMPLETE
    assert paused[0][1], "all is off while the run is paused"
    with Run.open(path) as measured:
        assert [interruption.kind for interruption in measured.interruptions] == ["paused"]


def test_two_signals_give_up_the_step_in_work(tiny_plan, fake_bench, path):
    fake = fake_bench()

    def strike(name, count):
        if (name, count) == ("grab", 2):
            os.kill(os.getpid(), signal.SIGHUP)
            os.kill(os.getpid(), signal.SIGHUP)

    fake.before = strike
    assert run(tiny_plan(steps=5), fake.opened(), path).status is RunState.INTERRUPTED
    assert left_safe(fake)
    with Run.open(path) as measured:
        assert [str(step.verdict) for step in measured][1] == "interrupted"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_a_signal_while_the_bench_is_opened_switches_nothing_on(
    small_plan, path, monkeypatch, number
):
    plan, opened = small_plan(), run_session.open_bench

    def strike(*asked, **more):
        os.kill(os.getpid(), number)
        return opened(*asked, **more)

    monkeypatch.setattr("acquire.runner.run_session.open_bench", strike)
    with pytest.raises(OpeningStoppedError):
        acquire.run(plan, path)
    assert not path.exists()
    assert not path.with_suffix(".process").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_frames_are_packed_leaves_a_complete_run(small_plan, path, number):
    plan, announced = small_plan({"keep": "frames"}), []
    summary = acquire.run(
        plan,
        path,
        callbacks=acquire.Callbacks(
            announce=announced.append, packing=lambda share: os.kill(os.getpid(), number)
        ),
    ).summary
    assert (summary.status, summary.ended_by) == (RunState.COMPLETE, "person")
    assert any("acquire pack" in words for words in announced)
    with Run.open(path) as measured:
        assert measured.good.all()


def test_who_ignores_a_closed_terminal_is_not_stopped_by_it():
    """As under nohup; Ctrl-C, which shells ignore for their background, stops all the same."""
    before = {
        number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGHUP, signal.SIGINT)
    }
    try:
        orders = Orders()
        with signals_obeyed(orders):
            os.kill(os.getpid(), signal.SIGHUP)
            assert not orders.stopped
            os.kill(os.getpid(), signal.SIGINT)
            assert orders.stopped
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_systems_without_a_signal_lack_nothing_else(monkeypatch):
    for name in ("SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGTSTP", "SIGTTOU"):
        monkeypatch.delattr(signal, name)
    monkeypatch.setattr(signal, "valid_signals", lambda: {signal.SIGINT, signal.SIGTERM})
    orders = Orders()
    with signals_obeyed(orders):
        os.kill(os.getpid(), signal.SIGINT)
        assert orders.stopped


def test_other_threads_get_no_signals_and_do_no_harm():
    done = []

    def measure():
        with signals_obeyed(Orders()):
            done.append(True)

    thread = threading.Thread(target=measure)
    thread.start()
    thread.join()
    assert done == [True]


# --- Patience ----------------------------------------------------------------------------------


def test_the_first_or_the_second_order_gives_up_as_asked():
    orders = Orders()
    orders.interrupt()
    with orders.given_up_at(2), pytest.raises(KeyboardInterrupt):
        orders.interrupt()
    first = Orders()
    with first.given_up_at(1), pytest.raises(KeyboardInterrupt):
        first.interrupt()
    with pytest.raises(KeyboardInterrupt), first.given_up_at(1):
        raise AssertionError("an order that came before counts")


def test_who_gave_up_is_not_interrupted_while_clearing_up():
    orders = Orders()
    with orders.given_up_at(2):
        orders.interrupt()
        with pytest.raises(KeyboardInterrupt):
            orders.interrupt()
        orders.interrupt()
    orders.interrupt()


def test_an_order_before_the_bench_is_used_switches_nothing_on(tiny_plan, fake_bench, path):
    fake, orders = fake_bench(), Orders()
    bench, plan = fake.opened(), tiny_plan()
    orders.stop()
    runner = Runner(
        plan, bench, path, lambda: Recorder.create(plan, bench, path, RunLabels(), print), print,
        orders,
    )  # fmt: skip
    assert runner.execute().status is RunState.INTERRUPTED
    assert not {"rf_on", "set_sine"} & set(fake.names())


@pytest.mark.parametrize("begun", [False, True], ids=["new", "resumed"])
def test_the_bench_is_free_while_frames_are_packed(small_plan, path, monkeypatch, begun):
    """Compression takes a minute for a large run; others may measure meanwhile."""
    plan, events = small_plan({"keep": "frames"}), []
    opened = run_session.open_bench

    def watched(*asked, **more):
        bench = opened(*asked, **more)

        def release():
            bench.release()
            events.append("released")

        return replace(bench, release=release)

    if begun:
        stop = acquire.Callbacks(step=lambda _: os.kill(os.getpid(), signal.SIGTERM))
        assert acquire.run(plan, path, callbacks=stop).status is RunState.INTERRUPTED
    monkeypatch.setattr("acquire.runner.run_session.open_bench", watched)
    calls = acquire.Callbacks(packing=lambda _: events.append("packing"))
    measured = (acquire.resume if begun else acquire.run)(plan, path, callbacks=calls)
    assert measured.status is RunState.COMPLETE
    assert events[0] == "released"
    assert "packing" in events[1:]
