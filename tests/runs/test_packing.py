"""Frames of complete runs: packed without the loss of a bit, or left as they are."""

import os
import shutil
import signal
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from acquire import Callbacks
from acquire import plan as planned
from acquire import run as measure
from acquire.runner.summary import RunState
from protocols.bench import BenchFile
from protocols.protocol import Protocol
from runs import packing
from runs.disk import DiskFile
from runs.errors import DiskError, RunFileError
from runs.packing import Packing, pack
from runs.reader import Run

SMALL = {
    "sweep.first": 60, "sweep.last": 66, "camera.width": 320, "camera.height": 256,
    "keep": "frames",
}  # fmt: skip


@pytest.fixture(scope="module")
def plan():
    bench = BenchFile.from_file("simulated").replace({"twin.mesh": "coarse"})
    return planned(Protocol.from_file("quick").replace(SMALL), bench).plan


@pytest.fixture(scope="module")
def unpacked(plan, tmp_path_factory):
    """A run file that was not packed, the 12 bits of its frames as a camera gives them."""
    path = tmp_path_factory.mktemp("unpacked") / "run.h5"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("acquire.runner.run_session.pack", lambda path, progress: None)
        assert measure(plan, path, reed="R07").status is RunState.COMPLETE
    return path


@pytest.fixture
def path(unpacked, tmp_path):
    return shutil.copy(unpacked, tmp_path / "run.h5")


def contents(path):
    """All that a run file holds: of groups the names, of datasets the bytes; and attributes."""
    found = {}

    def look(name, node):
        attributes = {key: repr(value) for key, value in node.attrs.items()}
        values = node[()] if isinstance(node, h5py.Dataset) else sorted(node)
        raw = values.tobytes() if isinstance(values, np.ndarray) else repr(values)
        found[name] = (raw, repr(getattr(node, "dtype", None)), attributes)

    with h5py.File(path, "r") as file:
        look("/", file)
        file.visititems(look)
        found["link"] = file["entry/data"].get("drive_hz", getlink=True).path
    return found


def test_nothing_is_lost(path, unpacked):
    fractions = []
    packed = pack(path, fractions.append)
    assert contents(path) == contents(unpacked)
    assert packed == Packing(unpacked.stat().st_size, path.stat().st_size)
    assert 0.1 < packed.ratio < 0.9
    with h5py.File(path, "r") as file:
        assert file["entry/data/frames"].compression == "lzf"
        assert file["entry/earlier_attempts/frames"].compression == "lzf"
    with Run.open(path) as run, Run.open(unpacked) as before:
        assert run.steps == before.steps
        for position in range(len(run)):
            np.testing.assert_array_equal(run.field(position), before.field(position))
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def test_a_plan_says_what_is_left(plan, path):
    size = path.stat().st_size
    pack(path)
    assert path.stat().st_size == pytest.approx(plan.packed_size_bytes, rel=0.1)
    assert plan.file_size_bytes < size < plan.largest_size_bytes + 1e6


def test_a_packed_run_and_one_of_holograms_are_left_alone(path, plan, tmp_path):
    pack(path)
    packed = path.read_bytes()
    again = pack(path)
    assert (again.ratio, "already" in again.reason) == (1.0, True)
    assert path.read_bytes() == packed
    holograms = tmp_path / "holograms.h5"
    protocol = plan.protocol.replace(keep="holograms")
    measure(planned(protocol, plan.bench), holograms, reed="R07")
    before = holograms.read_bytes()
    assert "holograms" in pack(holograms).reason
    assert holograms.read_bytes() == before


def test_only_complete_runs_are_packed(plan, tmp_path):
    def stop_at_once(report):
        os.kill(os.getpid(), signal.SIGTERM)

    complete, interrupted = tmp_path / "complete.h5", tmp_path / "interrupted.h5"
    shares = []
    measure(plan, complete, reed="R07", callbacks=Callbacks(packing=shares.append))
    assert shares[-1] == 1.0
    calls = Callbacks(step=stop_at_once)
    summary = measure(plan, interrupted, reed="R07", callbacks=calls).summary
    assert summary.status is RunState.INTERRUPTED
    for path, compression in ((complete, "lzf"), (interrupted, None)):
        with h5py.File(path, "r") as file:
            assert file["entry/data/frames"].compression == compression


def no_room(monkeypatch):
    usage = SimpleNamespace(free=1_000_000)
    monkeypatch.setattr(packing.shutil, "disk_usage", lambda _: usage)


def disk_refuses(monkeypatch):
    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(packing, "_copy_frames", refuse)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (no_room, r"needs \d+ MB .* has 1 MB left"),
        (disk_refuses, r"cannot be packed \(.*No space left"),
    ],
)
def test_what_goes_wrong_leaves_the_run_as_it_was(path, unpacked, monkeypatch, fault, reason):
    fault(monkeypatch)
    with pytest.raises(DiskError, match=f"{path}: .*{reason}.*unchanged") as caught:
        pack(path)
    assert caught.value.exit_status == 1
    assert path.read_bytes() == unpacked.read_bytes()
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def change_a_count(copy):
    copy["entry/data/frames"][-1, -1, -1, -1] += 1


def change_a_number(copy):
    copy["entry/steps/noise_level"][2] *= 1.0001


def change_the_header(copy):
    copy["entry/instrument/laser/wavelength"][()] = 6.4e-7


def lose_its_end(path):
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 1)


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        (change_a_count, "frames 4 of"),
        (change_a_number, "noise_level"),
        (change_the_header, "wavelength"),
        (lose_its_end, "end of the file"),
    ],
)
def test_a_copy_that_comes_back_changed_is_refused(path, unpacked, monkeypatch, fault, named):
    sync = DiskFile.sync

    def damage(disk):
        sync(disk)
        copy = path.with_name(".run.h5.packed")
        if fault is lose_its_end:
            fault(copy)
        else:
            with h5py.File(copy, "r+", locking=False) as file:
                fault(file)

    monkeypatch.setattr(DiskFile, "sync", damage)
    with pytest.raises(DiskError, match=f"packed copy .*{named}"):
        pack(path)
    assert path.read_bytes() == unpacked.read_bytes()
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def test_a_run_with_a_damaged_step_is_not_packed(path, unpacked):
    with h5py.File(path, "r+") as file:
        file["entry/data/frames"][1, 2, 3, 4] ^= 1
    before = path.read_bytes()
    with pytest.raises(RunFileError, match=r"step 62 is damaged .*checksum.*another copy"):
        pack(path)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def test_a_flipped_byte_in_a_packed_run_is_noticed(path):
    pack(path)
    with h5py.File(path, "r+") as file:
        file["entry/data/frames"][1, 2, 3, 4] ^= 1
    with Run.open(path) as run:
        run.frames(0)
        with pytest.raises(RunFileError, match="step 62 is damaged"):
            run.frames(1)


def test_a_run_that_is_not_complete_is_not_packed(path):
    with h5py.File(path, "r+") as file:
        file["entry/status"][()] = "interrupted"
    with pytest.raises(RunFileError, match=r"is interrupted and cannot be packed; .*--resume"):
        pack(path)


def test_ctrl_c_in_the_middle_of_a_copy_is_obeyed_and_harms_nothing(path, unpacked, monkeypatch):
    """Python would raise it inside HDF5, which loses it and a piece of the copy."""
    write, calls = DiskFile.write, []

    def interrupted(disk, data):
        calls.append(None)
        if len(calls) == 20:
            signal.raise_signal(signal.SIGINT)
        return write(disk, data)

    monkeypatch.setattr(DiskFile, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pack(path)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert path.read_bytes() == unpacked.read_bytes()
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def test_a_link_with_the_name_of_the_copy_is_not_followed(path, tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("kept")
    path.with_name(".run.h5.packed").symlink_to(precious)
    assert pack(path).ratio < 1
    assert precious.read_text() == "kept"
    assert not path.is_symlink()


def test_an_interrupted_packing_leaves_the_run_as_it_was(path, unpacked):
    def interrupt(share):
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pack(path, interrupt)
    assert path.read_bytes() == unpacked.read_bytes()
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def test_a_run_that_cannot_be_packed_is_complete_all_the_same(plan, tmp_path, monkeypatch):
    disk_refuses(monkeypatch)
    announced = []
    calls = Callbacks(announce=announced.append)
    summary = measure(plan, tmp_path / "run.h5", reed="R07", callbacks=calls).summary
    assert summary.status is RunState.COMPLETE
    assert "cannot be packed" in announced[-1]
    with Run.open(tmp_path / "run.h5") as run:
        assert run.status == "complete"
        assert run.good.all()
