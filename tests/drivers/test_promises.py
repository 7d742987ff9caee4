"""One list of promises for all drivers that run without hardware, and for the driver template."""

import math
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import InstrumentError, LimitError
from drivers.registry import open_bench
from drivers.safe_off import safe_off
from protocols.bench import BenchFile
from protocols.preparation import Preparation

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
COARSE = {"twin": {"mesh": "coarse"}}
CENTRE_HZ, DRIVE_HZ, RATE_HZ = Fraction(80_000_000), Fraction(2000), Fraction("12.4")
EXPOSURE_S, SHAPE = Fraction(1, 50), (64, 80)


@pytest.fixture(params=["template", "simulated", "emulated"])
def bench(request, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    if request.param == "template":
        bench_file = BenchFile.from_file(EXAMPLES / "my-bench.yaml")
    else:
        bench_file = BenchFile.from_file(request.param).replace(COARSE)
    with open_bench(bench_file, Preparation("R07", "A", "asymmetric")) as opened:
        yield opened


def elsewhere(*calls):
    """Call functions at the same time, each on a thread of its own; raise what one raises."""
    with ThreadPoolExecutor(len(calls)) as pool:
        for future in [pool.submit(call) for call in calls]:
            future.result()


def running(bench):
    bench.camera.configure(RATE_HZ, EXPOSURE_S, SHAPE)
    bench.camera.start()
    return bench.camera


def test_identities_are_one_line_that_stays(bench):
    before = bench.identities
    assert all(before.values())
    running(bench).grab(1, 0.0)
    assert bench.identities == before
    assert {role: getattr(bench, role).identity for role in before} == before


# --- Synthesizers ------------------------------------------------------------------------------


def test_pairs_are_played_on_the_grid(bench):
    step_hz = bench.synthesizers.step_hz
    bench.synthesizers.set_pair(CENTRE_HZ + step_hz / 3, CENTRE_HZ - step_hz)
    pair = bench.synthesizers.read_pair()
    assert pair == (CENTRE_HZ, CENTRE_HZ - step_hz)
    assert all(isinstance(hz, Fraction) for hz in pair)


@pytest.mark.parametrize("channel", [0, 1])
@pytest.mark.parametrize("beyond_hz", [-5_000_001, 5_000_001])
def test_a_pair_beyond_the_window_changes_nothing(bench, channel, beyond_hz):
    bench.synthesizers.set_pair(CENTRE_HZ + 100, CENTRE_HZ)
    pair = [CENTRE_HZ, CENTRE_HZ]
    pair[channel] += beyond_hz
    with pytest.raises(LimitError):
        bench.synthesizers.set_pair(*pair)
    assert bench.synthesizers.read_pair() == (CENTRE_HZ + 100, CENTRE_HZ)


# --- Generator ---------------------------------------------------------------------------------


def test_a_sine_is_played_and_switched_off(bench):
    generator = bench.generator
    assert generator.read()[2] is False
    generator.set_sine(DRIVE_HZ, 0.0)
    generator.ramp_to(1.0, 0.01)
    frequency_hz, volts, is_on = generator.read()
    assert (frequency_hz, is_on) == (DRIVE_HZ, True)
    assert isinstance(frequency_hz, Fraction)
    assert volts == pytest.approx(1.0, rel=1e-3)
    generator.output_off()
    generator.output_off()
    assert generator.read()[2] is False


@pytest.mark.parametrize(
    "ask",
    [
        *(lambda g, v=v: g.set_sine(DRIVE_HZ, v) for v in (-1.0, 16.1, math.nan, math.inf)),
        *(lambda g, v=v: g.ramp_to(v, 0.1) for v in (-1.0, 16.1, math.nan, math.inf)),
        *(lambda g, s=s: g.ramp_to(1.0, s) for s in (-0.1, math.nan, math.inf)),
        *(lambda g, hz=hz: g.set_sine(hz, 0.0) for hz in (Fraction(19), Fraction(20_001))),
    ],
)
def test_a_drive_beyond_the_limits_changes_nothing(bench, ask):
    bench.generator.set_sine(DRIVE_HZ, 0.5)
    before = bench.generator.read()
    with pytest.raises(LimitError):
        ask(bench.generator)
    assert bench.generator.read() == before


def test_an_output_that_is_off_cannot_be_ramped_up(bench):
    bench.generator.ramp_to(0.0, 0.1)
    with pytest.raises(InstrumentError):
        bench.generator.ramp_to(1.0, 0.1)
    assert bench.generator.read()[2] is False


# --- Camera ------------------------------------------------------------------------------------


def test_frames_are_consecutive_and_not_older_than_asked(bench):
    camera = running(bench)
    assert 255 <= camera.saturation_dn <= 65_535
    asked_s = camera.now_s() + 0.123
    frames = camera.grab(4, asked_s)
    assert [after.id - before.id for before, after in pairwise(frames)] == [1, 1, 1]
    assert frames[0].timestamp_s >= asked_s
    spacing_s = [after.timestamp_s - before.timestamp_s for before, after in pairwise(frames)]
    assert spacing_s == pytest.approx([float(1 / RATE_HZ)] * 3, rel=1e-3)
    assert {(frame.image.shape, frame.image.dtype) for frame in frames} == {
        (SHAPE, np.dtype(np.uint16))
    }
    assert camera.grab(1, 0.0)[0].id > frames[-1].id


def test_numbers_begin_again_at_a_start_and_time_goes_on(bench):
    """An exposure changes within a run: stop, configure, start."""
    camera = running(bench)
    camera.grab(4, camera.now_s() + 0.5)
    before_s = camera.now_s()
    camera.stop()
    camera.configure(RATE_HZ, 2 * EXPOSURE_S, SHAPE)
    camera.start()
    (frame,) = camera.grab(1, 0.0)
    assert frame.id == 0
    assert frame.timestamp_s >= before_s


@pytest.mark.parametrize(
    "settings",
    [
        (RATE_HZ, 1 / RATE_HZ + Fraction(1, 1000), SHAPE),
        (RATE_HZ, EXPOSURE_S, (1025, 80)),
        (Fraction(1000), Fraction(1, 2000), (1024, 1280)),
    ],
    ids=["exposure", "size", "rate"],
)
def test_a_camera_refuses_what_it_cannot_do(bench, settings):
    bench.camera.configure(RATE_HZ, EXPOSURE_S, SHAPE)
    with pytest.raises(LimitError):
        bench.camera.configure(*settings)
    bench.camera.start()
    assert bench.camera.grab(1, 0.0)[0].image.shape == SHAPE


def test_a_camera_is_configured_first_and_only_while_it_is_stopped(bench):
    with pytest.raises(InstrumentError):
        bench.camera.start()
    with pytest.raises(InstrumentError):
        bench.camera.grab(1, 0.0)
    camera = running(bench)
    with pytest.raises(InstrumentError):
        camera.configure(RATE_HZ, EXPOSURE_S, SHAPE)
    camera.stop()
    camera.stop()
    with pytest.raises(InstrumentError):
        camera.grab(1, 0.0)


# --- Off ---------------------------------------------------------------------------------------


def test_all_is_switched_off_from_other_threads_and_twice(bench):
    running(bench)
    bench.synthesizers.rf_on()
    bench.generator.set_sine(DRIVE_HZ, 1.0)
    ramp_down = partial(bench.generator.ramp_to, 0.0, 0.05)
    elsewhere(ramp_down, bench.synthesizers.rf_off, bench.camera.stop)
    assert safe_off(bench) == ()
    assert safe_off(bench) == ()
    assert bench.generator.read()[2] is False
    with pytest.raises(InstrumentError):
        bench.camera.grab(1, 0.0)


def test_instruments_are_closed_twice_without_an_error(bench):
    running(bench)
    for _ in range(2):
        for role in ("generator", "synthesizers", "camera"):
            getattr(bench, role).close()
