"""What a camera delivers is checked once, before anything looks at it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from acquire.runner.received_frames import received
from acquire.runner.runner import run
from drivers.errors import InstrumentError
from drivers.roles import Frame
from runs.reader import Run

SHAPE = (3, 4)


def frame(**changes):
    return replace(Frame(7, 1.5, np.full(SHAPE, 100, np.uint16)), **changes)


def test_what_the_role_promises_passes_as_it_is():
    (found,) = received([frame()], 1.0, SHAPE)
    assert (found.id, found.timestamp_s) == (7, 1.5)
    np.testing.assert_array_equal(found.image, frame().image)


def test_numbers_of_numpy_and_bytes_are_taken_without_loss():
    image = np.asfortranarray(np.arange(12, dtype=np.uint8).reshape(SHAPE))
    (found,) = received(
        [frame(id=np.int32(7), timestamp_s=np.float32(1.5), image=image)], 1.0, SHAPE
    )
    assert (type(found.id), type(found.timestamp_s)) == (int, float)
    assert found.image.dtype == np.uint16
    np.testing.assert_array_equal(found.image, image)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"timestamp_s": math.nan}, "time stamp"),
        ({"timestamp_s": math.inf}, "time stamp"),
        ({"timestamp_s": None}, "time stamp"),
        ({"timestamp_s": "1.5"}, "time stamp"),
        ({"id": 7.5}, "number"),
        ({"id": math.nan}, "number"),
        ({"id": None}, "number"),
        ({"image": np.zeros((4, 3), np.uint16)}, "shape"),
        ({"image": np.zeros((3, 4, 1), np.uint16)}, "shape"),
        ({"image": np.full(SHAPE, 100, np.int32)}, "int32"),
        ({"image": np.full(SHAPE, 100.0)}, "float64"),
        ({"image": np.full(SHAPE, 100, np.uint32)}, "uint32"),
        ({"image": np.full(SHAPE, True)}, "bool"),
        ({"image": None}, "shape"),
    ],
)
def test_anything_else_is_the_driver_s_fault(changes, named):
    with pytest.raises(InstrumentError, match=named):
        received([frame(), frame(**changes)], 1.0, SHAPE)


@pytest.mark.parametrize("changed_s", [math.nan, math.inf])
def test_a_clock_without_a_time_is_refused(changed_s):
    with pytest.raises(InstrumentError, match="clock"):
        received([frame()], changed_s, SHAPE)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda frames: [replace(f, timestamp_s=math.nan) for f in frames],
        lambda frames: [replace(f, image=f.image.astype(np.int32)) for f in frames],
        lambda frames: [replace(f, image=f.image + 0.25) for f in frames],
    ],
)
def test_a_run_does_not_keep_what_it_cannot_keep_as_it_is(tiny_plan, fake_bench, tmp_path, spoil):
    fake = fake_bench(spoilt={2: spoil})
    with pytest.raises(InstrumentError, match=r"camera: .*driver"):
        run(tiny_plan(), fake.opened(), tmp_path / "run.h5")
    with Run.open(tmp_path / "run.h5") as measured:
        assert [step.verdict.measured for step in measured] == [True, False, False]
