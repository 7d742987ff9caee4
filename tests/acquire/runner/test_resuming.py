"""Runs that were ended, failed or were killed, and that another process goes on with."""

import contextlib
import os
import random
import shutil
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import acquire
from acquire.runner.control import controllable
from acquire.runner.resuming import Unfinished, unfinished
from acquire.runner.runner import RunLabels, run
from acquire.runner.summary import RunState
from drivers.errors import InstrumentError
from protocols.bench import BenchFile
from protocols.yaml_files.strict_yaml import find_description
from runs.documents import DocumentLog, documents_path
from runs.errors import RunFileError
from runs.layout import MEASURED, READ_BACK_HZ
from runs.reader import Run
from runs.verdict import Verdict

TWICE = {"policy.bad_step.retries": 1}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.h5"


def dropped(frames):
    return frames[:3]


def events_of(documents):
    return [document["data"] for name, document in documents if name == "event"]


def measured_steps(path):
    """Record and field of every step that a file holds."""
    with Run.open(path) as measured:
        return {
            step.position: (step, measured.field(step.position))
            for step in measured
            if step.verdict.measured
        }


def assert_kept(before, path):
    """Every good step is, bit for bit, what it was."""
    after = measured_steps(path)
    for position, (step, field) in before.items():
        if step.verdict is Verdict.OK:
            assert after[position][0] == step
            np.testing.assert_array_equal(after[position][1], field)


def assert_one_stream(documents, path):
    """One beginning, one end, and each attempt of the run file written once, in order."""
    events = [document for name, document in documents if name == "event"]
    beginning, end = ["start", "descriptor", "descriptor"], ["stream_resource", "stream_datum"]
    assert [name for name, _ in documents] == [
        *beginning, *["event"] * len(events), *end, "stop"
    ]  # fmt: skip
    (start, primary, steps), stop = (found for _, found in documents[:3]), documents[-1][1]
    assert (primary["name"], steps["name"]) == ("primary", "steps")
    assert {d["run_start"] for d in (primary, steps, stop)} == {start["uid"]}
    assert {event["descriptor"] for event in events} == {primary["uid"]}
    assert [event["seq_num"] for event in events] == list(range(1, len(events) + 1))
    assert stop["num_events"] == {"primary": len(events), "steps": start["num_points"]}
    assert len({event["uid"] for event in events}) == len(events)
    with Run.open(path) as measured:
        assert measured.uid == start["uid"]
        expected, attempts = [], Counter()
        for taken in (*measured.earlier_attempts, *measured.steps):
            if taken.verdict.measured:
                attempts[taken.index] += 1
                expected.append((taken.index, attempts[taken.index], str(taken.verdict)))
    written = [event["data"] for event in events]
    assert sorted((t["index"], t["attempt"], t["verdict"]) for t in written) == sorted(expected)


# --- Killed at any moment ----------------------------------------------------------------------


@pytest.fixture
def killed(tiny_plan, fake_bench, lit, tmp_path, monkeypatch):
    """A run with a bad step, and what another process would find if it were killed anywhere.

    That is: before and after everything that the run file hands to the operating system, and after
    every event of the documents.
    """
    plan, path = tiny_plan(**TWICE), tmp_path / "run.h5"
    found, flush, event, finish = [], h5py.File.flush, DocumentLog.event, DocumentLog.finish

    def look():
        if path.is_file():
            contents = path.read_bytes(), documents_path(path).read_bytes()
            if contents not in found[-1:]:
                found.append(contents)

    def flushed(file):
        look()
        flush(file)
        look()

    def logged(log, *what):
        event(log, *what)
        look()

    def finished(log, *how):
        finish(log, *how)
        look()

    with monkeypatch.context() as patch:
        patch.setattr(h5py.File, "flush", flushed)
        patch.setattr(DocumentLog, "event", logged)
        patch.setattr(DocumentLog, "finish", finished)
        fake = fake_bench(picture=lit(plan), spoilt={2: dropped})
        assert run(plan, fake.opened(), path).status is RunState.COMPLETE
    return plan, path, found


@pytest.mark.slow
def test_wherever_a_run_is_killed_it_is_gone_on_with(
    killed, fake_bench, lit, tmp_path, documents_of
):
    plan, whole, found = killed
    undisturbed = events_of(documents_of(whole))
    assert [event["attempt"] for event in undisturbed] == [1, 1, 1, 2]
    seen = set()
    for number, (file, documents) in enumerate(found):
        path = tmp_path / f"killed{number}.h5"
        path.write_bytes(file)
        documents_path(path).write_bytes(documents)
        with Run.open(path) as measured:
            if measured.status == "complete":
                continue
            seen.add(tuple(str(step.verdict) for step in measured))
            bad = Verdict.DROPPED in [
                t.verdict for t in (*measured.steps, *measured.earlier_attempts)
            ]
        before = measured_steps(path)
        summary = run(plan, fake_bench(picture=lit(plan)).opened(), path, resume=True)
        assert (summary.status, summary.counts) == (RunState.COMPLETE, {Verdict.OK: 3})
        assert_kept(before, path)
        with Run.open(path) as measured:
            assert measured.status == "complete"
            # A bad attempt that was whole is neither lost nor kept twice.
            kept = [(attempt.position, attempt.verdict) for attempt in measured.earlier_attempts]
            assert kept == [(1, Verdict.DROPPED)] * len(kept)
            assert bad <= len(kept) == summary.repeated <= 1
            (interruption,) = measured.interruptions
            assert (interruption.kind, interruption.reason) == ("resumed", "the process had died")
            assert interruption.began == ""
        assert_one_stream(documents_of(path), path)
        # Written before the kill or after it, the event is the same.
        firsts = [event for event in events_of(documents_of(path)) if event["attempt"] == 1]
        known = {step.index for step, _ in before.values()}
        assert [event for event in firsts if event["index"] in known] == [
            event for event in undisturbed[:3] if event["index"] in known
        ]
    expected = {("ok", "pending", "pending"), ("ok", "dropped", "ok"), ("ok", "pending", "ok")}
    assert expected <= seen, "before, while and after the bad step was set aside"


# --- Real processes, killed for good -----------------------------------------------------------

SWEEP = """
import acquire

tell = lambda report: said.send(report.done)
said.send("go")
if go_on:
    acquire.resume(plan, path, callbacks=acquire.Callbacks(step=tell))
else:
    calls = acquire.Callbacks(step=tell)
    acquire.run(plan, path, reed="R07", seed=5, labels=labels, callbacks=calls)
"""
LABELS = RunLabels(strength=3.5, note="of a technician who pulls plugs")


@pytest.fixture
def sweep():
    """Plan the quick protocol on few pixels before a coarse reed."""
    small = {"camera.width": 160, "camera.height": 128, "sweep.stride": 4}
    bench = BenchFile.from_file().replace({"twin": {"mesh": "coarse"}})
    return acquire.plan(acquire.load("quick").replace(small), bench).plan


def planned(path):
    """All that a run file holds but what was measured, and when."""
    found = {}
    taken = {*READ_BACK_HZ, *(f"{name}_exact" for name in READ_BACK_HZ), *MEASURED}
    taken |= {"timestamp_s", "frame_id", "verdict", "sentence", "field", "began", "ended"}
    taken |= {"pixel_checksum", "row_checksum", "header_checksum"}
    taken |= {"start_time", "end_time", "status", "entry_identifier_uuid", "reason", "kind"}

    def look(name, item):
        if isinstance(item, h5py.Dataset) and Path(name).name not in taken | {"position"}:
            content = repr(np.asarray(item[()]).tolist())
            found[name] = content, str(item.dtype), repr(sorted(item.attrs.items()))

    with h5py.File(path) as file:
        file.visititems(look)
    return found


@pytest.mark.slow
def test_after_any_number_of_kills_a_run_is_what_it_would_have_been(
    processes, sweep, tmp_path, documents_of
):
    whole, seed = tmp_path / "whole.h5", random.randrange(10**6)
    acquire.run(sweep, whole, reed="R07", seed=5, labels=LABELS)
    rng, kills, files = random.Random(seed), [], 0
    expected, undisturbed = planned(whole), measured_steps(whole)
    assert len(undisturbed) == len(sweep.steps)
    while len(kills) < 8:
        path, before = tmp_path / f"killed{files}.h5", None
        files += 1
        for go_on in (False, True, True):
            child, heard = processes(SWEEP, path=str(path), plan=sweep, labels=LABELS, go_on=go_on)
            # After some steps, and some part of another.
            with contextlib.suppress(EOFError):
                for _ in range(rng.randrange(15)):
                    heard.recv()
            while not path.exists():
                assert child.is_alive()
                time.sleep(0.001)
            time.sleep(rng.uniform(0, 0.02))
            child.kill()
            child.join()
            with Run.open(path) as measured:
                ended = measured.status == "complete"
            if before is not None:
                assert_kept(before, path)
            before = measured_steps(path)
            if not go_on:
                # Nothing but the seed decides what a step looks like.
                for position, (step, field) in before.items():
                    np.testing.assert_array_equal(field, undisturbed[position][1], f"seed {seed}")
                    assert step == undisturbed[position][0]
            if ended:
                break
            kills.append(len(before))
        if not ended:
            assert acquire.resume(sweep, path).status is RunState.COMPLETE
        assert_kept(before, path)
        assert planned(path) == expected
        with Run.open(path) as measured:
            assert measured.status == "complete"
            assert measured.good.all()
            assert measured.earlier_attempts == ()
            assert (measured.reed, measured.seed, measured.labels) == ("R07", 5, LABELS)
            assert {interruption.kind for interruption in measured.interruptions} <= {"resumed"}
        assert_one_stream(documents_of(path), path)
    # The kills fell everywhere into the runs.
    assert len(set(kills)) > 3, kills


# --- A run that was ended is gone on with ------------------------------------------------------


def resumable(fake, plan):
    """A fake bench that passes for that of the plan."""
    return replace(fake.opened(), fingerprint=plan.bench.fingerprint)


def test_an_interrupted_run_goes_on_at_its_first_missing_step(
    tiny_plan, fake_bench, lit, path, documents_of
):
    plan, reports = tiny_plan(steps=5), []
    picture, labels = lit(plan), RunLabels(strength=2.5, note="wet", operator="Ada")

    def give_up_the_third(name, count):
        if (name, count) == ("grab", 3):
            raise KeyboardInterrupt

    fake = fake_bench(picture=picture, before=give_up_the_third)
    assert run(plan, resumable(fake, plan), path, labels).status is RunState.INTERRUPTED
    with Run.open(path) as measured:
        verdicts, ended = [step.verdict for step in measured], measured.end_time
        assert verdicts == ["ok", "ok", "interrupted", "pending", "pending"]
    assert documents_of(path)[-1][1]["exit_status"] == "abort"
    assert unfinished(path, plan) == Unfinished(path, "R07", 1, 3)
    before, fake = measured_steps(path), fake_bench(picture=picture)
    summary = run(plan, resumable(fake, plan), path, None, reports.append, resume=True)
    assert (summary.status, summary.counts) == (RunState.COMPLETE, {Verdict.OK: 5})
    assert [(report.index, report.done) for report in reports] == [(16, 3), (18, 4), (20, 5)]
    third = plan.steps[2]
    assert fake.log[4:7] == [
        ("set_pair", third.aom1_hz, third.aom2_hz), ("set_sine", third.drive_hz, 0.0),
        ("ramp_to", third.volts, 0.1),
    ]  # fmt: skip
    assert_kept(before, path)
    with Run.open(path) as measured:
        assert measured.labels == labels
        (interruption,) = measured.interruptions
        assert (interruption.position, interruption.kind, interruption.began) == (
            2,
            "resumed",
            ended,
        )
        assert interruption.reason == "the run had ended early"
        assert interruption.began <= interruption.ended <= measured.end_time
    assert_one_stream(documents_of(path), path)
    assert documents_of(path)[-1][1]["exit_status"] == "success"


def test_steps_that_were_done_without_are_taken_when_a_run_goes_on(
    tiny_plan, fake_bench, lit, path, documents_of
):
    """And what failed then may fail again: the run stays one that can be gone on with."""
    plan = tiny_plan(steps=5, **{"policy.instrument_error": {"retries": 0, "then": "skip"}})
    fakes = [fake_bench(picture=lit(plan)) for _ in range(3)]

    def fail_at(fake, count, error):
        def happen(name, number):
            if (name, number) == ("grab", count):
                raise error

        fake.before = happen

    fail_at(fakes[0], 2, InstrumentError("fake: fails; mend it"))
    fakes[0].spoilt = {4: lambda frames: 1 / 0}
    with pytest.raises(ZeroDivisionError):
        run(plan, resumable(fakes[0], plan), path)
    verdicts = ["ok", "skipped", "ok", "interrupted", "pending"]
    with Run.open(path) as measured:
        assert [step.verdict for step in measured] == verdicts
    fakes[1].spoilt = {3: lambda frames: 1 / 0}
    with pytest.raises(ZeroDivisionError):
        run(plan, resumable(fakes[1], plan), path, resume=True)
    with Run.open(path) as measured:
        assert measured.status == "failed"
        assert [step.verdict for step in measured] == ["ok"] * 4 + ["interrupted"]
    assert run(plan, resumable(fakes[2], plan), path, resume=True).counts == {Verdict.OK: 5}
    assert [fake.names().count("grab") for fake in fakes] == [4, 3, 1]
    with Run.open(path) as measured:
        assert measured.good.all()
        interruptions = [
            (interruption.position, interruption.kind) for interruption in measured.interruptions
        ]
        assert interruptions == [(1, "recovered"), (1, "resumed"), (4, "resumed")]
    assert_one_stream(documents_of(path), path)


def test_bad_steps_of_a_run_that_was_ended_are_taken_again(
    tiny_plan, fake_bench, lit, path, documents_of
):
    plan = tiny_plan(steps=4, **TWICE)
    fake = fake_bench(picture=lit(plan), spoilt={2: dropped, 3: lambda frames: 1 / 0})
    with pytest.raises(ZeroDivisionError):
        run(plan, resumable(fake, plan), path)
    fake = fake_bench(picture=lit(plan))
    summary = run(plan, resumable(fake, plan), path, resume=True)
    assert (summary.counts, summary.repeated) == ({Verdict.OK: 4}, 1)
    pairs = [entry[1] for entry in fake.log if entry[0] == "set_pair"]
    assert pairs == [plan.steps[position].aom1_hz for position in (2, 3, 1)]
    with Run.open(path) as measured:
        assert [
            (attempt.position, str(attempt.verdict)) for attempt in measured.earlier_attempts
        ] == [(1, "dropped")]
    assert_one_stream(documents_of(path), path)


@pytest.mark.parametrize("retry", [0, 1])
def test_a_run_that_a_bad_step_ended_goes_on_with_that_step_if_it_may_be_taken_again(
    tiny_plan, fake_bench, lit, path, documents_of, retry
):
    plan = tiny_plan(steps=4, **{"policy.bad_step": {"retries": retry, "then": "stop"}})
    fake = fake_bench(picture=lit(plan), spoilt=dict.fromkeys((2, 3), dropped))
    assert run(plan, resumable(fake, plan), path).status is RunState.INTERRUPTED
    fake = fake_bench(picture=lit(plan))
    summary = run(plan, resumable(fake, plan), path, resume=True)
    assert (summary.status, summary.repeated) == (RunState.COMPLETE, 2 * retry)
    pairs = [entry[1] for entry in fake.log if entry[0] == "set_pair"]
    assert pairs == [step.aom1_hz for step in plan.steps[2 - retry :]]
    with Run.open(path) as measured:
        second = "ok" if retry else "dropped"
        assert [step.verdict for step in measured] == ["ok", second, "ok", "ok"]
    assert_one_stream(documents_of(path), path)


def test_a_truncated_line_of_the_documents_is_left_out_and_written_again(
    tiny_plan, fake_bench, lit, path, documents_of
):
    plan = tiny_plan()
    run(plan, resumable(fake_bench(picture=lit(plan)), plan), path)
    lines = documents_path(path).read_text().splitlines(keepends=True)
    written = events_of(documents_of(path))
    for length in (1, 20, len(lines[4]) - 2):
        shutil.copy(path, copy := path.with_name(f"cut{length}.h5"))
        documents_path(copy).write_text("".join(lines[:4]) + lines[4][:length])
        with h5py.File(copy, "r+") as file:
            file["entry/status"][()] = "running"
        fake = fake_bench()
        assert run(plan, resumable(fake, plan), copy, resume=True).status is RunState.COMPLETE
        assert "grab" not in fake.names(), "all was measured"
        assert events_of(documents_of(copy)) == written
        assert_one_stream(documents_of(copy), copy)


# --- Refused in one line, and nothing is changed -----------------------------------------------


@pytest.fixture
def ended(tiny_plan, fake_bench, lit, path):
    """A run of which two steps of four were measured, and its plan."""
    plan = tiny_plan(steps=4)
    fake = fake_bench(picture=lit(plan), spoilt={3: lambda frames: 1 / 0})
    with pytest.raises(ZeroDivisionError):
        run(plan, resumable(fake, plan), path)
    return plan, path


def refused(plan, path):
    """What is said when a run is not gone on with; its files stay as they are."""
    files = [file for file in (path, documents_path(path)) if file.exists()]
    before = [file.read_bytes() for file in files]
    with pytest.raises(RunFileError) as caught:
        acquire.resume(plan, path)
    assert [file.read_bytes() for file in files] == before
    message = str(caught.value)
    assert message.startswith((f"{path}: ", f"{documents_path(path)}: "))
    assert message.isprintable()
    return message.partition(": ")[2]


def test_a_complete_run_is_not_gone_on_with(tiny_plan, fake_bench, lit, path):
    plan = tiny_plan()
    run(plan, resumable(fake_bench(picture=lit(plan)), plan), path)
    assert refused(plan, path) == "is complete; measure a new run"


def test_a_run_that_is_not_there_is_not_gone_on_with(tiny_plan, path):
    assert refused(tiny_plan(), path) == "there is no such file; check the name"


def test_another_protocol_bench_or_reed_is_no_way_to_go_on(
    tiny_plan, small_bench_file, fake_bench, lit, path, tmp_path
):
    reed = tmp_path / "reed.yaml"
    bass = find_description("bass-clarinet", "reed", "reeds").read_text(encoding="utf-8")
    reed.write_text(bass)
    plan = tiny_plan(steps=4, reed=str(reed))
    fake = fake_bench(picture=lit(plan), spoilt={3: lambda frames: 1 / 0})
    with pytest.raises(ZeroDivisionError):
        run(plan, resumable(fake, plan), path)
    assert unfinished(path, plan).missing == 2
    louder = acquire.plan(plan.protocol.replace({"drive.to": "15 V"}), plan.bench).plan
    assert refused(louder, path).startswith("was begun with another protocol (")
    other = acquire.plan(plan.protocol, small_bench_file(loss_factor=0.04)).plan
    assert refused(other, path).startswith("was begun with another bench (")
    reed.write_text(bass.replace("butt: 7.1 mm", "butt: 7.2 mm"))
    again = acquire.plan(plan.protocol, plan.bench).plan
    assert again.reed != plan.reed
    message = refused(again, path)
    assert message.startswith("was begun with another kind of reed (")
    assert f"({plan.reed.sha256[:12]} then, {again.reed.sha256[:12]} now)" in message


HOLDER = """
import time, h5py
with h5py.File(path, mode):
    said.send("open")
    time.sleep(60)
"""


@pytest.mark.parametrize("mode", ["r+", "r"])
def test_a_run_that_another_program_has_open_is_not_gone_on_with(ended, processes, mode):
    """HDF5 locks files; documents that another process may be writing are not touched either."""
    plan, path = ended
    child, heard = processes(HOLDER, path=str(path), mode=mode)
    heard.recv()
    assert "close other programs that have it open" in refused(plan, path)
    child.kill()
    child.join()
    unfinished(path, plan)


def test_a_run_that_is_being_measured_is_not_gone_on_with(ended):
    plan, path = ended
    with controllable(path):
        assert f"is being measured by process {os.getpid()}" in refused(plan, path)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "cannot be read"),
        ("", "does not begin with the documents of a run; measure the sweep again"),
        ("hello\n", "does not begin with the documents of a run"),
        ('["start", {}]\n', "does not begin with the documents of a run"),
        ("[1, 2]\n[3, 4]\n", "does not begin with the documents of a run"),
        ("5\n", "does not begin with the documents of a run"),
        (b"\xff\xfe", "cannot be read"),
    ],
)
def test_a_run_without_its_documents_is_not_gone_on_with(ended, content, expected):
    plan, path = ended
    if content is None:
        documents_path(path).unlink()
    elif isinstance(content, bytes):
        documents_path(path).write_bytes(content)
    else:
        documents_path(path).write_text(content)
    assert expected in refused(plan, path)
