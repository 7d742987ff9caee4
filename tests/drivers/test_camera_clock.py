"""Camera clocks err to one side: no frame is believed to have begun later than it did."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cameras.clock import (
    ArrivalClock,
    BoundedClock,
    LatchedClock,
)
from drivers.simulated.lab import VirtualClock

EXPOSURE_S = 0.03
PERIOD_S = 0.08


class CameraTime:
    """A crystal that began at another time and runs at another pace."""

    def __init__(self, host, offset_s, drift):
        self.host, self.offset_s, self.drift = host, offset_s, drift

    def at(self, host_s):
        return self.offset_s + (1 + self.drift) * host_s

    def now_s(self):
        return self.at(self.host.now_s())


crystals = st.tuples(st.floats(1.0, 1e6), st.floats(-0.99e-4, 0.99e-4))
delays = st.lists(st.floats(0.0, 0.3), min_size=1, max_size=20)


@given(crystal=crystals, delays=delays, pause_s=st.floats(0, 7200), at_end=st.booleans())
def test_a_bounded_clock_is_never_early_and_late_by_no_more_than_it_says(
    crystal, delays, pause_s, at_end
):
    host = VirtualClock()
    host.wait(5.0)
    camera = CameraTime(host, *crystal)
    clock = BoundedClock(host.now_s, stamped_at_end=at_end)
    clock.started()
    began_s = host.now_s() + 0.01
    for delay_s in delays:
        stamped_s = began_s + EXPOSURE_S if at_end else began_s
        host.wait(stamped_s + delay_s - host.now_s())
        believed_s = clock.began_s(camera.at(stamped_s), 0.0, EXPOSURE_S)
        assert believed_s == pytest.approx(camera.at(began_s), abs=1e-5)
        began_s += PERIOD_S
    host.wait(pause_s)
    late_s = clock.now_s() - camera.now_s()
    assert -1e-9 <= late_s <= clock.error_s + 1e-9


def test_the_first_frame_gives_the_time_as_well_as_it_followed_the_start():
    host = VirtualClock()
    camera = CameraTime(host, 1000.0, 0.0)
    clock = BoundedClock(host.now_s, stamped_at_end=False)
    host.wait(3.0)
    clock.started()
    assert not clock.known
    for delay_s in (0.007, 0.004, 0.020):
        host.wait(delay_s + 3.002 - host.now_s())
        clock.began_s(camera.at(host.now_s() - delay_s), 0.0, EXPOSURE_S)
    assert clock.now_s() == pytest.approx(camera.now_s() + 0.002, abs=1e-5)
    assert clock.error_s == pytest.approx(0.002 + 0.004, abs=1e-5)


def test_a_bounded_clock_does_not_guess():
    clock = BoundedClock(VirtualClock().now_s, stamped_at_end=False)
    with pytest.raises(ValueError, match="no frame has come"):
        clock.now_s()


@given(began_s=st.floats(1.0, 10.0), readout_s=st.floats(0.0, PERIOD_S), poll_s=st.floats(0, 0.01))
def test_arrivals_are_dated_no_later_than_they_began(began_s, readout_s, poll_s):
    clock = ArrivalClock(VirtualClock().now_s, readout_s=PERIOD_S)
    absent_s = began_s + EXPOSURE_S + readout_s - poll_s
    assert clock.began_s(0.0, absent_s, EXPOSURE_S) <= began_s


@pytest.mark.parametrize(("at_end", "began_s"), [(False, 7.0), (True, 7.0 - EXPOSURE_S)])
def test_a_latched_clock_goes_by_the_camera_alone(at_end, began_s):
    clock = LatchedClock(lambda: 42.0, stamped_at_end=at_end)
    assert clock.now_s() == 42.0
    assert clock.began_s(7.0, 0.0, EXPOSURE_S) == began_s
