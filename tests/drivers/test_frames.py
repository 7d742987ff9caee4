"""Frames come out in the order of their exposures, once, with numbers that show what is missing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cameras.frames import (
    LATE_MAX,
    FrameSequence,
    steps_between,
)

PIXELS = np.zeros((2, 3), np.uint16)
PERIOD_S = 0.08


def on_the_wire(index, first):
    """Number that GigE Vision gives to a frame: 16 bits, and never 0."""
    return (first - 1 + index) % 65535 + 1


# --- Numbers -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("earlier", "later", "steps"),
    [
        (1, 2, 1),
        (65535, 1, 1),
        (65534, 2, 3),
        (1, 65535, -1),
        (65409, 65407, -2),
        (0, 1, 1),
        (65535, 65536, 1),
        (2**40, 2**40 + 70_000, 70_000),
        (2**40, 2**40 - 70_000, -70_000),
        (10, 60_000, 59_990),
    ],
)
def test_numbers_wrap_from_65535_to_1(earlier, later, steps):
    assert steps_between(earlier, later) == steps


@given(
    first=st.integers(1, 65535),
    steps=st.integers(-LATE_MAX, 65535 - LATE_MAX - 1),
)
def test_16_bit_numbers_tell_any_step_short_of_a_lap(first, steps):
    assert steps_between(first, on_the_wire(steps, first)) == steps


# --- Sequences ---------------------------------------------------------------------------------


@st.composite
def streams(draw):
    """Indices of frames in the order of arrival: some are lost, some come twice, some late."""
    copies = draw(st.lists(st.sampled_from([1] * 6 + [0, 0, 2]), min_size=1, max_size=40))
    arrivals = [index for index, times in enumerate(copies) for _ in range(times)]
    delays = [draw(st.integers(0, 5)) for _ in arrivals]
    order = sorted(range(len(arrivals)), key=lambda at: arrivals[at] + delays[at])
    return [arrivals[at] for at in order]


@given(
    stream=streams(), first=st.integers(1, 65535), count=st.integers(1, 5), stale=st.integers(0, 10)
)
def test_what_is_taken_is_in_order_once_and_fresh(stream, first, count, stale):
    sequence, taken = FrameSequence(), []
    not_before_s = stale * PERIOD_S
    for index in stream:
        sequence.add(on_the_wire(index, first), index * PERIOD_S, PIXELS + np.uint16(index))
        frames = sequence.take(count, not_before_s, incomplete=True)
        if frames is not None:
            assert len(frames) == count
            taken += frames
    ids = [frame.id for frame in taken]
    assert ids == sorted(set(ids))
    # Frame 0 is the first that was seen, so ids and indices differ by the same number throughout.
    assert all(int(frame.image[0, 0]) - frame.id == stream[0] for frame in taken)
    assert all(frame.timestamp_s >= not_before_s for frame in taken)


@given(stream=streams(), first=st.integers(1, 65535))
def test_nothing_is_kept_back(stream, first):
    sequence, count = FrameSequence(), len(set(stream))
    for index in stream:
        sequence.add(on_the_wire(index, first), 0.0, PIXELS)
    assert sequence.waiting == count
    if count:
        assert len(sequence.take(count, 0.0, incomplete=True)) == count


def filled(*numbers):
    sequence = FrameSequence()
    for number in numbers:
        sequence.add(number, number * PERIOD_S, PIXELS)
    return sequence


def test_a_gap_is_waited_for_by_default():
    assert [f.id for f in filled(1, 2, 4, 5).take(4, 0.0, incomplete=True)] == [0, 1, 3, 4]
    sequence = filled(1, 2, 4, 5)
    assert sequence.take(4, 0.0, incomplete=False) is None
    sequence.add(3, 3 * PERIOD_S, PIXELS)
    assert [frame.id for frame in sequence.take(4, 0.0, incomplete=False)] == [0, 1, 2, 3]


def test_a_frame_that_comes_after_later_ones_were_taken_is_left_out():
    sequence = filled(7, 9)
    sequence.take(2, 0.0, incomplete=True)
    sequence.add(8, 8 * PERIOD_S, PIXELS)
    sequence.add(10, 10 * PERIOD_S, PIXELS)
    assert [frame.id for frame in sequence.take(1, 0.0, incomplete=True)] == [3]


@pytest.mark.parametrize(("first_number", "id"), [(None, 0), (1, 2), (0, 3), (65535, 3)])
def test_a_camera_that_restarts_its_count_shows_what_was_lost_at_the_start(first_number, id):
    sequence = FrameSequence(first_number)
    sequence.add(3, 0.0, PIXELS)
    assert [frame.id for frame in sequence.take(1, 0.0, incomplete=False)] == [id]


def test_frames_passed_over_as_stale_do_not_come_back():
    sequence = filled(1, 2, 3)
    assert [frame.id for frame in sequence.take(1, 2.5 * PERIOD_S, incomplete=False)] == [2]
    assert sequence.take(1, 0.0, incomplete=True) is None
