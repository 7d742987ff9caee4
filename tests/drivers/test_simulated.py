"""Simulated instruments have the manners of real ones."""

import math
import time
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from holography.demodulation import four_phase
from physics.bench import BenchState

RATE_HZ = Fraction(62, 5)
PERIOD_S = 1 / RATE_HZ
SHAPE = (128, 160)
DRIVE_HZ = Fraction(20001, 10)
CENTRE_HZ = Fraction(80_000_000)


@pytest.fixture
def bench(small_plan, open_small_bench):
    return open_small_bench(small_plan())


@pytest.fixture
def running(bench):
    """A bench whose camera runs and whose light and loudspeaker are on."""
    return switched_on(bench)


def switched_on(bench):
    bench.camera.configure(RATE_HZ, PERIOD_S, SHAPE)
    bench.synthesizers.rf_on()
    bench.synthesizers.set_pair(CENTRE_HZ + DRIVE_HZ + RATE_HZ / 4, CENTRE_HZ)
    bench.generator.set_sine(DRIVE_HZ, 2.0)
    bench.camera.start()
    return bench


def lab_of(bench):
    """Return the laboratory of the instruments."""
    return bench.camera.lab


# --- Synthesizers ------------------------------------------------------------------------------


@given(offsets=st.tuples(*[st.integers(-5_000_000_000, 5_000_000_000)] * 2))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_frequencies_snap_to_the_grid_and_read_back_so(bench, offsets):
    asked = [CENTRE_HZ + Fraction(offset, 1000) for offset in offsets]
    bench.synthesizers.set_pair(*asked)
    for hz, played_hz in zip(asked, bench.synthesizers.read_pair(), strict=True):
        assert played_hz % bench.synthesizers.step_hz == 0
        assert abs(played_hz - hz) <= bench.synthesizers.step_hz / 2


def test_both_channels_change_in_one_update(bench):
    start_s = bench.clock.now_s()
    bench.synthesizers.set_pair(CENTRE_HZ + 1000, CENTRE_HZ - 500)
    segments = lab_of(bench).segments(start_s, bench.clock.now_s() + 1)
    assert [segment.state.difference_hz for segment in segments] == [0, 1500]


@pytest.mark.parametrize("outside", [CENTRE_HZ + 5_000_001, CENTRE_HZ - 5_000_001, Fraction(0)])
@pytest.mark.parametrize("channel", [0, 1])
def test_nothing_changes_when_a_channel_would_leave_the_window(bench, outside, channel):
    pair = [CENTRE_HZ, CENTRE_HZ]
    pair[channel] = outside
    before = bench.synthesizers.read_pair(), lab_of(bench).state
    with pytest.raises(LimitError, match=f"AOM{channel + 1} was asked for"):
        bench.synthesizers.set_pair(*pair)
    assert (bench.synthesizers.read_pair(), lab_of(bench).state) == before


def test_without_rf_no_light_reaches_the_camera(running):
    bright = running.camera.grab(1, 0.0)[0].image.mean()
    running.synthesizers.rf_off()
    dark = running.camera.grab(1, running.camera.now_s())[0].image.mean()
    assert bright > 1000
    assert dark == pytest.approx(50, abs=1), "the ADC's offset"


# --- Generator ---------------------------------------------------------------------------------


@pytest.mark.parametrize("volts", [16.001, -0.5, math.nan, math.inf, 1e9])
def test_volts_outside_the_limits_change_nothing(bench, volts):
    bench.generator.set_sine(DRIVE_HZ, 1.0)
    before = bench.generator.read(), lab_of(bench).state
    for ask in (
        lambda: bench.generator.set_sine(DRIVE_HZ, volts),
        lambda: bench.generator.ramp_to(volts, 0.1),
    ):
        with pytest.raises(LimitError, match="outside 0 to 16 V"):
            ask()
    assert (bench.generator.read(), lab_of(bench).state) == before


@pytest.mark.parametrize("frequency_hz", [Fraction(19), Fraction(30_000), Fraction(0)])
def test_drives_outside_the_limits_change_nothing(bench, frequency_hz):
    before = bench.generator.read()
    with pytest.raises(LimitError, match="outside 20 to 20000 Hz"):
        bench.generator.set_sine(frequency_hz, 1.0)
    assert bench.generator.read() == before


@pytest.mark.parametrize("duration_s", [-0.1, math.nan, math.inf])
def test_a_ramp_needs_a_duration(bench, duration_s):
    bench.generator.set_sine(DRIVE_HZ, 1.0)
    with pytest.raises(LimitError, match="give a time"):
        bench.generator.ramp_to(0.0, duration_s)


def test_a_ramp_takes_its_time_in_small_equal_steps(bench):
    bench.generator.set_sine(DRIVE_HZ, 8.0)
    start_s = bench.clock.now_s()
    bench.generator.ramp_to(0.0, 0.1)
    assert bench.clock.now_s() - start_s == pytest.approx(0.1)
    segments = lab_of(bench).segments(start_s, bench.clock.now_s() + 1)
    volts = [segment.state.drive_v for segment in segments]
    assert len(volts) > 10
    np.testing.assert_allclose(np.diff(volts), -8.0 / (len(volts) - 1), rtol=1e-9)
    assert volts[-1] == 0.0


def test_an_output_that_is_off_does_not_ramp_up(bench):
    bench.generator.set_sine(DRIVE_HZ, 8.0)
    bench.generator.output_off()
    assert lab_of(bench).state.drive_v == 0
    assert not bench.generator.read()[2]
    bench.generator.ramp_to(0.0, 0.1)
    with pytest.raises(InstrumentError, match=r"output is off.*call set_sine first"):
        bench.generator.ramp_to(1.0, 0.1)
    assert lab_of(bench).state.drive_v == 0


def test_every_order_takes_time(bench):
    for order in (
        lambda: bench.synthesizers.set_pair(CENTRE_HZ, CENTRE_HZ),
        bench.synthesizers.read_pair,
        bench.synthesizers.rf_on,
        bench.synthesizers.rf_off,
        lambda: bench.generator.set_sine(DRIVE_HZ, 1.0),
        bench.generator.read,
        bench.generator.output_off,
    ):
        before_s = bench.clock.now_s()
        order()
        assert bench.clock.now_s() > before_s


# --- Camera ------------------------------------------------------------------------------------


@given(pauses_s=st.lists(st.floats(0, 2), min_size=1, max_size=4), count=st.integers(1, 3))
@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=20, deadline=None
)
def test_frames_run_freely_and_none_is_older_than_asked(bench, pauses_s, count):
    bench.camera.stop()
    bench.camera.configure(RATE_HZ, PERIOD_S, (16, 16))
    bench.camera.start()
    started_s, last_id = bench.camera.now_s(), -1
    for pause_s in pauses_s:
        wanted_s = bench.camera.now_s() + pause_s
        frames = bench.camera.grab(count, wanted_s)
        ids = [frame.id for frame in frames]
        assert ids == list(range(ids[0], ids[0] + count))
        assert ids[0] > last_id
        for frame in frames:
            expected_s = started_s + float(frame.id * PERIOD_S)
            assert frame.timestamp_s == pytest.approx(expected_s, abs=1e-9)
            assert frame.image.shape == (16, 16)
            assert frame.image.dtype == np.uint16
        assert wanted_s <= frames[0].timestamp_s < wanted_s + float(PERIOD_S) + 1e-9
        assert bench.camera.now_s() >= frames[-1].timestamp_s + float(PERIOD_S) - 1e-9
        last_id = ids[-1]


def test_a_camera_keeps_frames_of_the_last_second(running):
    """Instruments may be read while it exposes: what began since the setting settled is kept."""
    running.clock.wait(3.0)
    settled_s = running.camera.now_s() - 0.5
    frame = running.camera.grab(1, settled_s)[0]
    assert settled_s <= frame.timestamp_s < settled_s + float(PERIOD_S) + 1e-9
    # No buffer lasts for ever.
    running.clock.wait(3.0)
    oldest_s = running.camera.now_s() - 1.0
    assert running.camera.grab(1, 0.0)[0].timestamp_s >= oldest_s


FAULTY_FRAMES = {
    "duplicate_frame_at": lambda f: f[2].id == f[1].id and np.array_equal(f[2].image, f[1].image),
    "reorder_frames_at": lambda f: [frame.id - f[0].id for frame in f] == [0, 2, 1, 3],
    "partial_frame_at": lambda f: (
        np.array_equal(f[2].image[-3:], f[1].image[-3:])
        and not np.array_equal(f[2].image[:3], f[1].image[:3])
    ),
    "late_frame_at": lambda f: (
        f[2].timestamp_s - f[1].timestamp_s == pytest.approx(1.7 * float(PERIOD_S))
    ),
}


@pytest.mark.parametrize("fault", FAULTY_FRAMES)
def test_frames_are_spoilt_where_it_is_asked_for(fault, small_plan, open_small_bench):
    plan = small_plan(faults={fault: [2]})
    with open_small_bench(plan) as bench:
        bench.camera.configure(RATE_HZ, PERIOD_S, SHAPE)
        bench.synthesizers.rf_on()
        bench.camera.start()
        spoilt = [FAULTY_FRAMES[fault](bench.camera.grab(4, 0.0)) for _ in range(3)]
    assert spoilt == [False, True, False]


def test_a_clock_that_jumps_jumps_once(small_plan, open_small_bench):
    plan = small_plan(faults={"clock_jump_at": 2, "clock_jump_s": -0.3})
    with open_small_bench(plan) as bench:
        bench.camera.configure(RATE_HZ, PERIOD_S, SHAPE)
        bench.camera.start()
        starts_s = []
        for _ in range(3):
            wanted_s = bench.camera.now_s() + 0.05
            frames = bench.camera.grab(4, wanted_s)
            starts_s.append(frames[0].timestamp_s - frames[0].id * float(PERIOD_S))
        assert starts_s[1] - starts_s[0] == pytest.approx(-0.3)
        assert starts_s[2] == pytest.approx(starts_s[1])


def test_a_cable_that_is_out_gives_no_frame(small_plan, open_small_bench):
    with open_small_bench(small_plan(faults={"no_frame_from": 2})) as bench:
        bench.camera.configure(RATE_HZ, PERIOD_S, SHAPE)
        bench.camera.start()
        assert len(bench.camera.grab(4, 0.0)) == 4
        with pytest.raises(InstrumentError, match="check the trigger's cable"):
            bench.camera.grab(4, 0.0)


def test_a_stopped_camera_gives_no_frames(bench):
    with pytest.raises(InstrumentError, match="call configure first"):
        bench.camera.start()
    bench.camera.configure(RATE_HZ, PERIOD_S, SHAPE)
    with pytest.raises(InstrumentError, match="call start first"):
        bench.camera.grab(4, 0.0)
    bench.camera.start()
    with pytest.raises(InstrumentError, match="stop it first"):
        bench.camera.configure(RATE_HZ, PERIOD_S, SHAPE)
    bench.camera.stop()
    bench.camera.stop()
    with pytest.raises(InstrumentError, match="call start first"):
        bench.camera.grab(4, 0.0)


@pytest.mark.parametrize(
    ("rate_hz", "exposure_s", "shape", "said"),
    [
        (Fraction(13), Fraction(1, 20), SHAPE, "can do up to 12.5"),
        (Fraction(0), Fraction(1, 20), SHAPE, "can do up to 12.5"),
        (RATE_HZ, Fraction(1, 12), SHAPE, "can do up to the period"),
        (RATE_HZ, Fraction(0), SHAPE, "can do up to the period"),
        (RATE_HZ, PERIOD_S, (1025, 1280), "has 1280 x 1024"),
        (RATE_HZ, PERIOD_S, (1024, 0), "has 1280 x 1024"),
    ],
)
def test_settings_outside_the_camera_are_refused(bench, rate_hz, exposure_s, shape, said):
    with pytest.raises(LimitError, match=said):
        bench.camera.configure(rate_hz, exposure_s, shape)
    with pytest.raises(InstrumentError, match="call configure first"):
        bench.camera.start()


def test_in_real_time_frames_come_at_the_rate_of_the_wall(small_plan, open_small_bench):
    bench = switched_on(open_small_bench(small_plan(pace="realtime")))
    before_s = time.monotonic()
    frames = bench.camera.grab(2, bench.camera.now_s())
    elapsed_s = time.monotonic() - before_s
    assert 2 * float(PERIOD_S) <= elapsed_s + 1e-3
    assert elapsed_s < 10 * float(PERIOD_S)
    assert frames[1].timestamp_s - frames[0].timestamp_s == pytest.approx(float(PERIOD_S))


# --- One laboratory ----------------------------------------------------------------------------


@given(
    changes=st.lists(st.tuples(st.floats(0, 0.2), st.floats(0, 16)), max_size=8),
    start_s=st.floats(0, 1),
    length_s=st.floats(1e-3, 0.5),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_segments_tile_an_exposure_with_the_settings_of_their_time(
    bench, changes, start_s, length_s
):
    lab = lab_of(bench)
    start_s += lab.clock.now_s()
    lab.change(drive_v=0.0)
    history = []
    for pause_s, volts in changes:
        lab.clock.wait(pause_s)
        lab.change(drive_v=volts)
        history.append((lab.clock.now_s(), volts))
    segments = lab.segments(start_s, start_s + length_s)
    assert segments[0].start_s == start_s
    assert segments[-1].end_s == start_s + length_s
    for one, next_one in pairwise(segments):
        assert one.end_s == next_one.start_s
    for segment in segments:
        assert segment.start_s < segment.end_s
        before = [volts for time_s, volts in history if time_s <= segment.start_s]
        assert segment.state.drive_v == (before[-1] if before else 0.0)


def test_a_change_inside_an_exposure_spoils_that_frame_and_no_earlier_one(
    small_plan, open_small_bench
):
    """Both laboratories draw the same noise, so all that differs is light."""
    frames = []
    for changed in (False, True):
        bench = switched_on(open_small_bench(small_plan(), seed=3))
        lab, start_s = lab_of(bench), bench.camera.now_s()
        exposures = [
            (start_s + float(k * PERIOD_S), start_s + float((k + 1) * PERIOD_S)) for k in range(4)
        ]
        lab.clock.wait(2.5 * float(PERIOD_S))
        if changed:
            lab.change(drive_hz=DRIVE_HZ + 300)
        frames.append(np.stack(lab.expose(exposures)).astype(float))
    difference = frames[1] - frames[0]
    assert not difference[:2].any()
    spoilt, changed = np.sqrt(np.mean(difference[2:] ** 2, axis=(1, 2)))
    # Half of the exposure still saw the old light; shot noise alone would not differ at all.
    assert 0.2 * changed < spoilt < 0.9 * changed


def test_a_run_of_frames_follows_from_the_seed(small_plan, open_small_bench):
    images = [
        switched_on(open_small_bench(small_plan(), seed=seed)).camera.grab(1, 0.0)[0].image
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).mean() > 0.5


def test_before_anything_is_set_the_laboratory_is_dark_and_silent(bench):
    state = BenchState(Fraction(0), Fraction(0), 0.0, rf_on=False)
    assert lab_of(bench).state == state
    with pytest.raises(ValueError, match="prepare_sensor first"):
        lab_of(bench).expose([(0.0, 0.1)])


@pytest.mark.parametrize("role", ["synthesizers", "generator", "camera"])
def test_options_that_a_simulated_driver_does_not_know_are_refused(
    small_plan, open_small_bench, role
):
    plan = small_plan()
    bench_file = plan.bench.replace({f"instruments.{role}.options": {"port": "COM3"}})
    with pytest.raises(BenchSetupError, match=rf"instruments\.{role}\.options: .*port"):
        open_small_bench(replace(plan, bench=bench_file))


# --- Light that changes from hologram to hologram ----------------------------------------------


def grabbed(bench, count):
    """Grabs of four frames of the reed at rest."""
    bench.camera.configure(RATE_HZ, PERIOD_S, SHAPE)
    bench.synthesizers.rf_on()
    bench.synthesizers.set_pair(CENTRE_HZ + RATE_HZ / 4, CENTRE_HZ)
    bench.camera.start()
    return [bench.camera.grab(4, bench.camera.now_s()) for _ in range(count)]


def hologram(frames):
    """Hologram of four frames, its phase counted from frame 0 of the camera."""
    return 1j ** frames[0].id * four_phase(np.stack([frame.image for frame in frames]))


def gains(holograms):
    """Complex factor between the light of each hologram and that of the first."""
    first = holograms[0]
    return np.array([np.vdot(first, other) / np.vdot(first, first).real for other in holograms])


# As much light as the sensor bears, so that noise hides neither gain nor phase.
BRIGHT = {"local_oscillator_e_s": 40e3, "object_e_s": 8e3, "path_walk_rad_s": 0.0}


def test_light_without_scatter_is_that_of_a_bench_that_does_not_mention_it(
    small_plan, open_small_bench
):
    nominal, mentioned, drawn = (
        [f.image for g in grabbed(open_small_bench(small_plan(light=light), seed=4), 2) for f in g]
        for light in ({}, {"gain_scatter": 0.0, "phase_scatter": False}, {"gain_scatter": 1e-12})
    )
    np.testing.assert_array_equal(nominal, mentioned)
    # What scatters, however little, takes numbers that are the noise's otherwise.
    assert (np.array(nominal) != np.array(drawn)).mean() > 0.5


def test_every_acquisition_has_a_gain_and_a_phase_of_its_own(small_plan, open_small_bench):
    light = BRIGHT | {"gain_scatter": 0.2, "phase_scatter": True}
    grabs = grabbed(open_small_bench(small_plan(light=light), seed=4), 24)
    found = gains([hologram(frames) for frames in grabs])
    logs = np.log(np.abs(found))
    # Three standard errors of a deviation from 24 draws; the first is the reference.
    assert np.std(logs) == pytest.approx(0.2, rel=0.45)
    turns = np.exp(1j * np.angle(found))
    assert abs(np.mean(turns)) < 0.6, "all over the circle"
    assert len(np.unique(np.round(np.angle(turns) / (np.pi / 3)))) >= 5


@pytest.mark.parametrize(
    ("light", "turns", "grows"),
    [
        ({"gain_scatter": 0.2}, False, True),
        ({"phase_scatter": True}, True, False),
        ({}, False, False),
    ],
)
def test_gain_and_phase_scatter_apart(light, turns, grows, small_plan, open_small_bench):
    grabs = grabbed(open_small_bench(small_plan(light=BRIGHT | light), seed=4), 6)
    found = gains([hologram(frames) for frames in grabs])
    assert (np.abs(np.angle(found)).max() > 0.5) == turns
    assert (np.abs(np.abs(found) - 1).max() > 0.08) == grows
    if not turns:
        assert np.abs(np.angle(found)).max() < 0.02


def test_the_light_is_constant_over_the_frames_of_an_acquisition(small_plan, open_small_bench):
    """Frames a period of the beat apart are then equal, but for noise."""
    light = BRIGHT | {"gain_scatter": 0.3, "phase_scatter": True}
    bench = open_small_bench(small_plan(light=light), seed=4)
    grabbed(bench, 1)
    one, next_one = bench.camera.grab(8, 0.0), bench.camera.grab(1, 0.0)
    assert next_one[0].id == one[0].id + 8
    first, fourth, eighth = (frame.image.astype(float) for frame in (one[0], one[4], next_one[0]))
    noise = np.std(fourth - first)
    assert np.std(eighth - first) > 2 * noise
    expected_e = BRIGHT["local_oscillator_e_s"] * float(PERIOD_S)
    assert noise == pytest.approx(np.sqrt(2 * expected_e) / 4, rel=0.3)


# --- Faults ------------------------------------------------------------------------------------


def test_a_dropped_frame_leaves_a_gap_of_one(small_plan, open_small_bench):
    bench = switched_on(open_small_bench(small_plan(faults={"drop_frame_at": [2]})))
    gaps = [np.diff([f.id for f in bench.camera.grab(4, 0.0)]).tolist() for _ in range(3)]
    assert gaps == [[1, 1, 1], [1, 2, 1], [1, 1, 1]]


def test_stale_frames_are_older_than_asked_for(small_plan, open_small_bench):
    bench = switched_on(open_small_bench(small_plan(faults={"stale_frame_at": [2]})))
    for stale in (False, True, False):
        bench.clock.wait(1.0)
        wanted_s = bench.camera.now_s()
        frames = bench.camera.grab(4, wanted_s)
        assert (frames[0].timestamp_s < wanted_s) == stale


def test_a_frame_is_never_given_twice(small_plan, open_small_bench):
    bench = switched_on(open_small_bench(small_plan(faults={"stale_frame_at": [2, 3]})))
    ids = [frame.id for _ in range(4) for frame in bench.camera.grab(4, bench.camera.now_s())]
    assert all(before < after for before, after in pairwise(ids))


def test_a_wrong_frame_rate_shows_in_the_time_stamps(small_plan, open_small_bench):
    bench = switched_on(open_small_bench(small_plan(faults={"frame_rate_error_ppm": 5000.0})))
    first, second = bench.camera.grab(2, 0.0)
    rate_hz = 1 / (second.timestamp_s - first.timestamp_s)
    assert rate_hz == pytest.approx(float(RATE_HZ) * 1.005, rel=1e-9)


def test_too_much_light_saturates(small_plan, open_small_bench):
    bench = switched_on(open_small_bench(small_plan(faults={"local_oscillator_factor": 4})))
    image = bench.camera.grab(1, 0.0)[0].image
    assert (image >= bench.camera.saturation_dn).mean() > 0.9


def test_a_tweeter_that_is_unplugged_moves_nothing(small_plan, open_small_bench):
    """With the same noise the frames are those of a tweeter that is given no volts."""
    images = {}
    for name, unplugged, volts in (("off", False, 0.0), ("pulled", True, 2.0), ("on", False, 2.0)):
        bench = open_small_bench(small_plan(faults={"tweeter_unplugged": unplugged}), seed=2)
        switched_on(bench).generator.set_sine(DRIVE_HZ, volts)
        images[name] = bench.camera.grab(1, bench.camera.now_s())[0].image
    assert (images["pulled"] != images["off"]).mean() < 1e-3, "but for rounding"
    assert (images["on"] != images["off"]).mean() > 0.05


def test_dates_pass_as_the_time_of_the_bench_does(small_plan, open_small_bench):
    """Runs of a campaign are put in order of time by them: drifts have their true rates."""
    clock = open_small_bench(small_plan()).clock
    began, began_s = clock.date(), clock.now_s()
    clock.wait(250.0)
    assert clock.now_s() - began_s == pytest.approx(250.0)
    assert (clock.date() - began).total_seconds() == pytest.approx(250.0)
