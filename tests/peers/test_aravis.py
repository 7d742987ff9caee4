"""The Aravis driver over real GigE Vision: control and packets on this computer's loopback.

The other end is the camera that comes within Aravis. Its frames are ours.
"""

import os
import signal
import subprocess
import sys
import time
import warnings
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from acquire.runner.runner import run
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.registry import open_bench
from drivers.roles import Camera
from protocols.plan import make_plan
from runs.verdict import Verdict

with warnings.catch_warnings():
    # Imports through gi are older than importlib's present manners.
    warnings.simplefilter("ignore")
    from drivers.cameras.aravis import AravisCamera, load_aravis

    try:
        load_aravis()
    except BenchSetupError as absent:
        pytest.skip(f"Aravis is absent: {absent}", allow_module_level=True)

from drivers.emulators.cameras import FakeGigeCamera

REPOSITORY = Path(__file__).resolve().parents[2]
RATE_HZ = Fraction(25)
EXPOSURE_S = Fraction(1, 50)
SHAPE = (48, 64)
CONTEXT = SimpleNamespace(description=SimpleNamespace(name="loopback"))
GRANTED_BYTES = int(Path("/proc/sys/net/core/rmem_max").read_text())
# The far end runs by the wall clock of a machine that may stand still for seconds.
TIMEOUT_S = 10.0
# Registers of GigE Vision.
TIME_CONTROL, TIME_HIGH, TIME_LOW = 0x0944, 0x0948, 0x094C
LOOPBACK_CAMERA = "drivers.emulators.cameras:LoopbackGigeCamera"

# Python warns of the way in which `gi` finds what it imports.
pytestmark = pytest.mark.filterwarnings("ignore::ImportWarning")


def entry(bits=12, **options):
    return SimpleNamespace(
        driver="aravis",
        options={
            "device": "127.0.0.1",
            "pixel_format": "Mono16",
            "timeout_s": TIMEOUT_S,
            **options,
        },
        width=4000,
        height=4000,
        pixel_m=Fraction(69, 20_000_000),
        bits=bits,
        max_frame_rate_hz=Fraction(500),
    )


class Scene:
    """Random pixels of 12 bits, each frame with its number in the corner, and when it was taken."""

    def __init__(self, shape=SHAPE):
        self.rng, self.shape = np.random.default_rng(5), shape
        self.images, self.times_s = {}, {}

    def render(self, exposure_s):
        number = len(self.images)
        image = self.rng.integers(0, 4096, self.shape).astype(np.uint16)
        image[0, :2] = number % 4096, 4095
        self.images[number % 4096], self.times_s[number % 4096] = image, time.monotonic()
        return image

    def numbers(self, frames):
        """Numbers of frames, whose pixels are those that were rendered."""
        for frame in frames:
            np.testing.assert_array_equal(frame.image, self.images[int(frame.image[0, 0])])
        return [int(frame.image[0, 0]) for frame in frames]


@pytest.fixture
def scene():
    return Scene()


@pytest.fixture
def far_end(scene):
    camera = FakeGigeCamera(scene.render)
    yield camera
    camera.close()


@pytest.fixture
def connected(far_end):
    """Open the driver on the far end, set up."""
    opened = []

    def make(rate_hz=RATE_HZ, **options):
        camera = AravisCamera(entry(**options), CONTEXT)
        opened.append(camera)
        camera.configure(rate_hz, min(EXPOSURE_S, 1 / rate_hz), SHAPE)
        return camera

    yield make
    for camera in opened:
        camera.close()


@pytest.mark.parametrize("packet_socket", [True, False], ids=["packet socket", "UDP socket"])
def test_twelve_bits_come_through_as_they_were(connected, scene, packet_socket):
    camera = connected(packet_socket=packet_socket)
    camera.start()
    frames = camera.grab(8, -np.inf)
    assert [frame.id for frame in frames] == list(range(8))
    assert scene.numbers(frames) == list(range(8))
    assert frames[0].image.dtype == np.uint16


@pytest.mark.skipif(
    GRANTED_BYTES < 4_000_000,
    reason=f"sockets get {GRANTED_BYTES} bytes; as root: sysctl -w net.core.rmem_max=4000000",
)
def test_whole_frames_fit_the_socket(far_end):
    shape = (1024, 1280)
    scene = Scene(shape)
    far_end.close()
    far_end = FakeGigeCamera(scene.render)
    camera = AravisCamera(entry(packet_socket=False), CONTEXT)
    try:
        camera.configure(Fraction(62, 5), EXPOSURE_S, shape)
        camera.start()
        frames = camera.grab(8, -np.inf)
        # Not all, if this computer is busy; but without a large buffer there would be none.
        assert frames[-1].id - frames[0].id < 16
        # Numbers count from the first frame that was heard of; what came before it may be lost.
        lost = scene.numbers(frames)[0] - frames[0].id
        assert scene.numbers(frames) == [frame.id + lost for frame in frames]
    finally:
        camera.close()
        far_end.close()


def test_no_frame_from_before_is_handed_over(connected, scene):
    camera = connected()
    camera.start()
    for settle_s in (0.0, 0.1, 0.03):
        time.sleep(0.2)
        set_s = time.monotonic()
        frames = camera.grab(4, camera.now_s() + settle_s)
        assert [b.id - a.id for a, b in pairwise(frames)] == [1, 1, 1]
        # The far end shows the exposure that ends when it renders.
        ends_s = [scene.times_s[number] for number in scene.numbers(frames)]
        assert ends_s[0] - float(EXPOSURE_S) >= set_s + settle_s
        assert np.diff([frame.timestamp_s for frame in frames]) == pytest.approx(
            np.diff(ends_s), abs=2e-2
        )


def test_the_time_is_that_of_the_stamps_and_a_little_late(connected):
    camera = connected()
    before_s = time.monotonic()
    camera.start()
    # The far end stamps with the time of day.
    late_s = camera.now_s() - time.time()
    # The first frame was stamped between the start and now, however slow this computer is; the
    # rest is the drift of two crystals, 0.1 ms per second.
    passed_s = time.monotonic() - before_s
    assert 0 <= late_s <= passed_s * (1 + 2e-4) + 1e-3
    assert "clock, bounded by its start" in camera.identity


def test_a_clock_that_stands_still_is_none(connected, far_end):
    far_end.write_register(TIME_HIGH, 3)
    assert connected().link.latch is None


def test_the_time_is_latched_in_the_registers_of_gige_vision(
    connected, far_end, scene, monkeypatch
):
    device, latched_ns = load_aravis().Device, []
    write = device.write_register

    def write_and_latch(self, address, value):
        """Do what the camera at the far end does not: keep the time when asked to."""
        write(self, address, value)
        if (address, value) == (TIME_CONTROL, 2):
            latched_ns.append(time.time_ns())
            far_end.write_register(TIME_HIGH, latched_ns[-1] >> 32)
            far_end.write_register(TIME_LOW, latched_ns[-1] & 0xFFFFFFFF)

    monkeypatch.setattr(device, "write_register", write_and_latch)
    camera = connected()
    assert "clock, latched" in camera.identity
    assert camera.now_s() == pytest.approx(1e-9 * latched_ns[-1], abs=1e-6)
    camera.start()
    time.sleep(0.2)
    set_s = time.monotonic()
    not_before_s = camera.now_s()
    told_s = time.monotonic()
    frames = camera.grab(4, not_before_s)
    first = scene.numbers(frames)[0]
    begins_s = {n: ends_s - float(EXPOSURE_S) for n, ends_s in scene.times_s.items()}
    assert begins_s[first] >= set_s, "no frame from before"
    # One at most, whose stamp is a little older than its pixels.
    assert sum(told_s <= begins_s[n] < begins_s[first] for n in begins_s) <= 1


def test_lost_packets_leave_gaps_and_no_spoilt_pixels(connected, far_end, scene):
    camera = connected(rate_hz=Fraction(100), timeout_s=5.0)
    camera.start()
    far_end.lose_packets(0.05)
    frames = camera.grab(20, -np.inf)
    numbers = scene.numbers(frames)
    ids = [frame.id for frame in frames]
    assert ids[-1] - ids[0] > len(ids) - 1, "something was lost"
    assert np.diff(ids).tolist() == np.diff(numbers).tolist()


def test_a_socket_that_gets_less_than_it_asks_for_is_named_with_the_remedy(connected):
    link = connected(socket_buffer_bytes=2**30).link
    assert link.loss_remedy.endswith("as root: sysctl -w net.core.rmem_max=1073741824")


def test_nothing_but_lost_packets_is_an_error(connected, far_end):
    far_end.lose_packets(0.6)
    camera = connected(timeout_s=0.3)
    camera.start()
    with pytest.raises(InstrumentError, match=r"frames arrived incomplete|no frame within"):
        camera.grab(20, -np.inf)


def test_frames_that_fell_out_of_the_queue_are_counted(connected, scene):
    camera = connected(rate_hz=Fraction(50), buffer_s=1.0)
    camera.start()
    first = camera.grab(1, -np.inf)
    time.sleep(1.5)
    later = camera.grab(60, -np.inf)
    ids = [frame.id for frame in [*first, *later]]
    assert ids[:51] == list(range(51)), "frames of a second are kept"
    assert ids[-1] > 70
    numbers = scene.numbers([*first, *later])
    assert np.diff(ids).tolist() == np.diff(numbers).tolist()


def test_numbers_go_on_past_65535(connected, scene):
    # The far end begins to count at 65000.
    camera = connected(rate_hz=Fraction(500))
    camera.start()
    frames = []
    while not frames or frames[-1].id < 700:
        frames += camera.grab(50, -np.inf)
    numbers = scene.numbers(frames)
    ids = [frame.id for frame in frames]
    assert np.diff(ids).tolist() == np.diff(numbers).tolist()
    assert min(np.diff(ids)) > 0


def test_a_trigger_that_never_comes_is_an_error(connected):
    camera = connected(trigger="Line0", pulses="elsewhere", timeout_s=0.3)
    camera.start()
    with pytest.raises(InstrumentError, match=r"no frame within .* check the trigger cable at Li"):
        camera.grab(1, -np.inf)


def test_software_triggers_lose_no_frame(connected, scene):
    camera = connected(trigger="software")
    camera.start()
    assert scene.numbers(camera.grab(5, -np.inf)) == list(range(5))


def test_silent_rounding_is_refused(connected, far_end):
    camera = connected()
    write, period_us = camera.link.features.set_real, 0x138

    def set_real(name, value):
        write(name, value)
        # As a camera that counts periods in steps of 5 ms.
        if name == "AcquisitionFrameRate":
            far_end.write_register(period_us, round(1e6 / value / 5000) * 5000)

    camera.link.features.set_real = set_real
    with pytest.raises(InstrumentError, match=r"AcquisitionFrameRate 12\.5 instead of 12\.4"):
        camera.configure(Fraction(62, 5), EXPOSURE_S, SHAPE)


def test_what_the_sensor_cannot_do_is_refused(connected):
    camera = connected()
    with pytest.raises(LimitError, match="Width of 2050 pixels, has 1 to 2048"):
        camera.configure(RATE_HZ, EXPOSURE_S, (48, 2050))


def test_two_programs_cannot_have_the_camera(connected):
    connected()
    with pytest.raises(InstrumentError, match="another program controls it"):
        AravisCamera(entry(), CONTEXT)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"device": "no such"}, InstrumentError, "no such.*not found"),
        ({"serial": "1"}, BenchSetupError, r"options\.serial: unknown key"),
        ({"pixel_format": "Mono12"}, LimitError, "pixels Mono12, has .*Mono16"),
    ],
)
def test_options_that_lead_nowhere_are_refused(far_end, options, error, message):
    with pytest.raises(error, match=message):
        AravisCamera(entry(**options), CONTEXT).configure(RATE_HZ, EXPOSURE_S, SHAPE)


def test_the_only_camera_need_not_be_named(connected):
    assert connected(device=None).identity.startswith("Aravis Fake, serial reedbench")


def test_it_fills_the_role(connected):
    camera = connected()
    assert isinstance(camera, Camera)
    assert camera.identity.startswith("Aravis Fake, serial reedbench, firmware ")
    assert camera.saturation_dn == 4095


# --- A camera that goes away -------------------------------------------------------------------

ALONE = """
import sys, time
import numpy as np
from drivers.emulators.cameras import FakeGigeCamera
far_end = FakeGigeCamera(lambda exposure_s: np.zeros((48, 64), np.uint16))
print("ready", flush=True)
time.sleep(60)
"""


@pytest.fixture
def alone():
    """Start the far end in a process of its own."""
    process = subprocess.Popen(
        [sys.executable, "-c", ALONE], cwd=REPOSITORY, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_camera_that_dies_is_reported_as_gone(alone):
    camera = AravisCamera(entry(timeout_s=20.0), CONTEXT)
    camera.configure(RATE_HZ, EXPOSURE_S, SHAPE)
    camera.start()
    assert len(camera.grab(4, -np.inf)) == 4
    os.kill(alone.pid, signal.SIGKILL)
    with pytest.raises(InstrumentError, match=r"is gone, or another program has taken it"):
        camera.grab(100, -np.inf)
    camera.close()
    camera.close()


# --- The simulated laboratory behind it --------------------------------------------------------


@pytest.fixture
def bench(small_plan):
    plan = small_plan({"camera.width": 64, "camera.height": 48}, pace="realtime")
    driver = {"instruments.camera.driver": LOOPBACK_CAMERA}
    with open_bench(plan.bench.replace(driver), plan.preparation("R07"), seed=3) as bench:
        bench.camera.configure(Fraction(62, 5), Fraction(4, 100), SHAPE)
        bench.camera.start()
        yield bench


def test_the_laboratorys_light_goes_on_between_two_frames(bench):
    """Every frame that is taken for fresh shows the light that was switched before it."""
    for _ in range(2):
        bench.synthesizers.rf_on()
        bright = bench.camera.grab(2, bench.camera.now_s())
        bench.synthesizers.rf_off()
        dark = bench.camera.grab(2, bench.camera.now_s())
        assert all(frame.image.mean() > 500 for frame in bright)
        assert [frame.image.mean() for frame in dark] == pytest.approx([50, 50], abs=1)


def test_a_sweep_runs_over_the_network(small_plan, tmp_path):
    # Aravis' camera stamps its frames to a millisecond or so, which real ones do far better. Steps
    # whose frames come late because this computer is busy are measured again.
    small = {
        "camera.exposure": "40 ms",
        "tolerance.lock_phase": "0.5 rad",
        "policy.bad_step": {"retries": 3, "then": "skip"},
    }
    plan = small_plan(small, pace="realtime")
    bench_file = plan.bench.replace({"instruments.camera.driver": LOOPBACK_CAMERA})
    plan = make_plan(plan.protocol, bench_file)
    with open_bench(bench_file, plan.preparation("R07"), seed=3) as bench:
        summary = run(plan, bench, tmp_path / "run.h5")
    assert summary.counts[Verdict.OK] == len(plan.steps)
    assert summary.unconfirmed == ()


def test_the_laboratory_must_run_in_real_time(small_plan):
    plan = small_plan()
    bench_file = plan.bench.replace({"instruments.camera.driver": LOOPBACK_CAMERA})
    with pytest.raises(BenchSetupError, match="write pace: realtime"):
        open_bench(bench_file, plan.preparation("R07"))
