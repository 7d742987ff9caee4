"""Cameras that round, refuse, lose and lag, against the one driver that all of them share."""

import math
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.cameras.frames import Delivery
from drivers.cameras.genicam import (
    GenicamSettings,
    apply_settings,
    timestamp_latch,
)
from drivers.cameras.genicam_camera import GenicamCamera
from drivers.cameras.genicam_options import CameraOptions, pulses_for
from drivers.cameras.trigger import CameraTrigger
from drivers.context import BenchContext
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.roles import Camera
from drivers.simulated.lab import VirtualClock

RATE_HZ = Fraction(62, 5)
PERIOD_S = float(1 / RATE_HZ)
EXPOSURE_S = Fraction(3, 100)
SHAPE = (8, 12)

# How two generations of cameras call the same things.
NEW = {"exposure": "ExposureTime", "rate": "AcquisitionFrameRate", "possible": "ResultingFrameRate"}
OLD = {
    "exposure": "ExposureTimeAbs",
    "rate": "AcquisitionFrameRateAbs",
    "possible": "ResultingFrameRateAbs",
}


class FakeFeatures:
    """A camera's features: each a value, a range, and what it does with a value that is set."""

    def __init__(self, names=NEW, **changes):
        self.values = {
            "Width": 1440,
            "Height": 1080,
            "WidthMax": 1440,
            "HeightMax": 1080,
            "OffsetX": 0,
            "OffsetY": 0,
            names["exposure"]: 10_000.0,
            names["rate"]: 200.0,
            names["possible"]: 226.0,
            "AcquisitionFrameRateEnable": False,
            "ExposureAuto": "Continuous",
            "ExposureMode": "TriggerWidth",
            "AcquisitionMode": "SingleFrame",
            "PixelFormat": "Mono8",
            "TriggerSelector": "FrameBurstStart",
            "TriggerSource": "Line1",
            "TriggerActivation": "FallingEdge",
        } | changes
        self.values = {name: value for name, value in self.values.items() if value is not None}
        self.triggers = {"FrameBurstStart": "On", "FrameStart": "Off"}
        self.enumerations = {
            "PixelFormat": ("Mono8", "Mono12"),
            "TriggerSelector": tuple(self.triggers),
            "TriggerSource": ("Software", "Line1", "Line2"),
        }
        self.steps = {"Width": 4, "Height": 2, "OffsetX": 4, "OffsetY": 2}
        self.ranges = {names["exposure"]: (20.0, 1e7), "Width": (4, 1440), "Height": (2, 1080)}
        self.rounding = {}
        self.writes = []

    def has(self, name):
        return name in self.values or name == "TriggerMode"

    def writable(self, name):
        return self.has(name)

    def integer(self, name):
        return self.values[name]

    real = integer

    def text(self, name):
        if name == "TriggerMode":
            return self.triggers[self.values["TriggerSelector"]]
        return self.values[name]

    def _set(self, name, value):
        self.writes.append((name, value))
        if name == "TriggerMode":
            self.triggers[self.values["TriggerSelector"]] = value
        else:
            self.values[name] = self.rounding.get(name, lambda same: same)(value)

    set_integer = set_real = set_text = _set

    def set_switch(self, name, on):
        self._set(name, on)

    def integer_range(self, name):
        least, most = self.ranges.get(name, (0, 2000))
        return least, most, self.steps[name]

    def real_range(self, name):
        return self.ranges[name]

    def choices(self, name):
        return self.enumerations[name]

    def execute(self, name):
        self.writes.append((name, None))


def asked(**changes):
    settings = {
        "frame_rate_hz": RATE_HZ,
        "exposure_s": EXPOSURE_S,
        "shape": (1024, 1280),
        "pixel_format": "Mono12",
        "trigger": "free",
    }
    return GenicamSettings(**(settings | changes))


# --- Settings ----------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [NEW, OLD], ids=["new names", "old names"])
def test_a_free_running_camera_gets_all_that_was_asked(names):
    features = FakeFeatures(names)
    apply_settings(features, asked(), "test")
    assert features.values[names["exposure"]] == 30_000
    assert features.values[names["rate"]] == pytest.approx(12.4)
    assert features.values["AcquisitionFrameRateEnable"] is True
    assert features.values["ExposureAuto"] == "Off"
    assert features.values["ExposureMode"] == "Timed"
    assert features.values["AcquisitionMode"] == "Continuous"
    assert features.values["PixelFormat"] == "Mono12"
    assert features.triggers == {"FrameBurstStart": "Off", "FrameStart": "Off"}


@pytest.mark.parametrize("shape", [(1024, 1280), (1080, 1440), (2, 4), (512, 636)])
def test_the_middle_of_the_sensor_is_read_out(shape):
    features = FakeFeatures(OffsetX=100, OffsetY=100)
    apply_settings(features, asked(shape=shape), "test")
    for side, offset, sensor, pixels in (("Y", 2, 1080, shape[0]), ("X", 4, 1440, shape[1])):
        middle = features.values[f"Offset{side}"] + pixels / 2
        assert abs(middle - sensor / 2) <= offset / 2 + 1
        assert features.values[f"Offset{side}"] % offset == 0
    widened = [name for name, _ in features.writes].index("Width")
    assert ("OffsetX", 0) in features.writes[:widened]


def test_an_external_trigger_starts_frames_at_its_rising_edge_and_nothing_else_does():
    features = FakeFeatures()
    apply_settings(features, asked(trigger="Line2"), "test")
    assert features.triggers == {"FrameBurstStart": "Off", "FrameStart": "On"}
    assert features.values["TriggerSource"] == "Line2"
    assert features.values["TriggerActivation"] == "RisingEdge"
    assert features.values["AcquisitionFrameRateEnable"] is False


@pytest.mark.parametrize(
    ("name", "rounding", "message"),
    [
        ("Width", lambda value: value - 4, "Width 1276 instead of 1280"),
        ("ExposureTime", lambda value: min(value, 10_000.0), "ExposureTime 10000 instead of 30000"),
        ("AcquisitionFrameRate", lambda value: 12.5, "AcquisitionFrameRate 12.5 instead of 12.4"),
        ("PixelFormat", lambda _: "Mono8", "PixelFormat Mono8 instead of Mono12"),
    ],
)
def test_silent_rounding_is_refused(name, rounding, message):
    features = FakeFeatures()
    features.rounding[name] = rounding
    with pytest.raises(InstrumentError, match=message):
        apply_settings(features, asked(), "test")


def test_rounding_to_whole_microseconds_is_none():
    features = FakeFeatures()
    features.rounding["ExposureTime"] = round
    features.rounding["AcquisitionFrameRate"] = lambda hz: 1e6 / round(1e6 / hz)
    apply_settings(features, asked(), "test")
    assert features.values["AcquisitionFrameRate"] != 12.4


def test_a_camera_that_cannot_keep_the_rate_is_refused():
    with pytest.raises(InstrumentError, match=r"takes 12\.3 frames per second.*shorten camera"):
        apply_settings(FakeFeatures(ResultingFrameRate=12.3), asked(), "test")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": (1024, 1282)}, "Width of 1282 pixels, has 4 to 1440 in steps of 4"),
        ({"shape": (1082, 1280)}, "Height of 1082 pixels"),
        ({"exposure_s": Fraction(1, 100_000)}, "expose 10 µs, has 20"),
        ({"pixel_format": "Mono16"}, "pixels Mono16, has Mono8, Mono12"),
        ({"trigger": "Line3"}, "triggered by Line3, has Software, Line1, Line2"),
    ],
)
def test_what_the_camera_does_not_know_changes_nothing(changes, message):
    features = FakeFeatures()
    with pytest.raises(LimitError, match=message):
        apply_settings(features, asked(**changes), "test")
    assert features.writes == []


def test_a_camera_without_a_rate_needs_a_trigger():
    features = FakeFeatures(AcquisitionFrameRate=None)
    with pytest.raises(LimitError, match="has no AcquisitionFrameRate"):
        apply_settings(features, asked(), "test")
    apply_settings(features, asked(trigger="Line1"), "test")


@pytest.mark.parametrize(
    ("known", "command", "time_s"),
    [
        ({"TimestampLatch": 0, "TimestampLatchValue": 1_500_000_000}, "TimestampLatch", 1.5),
        (
            {
                "GevTimestampControlLatch": 0,
                "GevTimestampValue": 250_000_000,
                "GevTimestampTickFrequency": 125_000_000,
            },
            "GevTimestampControlLatch",
            2.0,
        ),
    ],
)
def test_the_time_is_latched_before_it_is_read(known, command, time_s):
    features = FakeFeatures(**known)
    assert timestamp_latch(features)() == time_s
    assert features.writes == [(command, None)]


def test_a_camera_without_a_latch_has_none():
    assert timestamp_latch(FakeFeatures()) is None


# --- A camera that runs ------------------------------------------------------------------------


@dataclass
class FakeLink:
    """A free-running camera whose frames show their index, on a link with a queue.

    `flying` are the frames on their way, each with the time of its arrival.
    """

    host: VirtualClock
    delay_s: object = lambda index: 0.02
    lost: frozenset = frozenset()
    broken: frozenset = frozenset()
    clock: str = "latch"
    stamped_at_end: bool = False
    offset_s: float = 1000.0
    dark_after_s: float = math.inf
    stalls_s: dict = field(default_factory=dict)
    idle_stalls_s: list = field(default_factory=list)
    spoil: object = lambda delivery: delivery
    features: FakeFeatures = field(default_factory=FakeFeatures)
    camera: str = "fake 1"
    identity: str = "fake camera, serial 1"
    loss_remedy: str = "mend the link"
    first_number: int | None = None

    def __post_init__(self):
        self.triggers_s, self.started_s, self.delivered = [], None, 0
        self.flying, self.queue, self.next_index = [], [], 0

    @property
    def stamps_frames(self):
        return self.clock != "none"

    @property
    def latch(self):
        return self._latched if self.clock == "latch" else None

    def _latched(self):
        self.host.wait(0.001)
        time_s = self.host.now_s() + self.offset_s
        self.host.wait(0.001)
        return time_s

    def open_stream(self, buffers):
        self.flying, self.queue, self.next_index, self.buffers = [], [], 0, buffers

    def start(self):
        assert self.started_s is None, "starts once"
        self.started_s = self.host.now_s() + 0.005

    def stop(self):
        self.started_s = None

    def close(self):
        pass

    def trigger(self):
        self.triggers_s.append(self.host.now_s())
        self.host.wait(0.005)

    def began_s(self, index):
        if self.triggers_s:
            return self.triggers_s[index] if index < len(self.triggers_s) else math.inf
        return self.started_s + index * PERIOD_S

    def receive(self, timeout_s):
        until_s = self.host.now_s() + timeout_s
        while True:
            self._come_in()
            if self.queue:
                delivery = self.spoil(self._delivery(self.queue.pop(0)))
                # The computer has something else to do.
                self.host.wait(self.stalls_s.get(self.delivered, 0.0))
                self.delivered += 1
                return delivery
            if self.host.now_s() >= until_s:
                self.host.wait(self.idle_stalls_s.pop(0) if self.idle_stalls_s else 0.0)
                return None
            times_s = [at_s for at_s, _ in self.flying] + [self.began_s(self.next_index), until_s]
            now_s = self.host.now_s()
            self.host.wait(min(time_s for time_s in times_s if time_s > now_s) - now_s)

    def _come_in(self):
        now_s = self.host.now_s()
        while self.began_s(self.next_index) <= min(now_s, self.dark_after_s):
            index = self.next_index
            if index not in self.lost:
                end_s = self.began_s(index) + float(EXPOSURE_S)
                self.flying.append((end_s + self.delay_s(index), index))
            self.next_index += 1
        arrived = sorted(flight for flight in self.flying if flight[0] <= now_s)
        self.flying = [flight for flight in self.flying if flight[0] > now_s]
        # A queue that is full takes no more.
        self.queue = (self.queue + [index for _, index in arrived])[: self.buffers]

    def _delivery(self, index):
        stamp_s = self.began_s(index) + self.offset_s
        if self.stamped_at_end:
            stamp_s += float(EXPOSURE_S)
        if index in self.broken:
            # What is left in the buffer from another frame.
            return Delivery(index % 3, 1e-3, None)
        number = (65530 - 1 + index) % 65535 + 1
        image = np.full(SHAPE, index, np.uint16)
        return Delivery(number, stamp_s if self.stamps_frames else 0.0, image)


ENTRY = SimpleNamespace(width=1440, height=1080, bits=12, max_frame_rate_hz=Fraction(50))


def camera_on(link, pulses=None, **options):
    camera = GenicamCamera(link, ENTRY, CameraOptions(**options), pulses, link.host)
    camera.configure(RATE_HZ, EXPOSURE_S, SHAPE)
    return camera


def running(**link):
    link = FakeLink(VirtualClock(), **link)
    camera = camera_on(link)
    camera.start()
    return camera, link


def indices(frames):
    return [int(frame.image[0, 0]) for frame in frames]


@st.composite
def streams(draw):
    late = draw(st.dictionaries(st.integers(0, 60), st.floats(0.0, 0.08), max_size=10))
    delay_s = draw(st.floats(0.0, 0.08))
    return {
        "delay_s": lambda index: late.get(index, delay_s),
        "lost": draw(st.frozensets(st.integers(1, 60), max_size=6)),
        "broken": draw(st.frozensets(st.integers(1, 60), max_size=6)),
        "clock": draw(st.sampled_from(["latch", "bounded", "none"])),
        "stamped_at_end": draw(st.booleans()),
        "stalls_s": draw(st.dictionaries(st.integers(0, 60), st.floats(0.0, 0.5), max_size=10)),
    }


@given(
    stream=streams(), pauses_s=st.lists(st.floats(0.0, 2.0), min_size=1, max_size=4),
    settle_s=st.floats(0.0, 0.3), count=st.integers(1, 5),
)  # fmt: skip
@example(
    stream={
        "delay_s": lambda _: 0.08, "lost": frozenset(), "broken": frozenset(), "clock": "none",
        "stamped_at_end": False,
        "stalls_s": {0: 0.375, 2: 0.5, 8: 0.5, 14: 0.5, 20: 0.5, 27: 0.5},
    },
    pauses_s=[2.0], settle_s=0.0, count=1,
)  # fmt: skip
@settings(max_examples=200, deadline=None)
def test_no_frame_from_before_is_ever_handed_over(stream, pauses_s, settle_s, count):
    camera, link = running(**stream)
    taken = []
    for pause_s in pauses_s:
        link.host.wait(pause_s)
        set_s = link.host.now_s()
        try:
            frames = camera.grab(count, camera.now_s() + settle_s)
        except InstrumentError:
            # Only a computer that is away for longer than a timeout may be kept from catching up.
            assert sum(stream["stalls_s"].values()) > CameraOptions().timeout_s
            break
        assert min(link.began_s(index) for index in indices(frames)) >= set_s + settle_s - 1e-9
        taken += frames
    got = indices(taken)
    assert got == sorted(set(got))
    assert not set(got) & (link.lost | link.broken)
    # Ids count what was lost, broken, or fell out of the queue.
    assert [b.id - a.id for a, b in pairwise(taken)] == [b - a for a, b in pairwise(got)]


def test_frames_are_consecutive_if_none_is_lost():
    camera, link = running()
    for _ in range(3):
        ids = [frame.id for frame in camera.grab(4, camera.now_s())]
        assert ids == list(range(ids[0], ids[0] + 4))
        link.host.wait(3.0)


def test_many_frames_take_longer_than_the_timeout():
    camera, _ = running()
    assert indices(camera.grab(60, 0.0)) == list(range(60))


def test_a_late_frame_is_put_in_its_place():
    camera, _ = running(delay_s=lambda index: 0.02 + (0.19 if index == 2 else 0.0))
    assert indices(camera.grab(4, 0.0)) == [0, 1, 2, 3]


def test_a_busy_computer_gives_up_no_frame_that_lies_ready():
    # Frame 2 comes after frame 5, and while the computer does something else.
    delays_s = {2: 0.249, 5: 0.0}
    camera, _ = running(delay_s=lambda index: delays_s.get(index, 0.02), stalls_s={4: 0.3})
    assert indices(camera.grab(4, 0.0)) == [0, 1, 2, 3]


def test_a_computer_that_was_away_misses_no_frame():
    camera, link = running(idle_stalls_s=[0.0, 5.0])
    assert len(camera.grab(4, 0.0)) == 4
    assert link.host.now_s() > 5.0


def test_frames_of_a_second_are_kept():
    camera, link = running()
    link.host.wait(1.0)
    assert indices(camera.grab(12, 0.0)) == list(range(12))


def test_half_of_all_frames_may_be_broken():
    camera, _ = running(broken=frozenset(range(0, 400, 2)))
    assert indices(camera.grab(100, 0.0)) == list(range(1, 201, 2))


@pytest.mark.parametrize("fate", ["lost", "broken"])
def test_a_missing_frame_is_waited_for_no_longer_than_a_period(fate):
    camera, link = running(**{fate: frozenset({2})})
    assert indices(camera.grab(4, 0.0)) == [0, 1, 3, 4]
    assert link.host.now_s() < 6.5 * PERIOD_S


def test_time_stamps_are_those_of_the_exposures():
    camera, link = running(stamped_at_end=True)
    for frame in camera.grab(4, 0.0):
        began_s = link.began_s(int(frame.image[0, 0])) + link.offset_s
        assert frame.timestamp_s == pytest.approx(began_s, abs=1e-9)


def test_the_time_is_that_of_the_stamps():
    camera, link = running()
    before_s, now_s = link.host.now_s(), camera.now_s()
    assert before_s <= now_s - link.offset_s <= link.host.now_s()


@pytest.mark.parametrize(
    ("link", "message"),
    [
        ({"dark_after_s": 0.0}, r"no frame within .* s; check the camera's cable"),
        ({"broken": frozenset(range(100))}, r"frames arrived incomplete .*; mend the link"),
    ],
)
def test_no_good_frame_is_an_error(link, message):
    camera, link = running(**link)
    with pytest.raises(InstrumentError, match=message):
        camera.grab(4, 0.0)
    # The timeout, a period and an exposure; and what may lie in the queue.
    patience_s = 2.0 + PERIOD_S + float(EXPOSURE_S)
    assert patience_s < link.host.now_s() < patience_s + 1.5 + 5 * PERIOD_S


def test_a_missing_trigger_is_named():
    link = FakeLink(VirtualClock(), dark_after_s=0.0)
    camera = camera_on(link, trigger="Line1", timeout_s=0.5)
    camera.start()
    with pytest.raises(InstrumentError, match=r"no frame within .* check the trigger cable at L"):
        camera.grab(1, 0.0)


def test_a_long_settling_time_is_no_missing_frame():
    camera, _ = running()
    assert len(camera.grab(1, camera.now_s() + 30.0)) == 1


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ({"stamp_s": 1.0}, r"frames arrived, but all began before .* check its clock"),
        ({"stamp_s": 1e9}, "later than its clock says"),
        ({"stamp_s": 0.0}, "without a time stamp"),
        ({"image": np.full(SHAPE, 4096, np.uint16)}, "pixels up to 4096, but has 12 bits"),
        ({"image": np.zeros((4, 5), np.uint16)}, "sent 5 x 4 pixels, but was set to 12 x 8"),
    ],
)
def test_what_cannot_be_a_frame_is_refused(spoil, message):
    camera, _ = running(spoil=lambda delivery: replace(delivery, **spoil))
    with pytest.raises(InstrumentError, match=message):
        camera.grab(1, camera.now_s())


def test_what_a_broken_frame_says_does_not_set_the_clock():
    camera, link = running(clock="bounded", broken=frozenset({0, 2}))
    camera.grab(3, 0.0)
    assert camera.now_s() >= link.host.now_s() + link.offset_s


def test_a_software_trigger_keeps_the_rate_and_takes_nothing_in_vain():
    link = FakeLink(VirtualClock())
    camera = camera_on(link, trigger="software")
    camera.start()
    link.host.wait(1.0)
    frames = camera.grab(5, camera.now_s() + 0.5)
    assert indices(frames) == [0, 1, 2, 3, 4]
    gaps_s = [b - a for a, b in pairwise(link.triggers_s)]
    assert gaps_s == pytest.approx([PERIOD_S] * 4, abs=1e-9)


def test_a_software_trigger_that_was_late_is_back_in_step_with_the_next():
    link = FakeLink(VirtualClock(), stalls_s={1: 0.05})
    camera = camera_on(link, trigger="software")
    camera.start()
    camera.grab(5, camera.now_s())
    late, *gaps = [(at - link.triggers_s[1]) / PERIOD_S for at in link.triggers_s[2:]]
    assert 1.1 < late < 1.9
    assert gaps == pytest.approx([2, 3], abs=1e-9)


# --- Pulses from another instrument ------------------------------------------------------------


class PulseSource:
    def __init__(self, link):
        self.link, self.log = link, []

    def play_pulses(self, frame_rate_hz):
        self.log.append(("play", frame_rate_hz, self.link.started_s is not None))

    def stop_pulses(self):
        self.log.append("stop")
        raise InstrumentError("cannot be reached")


def triggered(context, **options):
    options = CameraOptions(trigger="Line1", **options)
    link = FakeLink(VirtualClock())
    camera = GenicamCamera(link, ENTRY, options, pulses_for(options, context), link.host)
    camera.configure(RATE_HZ, EXPOSURE_S, SHAPE)
    return camera, link


@pytest.fixture
def context():
    return BenchContext(SimpleNamespace(name="a bench"), None, None, lambda _: None)


def test_pulses_are_played_while_the_camera_runs(context):
    camera, link = triggered(context)
    source = PulseSource(link)
    context.share(CameraTrigger).offer(source)
    camera.start()
    assert source.log == [("play", RATE_HZ, True)], "the camera is ready for them"
    with pytest.raises(InstrumentError, match="cannot be reached"):
        camera.stop()
    assert source.log[1:] == ["stop"]
    assert link.started_s is None, "the camera is stopped all the same"
    camera.start()
    camera.close()
    assert source.log[2:] == [("play", RATE_HZ, True), "stop"]


def test_a_camera_that_was_opened_again_stops_the_pulses_of_the_one_before(context):
    camera, link = triggered(context)
    source = PulseSource(link)
    context.share(CameraTrigger).offer(source)
    with pytest.raises(InstrumentError, match="cannot be reached"):
        camera.stop()
    assert source.log == ["stop"]


def test_a_camera_whose_start_was_interrupted_is_stopped():
    class Interrupted(FakeLink):
        def start(self):
            super().start()
            raise KeyboardInterrupt

    link = Interrupted(VirtualClock())
    camera = camera_on(link)
    with pytest.raises(KeyboardInterrupt):
        camera.start()
    camera.stop()
    assert link.started_s is None


def test_a_camera_that_did_not_stop_is_stopped_again(monkeypatch):
    camera, link = running()
    asked = []

    def refuse():
        asked.append(len(asked))
        raise InstrumentError("does not stop")

    monkeypatch.setattr(link, "stop", refuse)
    for _ in range(2):
        with pytest.raises(InstrumentError, match="does not stop"):
            camera.stop()
    assert asked == [0, 1]


def test_pulses_that_are_not_played_are_missed(context):
    camera, _ = triggered(context)
    with pytest.raises(BenchSetupError, match="no instrument plays them; add camera_trigger"):
        camera.start()


def test_pulses_from_elsewhere_are_waited_for(context):
    camera, _ = triggered(context, pulses="elsewhere")
    camera.start()
    assert len(camera.grab(1, 0.0)) == 1


# --- States and limits -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frame_rate_hz": Fraction(51)}, "51 frames per second, can do up to 50"),
        ({"frame_rate_hz": Fraction(0)}, "0 frames per second"),
        ({"exposure_s": Fraction(1, 12)}, "shorten camera.exposure"),
        ({"shape": (1082, 8)}, "8 x 1082 pixels, has 1440 x 1080"),
        ({"shape": (0, 8)}, "8 x 0 pixels"),
    ],
)
def test_limits_of_the_bench_file_are_checked_before_anything_is_sent(changes, message):
    link = FakeLink(VirtualClock())
    camera = camera_on(link)
    link.features.writes.clear()
    settings = {"frame_rate_hz": RATE_HZ, "exposure_s": EXPOSURE_S, "shape": SHAPE} | changes
    with pytest.raises(LimitError, match=message):
        camera.configure(**settings)
    assert link.features.writes == []
    camera.start()
    assert len(camera.grab(1, 0.0)) == 1, "the settings from before hold"


def test_settings_that_the_camera_does_not_know_leave_those_from_before():
    camera = camera_on(FakeLink(VirtualClock()))
    with pytest.raises(LimitError, match="in steps of 4"):
        camera.configure(RATE_HZ, EXPOSURE_S, (8, 10))
    camera.start()
    assert len(camera.grab(1, 0.0)) == 1


def test_settings_that_were_not_confirmed_are_no_settings():
    link = FakeLink(VirtualClock())
    camera = camera_on(link)
    link.features.rounding["Width"] = lambda value: value - 4
    with pytest.raises(InstrumentError):
        camera.configure(RATE_HZ, EXPOSURE_S, SHAPE)
    with pytest.raises(InstrumentError, match="without settings"):
        camera.start()


def test_settings_cannot_change_while_it_runs():
    camera, _ = running()
    with pytest.raises(InstrumentError, match="is running"):
        camera.configure(RATE_HZ, EXPOSURE_S, SHAPE)


def test_a_stopped_camera_has_no_frames():
    camera, _ = running()
    camera.stop()
    camera.stop()
    with pytest.raises(InstrumentError, match="is stopped"):
        camera.grab(1, 0.0)


def test_a_restart_counts_from_0():
    camera, _ = running()
    camera.grab(4, 0.0)
    camera.start()
    assert [frame.id for frame in camera.grab(2, 0.0)] == [0, 1]


def test_bits_and_pixels_must_agree():
    link = FakeLink(VirtualClock())
    with pytest.raises(BenchSetupError, match=r"Mono8 hold 8 bits, but instruments\.camera"):
        GenicamCamera(link, ENTRY, CameraOptions(pixel_format="Mono8"), host=link.host)
    GenicamCamera(link, ENTRY, CameraOptions(pixel_format="Mono16"), host=link.host)


@pytest.mark.parametrize(("stated", "used"), [(None, 4095), (4000, 4000), (5000, 4095)])
def test_saturation_is_the_lesser_of_adc_and_what_is_stated(stated, used):
    link = FakeLink(VirtualClock())
    assert camera_on(link, saturation_dn=stated).saturation_dn == used


def test_it_fills_the_role_and_says_what_its_times_are():
    camera, _ = running()
    assert isinstance(camera, Camera)
    assert camera.identity == "fake camera, serial 1; times of the camera's clock, latched"
