"""The clock by which waits are limited."""

import time

import pytest

from tests.awake import AwakeClock, Stalls


def test_time_in_which_the_process_stood_still_does_not_count():
    stalls = Stalls(0.0)
    for now_s in (0.02, 0.05, 3.05, 3.07):
        stalls.note(now_s)
    # The stall of 3 s counts as long as a busy machine may be late, 50 ms.
    assert stalls.awake_s(0.0, 3.07) == pytest.approx(0.12)
    assert stalls.awake_s(1.05, 3.07) == pytest.approx(0.02)
    assert stalls.awake_s(0.0, 0.05) == pytest.approx(0.05)


def test_a_wait_counts_whole():
    with AwakeClock() as clock:
        began_s = time.monotonic()
        time.sleep(0.3)
        ended_s = time.monotonic()
        assert clock.awake_s(began_s) > 0.2
    assert 0.2 < clock.awake_s(began_s, ended_s) <= ended_s - began_s
