"""Disks that refuse, lose or change what is written: one line, and nothing half made."""

import errno
import itertools
import os
import resource
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from acquire import load
from acquire.runner.recorder import reconstruction_of
from acquire.runner.runner import run
from drivers.roles import Frame
from runs.disk import DiskFile, error_class
from runs.documents import DocumentLog, documents_path
from runs.errors import DiskError, RunFileError
from runs.reader import (
    MeasuredStep,
    Run,
    RunLabels,
    RunWriter,
)
from runs.verdict import (
    Judgement,
    ReadBack,
    Verdict,
)

ROOT = Path(__file__).parents[2]


@pytest.fixture
def plan(tiny_plan):
    return tiny_plan(steps=3)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.h5"


@pytest.fixture
def create(plan, fake_bench, path):
    def make():
        bench = fake_bench().opened()
        return RunWriter.create(path, plan, bench, RunLabels(), reconstruction_of(plan), "uid")

    return make


def taken(plan, position):
    step, image = plan.steps[position], np.full(plan.frame_shape, 7 + position, np.uint16)
    field = np.full((plan.region.height, plan.region.width), position + 1j, np.complex64)
    read = ReadBack(step.aom1_hz, step.aom2_hz, step.drive_hz, step.volts)
    frames = [Frame(4 * position + k, 1.0 * position, image) for k in range(4)]
    judgement = Judgement(Verdict.OK, f"step {position}")
    return MeasuredStep(read, 1.0, frames, field, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, judgement)


def full(monkeypatch, call, number=errno.ENOSPC):
    """Let the `call`-th write to a `DiskFile`, and those after it, be refused; count them."""
    write, calls = os.pwrite, []

    def refuse(descriptor, data, place):
        calls.append(None)
        if len(calls) >= call:
            raise OSError(number, os.strerror(number))
        return write(descriptor, data, place)

    monkeypatch.setattr("runs.disk.os.pwrite", refuse)
    return calls


# --- While a run file is made ------------------------------------------------------------------


def test_wherever_a_disk_refuses_a_new_run_none_is_left(create, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        calls = full(patch, 10**9)
        create().discard()
    assert len(calls) > 100
    for call in range(1, len(calls), 29):
        with monkeypatch.context() as patch:
            full(patch, call, errno.EIO)
            with pytest.raises(DiskError, match=r"cannot be made .*Input/output error") as refused:
                create()
        assert refused.value.exit_status == 1
        assert list(tmp_path.iterdir()) == []


def cut(path):
    os.truncate(path, path.stat().st_size - 1)


def lose_all(path):
    os.truncate(path, 0)


def zero_a_page(path):
    with path.open("r+b") as file:
        file.seek(4096)
        file.write(bytes(4096))


def change_a_plan(path):
    with h5py.File(path, "r+", locking=False) as file:
        file["entry/steps/volts"][1] *= 1 + 1e-15


def change_a_unit(path):
    with h5py.File(path, "r+", locking=False) as file:
        file["entry/steps/volts"].attrs["units"] = "mV"


def forget_a_column(path):
    with h5py.File(path, "r+", locking=False) as file:
        del file["entry/earlier_attempts/noise_level"]


@pytest.mark.parametrize(
    "fault", [cut, lose_all, zero_a_page, change_a_plan, change_a_unit, forget_a_column]
)
def test_a_new_run_that_comes_back_changed_is_not_begun(create, tmp_path, monkeypatch, fault):
    sync = DiskFile.sync

    def damage(disk):
        sync(disk)
        fault(tmp_path / ".run.h5.part")

    monkeypatch.setattr(DiskFile, "sync", damage)
    with pytest.raises(DiskError, match=r"does not give back what was written .*another disk") as e:
        create()
    assert e.value.exit_status == 1
    assert str(e.value).isprintable()
    assert list(tmp_path.iterdir()) == []


def test_a_new_run_is_on_the_disk_before_it_has_its_name(create, path, monkeypatch):
    synced, sync = [], os.fsync

    def seen(descriptor):
        synced.append(path.exists())
        sync(descriptor)

    monkeypatch.setattr("runs.disk.os.fsync", seen)
    create().close()
    assert synced == [False]


@pytest.mark.parametrize("limit", [100, 60_000, 200_000])
def test_a_disk_that_is_too_small_ends_the_command_with_one_line(tmp_path, limit):
    """A limit on the size of files acts as a full disk does, and needs no rights."""
    small = {"camera.width": 160, "camera.height": 128, "sweep.first": 14, "sweep.last": 30}
    protocol, out = tmp_path / "p.yaml", tmp_path / "runs"
    protocol.write_text(load("quick").replace(small).text)
    out.mkdir()
    done = subprocess.run(
        [sys.executable, "-m", "acquire", "run", protocol, "--out", out / "x.h5", "--no-fit"],
        cwd=ROOT, capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (1, "")
    # Where no reed has been kept yet, that one is computed is said before.
    (line,) = (said for said in done.stderr.splitlines() if said.startswith("acquire: "))
    assert done.stderr.endswith(f"{line}\n")
    assert "File too large" in line
    assert list(out.iterdir()) == []


# --- While a run is measured -------------------------------------------------------------------


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_wherever_a_disk_refuses_a_step_those_before_are_safe(
    create, plan, path, monkeypatch, number
):
    with monkeypatch.context() as patch:
        writer = create()
        calls = full(patch, 10**9)
        writer.write(0, taken(plan, 0))
        last = len(calls)
        writer.discard()
    for call in (*range(1, last, 13), last):
        writer = create()
        writer.write(0, taken(plan, 0))
        with monkeypatch.context() as patch:
            full(patch, call, number)
            with pytest.raises(
                DiskError, match=r"step 2 cannot be written .*steps before are safe"
            ):
                writer.write(1, taken(plan, 1))
        writer.finish("failed")
        with Run.open(path) as run_:
            assert run_.status == "failed"
            assert [step.verdict for step in run_] == ["ok", "pending", "pending"]
            np.testing.assert_array_equal(run_.field(0), taken(plan, 0).field)
        path.unlink()


def test_a_run_is_complete_once_its_steps_are_on_the_disk(create, plan, path, monkeypatch):
    def lost(_descriptor):
        raise OSError(errno.EIO, "Input/output error")

    writer = create()
    writer.write(0, taken(plan, 0))
    monkeypatch.setattr("runs.disk.os.fsync", lost)
    with pytest.raises(DiskError, match=r"cannot be closed .*Input/output error"):
        writer.finish("complete")
    with Run.open(path) as run_:
        assert run_.status == "failed"


def test_a_disk_that_is_full_fails_a_run_once(tiny_plan, fake_bench, lit, path, monkeypatch):
    plan = tiny_plan()
    fake = fake_bench(picture=lit(plan))
    with pytest.raises(DiskError, match="No space left on device") as failed:
        run(plan, fake.opened(), path, progress=lambda _report: full(monkeypatch, 1))
    assert not getattr(failed.value, "__notes__", ())
    monkeypatch.undo()
    with Run.open(path) as run_:
        assert run_.good.tolist() == [True, False, False]


def test_a_bad_sector_is_no_bad_input(create, plan, path, monkeypatch):
    writer = create()
    writer.write(0, taken(plan, 0))
    writer.finish("complete")

    def bad(*_):
        raise OSError("Can't synchronously read data (file read failed, errno = 5, error message "
                      "= 'Input/output error')")  # fmt: skip

    with Run.open(path) as run_:
        monkeypatch.setattr(h5py.Dataset, "__getitem__", bad)
        with pytest.raises(DiskError, match=r"step 12 is damaged \(Input/output error\)"):
            run_.field(0)
    with pytest.raises(DiskError, match="Input/output error"):
        Run.open(path)


# --- Documents ---------------------------------------------------------------------------------


@pytest.fixture
def log(plan, fake_bench, path):
    with DocumentLog.create(path, plan, fake_bench().opened(), RunLabels(), "uid") as log:
        yield log


def test_documents_that_a_disk_refuses_hold_whole_lines(log, path, monkeypatch):
    before = documents_path(path).read_bytes()
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 50, limit[1]))
    try:
        with pytest.raises(
            DiskError, match=r"cannot be written .*too large.*free space"
        ) as refused:
            log.finish("failed", "why")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert refused.value.exit_status == 1
    assert documents_path(path).read_bytes() == before
    log.finish("failed", "why")
    assert b'["stop"' in documents_path(path).read_bytes()


# --- Links, and files that are in use ----------------------------------------------------------


def test_a_link_where_a_run_file_is_made_is_not_followed(create, path, tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("kept")
    path.with_name(".run.h5.part").symlink_to(precious)
    create().finish("complete")
    assert precious.read_text() == "kept"
    assert not path.is_symlink()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["precious.txt", "run.h5"]


def test_a_link_where_documents_are_put_together_is_not_followed(log, path, tmp_path):
    log.close()
    precious = tmp_path / "precious.txt"
    precious.write_text("kept")
    path.with_name("run.documents.part").symlink_to(precious)
    DocumentLog.resume(path).close()
    assert precious.read_text() == "kept"
    assert not documents_path(path).is_symlink()
    assert not path.with_name("run.documents.part").is_symlink()


def test_a_link_that_leads_nowhere_has_a_name_that_is_taken(create, path, tmp_path):
    path.symlink_to(tmp_path / "nowhere")
    with pytest.raises(RunFileError, match="exists already"):
        create()
    assert path.is_symlink()


def test_a_file_that_is_being_written_is_locked(tmp_path):
    path = tmp_path / "some.h5"
    disk = DiskFile.create(path)
    with h5py.File(disk, "w") as file:
        file["data"] = [1, 2, 3]
        file.flush()
        with pytest.raises(BlockingIOError):
            DiskFile.open_existing(path)
        with pytest.raises(BlockingIOError):
            h5py.File(path, "r")
        with h5py.File(path, "r", locking=False) as reader:
            assert reader["data"][()].tolist() == [1, 2, 3]
    disk.close()
    disk.close()
    DiskFile.open_existing(path).close()


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), DiskError),
        (RuntimeError("file write failed: errno = 5, error message = 'x'"), DiskError),
        (PermissionError(errno.EACCES, "Permission denied"), RunFileError),
        (FileNotFoundError(errno.ENOENT, "No such file or directory"), RunFileError),
        (ValueError("no number"), RunFileError),
    ],
)
def test_a_disk_that_refuses_is_reported_from_a_wrong_name(error, kind):
    assert error_class(error) is kind


def test_an_identity_that_is_never_the_same_twice_is_no_fault_of_the_disk(plan, fake_bench, path):
    """A driver may count, or add a temperature; its serial line may return a null character."""
    bench, readings = fake_bench().opened(), itertools.count()

    class Counting:
        saturation_dn = 4095

        @property
        def identity(self):
            return f"camera\0 A,\n{next(readings)} readings\x1b"

    bench.camera = Counting()
    RunWriter.create(path, plan, bench, RunLabels(), reconstruction_of(plan), "uid").close()
    with Run.open(path) as run:
        assert run.identities["camera"] == "camera A, 0 readings"
