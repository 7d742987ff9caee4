"""Many runs in one process leave it as it was; of rival programs one wins and none does harm."""

import os
import threading

import numpy as np
import pytest

from benchmarks.soaking import contention as soak_contention
from benchmarks.soaking import leaks as soak_leaks


def test_a_slope_is_that_of_the_line_with_its_standard_error():
    assert soak_leaks.slope([3.0] * 9) == (0.0, 0.0)
    per_value, error = soak_leaks.slope(2.0 + 0.5 * np.arange(9))
    assert (per_value, error) == pytest.approx((0.5, 0.0), abs=1e-12)
    noise = np.array([1.0, -1.0, -1.0, 1.0])
    per_value, error = soak_leaks.slope(noise + np.arange(4))
    # Residuals of sum of squares 4 over 2 degrees of freedom, positions of sum of squares 5.
    assert (per_value, error) == pytest.approx((1.0, np.sqrt(2 / 5)))


@pytest.mark.slow
def test_each_kind_of_leak_is_seen():
    kept, stop = [], threading.Event()

    def grow():
        # Beyond 32 MiB glibc always asks the system for new pages (mallopt(3), M_MMAP_THRESHOLD).
        kept.append(np.ones(5_000_000))

    def forget_file():
        kept.append(os.dup(0))

    def forget_thread():
        kept.append(threading.Thread(target=stop.wait))
        kept[-1].start()

    try:
        assert soak_leaks.series("memory", grow, 8, 2).leaks == ["memory_bytes"]
        assert soak_leaks.series("files", forget_file, 5, 2).leaks == ["files"]
        assert soak_leaks.series("threads", forget_thread, 5, 2).leaks == ["threads", "tasks"]
    finally:
        stop.set()
        for each in kept:
            if isinstance(each, int):
                os.close(each)
            elif isinstance(each, threading.Thread):
                each.join()
    assert soak_leaks.series("nothing", lambda: None, 5, 0).leaks == []


@pytest.mark.parametrize(
    "name",
    [
        "runs on the simulated bench",
        "runs on the emulated bench",
        pytest.param("runs that fail", marks=pytest.mark.slow),
    ],
)
def test_runs_leave_no_file_and_no_thread(name, tmp_path):
    done = soak_leaks.series(name, soak_leaks.works(tmp_path)[name], 2, 0)
    for figure in ("files", "threads", "tasks"):
        assert len(set(done.values(figure))) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return soak_contention.Files.write(tmp_path_factory.mktemp("small"))


@pytest.mark.parametrize("name", soak_contention.RIVALRIES)
def test_of_two_that_want_the_same_one_wins_and_nothing_is_harmed(name, files):
    result = soak_contention.rivalry(name, 1, files)
    assert result.met, result


@pytest.mark.slow
def test_processes_on_an_empty_cache_compute_the_reed_once(files):
    result = soak_contention.on_an_empty_cache(2, files)
    assert result.met, result
