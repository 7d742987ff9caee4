"""Light and sensor that differ from frame to frame, and from acquisition to acquisition."""

from fractions import Fraction

import numpy as np
import pytest

from diagnosis.observables.brightness import log_light
from physics.bench import BenchModel, BenchState, Scene, Segment
from physics.motion import PlainMotion
from physics.object_light import renewed, smooth_shapes, smoothly_changed
from physics.optics import lamp_profile
from physics.parameters.optics import Illumination
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters, with_part
from physics.sensor import read_out

FRAME_S = 0.08
LOCK_HZ = Fraction(25, 8)
LO_ONLY = Scene(object_beam=False)


@pytest.fixture(scope="module")
def bench_with(quiet_settings, coarse_reed):
    """Return a maker of quiet benches with other values of some fields of a part."""

    def make(part=None, **changes):
        settings = with_part(quiet_settings, part, **changes) if part else quiet_settings
        return BenchModel(settings, PlainMotion(coarse_reed), np.random.default_rng(1))

    return make


def exposure(number=0, difference_hz=LOCK_HZ, rf_on=True):
    state = BenchState(difference_hz, Fraction(0), 0.0, rf_on)
    return [Segment(number * FRAME_S, (number + 1) * FRAME_S, state)]


def pixels(frames):
    return np.asarray(frames, dtype=float)


# --- Object light --------------------------------------------------------------------------------


def test_renewed_speckle_keeps_its_power_and_the_correlation_that_it_says():
    rng = np.random.default_rng(3)
    envelope = np.linspace(1, 2, 200_000).astype(np.float32)
    light = renewed(np.zeros(len(envelope), dtype=np.complex64), envelope, 1.0, rng)
    later = light
    for _ in range(10):
        later = renewed(later, envelope, 0.3, rng)
    power = np.sum(np.abs(light) ** 2)
    assert power == pytest.approx(np.sum(envelope**2), rel=0.01)
    assert np.sum(np.abs(later) ** 2) == pytest.approx(power, rel=0.01)
    correlation = np.vdot(light, later) / power
    assert correlation == pytest.approx((1 - 0.3**2) ** 5, abs=0.01)


def test_images_have_the_part_of_new_light_that_the_parameters_say(bench_with, take_field):
    part = 0.025
    bench = bench_with("optics.interference", speckle_renewal=part)
    before = take_field(bench, LOCK_HZ)
    bench.next_acquisition(np.random.default_rng(8))
    after = take_field(bench, LOCK_HZ)
    new = after - np.sqrt(1 - part**2) * before
    assert np.linalg.norm(new) / np.linalg.norm(before) == pytest.approx(part, rel=0.05)


def test_smooth_changes_have_their_rms_and_vary_over_thirds_of_the_reed(bench_with, take_field):
    rms = 0.02
    bench = bench_with("optics.interference", field_change=rms)
    squares, neighbours, rng = [], [], np.random.default_rng(9)
    before = take_field(bench, LOCK_HZ)
    bright = np.abs(before) > 0.5 * np.sqrt(np.mean(np.abs(before) ** 2))
    for _ in range(12):
        bench.next_acquisition(rng)
        after = take_field(bench, LOCK_HZ)
        change = np.where(bright, np.log(after / np.where(bright, before, 1)), 0)
        squares.append(np.mean(np.abs(change[bright]) ** 2))
        both = bright[:, 1:] & bright[:, :-1]
        pair = change[:, 1:][both], change[:, :-1][both]
        neighbours.append(np.vdot(*pair).real / (np.linalg.norm(pair[0]) * np.linalg.norm(pair[1])))
        before = after
    # A mean of 12 draws with 30 degrees of freedom each.
    assert np.sqrt(np.mean(squares)) == pytest.approx(rms, rel=0.2)
    assert min(neighbours) > 0.85


def test_smooth_shapes_are_no_gain_and_have_unit_mean_square():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0, 36e-3, 4000), rng.uniform(-6e-3, 6e-3, 4000)
    shapes = smooth_shapes(x, y)
    gram = shapes.T @ shapes / len(x)
    assert gram == pytest.approx(np.eye(15), abs=1e-4)
    assert np.abs(shapes.mean(axis=0)).max() < 1e-4
    light = np.ones(4000, dtype=np.complex64)
    sizes = [
        np.mean(np.abs(np.log(smoothly_changed(light, shapes, 0.01, rng))) ** 2) for _ in range(200)
    ]
    assert np.sqrt(np.mean(sizes)) == pytest.approx(0.01, rel=0.06)


def test_light_that_does_not_change_draws_nothing(bench_with):
    bench, rng = bench_with(), np.random.default_rng(4)
    bench.next_acquisition(rng)
    bench.expose_unread(exposure(), rng)
    assert rng.bit_generator.state == np.random.default_rng(4).bit_generator.state


# --- Frames --------------------------------------------------------------------------------------


def test_the_power_of_the_laser_scatters_from_frame_to_frame(bench_with):
    bench, rng = bench_with("optics.interference", power_noise=0.002), np.random.default_rng(5)
    light = [pixels(bench.frame(exposure(n), rng, scene=LO_ONLY)).mean() for n in range(100)]
    assert np.std(light) / np.mean(light) == pytest.approx(0.002, rel=0.25)
    still = [pixels(bench_with().frame(exposure(), rng, scene=LO_ONLY)).mean() for _ in range(2)]
    assert still[0] == pytest.approx(still[1], rel=1e-6)


def test_light_fades_as_the_diagnosis_says(bench_with):
    """After three hours by 0.6 nepers; in a bench in which 1 − 0.2/h were left it would be 0.92."""
    bench, late = bench_with("optics.interference", fade_per_h=0.2), round(3 * 3600 / FRAME_S)
    rng = np.random.default_rng(8)
    offset_dn = bench.parameters.sensor.offset_dn
    first, last = (
        pixels(bench.frame(exposure(n), rng, scene=LO_ONLY)).mean() - offset_dn for n in (0, late)
    )
    expected = log_light(np.array(late * FRAME_S), bench.parameters.optics.interference)
    assert expected == pytest.approx(-0.6)
    assert np.log(last / first) == pytest.approx(float(expected), abs=2e-3)


def test_a_frame_keeps_a_part_of_the_light_of_the_one_before(bench_with):
    bench, rng = bench_with("sensor", lag=0.01), np.random.default_rng(6)
    full = pixels(bench_with().frame(exposure(), rng, scene=LO_ONLY))
    dark = exposure(rf_on=False)
    first, second, third = (
        pixels(bench.frame(each, rng, scene=LO_ONLY)) for each in (exposure(), dark, dark)
    )
    assert first.mean() == pytest.approx(0.99 * full.mean(), rel=1e-4)
    assert second.mean() == pytest.approx(0.01 * full.mean(), rel=1e-2)
    assert third.max() == 0
    bench.expose_unread(exposure(), rng, scene=LO_ONLY)
    after_unread = pixels(bench.frame(exposure(), rng, scene=LO_ONLY))
    assert after_unread.mean() == pytest.approx(full.mean(), rel=1e-5)


def test_rows_share_their_noise_in_a_frame_only():
    sensor = Sensor(shape=(400, 300), read_noise_e=3.0, row_noise_e=8.0, gain_e_dn=1.0)
    rng = np.random.default_rng(7)
    first, second = (
        pixels(read_out(sensor, np.full(sensor.shape, 0.0, dtype=np.float32), rng)).mean(axis=1)
        for _ in range(2)
    )
    assert np.std(first) == pytest.approx(8.0, rel=0.15)
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.2


def test_a_lamp_is_as_uneven_as_its_rms_says(bench_with):
    sensor = Sensor(shape=(96, 128))
    assert lamp_profile(Illumination(), sensor) is None
    profile = lamp_profile(Illumination(lamp_unevenness=0.05), sensor)
    assert profile.mean() == pytest.approx(1.0, abs=1e-6)
    assert profile.std() == pytest.approx(0.05, rel=1e-3)
    flat = Scene(local_oscillator=False, object_beam=False, lamp_e_s=80e12)
    bench = bench_with("optics.illumination", lamp_unevenness=0.05)
    image = pixels(bench.frame(exposure(), np.random.default_rng(1), scene=flat))
    assert image.std() / image.mean() == pytest.approx(0.05, rel=1e-2)


def test_object_light_is_left_in_the_image_of_the_reference(bench_with):
    """Its beat with the local oscillator has √leak of the amplitude of the open beam."""
    rng = np.random.default_rng(1)

    def contrast(bench, scene):
        frames = [pixels(bench.frame(exposure(n), rng, scene=scene)) for n in (0, 2)]
        return np.std(frames[1] - frames[0])

    leaking, tight = bench_with("optics.illumination", reference_leak=1e-4), bench_with()
    whole = contrast(tight, Scene())
    assert contrast(leaking, LO_ONLY) == pytest.approx(1e-2 * whole, rel=0.1)
    assert contrast(tight, LO_ONLY) < 1e-3 * whole


def test_a_bench_has_no_such_disorder_unless_it_is_said():
    """What is zero here leaves the frames of the simulated bench as they are."""
    nominal = BenchParameters()
    changes, light = nominal.optics.interference, nominal.optics.illumination
    none = (
        changes.step_walk_rad, changes.gain_scatter, changes.power_noise, changes.speckle_renewal,
        changes.field_change, light.lamp_unevenness, light.reference_leak, nominal.sensor.lag,
        nominal.sensor.row_noise_e, nominal.clocks.frame_jitter_s, nominal.chamber.travelling,
        nominal.chamber.rail_leak, nominal.reed.shear_loss_log, nominal.sensor.pattern,
        nominal.sensor.nonlinearity,
    )  # fmt: skip
    assert not any(none)
