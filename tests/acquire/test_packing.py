"""Frames of complete runs: packed without the loss of a bit, or left as they are."""

import os
import shutil
import signal
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from acquire import packing
from acquire.bench_file import BenchFile
from acquire.errors import RunFileError
from acquire.packing import pack
from acquire.protocol import Protocol
from acquire.runfile import Run
from acquire.runner import RunState
from acquire.script import plan as planned
from acquire.script import run as measure

SMALL = {
    "sweep.first": 60, "sweep.last": 66, "camera.width": 320, "camera.height": 256,
    "keep": "frames",
}  # fmt: skip


@pytest.fixture(scope="module")
def plan():
    bench = BenchFile.from_file("simulated").replace({"twin.mesh": "coarse"})
    return planned(Protocol.from_file("quick").replace(SMALL), bench)


@pytest.fixture(scope="module")
def unpacked(plan, tmp_path_factory):
    """A run file that nobody packed, the 12 bits of its frames as a camera gives them."""
    path = tmp_path_factory.mktemp("unpacked") / "run.h5"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("acquire.script.pack", lambda path, progress: 1.0)
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
    told = []
    share = pack(path, told.append)
    assert contents(path) == contents(unpacked)
    assert share == path.stat().st_size / unpacked.stat().st_size
    with h5py.File(path, "r") as file:
        assert file["entry/data/frames"].compression == "lzf"
        assert file["entry/retakes/frames"].compression == "lzf"
    with Run.open(path) as run, Run.open(unpacked) as before:
        assert run.steps == before.steps
        for position in range(len(run)):
            np.testing.assert_array_equal(run.field(position), before.field(position))
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def test_a_plan_says_what_is_left(plan, path):
    size = path.stat().st_size
    pack(path)
    assert path.stat().st_size == pytest.approx(plan.packed_size_bytes, rel=0.1)
    assert plan.file_size_bytes < size < plan.largest_size_bytes + 1e6


def test_a_packed_run_and_one_of_holograms_are_left_alone(path, plan, tmp_path):
    pack(path)
    packed = path.read_bytes()
    assert pack(path) == 1.0
    assert path.read_bytes() == packed
    holograms = tmp_path / "holograms.h5"
    protocol = plan.protocol.replace(keep="holograms")
    measure(planned(protocol, plan.bench), holograms, reed="R07")
    before = holograms.read_bytes()
    assert pack(holograms) == 1.0
    assert holograms.read_bytes() == before


def test_only_complete_runs_are_packed(plan, tmp_path):
    def stop_at_once(report):
        os.kill(os.getpid(), signal.SIGTERM)

    complete, interrupted = tmp_path / "complete.h5", tmp_path / "interrupted.h5"
    shares = []
    measure(plan, complete, reed="R07", packing=shares.append)
    assert shares[-1] == 1.0
    summary = measure(plan, interrupted, reed="R07", progress=stop_at_once)
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
    ("fault", "said"),
    [
        (no_room, r"may take \d+ MB for a while, but its disk has 1 MB left"),
        (disk_refuses, r"cannot be packed \(.*No space left"),
    ],
)
def test_what_goes_wrong_leaves_the_run_as_it_was(path, unpacked, monkeypatch, fault, said):
    fault(monkeypatch)
    with pytest.raises(RunFileError, match=f"{path}: .*{said}.*the file is whole as it is"):
        pack(path)
    assert path.read_bytes() == unpacked.read_bytes()
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def test_a_copy_that_differs_by_one_count_is_refused(path, unpacked):
    def damage(share):
        if share == pytest.approx(0.7):
            with h5py.File(path.with_name(".run.h5.packed"), "r+") as copy:
                copy["entry/data/frames"][-1, -1, -1, -1] += 1

    with pytest.raises(RunFileError, match="frames come back changed"):
        pack(path, damage)
    assert path.read_bytes() == unpacked.read_bytes()
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


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
    told = []
    summary = measure(plan, tmp_path / "run.h5", reed="R07", announce=told.append)
    assert summary.status is RunState.COMPLETE
    assert "cannot be packed" in told[-1]
    with Run.open(tmp_path / "run.h5") as run:
        assert run.status == "complete"
        assert run.good.all()
