"""A simulated bench small enough for tests: a coarse reed before a few thousand pixels."""

import contextlib
import fcntl
import os
import signal

import h5py
import numpy as np
import pytest
from hypothesis import settings

from drivers.registry import open_bench
from protocols.bench import BenchFile
from protocols.plan import make_plan
from protocols.protocol import Protocol
from runs.integrity.checksums import (
    header_checksum,
    in_header,
    pixel_checksum,
    row_checksums,
)
from tests.awake import AwakeClock

# No test is a timing: a busy machine, or the measurement of coverage, makes any of them slow.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


def pytest_configure():
    """Take signals as a terminal's programs do, also under nohup or a shell's background job."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in ("SIGHUP", "SIGQUIT", "SIGTERM"):
        signal.signal(getattr(signal, name), signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def _folders_of_the_tests(request, tmp_path_factory):
    """Keep reeds together for all workers and the next time, away from the user's.

    Each worker has bench locks of its own: tests name instruments that do not exist.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("REEDBENCH_CACHE", str(request.config.cache.mkdir("reeds")))
        patch.setenv("REEDBENCH_LOCKS", str(tmp_path_factory.mktemp("locks")))
        yield


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """Return ``made_once(name, make)``: the path of a file that one worker makes for all."""
    base = tmp_path_factory.getbasetemp()
    common = base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base

    def made(name, make):
        # In a folder of its own: some tests take all the files of a folder.
        path = common / f"made-once-{name}" / name
        path.parent.mkdir(exist_ok=True)
        with (common / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                make(path)
        return path

    return made


@pytest.fixture
def awake_s():
    """Return ``awake_s(from_s[, until_s])``: monotonic time less that in which we stood still."""
    with AwakeClock() as clock:
        yield clock.awake_s


@pytest.fixture
def small_bench_file():
    """Return the simulated bench with a coarse reed and changes by key path."""

    def make(**twin):
        return BenchFile.from_file().replace({"twin": {"mesh": "coarse", **twin}})

    return make


@pytest.fixture
def small_plan(small_bench_file):
    """Plan five steps around F1 on 128 × 160 pixels."""

    def make(changes=None, **twin):
        small = {
            "sweep.first": 14,
            "sweep.last": 22,
            "camera.width": 160,
            "camera.height": 128,
            **(changes or {}),
        }
        return make_plan(Protocol.from_file("quick").replace(small), small_bench_file(**twin))

    return make


@pytest.fixture
def open_small_bench():
    """Open the bench of a plan with a reed on it."""
    opened = []

    def make(plan, seed=1, reed="R07"):
        opened.append(open_bench(plan.bench, plan.preparation(reed), seed=seed))
        return opened[-1]

    yield make
    for bench in opened:
        bench.close()


def _values(name, node):
    """What a header checksum may cover, by its path."""
    return {name: node[()]} if isinstance(node, h5py.Dataset) and in_header(name) else {}


@pytest.fixture(scope="session")
def resealed():
    """Return ``resealed(path)``: a run file, open for changes, with new checksums."""

    @contextlib.contextmanager
    def changing(path):
        with h5py.File(path, "r+") as file:
            yield file
            steps, data = file["entry/steps"], file["entry/data"]
            pixels = data[data.attrs["signal"]]
            sums = [pixel_checksum(pixels[k]) for k in range(len(pixels))]
            steps["pixel_checksum"][...] = np.array(sums, dtype=np.uint64)
            steps["row_checksum"][...] = row_checksums({n: steps[n][()] for n in steps})
            header = {}
            file.visititems(lambda name, node: header.update(_values(name, node)))
            file["entry/header_checksum"][()] = header_checksum(header)

    return changing
