"""The runner: what it asks of instruments, in which order, and how it leaves them."""

import itertools
import os
import signal
import threading
import time
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from acquire.runner.recorder import Recorder
from acquire.runner.runner import RAMP_S, Runner, run, safe_off
from acquire.runner.summary import RunState
from drivers.errors import InstrumentError, LimitError
from holography.reconstruction import mean_power
from protocols.errors import ProtocolError
from protocols.plan import Plan
from runs.errors import RunFileError, SilentDiskError
from runs.reader import Run, RunLabels
from runs.verdict import Verdict

SAFE_OFF = ["ramp_to", "output_off", "read", "rf_off", "stop"]
# What a run asks of instruments before and during its steps.
USED = ["output_off", "configure", "rf_on", "start", "set_pair", "set_sine", "ramp_to", "read"]
USED += ["read_pair", "grab"]


def left_safe(fake):
    return not fake.output_on and not fake.rf and not fake.running


def runner_of(plan, fake, path, progress=lambda report: None):
    bench = fake.opened()

    def recorder():
        return Recorder.create(plan, bench, path, RunLabels(), progress)

    return Runner(plan, bench, path, recorder, lambda _: None)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.h5"


# --- A run from beginning to end ---------------------------------------------------------------


def test_orders_come_in_the_order_of_the_state_diagram(tiny_plan, fake_bench, path):
    plan, fake = tiny_plan(steps=2), fake_bench()
    run(plan, fake.opened(), path)
    read_back = ["read", "read_pair"]
    first = ["set_pair", "set_sine", "ramp_to", *read_back, "grab", *read_back]
    # Before anything is changed the output has to be on still.
    later = ["set_pair", "read", "set_sine", *read_back, "grab", *read_back]
    opening = ["output_off", "configure", "rf_on", "start"]
    assert fake.names() == [*opening, *first, *later, *SAFE_OFF]
    one, two = plan.steps
    orders = fake.log[4:]
    assert orders[0] == ("set_pair", one.aom1_hz, one.aom2_hz)
    assert orders[1] == ("set_sine", one.drive_hz, 0.0), "the output comes on without a jump"
    assert orders[2] == ("ramp_to", one.volts, RAMP_S)
    assert orders[10] == ("set_sine", two.drive_hz, two.volts)
    assert fake.log[-5] == ("ramp_to", 0.0, RAMP_S)
    assert RAMP_S >= 0.05
    protocol = plan.protocol
    rate_hz, exposure_s = protocol.camera.frame_rate_hz, protocol.exposure_s
    assert fake.log[1] == ("configure", rate_hz, exposure_s, plan.frame_shape)


@pytest.mark.parametrize(("to", "ramped"), [("1.24 V", False), ("1.26 V", True), ("0.79 V", True)])
def test_volts_that_jump_are_ramped_and_others_are_not(tiny_plan, fake_bench, path, to, ramped):
    """Up or down by more than a quarter. Between two ramps the frequency changes at 0 V."""
    volts = {"law": "ramp", "from": "1 V", "to": to, "first": 12, "last": 14}
    plan, fake = tiny_plan(steps=2, drive=volts), fake_bench()
    run(plan, fake.opened(), path)
    second = plan.steps[1]
    begun = [entry[0] for entry in fake.log].index("grab") + 5
    if ramped:
        assert fake.log[begun : begun + 3] == [
            ("ramp_to", 0.0, RAMP_S), ("set_sine", second.drive_hz, 0.0),
            ("ramp_to", second.volts, RAMP_S),
        ]  # fmt: skip
    else:
        assert fake.log[begun] == ("set_sine", second.drive_hz, second.volts)
        assert fake.names()[begun + 1] == "read"


def test_a_loud_step_is_not_followed_at_once_by_the_quiet_one_that_is_taken_again(
    tiny_plan, fake_bench, lit, path
):
    volts = {"law": "ramp", "from": "0.5 V", "to": "1 V", "first": 12, "last": 20}
    plan = tiny_plan(steps=5, **{"drive": volts, "policy.bad_step.retries": 1})
    fake = fake_bench(picture=lit(plan), spoilt={1: lambda frames: frames[1:]})
    run(plan, fake.opened(), path)
    first = plan.steps[0]
    again = [k for k, entry in enumerate(fake.log) if entry[0] == "set_pair"][5]
    assert fake.log[again : again + 5] == [
        ("set_pair", first.aom1_hz, first.aom2_hz), ("read",), ("ramp_to", 0.0, RAMP_S),
        ("set_sine", first.drive_hz, 0.0), ("ramp_to", first.volts, RAMP_S),
    ]  # fmt: skip


def test_frames_are_asked_for_after_the_settle_time(tiny_plan, fake_bench, path):
    plan, fake = tiny_plan(steps=3, settle="0.7 s"), fake_bench()
    run(plan, fake.opened(), path)
    with Run.open(path) as measured:
        grabs = [entry for entry in fake.log if entry[0] == "grab"]
        for step, (_, count, not_before_s) in zip(measured, grabs, strict=True):
            assert count == 4
            assert not_before_s == pytest.approx(step.changed_s + 0.7)
            assert step.timestamps_s[0] >= step.changed_s + 0.7
            assert step.verdict is not Verdict.STALE


def test_a_simulated_run_is_good_and_complete(small_plan, open_small_bench, path):
    plan, reports = small_plan(), []
    summary = run(plan, open_small_bench(plan), path, progress=reports.append)
    assert summary.status is RunState.COMPLETE
    assert summary.counts == {Verdict.OK: 5}
    assert (summary.steps, summary.path, summary.unconfirmed) == (5, path, ())
    assert [report.done for report in reports] == [1, 2, 3, 4, 5]
    assert [report.index for report in reports] == [step.index for step in plan.steps]
    assert [report.drive_hz for report in reports] == [float(s.drive_hz) for s in plan.steps]
    assert all(report.of == 5 and report.seconds_left >= 0 for report in reports)
    assert reports[-1].seconds_left == 0
    with Run.open(path) as measured:
        assert measured.status == "complete"
        assert measured.good.all()
        for step in measured:
            assert step.read_drive_hz == step.drive_hz
            assert step.signal_to_noise > 5
            assert len(set(step.frame_ids)) == 4


def test_a_run_follows_from_its_seed(small_plan, open_small_bench, tmp_path):
    plan, fields = small_plan(), []
    for name, seed in (("one", 1), ("same", 1), ("other", 2)):
        run(plan, open_small_bench(plan, seed=seed), tmp_path / f"{name}.h5")
        with Run.open(tmp_path / f"{name}.h5") as measured:
            fields.append(np.stack([measured.field(position) for position in range(5)]))
    np.testing.assert_array_equal(fields[0], fields[1])
    assert (fields[0] != fields[2]).mean() > 0.9


def test_frames_and_holograms_of_one_seed_are_the_same_light(
    small_plan, open_small_bench, tmp_path
):
    fields = []
    for keep in ("holograms", "frames"):
        plan = small_plan({"keep": keep})
        run(plan, open_small_bench(plan), tmp_path / f"{keep}.h5")
        with Run.open(tmp_path / f"{keep}.h5") as measured:
            fields.append([measured.field(position) for position in range(5)])
    np.testing.assert_array_equal(*fields)


def test_in_real_time_the_same_run_is_good(small_plan, open_small_bench, path):
    plan = small_plan({"sweep.last": 16, "settle": "0.1 s"}, pace="realtime")
    begun_s = time.monotonic()
    summary = run(plan, open_small_bench(plan), path)
    assert summary.counts == {Verdict.OK: 2}
    # Four frames a step and the settle time pass on the wall.
    assert time.monotonic() - begun_s > 2 * (4 / 12.4 + 0.1)


def test_the_camera_is_at_most_three_steps_ahead_of_the_disk(tiny_plan, fake_bench, path):
    fake, ahead = fake_bench(), []

    def slow(report):
        time.sleep(0.02)
        ahead.append(fake.names().count("grab") - report.done)

    run(tiny_plan(steps=8), fake.opened(), path, progress=slow)
    assert max(ahead) <= 3


def test_a_run_may_live_on_another_thread(tiny_plan, fake_bench, path):
    summaries = []
    thread = threading.Thread(
        target=lambda: summaries.append(run(tiny_plan(), fake_bench().opened(), path))
    )
    thread.start()
    thread.join()
    assert summaries[0].status is RunState.COMPLETE


# --- What is wrong with a bench becomes a verdict ----------------------------------------------


def verdicts_of(plan, bench, path):
    run(plan, bench, path)
    with Run.open(path) as measured:
        return [step.verdict for step in measured]


def test_the_printed_formula_of_the_paper_is_caught(small_plan, open_small_bench, path):
    """The paper prints (f + f_CCD)/4; decision 0001."""
    plan = small_plan()
    rate_hz = plan.protocol.camera.frame_rate_hz
    steps = []
    for step in plan.steps:
        printed_hz = (step.drive_hz + rate_hz) / 4
        changes = {"difference_hz": printed_hz, "aom1_hz": step.aom2_hz + printed_hz}
        fields = {name: getattr(step, name) for name in type(step).__slots__}
        steps.append(type(step)(**(fields | changes)))
    wrong = Plan(plan.protocol, plan.reed, plan.bench, tuple(steps), ())
    assert verdicts_of(wrong, open_small_bench(wrong), path) == [Verdict.LOCK] * 5
    with Run.open(path) as measured:
        assert max(step.signal_to_noise for step in measured) < 2, "and there is no light"
        assert "off the lock" in measured.steps[0].sentence


@pytest.mark.parametrize(
    ("faults", "verdicts"),
    [
        ({"drop_frame_at": [2, 5]}, ["ok", "dropped", "ok", "ok", "dropped"]),
        ({"stale_frame_at": [3]}, ["ok", "ok", "stale", "ok", "ok"]),
        ({"local_oscillator_factor": 4}, ["saturated"] * 5),
        ({"tweeter_unplugged": True}, ["no_signal"] * 5),
        ({"frame_rate_error_ppm": 5000.0}, ["lock"] * 5),
        ({"frame_rate_error_ppm": 50.0}, ["ok"] * 5),
        # Two things wrong at once: the more severe is named.
        ({"drop_frame_at": [3], "stale_frame_at": [3]}, ["ok", "ok", "dropped", "ok", "ok"]),
        (
            {"stale_frame_at": [3], "frame_rate_error_ppm": 5000.0},
            ["lock", "lock", "stale", "lock", "lock"],
        ),
        ({"frame_rate_error_ppm": 5000.0, "local_oscillator_factor": 4}, ["lock"] * 5),
        ({"local_oscillator_factor": 4, "tweeter_unplugged": True}, ["saturated"] * 5),
    ],
)
def test_each_fault_has_its_verdict(small_plan, open_small_bench, path, faults, verdicts):
    plan = small_plan({"policy.bad_step.retries": 0}, faults=faults)
    assert verdicts_of(plan, open_small_bench(plan), path) == verdicts


def test_a_camera_that_gives_too_few_frames_is_dropped(tiny_plan, fake_bench, path):
    fake = fake_bench()
    bench = fake.opened()
    whole = bench.camera.grab
    bench.camera.grab = lambda count, not_before_s: whole(count, not_before_s)[: fake.next_id % 3]
    verdicts = verdicts_of(tiny_plan(), bench, path)
    assert verdicts == [Verdict.DROPPED] * 3


@pytest.mark.parametrize("to", ["0.52 V", "16 V"])
@pytest.mark.parametrize("when", [("grab", 1), ("set_pair", 2), ("grab", 2)])
def test_an_output_that_tripped_is_not_switched_on_again(tiny_plan, fake_bench, path, when, to):
    """During the frames, or between two steps, whether the volts are then ramped or not."""
    fake = fake_bench()

    def trip(name, count):
        if (name, count) == when:
            fake.output_on = False

    fake.before = trip
    plan = tiny_plan(drive={"law": "ramp", "from": "0.5 V", "to": to, "first": 12, "last": 16})
    with pytest.raises(InstrumentError, match="output is off at step"):
        run(plan, fake.opened(), path)
    assert fake.names().count("set_sine") == when[1] - (when[0] == "set_pair")
    assert left_safe(fake)


def test_an_output_that_tripped_comes_back_where_the_protocol_says_so(
    tiny_plan, fake_bench, lit, path
):
    plan = tiny_plan(**policy(1, "stop"))
    fake = fake_bench(picture=lit(plan))

    def trip(name, count):
        if (name, count) == ("grab", 2):
            fake.output_on = False

    fake.before = trip
    assert run(plan, fake.opened(), path).counts == {Verdict.OK: 3}
    with Run.open(path) as measured:
        assert [interruption.kind for interruption in measured.interruptions] == ["recovered"]


# --- Nothing is touched before all is checked --------------------------------------------------


def test_an_impossible_plan_touches_no_instrument(tiny_plan, fake_bench, path):
    plan, fake = tiny_plan(**{"drive.to": "17 V"}), fake_bench()
    with pytest.raises(ProtocolError, match="17 V is above"):
        run(plan, fake.opened(), path)
    assert fake.log == []
    assert not path.exists()


@pytest.mark.parametrize("name", ["run.h5", "run.documents.jsonl"])
def test_an_existing_file_is_kept_and_no_instrument_touched(tiny_plan, fake_bench, path, name):
    fake, existing = fake_bench(), path.with_name(name)
    existing.write_text("precious")
    with pytest.raises(RunFileError, match="exists already"):
        run(tiny_plan(), fake.opened(), path)
    assert fake.log == []
    assert existing.read_text() == "precious"
    assert list(path.parent.iterdir()) == [existing]


def test_a_missing_folder_or_a_full_disk_is_found_before(
    tiny_plan, fake_bench, tmp_path, monkeypatch
):
    fake = fake_bench()
    with pytest.raises(RunFileError, match="there is no folder"):
        run(tiny_plan(), fake.opened(), tmp_path / "nowhere" / "run.h5")
    usage = type("Usage", (), {"free": 100})
    monkeypatch.setattr("acquire.runner.run_folder.shutil.disk_usage", lambda folder: usage)
    with pytest.raises(RunFileError, match="has 0 MB left; free space"):
        run(tiny_plan(), fake.opened(), tmp_path / "run.h5")
    assert fake.log == []


def test_a_runner_runs_once(tiny_plan, fake_bench, path):
    runner = runner_of(tiny_plan(), fake_bench(), path)
    assert runner.state is RunState.IDLE
    runner.execute()
    assert runner.state is RunState.COMPLETE
    with pytest.raises(RuntimeError, match="complete cannot become opening"):
        runner.execute()


# --- Every way out leaves the bench safe -------------------------------------------------------


@pytest.mark.parametrize("order", USED)
@pytest.mark.parametrize("count", [1, 3])
def test_whatever_fails_the_bench_is_left_safe(tiny_plan, fake_bench, path, order, count):
    """From the count-th time on the order fails, in the run and while switching off."""
    fake = fake_bench(failing={order: count})
    used = {"configure": 1, "rf_on": 1, "start": 1, "output_off": 2, "ramp_to": 2}
    runner = runner_of(tiny_plan(steps=4), fake, path)
    if count > used.get(order, 4):
        assert runner.execute().status is RunState.COMPLETE
    else:
        with pytest.raises(InstrumentError, match=f"{order} fails") as caught:
            runner.execute()
        assert runner.state is RunState.FAILED
        notes = " ".join(getattr(caught.value, "__notes__", []))
        assert (order in notes) == (order in SAFE_OFF)
        assert path.exists() == (fake.names().count("grab") > (order == "grab"))
    attempted = [name for name in fake.names() if name in SAFE_OFF]
    # Whether the output is off is only asked after the order to switch it off went through.
    unanswered = order == "output_off" and count <= used[order]
    expected = [name for name in SAFE_OFF if not (unanswered and name == "read")]
    assert attempted[-len(expected) :] == expected
    assert not fake.running
    assert not fake.rf
    if order != "output_off":
        assert not fake.output_on


def test_each_switch_is_tried_whatever_became_of_the_others(fake_bench):
    names = ["ramp_to", "output_off", "rf_off", "stop"]
    for failing in itertools.chain.from_iterable(
        itertools.combinations(names, count) for count in range(5)
    ):
        fake = fake_bench(failing=dict.fromkeys(failing, 1), output_on=True, rf=True, running=True)
        unconfirmed = safe_off(fake.opened())
        assert [name for name in fake.names() if name in names] == names
        assert len(unconfirmed) == len(failing)
        for name, message in zip(failing, unconfirmed, strict=True):
            assert f"fake: {name} fails" in message


def test_an_output_that_stays_on_is_reported(fake_bench):
    fake = fake_bench(output_on=True)
    bench = fake.opened()
    bench.generator.output_off = lambda: None
    assert safe_off(bench) == (
        "tweeter output off: generator: its output is still on; pull the tweeter's cable",
    )


def test_all_is_switched_off_where_no_thread_can_be_started(fake_bench, monkeypatch):
    fake = fake_bench(output_on=True, rf=True, running=True)

    def refuse(thread):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("threading.Thread.start", refuse)
    assert safe_off(fake.opened()) == ()
    assert left_safe(fake)
    assert not fake.running


def test_what_was_not_confirmed_is_said_at_once_and_in_the_summary(tiny_plan, fake_bench, path):
    said, fake = [], fake_bench(failing={"rf_off": 1})
    summary = run(tiny_plan(), fake.opened(), path, announce=said.append)
    assert summary.status is RunState.COMPLETE
    assert summary.unconfirmed == ("RF off: fake: rf_off fails; mend it",)
    assert [line for line in said if "rf_off fails" in line] == said != []


def test_a_disk_that_does_not_answer_leaves_nothing_on(tiny_plan, fake_bench, path, monkeypatch):
    fake, answers, safe = fake_bench(), threading.Event(), []

    def announce(_line):
        safe.append(left_safe(fake))
        answers.set()

    monkeypatch.setattr("acquire.runner.recorder._PATIENCE_S", 1)
    with pytest.raises(SilentDiskError, match="--resume"):
        run(
            tiny_plan(steps=9),
            fake.opened(),
            path,
            progress=lambda report: answers.wait(30),
            announce=announce,
        )
    assert safe == [True]
    with Run.open(path) as measured:
        assert measured.status == "failed"
        assert measured.steps[0].verdict.measured
        assert not measured.steps[8].verdict.measured


def test_a_ctrl_c_while_switching_off_hides_nothing(tiny_plan, fake_bench, path):
    """Python's own Ctrl-C, which a caller with orders of its own may have left."""
    fake = fake_bench(failing={"rf_off": 1})
    runner = runner_of(tiny_plan(steps=2), fake, path)

    def interrupt(name, count):
        if name == "rf_off":
            signal.raise_signal(signal.SIGINT)

    fake.before = interrupt
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        summary = runner.execute()
    finally:
        signal.signal(signal.SIGINT, before)
    assert summary.unconfirmed == ("RF off: fake: rf_off fails; mend it",)


def test_a_failed_step_keeps_those_before_it(tiny_plan, fake_bench, path):
    fake = fake_bench(failing={"grab": 3})
    with pytest.raises(InstrumentError):
        run(tiny_plan(steps=5), fake.opened(), path)
    with Run.open(path) as measured:
        assert measured.status == "failed"
        assert [step.verdict.measured for step in measured] == [True, True, False, False, False]
        assert measured.steps[2].verdict is Verdict.INTERRUPTED
        assert measured.steps[2].sentence == "fake: grab fails; mend it"
        assert measured.steps[3].verdict is Verdict.PENDING
        measured.field(1)


def test_a_run_that_recorded_nothing_leaves_nothing(tiny_plan, fake_bench, path):
    with pytest.raises(InstrumentError):
        run(tiny_plan(), fake_bench(failing={"rf_on": 1}).opened(), path)
    assert list(path.parent.iterdir()) == []


def test_what_goes_wrong_behind_the_camera_stops_the_run(tiny_plan, fake_bench, path):
    fake = fake_bench()

    def broken(report):
        if report.done == 2:
            raise ZeroDivisionError("a broken display")

    with pytest.raises(ZeroDivisionError, match="a broken display"):
        run(tiny_plan(steps=20), fake.opened(), path, progress=broken)
    assert fake.names().count("grab") <= 6, "soon after the second step"
    assert fake.names()[-5:] == SAFE_OFF
    assert left_safe(fake)
    with Run.open(path) as measured:
        assert measured.status == "failed"


def test_a_disk_that_fills_up_stops_the_run(tiny_plan, fake_bench, path, monkeypatch):
    from runs.writer import RunWriter

    written = RunWriter.write

    def full(writer, position, step):
        if position >= 1:
            raise RunFileError("run.h5: step 2 cannot be written (No space left on device)")
        written(writer, position, step)

    monkeypatch.setattr(RunWriter, "write", full)
    fake = fake_bench()
    with pytest.raises(RunFileError, match="No space left"):
        run(tiny_plan(steps=20), fake.opened(), path)
    assert left_safe(fake)
    with Run.open(path) as measured:
        assert measured.status == "failed"
        assert [step.verdict.measured for step in measured][:2] == [True, False]


# --- Interrupts --------------------------------------------------------------------------------


def test_stop_ends_the_run_at_a_step_boundary(tiny_plan, fake_bench, path):
    fake = fake_bench()
    runner = runner_of(tiny_plan(steps=9), fake, path)
    fake.before = lambda name, count: (name, count) == ("set_sine", 3) and runner.orders.stop()
    summary = runner.execute()
    assert summary.status is runner.state is RunState.INTERRUPTED
    assert sum(summary.counts.values()) == fake.names().count("grab") == 3
    assert fake.names()[-5:] == SAFE_OFF
    assert left_safe(fake)
    with Run.open(path) as measured:
        assert measured.status == "interrupted"
        assert [step.verdict.measured for step in measured] == [True] * 3 + [False] * 6


def test_a_stop_during_the_last_step_leaves_a_complete_run(tiny_plan, fake_bench, path):
    fake = fake_bench()
    runner = runner_of(tiny_plan(steps=2), fake, path)
    fake.before = lambda name, count: (name, count) == ("grab", 2) and runner.orders.stop()
    assert runner.execute().status is RunState.COMPLETE


def test_a_second_ctrl_c_gives_up_the_step_but_not_the_safe_off(tiny_plan, fake_bench, path):
    fake = fake_bench()
    runner = runner_of(tiny_plan(steps=9), fake, path)

    def impatient(name, count):
        switching_off = runner.state is RunState.CLOSING
        if (name, count) == ("grab", 3) or switching_off:
            runner.orders.interrupt()
            runner.orders.interrupt()

    fake.before = impatient
    summary = runner.execute()
    assert summary.status is RunState.INTERRUPTED
    assert summary.unconfirmed == ()
    assert left_safe(fake)
    assert fake.names()[-5:] == SAFE_OFF
    with Run.open(path) as measured:
        verdicts = [step.verdict for step in measured]
        assert [verdict.measured for verdict in verdicts] == [True] * 2 + [False] * 7
        assert verdicts[2] is Verdict.INTERRUPTED
        assert "second Ctrl-C" in measured.steps[2].sentence


def test_a_second_ctrl_c_while_switching_off_changes_nothing(tiny_plan, fake_bench, path):
    fake = fake_bench()
    runner = runner_of(tiny_plan(steps=3), fake, path)
    fake.before = lambda name, count: runner.state is RunState.CLOSING and runner.orders.interrupt()
    runner.orders.stop()
    assert runner.execute().unconfirmed == ()
    assert left_safe(fake)


@pytest.mark.slow
@given(
    events=st.lists(
        st.tuples(
            st.sampled_from(["fail", "stop", "interrupt", "interrupt twice", "break display"]),
            st.integers(0, 40),
        ),
        max_size=3,
    ),
    stubborn=st.sets(st.sampled_from(SAFE_OFF), max_size=2),
)
@settings(
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_whatever_happens_when_the_run_ends_in_a_known_state(
    tiny_plan, fake_bench, tmp_path_factory, events, stubborn
):
    """At any orders instruments fail, people interrupt, or the display breaks."""
    path = tmp_path_factory.mktemp("any") / "run.h5"
    fake, broken = fake_bench(), threading.Event()

    def display(report):
        if broken.is_set():
            raise ZeroDivisionError("a broken display")

    runner = runner_of(tiny_plan(steps=5), fake, path, display)

    def happen(name, count):
        closing = runner.state is RunState.CLOSING
        if closing and name in stubborn:
            raise InstrumentError(f"fake: {name} fails while switching off; mend it")
        for event, when in events:
            if when != len(fake.log):
                continue
            if event == "fail" and not closing:
                raise InstrumentError("fake: fails; mend it")
            if event == "stop":
                runner.orders.stop()
            if event.startswith("interrupt"):
                runner.orders.interrupt()
            if event == "interrupt twice":
                runner.orders.interrupt()
            if event == "break display":
                broken.set()

    fake.before = happen
    try:
        ended = runner.execute().status
    except (InstrumentError, ZeroDivisionError):
        ended = RunState.FAILED
    assert runner.state is ended
    assert ended in (RunState.COMPLETE, RunState.INTERRUPTED, RunState.FAILED)
    switches = [name for name in fake.names() if name in ("ramp_to", "rf_off", "stop")]
    assert switches[-3:] == ["ramp_to", "rf_off", "stop"], "each exactly at the end"
    assert fake.names().count("rf_off") == fake.names().count("stop") == 1
    if not stubborn:
        assert left_safe(fake)
    if not path.exists():
        assert ended is RunState.FAILED
        return
    with Run.open(path) as measured:
        assert measured.status == str(ended)
        whole = [step.verdict.measured for step in measured]
        assert whole == sorted(whole, reverse=True), "the steps measured come first"
        assert all(whole) or ended is not RunState.COMPLETE


# --- Pauses ------------------------------------------------------------------------------------

OPENING = ["output_off", "configure", "rf_on", "start"]


def attend(runner, fake, *actions):
    """At each pause of a run, once all is off, do the next of some actions."""

    def wait():
        given_up_s = time.monotonic() + 20
        for pauses, action in enumerate(actions, 1):
            while fake.names().count("stop") < pauses or fake.running:
                time.sleep(0.002)
                if time.monotonic() > given_up_s:
                    runner.orders.stop()
                    return
            # Whatever the runner does while it is paused would be in the log by then.
            time.sleep(0.15)
            action()

    attendant = threading.Thread(target=wait, daemon=True)
    attendant.start()
    return attendant


def test_while_a_run_is_paused_all_is_off(tiny_plan, fake_bench, lit, path):
    plan, orders, safe = tiny_plan(steps=4), [], []
    fake = fake_bench(picture=lit(plan))
    runner = runner_of(plan, fake, path)

    def look_and_go_on():
        orders.extend(fake.names())
        safe.append(left_safe(fake) and runner.state is RunState.PAUSED)
        runner.orders.proceed()

    attendant = attend(runner, fake, look_and_go_on)
    fake.before = lambda name, count: (name, count) == ("set_sine", 2) and runner.orders.pause()
    summary = runner.execute()
    attendant.join()
    assert safe == [True]
    # The step in work is finished; then all is off, and nothing is asked of the bench.
    assert orders[-8:] == ["grab", "read", "read_pair", *SAFE_OFF]
    assert orders.count("grab") == 2
    later = fake.log[len(orders) :]
    third = plan.steps[2]
    assert [entry[0] for entry in later[:4]] == OPENING
    assert later[4] == ("set_pair", third.aom1_hz, third.aom2_hz)
    assert later[5] == ("set_sine", third.drive_hz, 0.0), "the output comes on without a jump"
    assert later[6] == ("ramp_to", third.volts, RAMP_S)
    assert summary.status is RunState.COMPLETE
    assert left_safe(fake)
    with Run.open(path) as measured:
        assert measured.good.all()
        (interruption,) = measured.interruptions
        assert (interruption.position, interruption.kind) == (2, "paused")
        assert measured.start_time <= interruption.began <= interruption.ended <= measured.end_time
        # Frames are numbered from the camera's start.
        assert measured.steps[2].frame_ids[0] < measured.steps[1].frame_ids[0] + 4


def test_a_run_may_be_paused_again_and_before_its_first_step(tiny_plan, fake_bench, path):
    fake = fake_bench()
    runner = runner_of(tiny_plan(steps=3), fake, path)
    attendant = attend(runner, fake, runner.orders.proceed, runner.orders.proceed)
    fake.before = lambda name, count: (name, count) == ("grab", 2) and runner.orders.pause()
    runner.orders.pause()
    assert runner.execute().status is RunState.COMPLETE
    attendant.join()
    with Run.open(path) as measured:
        found = [(each.position, each.kind) for each in measured.interruptions]
        assert found == [(0, "paused"), (2, "paused")]
        assert all(step.verdict.measured for step in measured)


def test_a_stop_ends_a_pause_and_the_run(tiny_plan, fake_bench, path):
    fake = fake_bench()
    runner = runner_of(tiny_plan(steps=4), fake, path)
    attendant = attend(runner, fake, runner.orders.stop)
    fake.before = lambda name, count: (name, count) == ("grab", 2) and runner.orders.pause()
    assert runner.execute().status is RunState.INTERRUPTED
    attendant.join()
    assert fake.names().count("start") == 1, "nothing was switched on again"
    assert fake.names()[-5:] == SAFE_OFF
    assert left_safe(fake)
    with Run.open(path) as measured:
        assert measured.status == "interrupted"
        assert [step.verdict.measured for step in measured] == [True, True, False, False]
        assert measured.interruptions == ()


def test_who_goes_on_before_the_pause_has_begun_never_paused(tiny_plan, fake_bench, path):
    fake = fake_bench()
    runner = runner_of(tiny_plan(steps=3), fake, path)

    def hesitate(name, count):
        if (name, count) == ("grab", 2):
            runner.orders.pause()
            runner.orders.proceed()

    fake.before = hesitate
    assert runner.execute().status is RunState.COMPLETE
    assert fake.names().count("start") == 1
    with Run.open(path) as measured:
        assert measured.interruptions == ()


def test_a_run_that_is_to_end_does_not_pause_before(tiny_plan, fake_bench, path):
    fake = fake_bench()
    runner = runner_of(tiny_plan(steps=3), fake, path)
    runner.orders.pause()
    runner.orders.stop()
    assert runner.execute().status is RunState.INTERRUPTED
    assert fake.names() == SAFE_OFF, "nothing was switched on"


@pytest.mark.parametrize("order", ["output_off", "rf_off", "stop"])
def test_a_pause_in_which_not_all_is_off_ends_the_run(tiny_plan, fake_bench, path, order):
    """A bench that is thought to be off stays off."""
    fake = fake_bench(failing={order: 2 if order == "output_off" else 1})
    runner = runner_of(tiny_plan(steps=3), fake, path)
    fake.before = lambda name, count: (name, count) == ("grab", 2) and runner.orders.pause()
    said = "switched off to pause, but not all .* confirmed off: .*mend it; "
    with pytest.raises(InstrumentError, match=said):
        runner.execute()
    assert runner.state is RunState.FAILED
    with Run.open(path) as measured:
        assert [step.verdict.measured for step in measured] == [True, True, False]


# --- What happens when an instrument fails -----------------------------------------------------


def policy(retry, then):
    return {"policy.instrument_error": {"retries": retry, "then": then}}


def fail_at(fake, order, counts):
    """Let an order fail at some of its times."""

    def happen(name, count):
        if name == order and count in counts:
            raise InstrumentError(f"fake: {order} fails; mend it")

    fake.before = happen


@pytest.mark.parametrize(
    ("order", "count"),
    # The orders of the third step. Only the first step and those after a failure are ramped to.
    # Before the drive is changed, before the frames and after them the settings are read.
    [
        ("set_pair", 3),
        ("read", 6),
        ("set_sine", 3),
        ("read", 7),
        ("read_pair", 5),
        ("grab", 3),
        ("read", 8),
        ("read_pair", 6),
    ],
)
def test_after_a_failure_all_is_switched_off_and_on_and_the_step_taken_again(
    tiny_plan, fake_bench, lit, path, order, count
):
    plan = tiny_plan(steps=5, **policy(1, "stop"))
    fake = fake_bench(picture=lit(plan))
    fail_at(fake, order, {count})
    summary = run(plan, fake.opened(), path)
    assert (summary.status, summary.counts) == (RunState.COMPLETE, {Verdict.OK: 5})
    assert summary.repeated == 0, "a step that was not measured is not a attempt"
    names = fake.names()
    failed = [k for k, name in enumerate(names) if name == order][count - 1]
    assert names[failed + 1 : failed + 10] == [*SAFE_OFF, *OPENING]
    third, again = plan.steps[2], fake.log[failed + 10 :]
    assert again[0] == ("set_pair", third.aom1_hz, third.aom2_hz)
    assert again[1] == ("set_sine", third.drive_hz, 0.0), "the output comes on without a jump"
    assert again[2] == ("ramp_to", third.volts, RAMP_S)
    assert left_safe(fake)
    with Run.open(path) as measured:
        assert measured.status == "complete"
        assert measured.earlier_attempts == ()
        (interruption,) = measured.interruptions
        assert (interruption.position, interruption.kind) == (2, "recovered")
        assert interruption.reason == f"fake: {order} fails; mend it"


def test_a_step_at_which_an_instrument_keeps_failing_is_done_without(
    tiny_plan, fake_bench, lit, path, documents_of
):
    plan = tiny_plan(steps=4, **policy(1, "skip"))
    fake = fake_bench(picture=lit(plan))
    fail_at(fake, "grab", {2, 3})
    summary = run(plan, fake.opened(), path)
    assert (summary.status, summary.counts) == (RunState.COMPLETE, {Verdict.OK: 3})
    with Run.open(path) as measured:
        assert [step.verdict for step in measured] == ["ok", "skipped", "ok", "ok"]
        assert measured.steps[1].sentence == "fake: grab fails; mend it"
        assert [
            (interruption.position, interruption.kind) for interruption in measured.interruptions
        ] == [(1, "recovered")] * 2
    events = [document["data"] for name, document in documents_of(path) if name == "event"]
    assert [event["index"] for event in events] == [12, 16, 18]


@pytest.mark.parametrize("retry", [0, 2])
def test_a_run_ends_at_an_instrument_that_keeps_failing_if_it_is_to(
    tiny_plan, fake_bench, path, retry
):
    fake = fake_bench(failing={"grab": 3})
    with pytest.raises(InstrumentError, match="grab fails"):
        run(tiny_plan(steps=4, **policy(retry, "stop")), fake.opened(), path)
    assert fake.names().count("grab") == 3 + retry
    assert left_safe(fake)
    with Run.open(path) as measured:
        assert measured.status == "failed"
        assert [step.verdict for step in measured][2:] == ["interrupted", "pending"]
        assert [interruption.kind for interruption in measured.interruptions] == [
            "recovered"
        ] * retry


@pytest.mark.parametrize("then", ["skip", "stop"])
@pytest.mark.parametrize("order", ["ramp_to", "output_off", "rf_off", "stop"])
def test_what_is_not_confirmed_to_be_off_ends_the_run_whatever_the_policy(
    tiny_plan, fake_bench, path, order, then
):
    fake = fake_bench(failing={"grab": 2, order: 1 if order in ("rf_off", "stop") else 2})
    with pytest.raises(InstrumentError, match="grab fails") as caught:
        run(tiny_plan(steps=4, **policy(5, then)), fake.opened(), path)
    notes = " ".join(caught.value.__notes__)
    assert "switched off after an instrument failed, but not all" in notes
    assert f"{order} fails" in notes
    assert fake.names().count("grab") == 2
    with Run.open(path) as measured:
        assert measured.status == "failed"
        assert [step.verdict.measured for step in measured] == [True, False, False, False]
        assert measured.steps[1].verdict is Verdict.INTERRUPTED
        assert measured.steps[1].sentence == "fake: grab fails; mend it"


@pytest.mark.parametrize("order", ["configure", "rf_on", "start"])
def test_a_bench_that_does_not_come_back_ends_the_run(tiny_plan, fake_bench, path, order):
    fake = fake_bench(failing={"grab": 2, order: 2})
    with pytest.raises(InstrumentError, match="grab fails") as caught:
        run(tiny_plan(steps=4, **policy(5, "skip")), fake.opened(), path)
    assert f"{order} fails" in " ".join(caught.value.__notes__)
    assert left_safe(fake)
    with Run.open(path) as measured:
        assert measured.steps[1].verdict is Verdict.INTERRUPTED


def test_what_was_asked_beyond_a_limit_is_not_asked_again(tiny_plan, fake_bench, path):
    fake = fake_bench()

    def refuse(name, count):
        if (name, count) == ("set_sine", 2):
            raise LimitError("generator: was asked for 17 V; ask for less")

    fake.before = refuse
    with pytest.raises(LimitError, match="17 V"):
        run(tiny_plan(**policy(5, "skip")), fake.opened(), path)
    assert fake.names().count("set_sine") == 2
    assert left_safe(fake)


@pytest.mark.slow
@given(
    events=st.lists(
        st.tuples(
            st.sampled_from(["fail", "fail", "pause", "stop", "interrupt"]), st.integers(4, 80)
        ),
        max_size=6,
    ),
    retry=st.integers(0, 2),
    then=st.sampled_from(["skip", "stop"]),
)
@settings(
    deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_whatever_fails_and_whoever_pauses_the_run_ends_in_a_known_state(
    tiny_plan, fake_bench, lit, tmp_path_factory, documents_of, events, retry, then
):
    path = tmp_path_factory.mktemp("any") / "run.h5"
    plan = tiny_plan(steps=4, **policy(retry, then), **{"policy.bad_step.retries": 1})
    fake = fake_bench(picture=lit(plan), spoilt={2: lambda frames: frames[1:]})
    runner = runner_of(plan, fake, path)

    def happen(name, count):
        # Whoever paused the run goes on as soon as all is off.
        if name == "stop" and runner.state is RunState.PAUSED:
            runner.orders.proceed()
        for event, when in events:
            if when != len(fake.log):
                continue
            if event == "fail" and name not in SAFE_OFF:
                raise InstrumentError("fake: fails; mend it")
            # Nothing here would end a second pause of a run that is paused.
            if event == "pause" and runner.state is not RunState.PAUSED:
                runner.orders.pause()
            if event == "stop":
                runner.orders.stop()
            if event == "interrupt":
                runner.orders.interrupt()

    fake.before = happen
    try:
        ended = runner.execute().status
    except InstrumentError:
        ended = RunState.FAILED
    assert runner.state is ended
    assert left_safe(fake)
    assert fake.names()[-5:] == SAFE_OFF
    assert fake.names().count("rf_off") == fake.names().count("stop")
    if not path.exists():
        assert ended is RunState.FAILED
        return
    with Run.open(path) as measured:
        assert measured.status == str(ended)
        verdicts = [step.verdict for step in measured]
        if ended is RunState.COMPLETE:
            assert set(verdicts) <= {Verdict.OK, Verdict.SKIPPED, Verdict.DROPPED}
            assert then == "skip" or Verdict.SKIPPED not in verdicts
        written = [document["data"] for name, document in documents_of(path) if name == "event"]
        attempts = [*measured.steps, *measured.earlier_attempts]
        taken = sorted((t.index, str(t.verdict)) for t in attempts if t.verdict.measured)
        assert sorted((event["index"], event["verdict"]) for event in written) == taken


# --- Giving up ---------------------------------------------------------------------------------


def without_the_reed(frames):
    """The local oscillator alone."""
    rng = np.random.default_rng(0)
    noise = rng.normal(2000, 2, (len(frames), *frames[0].image.shape)).round().astype(np.uint16)
    return [replace(frame, image=image) for frame, image in zip(frames, noise, strict=True)]


@pytest.mark.parametrize("limit", [3, 5])
def test_a_cable_that_is_off_does_not_cost_a_whole_sweep(tiny_plan, fake_bench, lit, path, limit):
    changes = {"policy.give_up_after": limit, "policy.bad_step.retries": 1}
    plan = tiny_plan(steps=20, **changes)
    # From the fifth step on there is no light.
    fake = fake_bench(picture=lit(plan), spoilt=dict.fromkeys(range(5, 99), without_the_reed))
    summary = run(plan, fake.opened(), path)
    assert (summary.status, summary.ended_by) == (RunState.INTERRUPTED, "policy")
    assert f"{limit} steps one after another" in summary.reason
    assert "tweeter's cable" in summary.reason
    assert left_safe(fake)
    # The recorder judges at most three steps behind the camera.
    assert 4 + limit <= fake.names().count("grab") <= 4 + limit + 3
    # Mended, the run is gone on with, and the steps that were lost are measured again.
    mended = fake_bench(picture=lit(plan))
    summary = run(plan, mended.opened(), path, resume=True)
    assert (summary.status, summary.counts) == (RunState.COMPLETE, {Verdict.OK: 20})


def test_bad_steps_among_good_ones_end_no_run(tiny_plan, fake_bench, lit, path):
    plan = tiny_plan(steps=9, **{"policy.give_up_after": 2})
    spoilt = dict.fromkeys((2, 4, 6, 8), lambda frames: frames[1:])
    summary = run(plan, fake_bench(picture=lit(plan), spoilt=spoilt).opened(), path)
    assert (summary.status, summary.ended_by) == (RunState.COMPLETE, "")
    assert summary.counts == {Verdict.OK: 5, Verdict.DROPPED: 4}


def test_a_sweep_whose_last_steps_are_lost_is_given_up_too(tiny_plan, fake_bench, lit, path):
    plan = tiny_plan(steps=6, **{"policy.give_up_after": 3})
    fake = fake_bench(picture=lit(plan), spoilt=dict.fromkeys((4, 5, 6), lambda frames: frames[1:]))
    summary = run(plan, fake.opened(), path)
    assert summary.ended_by == "policy"
    assert "camera's bus cable" in summary.reason


def test_an_instrument_that_fails_at_every_step_is_given_up(tiny_plan, fake_bench, path):
    plan = tiny_plan(steps=9, **policy(0, "skip"), **{"policy.give_up_after": 3})
    summary = run(plan, fake_bench(failing={"grab": 1}).opened(), path)
    assert summary.ended_by == "policy"
    assert "3 skipped" in summary.reason


# --- Signals to real processes -----------------------------------------------------------------

# Reports every step and every change of what is switched on.
CHILD = """
import threading, time
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.protocol import Protocol
from acquire.runner.runner import run
from drivers.registry import open_bench
from drivers.roles import Preparation

protocol = Protocol.from_file("quick").replace({"camera.width": 160, "camera.height": 128})
bench_file = BenchFile.from_file().replace({"twin": {"mesh": "coarse", "pace": pace}})
one_at_a_time = threading.Lock()

def tell(what):
    with one_at_a_time:
        said.send(what)

def watch(lab, over):
    last = None
    while not over.wait(0.001):
        now = lab.state.rf_on, lab.state.drive_v > 0
        if now != last:
            tell(now)
        last = now

with open_bench(bench_file, Preparation("R07", "A", "asymmetric")) as bench:
    over = threading.Event()
    watcher = threading.Thread(target=watch, args=(bench.camera.lab, over))
    watcher.start()
    summary = run(make_plan(protocol, bench_file), bench, path,
                  progress=lambda report: tell(report.done))
    over.set()
    watcher.join()
    state = bench.camera.lab.state
    tell((str(summary.status), bench.generator.read()[2], state.rf_on, state.drive_v))
"""
ENDED_SAFELY = ("interrupted", False, False, 0.0)


def hear(heard, wanted):
    """Everything that a process says until it says what is wanted."""
    said = []
    while wanted not in said[-1:]:
        assert heard.poll(20), f"the process said {said}, but never {wanted}"
        said.append(heard.recv())
    return said


ENDINGS = {
    "ctrl-c": [signal.SIGINT],
    "terminate": [signal.SIGTERM],
    "impatient": [signal.SIGINT, signal.SIGINT, signal.SIGINT],
}


@pytest.mark.slow
def test_a_real_signal_ends_a_real_process_safely(processes, tmp_path):
    # At the same time, because most of it is waiting for frames.
    children = {
        name: processes(CHILD, path=str(tmp_path / f"{name}.h5"), pace="realtime")
        for name in ENDINGS
    }
    for name, (child, heard) in children.items():
        hear(heard, 2)
        for number in ENDINGS[name]:
            os.kill(child.pid, number)
            time.sleep(0.05)
        hear(heard, ENDED_SAFELY)
        child.join(20)
        assert child.exitcode == 0
        with Run.open(tmp_path / f"{name}.h5") as measured:
            assert measured.status == "interrupted"
            whole = [step.verdict.measured for step in measured]
            assert 2 <= sum(whole) < 44
            assert whole == sorted(whole, reverse=True)


def test_real_signals_pause_a_real_process_and_go_on_with_it(processes, path):
    child, heard = processes(CHILD, path=str(path), pace="fast")
    hear(heard, 3)
    os.kill(child.pid, signal.SIGUSR1)
    hear(heard, (False, False))
    while heard.poll(0.3):
        # What was taken before is still reported; nothing is switched on.
        assert isinstance(heard.recv(), int)
    os.kill(child.pid, signal.SIGUSR2)
    hear(heard, (True, True))
    os.kill(child.pid, signal.SIGUSR1)
    hear(heard, (False, False))
    os.kill(child.pid, signal.SIGTERM)
    hear(heard, ENDED_SAFELY)
    child.join(20)
    assert child.exitcode == 0
    with Run.open(path) as measured:
        (interruption,) = measured.interruptions
        assert (interruption.kind, measured.status) == ("paused", "interrupted")
        whole = [step.verdict.measured for step in measured]
        assert 3 <= interruption.position < sum(whole)
        assert whole == sorted(whole, reverse=True)
        assert all(measured.good[: sum(whole)])


def test_the_signal_handlers_of_the_program_come_back(tiny_plan, fake_bench, path):
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2
    before = [signal.getsignal(number) for number in numbers]
    with pytest.raises(InstrumentError):
        run(tiny_plan(), fake_bench(failing={"grab": 1}).opened(), path)
    assert [signal.getsignal(number) for number in numbers] == before


def test_frequencies_reach_the_instruments_as_exact_fractions(tiny_plan, fake_bench, path):
    fake = fake_bench()
    run(tiny_plan(), fake.opened(), path)
    sent = [entry[1] for entry in fake.log if entry[0] in ("set_pair", "set_sine")]
    assert all(isinstance(hz, Fraction) for hz in sent)


def test_a_run_of_several_sidebands_shows_each_of_them(small_plan, open_small_bench, path):
    """Light that leaves the carrier is in the other sidebands; a dark second one is no fault."""
    plan = small_plan({"sideband.orders": [0, 1, 2]})
    summary = run(plan, open_small_bench(plan), path)
    assert summary.counts == {Verdict.OK: 15}
    with Run.open(path) as measured:
        assert measured.sideband_order == 1
        assert [(s.index, s.order) for s in measured] == [(s.index, s.order) for s in plan.steps]
        power = [mean_power(measured.field(p)) / measured.steps[p].noise_level for p in range(15)]
        carrier, first, second = power[:3]
        assert carrier > 10 * first
        assert first > second
        single = {step.drive_hz for step in measured}
        assert len(single) == 5
