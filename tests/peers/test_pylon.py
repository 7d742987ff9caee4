"""The Basler driver over the real pylon and its camera emulator: files instead of light.

The emulator stamps nothing, has no wire, and waits for a computer that is slow. So time stamps,
lost packets and queues that overflow are shown elsewhere.
"""

import os
import time
import warnings
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

# Read by pylon when it is loaded: two cameras, so that one has to be named.
os.environ.setdefault("PYLON_CAMEMU", "2")
with warnings.catch_warnings():
    # What pylon's wrapper warns of is no matter of ours.
    warnings.simplefilter("ignore")
    pytest.importorskip(
        "pypylon.pylon", reason="pypylon is absent; install it: pip install 'reedbench[basler]'"
    )

from acquire.runner.runner import run
from drivers.cameras.basler import BaslerCamera
from drivers.emulators.cameras import write_images
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.registry import open_bench
from drivers.roles import Camera
from protocols.plan import make_plan
from runs.verdict import Verdict

RATE_HZ = Fraction(40)
EXPOSURE_S = Fraction(1, 100)
SHAPE = (48, 64)
FILES = 7
CONTEXT = SimpleNamespace(description=SimpleNamespace(name="emulated"))
EMULATED_CAMERA = "drivers.emulators.cameras:EmulatedBaslerCamera"


def entry(bits=12, **options):
    return SimpleNamespace(
        driver="basler",
        options={"serial": "0815-0000", **options},
        width=8000,
        height=8000,
        pixel_m=Fraction(69, 20_000_000),
        bits=bits,
        max_frame_rate_hz=Fraction(200),
    )


@pytest.fixture
def images():
    rng = np.random.default_rng(7)
    images = [rng.integers(0, 4096, SHAPE).astype(np.uint16) for _ in range(FILES)]
    images[0][0, :4] = 0, 1, 4094, 4095
    return images


@pytest.fixture
def emulated(images, tmp_path):
    """Open a camera that plays the images, over and over, in order."""
    opened = []

    def make(**options):
        camera = BaslerCamera(entry(**options), CONTEXT)
        opened.append(camera)
        camera.configure(RATE_HZ, EXPOSURE_S, SHAPE)
        write_images(images, tmp_path, bits=12)
        features = camera.link.features
        features.set_text("TestImageSelector", "Off")
        features.set_text("ImageFilename", str(tmp_path))
        features.set_text("ImageFileMode", "On")
        return camera

    yield make
    for camera in opened:
        camera.close()


def require_played(frames, images):
    for frame in frames:
        assert frame.image.dtype == np.uint16
        np.testing.assert_array_equal(frame.image, images[frame.id % FILES])


def test_twelve_bits_come_through_as_they_were(emulated, images):
    camera = emulated()
    camera.start()
    frames = camera.grab(2 * FILES, -np.inf)
    assert [frame.id for frame in frames] == list(range(2 * FILES))
    require_played(frames, images)


def test_settings_arrive_and_lie_in_the_middle(emulated):
    features = emulated().link.features
    assert features.real("AcquisitionFrameRate") == pytest.approx(40)
    assert features.real("ExposureTime") == pytest.approx(10_000)
    assert features.text("PixelFormat") == "Mono12"
    sensor = features.integer("WidthMax"), features.integer("HeightMax")
    assert (features.integer("OffsetX"), features.integer("OffsetY")) == (
        (sensor[0] - SHAPE[1]) // 2,
        (sensor[1] - SHAPE[0]) // 2,
    )


def test_frames_are_those_asked_for_from_now_on(emulated, images):
    camera = emulated()
    camera.start()
    time.sleep(0.3)
    not_before_s = camera.now_s() + 0.1
    frames = camera.grab(4, not_before_s)
    assert all(frame.timestamp_s >= not_before_s for frame in frames)
    # Ten frames at least had been taken by then, and wait in the queue.
    assert frames[0].id >= 10
    assert frames[-1].timestamp_s + float(EXPOSURE_S) <= camera.now_s()
    require_played(frames, images)


def test_frames_that_are_not_asked_for_yet_are_kept(emulated, images):
    camera = emulated()
    camera.start()
    first = camera.grab(1, -np.inf)
    time.sleep(1.0)
    later = camera.grab(40, -np.inf)
    assert [frame.id for frame in [*first, *later]] == list(range(41))
    require_played(later, images)


def test_broken_frames_are_left_out_and_show_in_the_ids(emulated, images):
    camera = emulated()
    camera.start()
    before = camera.grab(2, -np.inf)
    features = camera.link.features
    features.set_integer("ForceFailedBufferCount", 3)
    features.execute("ForceFailedBuffer")
    after = camera.grab(6, -np.inf)
    ids = [frame.id for frame in [*before, *after]]
    assert ids[-1] - ids[0] == len(ids) - 1 + 3
    require_played(after, images)


def test_nothing_but_broken_frames_is_an_error(emulated):
    camera = emulated(timeout_s=0.2)
    camera.start()
    camera.link.features.set_integer("ForceFailedBufferCount", 1000)
    camera.link.features.execute("ForceFailedBuffer")
    with pytest.raises(InstrumentError, match=r"frames arrived incomplete .* jumbo packets"):
        camera.grab(8, -np.inf)


def test_a_trigger_that_never_comes_is_an_error(emulated):
    camera = emulated(trigger="Line1", pulses="elsewhere", timeout_s=0.3)
    camera.start()
    with pytest.raises(InstrumentError, match=r"no frame within .* check the trigger cable at Li"):
        camera.grab(1, camera.now_s())


def test_software_triggers_lose_no_frame(emulated, images):
    camera = emulated(trigger="software")
    camera.start()
    frames = camera.grab(8, -np.inf)
    assert [frame.id for frame in frames] == list(range(8))
    require_played(frames, images)


def test_a_trigger_for_a_camera_that_is_not_ready_is_an_error(emulated):
    camera = emulated(trigger="software")
    with pytest.raises(InstrumentError, match=r"asked to trigger, and refused|is not ready"):
        camera.link.trigger()


def test_an_unplugged_camera_is_reported_as_such(emulated):
    camera = emulated()
    camera.start()
    camera.grab(1, -np.inf)
    camera.link.features.execute("FirePnPCallback")
    with pytest.raises(InstrumentError, match=r"camera \(Emulation 0815-0000\): .* check its cabl"):
        camera.grab(100, -np.inf)
    camera.close()


@pytest.mark.parametrize(
    ("exposure_s", "shape", "message"),
    [
        (EXPOSURE_S, (48, 4098), "Width of 4098 pixels, has 1 to 4096"),
        (Fraction(1, 2_000_000), SHAPE, "expose 0.5 µs, has 1"),
    ],
)
def test_what_the_sensor_cannot_do_is_refused_and_changes_nothing(
    emulated, images, exposure_s, shape, message
):
    camera = emulated()
    with pytest.raises(LimitError, match=message):
        camera.configure(RATE_HZ, exposure_s, shape)
    camera.start()
    require_played(camera.grab(2, -np.inf), images)


def test_a_feature_that_refuses_is_reported_with_its_name(emulated):
    with pytest.raises(InstrumentError, match="was asked for Width 99999, and refused"):
        emulated().link.features.set_integer("Width", 99_999)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"serial": "4711"}, "camera 4711, found 0815-0000"),
        ({"serial": None}, "of any number, found 0815-0000, 0815-0001; name one"),
        ({"packet_socket": True}, r"options\.packet_socket: unknown key"),
        ({"pixel_format": "Mono8"}, "hold 8 bits"),
    ],
)
def test_options_that_lead_nowhere_are_refused(options, message):
    with pytest.raises(BenchSetupError, match=message):
        BaslerCamera(entry(**options), CONTEXT)


def test_it_fills_the_role_and_says_that_its_times_are_arrivals(emulated):
    camera = emulated()
    assert isinstance(camera, Camera)
    assert camera.identity.startswith("Basler Emulation, serial 0815-0000, firmware ")
    assert "no time stamps: times of arrival" in camera.identity
    assert "\n" not in camera.identity


# --- The simulated laboratory behind it --------------------------------------------------------


@pytest.fixture
def opened(small_plan):
    """Open the small bench with one camera or another on it, switched on."""
    benches = []

    def make(driver):
        plan = small_plan({"camera.width": 64, "camera.height": 48})
        bench_file = plan.bench.replace({"instruments.camera.driver": driver})
        bench = open_bench(bench_file, plan.preparation("R07"), seed=3)
        benches.append(bench)
        step = plan.steps[0]
        bench.camera.configure(plan.protocol.camera.frame_rate_hz, step.exposure_s, SHAPE)
        bench.synthesizers.rf_on()
        bench.synthesizers.set_pair(step.aom1_hz, step.aom2_hz)
        bench.generator.set_sine(step.drive_hz, step.volts)
        bench.camera.start()
        return bench

    yield make
    for bench in benches:
        bench.close()


def test_the_laboratorys_frames_come_through_bit_for_bit(opened):
    through, direct = opened(EMULATED_CAMERA).camera, opened("simulated").camera
    assert "Basler Emulation" in through.identity
    for _ in range(2):
        got, expected = through.grab(4, 0.0), direct.grab(4, 0.0)
        assert [(f.id, f.timestamp_s) for f in got] == [(f.id, f.timestamp_s) for f in expected]
        for one, other in zip(got, expected, strict=True):
            np.testing.assert_array_equal(one.image, other.image)
        assert len({frame.image.tobytes() for frame in got}) == 4


def test_what_the_emulator_plays_is_what_comes(opened):
    through, direct = opened(EMULATED_CAMERA).camera, opened("simulated").camera
    features = through.basler.link.features
    features.set_text("ImageFileMode", "Off")
    features.set_text("TestImageSelector", "Testimage1")
    for got, sent in zip(through.grab(2, 0.0), direct.grab(2, 0.0), strict=True):
        assert np.mean(got.image == sent.image) < 0.1


def test_a_broken_frame_is_missing_from_the_laboratorys(opened):
    camera = opened(EMULATED_CAMERA).camera
    features = camera.basler.link.features
    features.set_integer("ForceFailedBufferCount", 1)
    features.execute("ForceFailedBuffer")
    assert [frame.id for frame in camera.grab(4, 0.0)] == [1, 2, 3]


def test_a_sweep_runs_through_the_real_driver(small_plan, tmp_path):
    plan = small_plan()
    bench_file = plan.bench.replace({"instruments.camera.driver": EMULATED_CAMERA})
    plan = make_plan(plan.protocol, bench_file)
    with open_bench(bench_file, plan.preparation("R07"), seed=3) as bench:
        summary = run(plan, bench, tmp_path / "run.h5")
    assert summary.counts[Verdict.OK] == len(plan.steps)
    assert summary.unconfirmed == ()
