"""A simulated bench small enough for tests: a coarse reed before a few thousand pixels."""

import fcntl
import os

import pytest

from acquire.bench_file import BenchFile
from acquire.plan import make_plan
from acquire.protocol import Protocol
from drivers.registry import open_bench


@pytest.fixture(scope="session", autouse=True)
def _reed_cache(request):
    """Keep reeds together for all workers and the next time, away from the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("REEDBENCH_CACHE", str(request.config.cache.mkdir("reeds")))
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
