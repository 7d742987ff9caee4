"""What a killed process leaves next to a run: cleared by the next one, and by nothing else."""

import json
import os
import signal
import time

import h5py
import pytest

import acquire
from acquire.runner.control import control_path, controllable
from acquire.runner.summary import RunState
from protocols.bench import BenchFile
from runs.documents import DocumentLog, documents_path
from runs.errors import RunFileError
from runs.leftovers import clear_leftovers
from runs.reader import Run, RunLabels

PART, PACKED, REWRITTEN = ".run.h5.part", ".run.h5.packed", "run.documents.part"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.h5"


@pytest.fixture
def begun(tiny_plan, fake_bench, path):
    """Documents of a run whose process died before it had made the run file."""
    DocumentLog.create(path, tiny_plan(), fake_bench().opened(), RunLabels(), "uid").close()
    return documents_path(path)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_nothing_needs_is_removed_and_named(path, begun, tmp_path):
    others = (".other.h5.part", "other.documents.part", ".run.h5.copy", "run.html")
    for name in (PART, PACKED, REWRITTEN, *others):
        (tmp_path / name).write_text("half")
    removed = clear_leftovers(path)
    assert sorted(file.name for file in removed) == sorted([PART, PACKED, REWRITTEN, begun.name])
    assert names(tmp_path) == sorted(others)
    assert clear_leftovers(path) == []


def test_links_are_removed_and_what_they_lead_to_stays(path, tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("kept")
    (tmp_path / PART).symlink_to(precious)
    (tmp_path / PACKED).symlink_to(tmp_path / "nowhere")
    assert len(clear_leftovers(path)) == 2
    assert names(tmp_path) == ["precious.txt"]
    assert precious.read_text() == "kept"


@pytest.mark.parametrize("lines", [0, 1, 2, 3])
@pytest.mark.parametrize("cut", [0, 1, 12])
def test_a_beginning_without_a_step_is_no_run_wherever_it_was_cut(path, begun, lines, cut):
    written = begun.read_text().splitlines(keepends=True)
    begun.write_text("".join(written[:lines]) + "".join(written[lines : lines + 1])[:cut])
    assert clear_leftovers(path) == [begun]


def with_an_event(documents):
    return documents + json.dumps(["event", {"data": {}}]) + "\n"


def with_half_an_event(documents):
    return documents + '["event", {"da'


def of_another_run(documents):
    return documents.replace('"run.h5"', '"other.h5"')


def of_something_else(_documents):
    return "hello\n"


def half_of_something_else(_documents):
    return "hello"


@pytest.mark.parametrize(
    "change",
    [with_an_event, with_half_an_event, of_another_run, of_something_else, half_of_something_else],
)
def test_documents_that_may_be_worth_something_stay_and_block_the_name(
    path, begun, tiny_plan, change
):
    begun.write_text(change(begun.read_text()))
    before = begun.read_bytes()
    assert clear_leftovers(path) == []
    with pytest.raises(RunFileError, match=r"run\.documents\.jsonl: exists already"):
        acquire.run(tiny_plan(), path)
    assert begun.read_bytes() == before
    assert names(path.parent) == [begun.name]


def test_documents_of_a_run_file_stay(path, begun):
    path.write_bytes(b"a run")
    assert clear_leftovers(path) == []


def test_what_cannot_be_removed_is_named(path, tmp_path):
    (tmp_path / PART).mkdir()
    with pytest.raises(RunFileError, match=r"\.run\.h5\.part: .*cannot be removed .*remove it"):
        clear_leftovers(path)


def planned(last):
    small = {"camera.width": 160, "camera.height": 128, "sweep.first": 60, "sweep.last": last}
    bench = BenchFile.from_file().replace({"twin": {"mesh": "coarse"}})
    return acquire.plan(acquire.load("quick").replace({**small, "keep": "frames"}), bench).plan


@pytest.fixture
def plan():
    return planned(66)


def test_a_name_that_a_killed_process_blocked_is_free_again(plan, path, tmp_path):
    (tmp_path / "run.documents.jsonl").write_text('["start", {"uid')
    for name in (PART, PACKED, REWRITTEN):
        (tmp_path / name).write_text("half")
    said = []
    assert (
        acquire.run(plan, path, callbacks=acquire.Callbacks(announce=said.append)).status
        is RunState.COMPLETE
    )
    assert names(tmp_path) == ["run.documents.jsonl", "run.h5"]
    for name in (PART, PACKED, REWRITTEN, "run.documents.jsonl"):
        assert any(name in line and "removed" in line for line in said)


PACKER = """
import os, signal
import acquire

def strike(share):
    if share > 0.3:
        os.kill(os.getpid(), signal.SIGKILL)
acquire.pack(path, callbacks=acquire.Callbacks(packing=strike))
"""


def test_a_run_whose_packing_was_killed_is_packed_the_next_time(plan, path, tmp_path, processes):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("acquire.runner.run_session.pack", lambda _path, _progress: None)
        acquire.run(plan, path)
    before = path.read_bytes()
    child, _ = processes(PACKER, path=str(path))
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert (tmp_path / PACKED).exists()
    assert path.read_bytes() == before
    packed = acquire.pack(path)
    assert packed.ratio < 1
    assert names(tmp_path) == ["run.documents.jsonl", "run.h5"]
    with h5py.File(path) as file:
        assert file["entry/data/frames"].compression == "lzf"


def test_a_run_that_is_in_work_is_neither_packed_nor_cleared(plan, path, tmp_path):
    acquire.run(plan, path)
    (tmp_path / PART).write_text("of the process that has the run in work")
    with controllable(path), pytest.raises(RunFileError, match="is being measured by process"):
        acquire.pack(path)
    assert (tmp_path / PART).exists()
    with pytest.raises(RunFileError, match="no such file"):
        acquire.pack(tmp_path / "no" / "run.h5")


GOING_ON = """
import acquire
from holography.errors import BenchError

said.send("ready")
while not go.exists():
    pass
try:
    said.send(str(acquire.resume(plan, path).status))
except BenchError as error:
    said.send(str(error))
"""


def test_of_two_processes_that_go_on_with_a_run_at_once_one_does(
    path, tmp_path, processes, documents_of
):
    """The other says so, and the run is what it would have been."""

    def end(report):
        # The camera is up to three steps ahead of what is reported.
        if report.done == 1:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.2)

    # Steps enough that some are left when the signal comes.
    plan, go = planned(90), tmp_path / "go"
    assert (
        acquire.run(plan, path, callbacks=acquire.Callbacks(step=end)).status
        is RunState.INTERRUPTED
    )
    both = [processes(GOING_ON, plan=plan, path=path, go=go) for _ in range(2)]
    assert [heard.recv() for _, heard in both] == ["ready", "ready"]
    go.touch()
    said = sorted(heard.recv() for _, heard in both)
    for child, _ in both:
        child.join()
    assert said.count("complete") == 1
    (other,) = (line for line in said if line != "complete")
    assert "is being measured by process" in other or "is complete; measure a new run" in other
    with Run.open(path) as whole:
        assert whole.good.all()
        assert len(whole.interruptions) == 1
        for step in whole:
            whole.field(step.position)
    events = [name for name, _ in documents_of(path) if name in ("event", "stop")]
    assert events == ["event"] * len(plan.steps) + ["stop"]
    assert not control_path(path).exists()
