"""A simulated bench small enough for tests: a coarse reed before a few thousand pixels."""

import pytest

from acquire.bench_file import BenchFile
from acquire.plan import make_plan
from acquire.protocol import Protocol
from drivers.registry import open_bench


@pytest.fixture(scope="session")
def reed_cache(tmp_path_factory):
    """Keep reeds that are built in this session together, away from the user's."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("reeds")
        patch.setenv("REEDBENCH_CACHE", str(folder))
        yield folder


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
def open_small_bench(reed_cache):
    """Open the bench of a plan with a reed on it."""
    opened = []

    def make(plan, seed=1, reed="R07"):
        opened.append(open_bench(plan.bench, plan.preparation(reed), seed=seed))
        return opened[-1]

    yield make
    for bench in opened:
        bench.close()
