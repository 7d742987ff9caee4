"""The whole twin: frames, demodulated and propagated back, show the motion that was put in."""

import gc
import weakref
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import jv

from holography.demodulation import (
    carrier_leak,
    four_phase,
    sideband_gain,
)
from holography.reconstruction import Reconstruction
from physics.air import pressure_shape
from physics.bench import (
    BenchModel,
    BenchState,
    Scene,
    Segment,
)
from physics.drive import resonance_gain, tweeter_pressure_pa
from physics.motion import PlainMotion
from physics.optics import beat_integral, reed_axes_m
from physics.parameters.chamber import Chamber, Filling
from physics.parameters.drive import AcousticResonance, Tweeter
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters, with_part
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    viscoelastic_cane,
)
from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import Outline
from physics.reed.reduced.response import forced_response
from physics.reed.surface import on_reed, surface_shapes
from physics.sensor import saturation_dn

FRAME_RATE_HZ = Fraction(25, 2)
EXPOSURE_S = 0.08
# An odd multiple of a quarter of the frame rate: four frames cancel the carrier.
DRIVE_HZ = Fraction(685, 4) * FRAME_RATE_HZ
WAVELENGTH_M = 650e-9
# Of the rounding of frames to whole numbers, per pixel of a field.
ROUNDING_DN = 2 / np.sqrt(12)


def lock_hz(drive_hz, order=1):
    return order * drive_hz + FRAME_RATE_HZ / 4


def phase_rad(displacement_m):
    return 4 * np.pi / WAVELENGTH_M * np.abs(displacement_m.astype(np.complex128))


def sideband(displacement_m, order):
    """What a vibration does to the light of a point: ``iⁿ J_n(φ) e^{inψ}``."""
    direction = np.exp(1j * order * np.angle(displacement_m))
    return 1j**order * jv(order, phase_rad(displacement_m)) * direction


def relative(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.fixture(scope="module")
def at_rest(quiet_bench, take_field):
    """The field of the reed without drive: speckle, illumination and gain of the method."""
    return take_field(quiet_bench, FRAME_RATE_HZ / 4)


@pytest.mark.parametrize("drive_v", [0.1, 0.5, 2.0, 8.0])
def test_the_field_is_the_first_bessel_function_of_the_motion(
    drive_v, quiet_bench, at_rest, take_field
):
    """Vibrations of 0.4 to 30 rad, down to the rounding of the frames."""
    field = take_field(quiet_bench, lock_hz(DRIVE_HZ), DRIVE_HZ, drive_v)
    moved = quiet_bench.displacement_m(DRIVE_HZ, drive_v)
    assert relative(field, at_rest * sideband(moved, 1)) < 2e-3


@pytest.mark.parametrize("order", [-1, 0, 2, 5])
def test_the_difference_frequency_selects_the_sideband(order, quiet_bench, at_rest, take_field):
    field = take_field(quiet_bench, lock_hz(DRIVE_HZ, order), DRIVE_HZ, 2.0)
    expected = at_rest * sideband(quiet_bench.displacement_m(DRIVE_HZ, 2.0), order)
    assert relative(field, expected) < 5e-3


def test_the_light_of_the_reed_is_as_bright_as_its_settings_say(
    quiet_bench, quiet_settings, at_rest
):
    """Electrons: object light and LO per second, over the exposure, 4·sinc(1/4) in a hologram."""
    light, sensor = quiet_settings.optics.illumination, quiet_settings.sensor
    per_pixel = (
        light.object_e_s * light.local_oscillator_e_s * (4 * np.sinc(0.25) * EXPOSURE_S) ** 2
    )
    expected = per_pixel * np.prod(sensor.shape) / sensor.gain_e_dn**2
    assert np.sum(np.abs(at_rest.astype(complex)) ** 2) == pytest.approx(expected, rel=1e-3)


def test_points_between_pixels_have_no_displacement_of_a_pixel(
    quiet_settings, quiet_bench, coarse_reed
):
    """They are as bright as those of pixels, on the whole sensor."""
    light = replace(quiet_settings.optics.illumination, lattices=2)
    bench = BenchModel(
        with_part(quiet_settings, "optics", illumination=light),
        PlainMotion(coarse_reed),
        np.random.default_rng(1),
    )
    segment = Segment(0.0, EXPOSURE_S, BenchState(Fraction(1), DRIVE_HZ, 0.0))
    rng, scene = np.random.default_rng(2), Scene(local_oscillator=False)
    frames = [one.frame([segment], rng, scene=scene).mean() for one in (bench, quiet_bench)]
    assert frames[0] == pytest.approx(frames[1], rel=0.05)
    assert frames[1] > 0
    with pytest.raises(ValueError, match="displacement_at_m"):
        bench.displacement_m(DRIVE_HZ, 1.0)


def test_without_a_local_oscillator_the_camera_sees_speckle(quiet_settings, coarse_reed):
    """``|E|²`` of the reed: the light that its settings give it, with the contrast of speckle."""
    light = replace(quiet_settings.optics.illumination, local_oscillator_e_s=1e-3, object_e_s=10e12)
    bench = BenchModel(
        with_part(quiet_settings, "optics", illumination=light),
        PlainMotion(coarse_reed),
        np.random.default_rng(1),
    )
    state = BenchState(lock_hz(DRIVE_HZ), DRIVE_HZ, 0.0)
    frame = bench.frame([Segment(0.0, EXPOSURE_S, state)], np.random.default_rng(2))
    expected_dn = 10e12 * EXPOSURE_S / quiet_settings.sensor.gain_e_dn
    assert frame.mean() == pytest.approx(expected_dn, rel=1e-3)
    assert frame.std() == pytest.approx(expected_dn, rel=0.05)


def test_the_local_oscillator_falls_to_an_eighth_at_its_waist(quiet_settings, coarse_reed):
    """``I(w) = e⁻² I(0)``."""
    light = replace(
        quiet_settings.optics.illumination, local_oscillator_waist_m=0.5e-3, object_e_s=1e-3
    )
    settings = with_part(quiet_settings, "optics", illumination=light)
    bench = BenchModel(settings, PlainMotion(coarse_reed), np.random.default_rng(1))
    state = BenchState(lock_hz(DRIVE_HZ), DRIVE_HZ, 0.0)
    frame = bench.frame([Segment(0.0, EXPOSURE_S, state)], np.random.default_rng(2))
    y, x = (settings.sensor.pixel_m * (np.arange(n) - n // 2) for n in settings.sensor.shape)
    expected = 28e3 * np.exp(-2 * np.add.outer(y**2, x**2) / 0.5e-3**2)
    assert np.abs(frame - expected).max() < 2


def test_the_light_on_the_reed_falls_to_an_eighth_at_its_waist(
    quiet_settings, coarse_reed, at_rest, take_field
):
    """Against the wider light of the quiet bench, on the same speckle."""
    light = replace(quiet_settings.optics.illumination, object_waist_m=12e-3)
    settings = with_part(quiet_settings, "optics", illumination=light)
    bench = BenchModel(settings, PlainMotion(coarse_reed), np.random.default_rng(1))
    narrow = take_field(bench, FRAME_RATE_HZ / 4)
    y, x = reed_axes_m(settings.optics.layout, bench.region, bench.transform)
    r2 = np.add.outer(y**2, (x - 19e-3) ** 2)
    bright = np.abs(narrow) > 0.3 * np.abs(narrow).max()
    slope, _ = np.polyfit(r2[bright], 2 * np.log(np.abs(narrow / at_rest)[bright]), 1)
    assert slope == pytest.approx(-2 / 12e-3**2 + 2 / 35e-3**2, rel=0.01)


def test_light_comes_from_the_reed_alone(quiet_bench, quiet_settings, at_rest):
    axes = reed_axes_m(quiet_settings.optics.layout, quiet_bench.region, quiet_bench.transform)
    y, x = np.meshgrid(*axes, indexing="ij")
    light, inside = np.abs(at_rest), on_reed(Outline(), x, y)
    assert 0.7 < inside.mean() < 0.95
    assert np.sqrt(np.mean(light[~inside] ** 2)) < 2 * ROUNDING_DN
    assert np.sqrt(np.mean(light[inside] ** 2)) > 100 * ROUNDING_DN
    # The rounded tip is dark at the corners of the left side.
    assert not inside[:3, 0].any()
    assert inside[len(y) // 2, 2]


def test_displacement_is_that_of_the_driven_reed(quiet_bench, quiet_settings, coarse_reed):
    """Volts to pressure to forced response to the bark side, put together again."""
    axes = reed_axes_m(quiet_settings.optics.layout, quiet_bench.region, quiet_bench.transform)
    y, x = np.meshgrid(*axes, indexing="ij")
    inside = on_reed(Outline(), x, y)

    def pressure(hz, x_m, y_m):
        at_tip = tweeter_pressure_pa(Tweeter(), hz, 3.0) * complex(
            resonance_gain(AcousticResonance(), hz)
        )
        return at_tip * pressure_shape(Chamber(Filling.ASYMMETRIC), hz, x_m, y_m)

    cane = viscoelastic_cane(Components(), Series.A)
    response = forced_response(coarse_reed, cane, 0.03, np.array([float(DRIVE_HZ)]), pressure)
    shapes = surface_shapes(coarse_reed, x[inside], y[inside])
    expected = sum(shapes[symmetry] @ response[symmetry][0] for symmetry in Symmetry)
    moved = quiet_bench.displacement_m(DRIVE_HZ, 3.0)
    np.testing.assert_allclose(moved[inside], expected, atol=1e-5 * np.abs(expected).max())
    assert not moved[~inside].any()


def test_motion_is_microns_at_the_papers_volts(coarse_reed):
    """The paper counts up to some ten fringes (1.6 µm) at the first resonances, 0.5 to 16 V."""
    bench = BenchModel(
        BenchParameters(sensor=Sensor(shape=(256, 320))),
        PlainMotion(coarse_reed),
        np.random.default_rng(3),
    )
    reach_m = [
        np.abs(bench.displacement_m(Fraction(hz), volts)).max()
        for hz, volts in ((1838, 1.2), (4767, 16.0), (6182, 16.0))
    ]
    assert min(reach_m) > 0.05e-6
    assert max(reach_m) < 3e-6


def test_clay_decides_whether_the_reed_twists(quiet_settings, quiet_bench, coarse_reed):
    open_bench = BenchModel(
        replace(quiet_settings, chamber=Chamber()),
        PlainMotion(coarse_reed),
        np.random.default_rng(1),
    )
    axes = reed_axes_m(quiet_settings.optics.layout, open_bench.region, open_bench.transform)
    rows, columns = np.searchsorted(axes[0], [-4e-3, 4e-3]), np.searchsorted(axes[1], 3e-3)
    for bench, twists in ((open_bench, False), (quiet_bench, True)):
        right, left = bench.displacement_m(Fraction(3400), 1.0)[rows, columns]
        # Rows do not lie symmetrically about the axis, to a fraction of a pixel.
        assert (abs(left - right) > 0.5 * abs(left + right)) == twists


def test_the_printed_difference_frequency_shows_next_to_nothing(quiet_bench, at_rest, take_field):
    expected = at_rest * sideband(quiet_bench.displacement_m(DRIVE_HZ, 1.0), 1)
    printed = take_field(quiet_bench, (DRIVE_HZ + FRAME_RATE_HZ) / 4, DRIVE_HZ, 1.0)
    assert np.linalg.norm(printed) < 0.02 * np.linalg.norm(expected)


@pytest.mark.parametrize("real_rate_hz", [Fraction(10), Fraction(12), Fraction(25)])
def test_a_wrong_frame_rate_has_the_gain_of_its_phase_steps(
    real_rate_hz, quiet_bench, at_rest, take_field
):
    """The difference frequency presumes 12.5 Hz: the beat is stepped by another angle."""
    expected = at_rest * sideband(quiet_bench.displacement_m(DRIVE_HZ, 1.0), 1)
    field = take_field(quiet_bench, lock_hz(DRIVE_HZ), DRIVE_HZ, 1.0, frame_rate_hz=real_rate_hz)
    beat_hz = -float(FRAME_RATE_HZ) / 4

    def integrated(rate_hz):
        return sideband_gain(beat_hz, rate_hz, 1 / rate_hz) / rate_hz

    found = np.vdot(expected, field) / np.vdot(expected, expected)
    assert found == pytest.approx(
        integrated(float(real_rate_hz)) / integrated(float(FRAME_RATE_HZ)), abs=5e-3
    )


def test_an_unplugged_tweeter_shows_nothing(quiet_settings, coarse_reed, at_rest, take_field):
    bench = BenchModel(
        with_part(quiet_settings, "drive.tweeter", connected=False),
        PlainMotion(coarse_reed),
        np.random.default_rng(1),
    )
    assert not bench.displacement_m(DRIVE_HZ, 16.0).any()
    field = take_field(bench, lock_hz(DRIVE_HZ), DRIVE_HZ, 16.0)
    assert np.linalg.norm(field) < 2e-3 * np.linalg.norm(at_rest)


def test_without_radio_frequency_the_camera_is_dark(coarse_reed):
    settings = BenchParameters(sensor=Sensor(shape=(256, 320)))
    bench = BenchModel(settings, PlainMotion(coarse_reed), np.random.default_rng(3))
    dark = BenchState(lock_hz(DRIVE_HZ), DRIVE_HZ, 1.0, rf_on=False)
    frame = bench.frame([Segment(0.0, EXPOSURE_S, dark)], np.random.default_rng(4))
    sensor = settings.sensor
    assert frame.mean() == pytest.approx(sensor.offset_dn, abs=0.1)
    assert frame.std() == pytest.approx(np.hypot(12 / 4, np.sqrt(1 / 12)), rel=0.02)
    # Radio frequency for half of the exposure: half of the light.
    bright = replace(dark, rf_on=True)
    half, whole = (
        bench.frame(segments, np.random.default_rng(4)).mean() - sensor.offset_dn
        for segments in (
            [Segment(0.0, 0.04, dark), Segment(0.04, 0.08, bright)],
            [Segment(0.0, 0.08, bright)],
        )
    )
    assert half / whole == pytest.approx(0.5, abs=1e-3)
    assert whole * sensor.gain_e_dn == pytest.approx(80e3 * EXPOSURE_S, rel=0.02)
    assert whole + sensor.offset_dn < 0.6 * saturation_dn(sensor)


def test_stretches_of_an_exposure_add(quiet_bench):
    first = BenchState(lock_hz(DRIVE_HZ), DRIVE_HZ, 1.0)
    other_hz = DRIVE_HZ + 100
    second = BenchState(lock_hz(other_hz), other_hz, 2.0)
    pieces = [Segment(0.0, 0.03, first), Segment(0.03, 0.08, second)]
    rng = np.random.default_rng(5)
    together = quiet_bench.frame(pieces, rng).astype(int)
    apart = sum(quiet_bench.frame([piece], rng).astype(int) for piece in pieces)
    assert np.abs(together - apart).max() <= 3
    # And a cut without a change is no cut.
    whole = quiet_bench.frame([Segment(0.0, 0.08, first)], rng).astype(int)
    cut = [Segment(0.0, 0.05, first), Segment(0.05, 0.08, first)]
    assert np.abs(quiet_bench.frame(cut, rng).astype(int) - whole).max() <= 2


def test_a_drive_that_changes_within_an_exposure_spoils_it(quiet_bench, at_rest, take_frames):
    """Three quarters of the first frame see the drive of the step before: their light is lost."""
    expected = at_rest * sideband(quiet_bench.displacement_m(DRIVE_HZ, 1.0), 1)
    frames = take_frames(quiet_bench, lock_hz(DRIVE_HZ), DRIVE_HZ, 1.0)
    after = BenchState(lock_hz(DRIVE_HZ), DRIVE_HZ, 1.0)
    before = replace(after, drive_hz=DRIVE_HZ - 30)
    frames[0] = quiet_bench.frame(
        [Segment(0.0, 0.06, before), Segment(0.06, 0.08, after)], np.random.default_rng(6)
    )
    field = quiet_bench.region.crop(quiet_bench.transform.to_object(four_phase(frames)))
    beat_hz = -FRAME_RATE_HZ / 4
    lost = beat_integral(beat_hz, 0.0, 0.06) / (4 * beat_integral(beat_hz, 0.0, EXPOSURE_S))
    assert relative(field, expected) == pytest.approx(abs(lost), rel=0.05)
    assert abs(lost) > 0.19


def test_acquisitions_repeat_when_the_beat_has_turned_whole(quiet_bench):
    """8 s hold 25 turns of f_CCD/4, and a whole number of turns of the drive."""
    state = BenchState(lock_hz(DRIVE_HZ), DRIVE_HZ, 1.0)
    rng = np.random.default_rng(7)
    early, late, between = (
        quiet_bench.frame([Segment(t, t + EXPOSURE_S, state)], rng).astype(int)
        for t in (0.0, 800.0, 0.04)
    )
    assert np.abs(early - late).max() <= 2
    assert np.abs(early - between).max() > 100


def test_the_same_seed_gives_the_same_bits(coarse_reed):
    settings = BenchParameters(sensor=Sensor(shape=(256, 320)))

    def frames(seed, noise_seed):
        bench = BenchModel(settings, PlainMotion(coarse_reed), np.random.default_rng(seed))
        state = BenchState(lock_hz(DRIVE_HZ), DRIVE_HZ, 1.0)
        return bench.frame([Segment(0.0, EXPOSURE_S, state)], np.random.default_rng(noise_seed))

    np.testing.assert_array_equal(frames(1, 2), frames(1, 2))
    assert np.any(frames(1, 2) != frames(1, 3))
    assert np.any(frames(1, 2) != frames(4, 2))


def carrier_in(field, at_rest, displacement_m):
    """Amplitudes of sideband 1 and of the carrier in a field, by least squares."""
    parts = np.stack([(at_rest * sideband(displacement_m, n)).ravel() for n in (1, 0)], axis=1)
    return np.linalg.lstsq(parts, field.ravel(), rcond=None)[0]


@pytest.mark.parametrize("quarters", [684, 685, 686, 687])
def test_the_carrier_leaks_as_demodulation_says(quarters, quiet_bench, at_rest, take_field):
    """At whole multiples of f_CCD 15 % of a sideband of φ = 0.02; nothing at odd quarters."""
    drive_hz = Fraction(quarters, 4) * FRAME_RATE_HZ
    field = take_field(quiet_bench, lock_hz(drive_hz), drive_hz, 0.5)
    first, carrier = carrier_in(field, at_rest, quiet_bench.displacement_m(drive_hz, 0.5))
    assert first == pytest.approx(1, abs=5e-3)
    leak = carrier_leak(float(drive_hz), float(FRAME_RATE_HZ), EXPOSURE_S, off_axis=True)
    assert abs(carrier) == pytest.approx(leak, abs=1e-4)
    at_small_motion = abs(carrier) * jv(0, 0.02) / jv(1, 0.02)
    if quarters == 684:
        assert at_small_motion == pytest.approx(0.15, abs=0.01)
    elif quarters % 2:
        assert at_small_motion < 0.01


def test_displacements_at_points_are_those_that_frames_are_rendered_from(quiet_bench, coarse_reed):
    y, x = np.meshgrid(
        *reed_axes_m(
            quiet_bench.parameters.optics.layout, quiet_bench.region, quiet_bench.transform
        ),
        indexing="ij",
    )
    inside = on_reed(coarse_reed.geometry.outline, x, y)
    drives = [(DRIVE_HZ, 2.0), (Fraction(5000), 1.0)]
    found = quiet_bench.displacement_at_m(x[inside], y[inside], drives)
    for row, (drive_hz, volts) in zip(found, drives, strict=True):
        rendered = quiet_bench.displacement_m(drive_hz, volts)[inside]
        assert row == pytest.approx(rendered, rel=1e-5, abs=1e-13)
        coordinates = quiet_bench.coordinates_m(float(drive_hz), volts)
        surface = surface_shapes(coarse_reed, x[inside], y[inside])
        moved = sum(surface[part] @ q for part, q in coordinates.items())
        assert moved == pytest.approx(rendered, rel=1e-4, abs=1e-12)


def test_sidebands_left_out_would_not_change_a_pixel(quiet_bench, at_rest, take_frames):
    """All orders to ±80, at 30 rad and where they leak most; numbers as on the nominal bench."""
    drive_hz, drive_v = 147 * FRAME_RATE_HZ, 16.0
    frames = take_frames(quiet_bench, lock_hz(drive_hz), drive_hz, drive_v).astype(float)
    moved = quiet_bench.displacement_m(drive_hz, drive_v)
    assert phase_rad(moved).max() > 30
    unit = beat_integral(-FRAME_RATE_HZ / 4, 0.0, EXPOSURE_S)
    difference = np.zeros(frames.shape[1:])
    for m, sign in ((0, 1), (2, -1)):
        start_s = m * EXPOSURE_S
        light = sum(
            sideband(moved, n)
            * beat_integral(n * drive_hz - lock_hz(drive_hz), start_s, start_s + EXPOSURE_S)
            for n in range(-80, 81)
        )
        object_plane = quiet_bench.region.paste(at_rest * light / unit, difference.shape)
        # A field of the four frames is four times that of one beat.
        difference += sign * 0.5 * quiet_bench.transform.to_sensor(object_plane).real
    left_out = frames[0] - frames[2] - difference
    nominal_dn = 80e3 * EXPOSURE_S / 4 / 28e3 * left_out
    assert np.sqrt(np.mean(nominal_dn**2)) < 0.1


def test_the_noise_of_an_empty_image_is_shot_noise_and_read_noise(coarse_reed, take_frames):
    settings = BenchParameters(sensor=Sensor(shape=(256, 320)))
    bench = BenchModel(settings, PlainMotion(coarse_reed), np.random.default_rng(8))
    frames = take_frames(bench, lock_hz(DRIVE_HZ), DRIVE_HZ, 1.0)
    image = bench.transform.to_object(four_phase(frames))
    sensor = settings.sensor
    mean_dn = frames.mean() - sensor.offset_dn
    variance = mean_dn / sensor.gain_e_dn + (12 / 4) ** 2 + 1 / 12
    # Away from reed, twin and zero order.
    empty = image[100:156, :80]
    assert np.mean(np.abs(empty) ** 2) == pytest.approx(4 * variance, rel=0.06)


def test_fringes_close_in_on_the_reed_when_the_local_oscillator_is_faster(quiet_bench, take_frames):
    """Real waves ``cos(2πνt − kr)``: the phase of H against that of the LO is ``−kr``.

    With the LO above by f_CCD/4, points of the reed are therefore found by adding up the hologram
    with ``exp(+ikr)``; with the opposite sign it is out of focus.
    """
    hologram = four_phase(take_frames(quiet_bench, FRAME_RATE_HZ / 4)).astype(complex)
    transform = quiet_bench.transform
    rows, columns = ((np.arange(n) - n // 2) * transform.pixel_m for n in transform.shape)
    region = quiet_bench.region
    dy, dx = transform.object_pitch_m

    def light_at(row, column, sign):
        y = (row - transform.shape[0] // 2) * dy
        x = (column - transform.shape[1] // 2) * dx
        kr = np.pi / (WAVELENGTH_M * transform.distance_m)
        to_y, to_x = (np.exp(1j * sign * kr * (u - v) ** 2) for u, v in ((rows, y), (columns, x)))
        return abs(to_y @ hologram @ to_x) ** 2

    middle = region.row + region.height // 2
    points = range(region.column + 20, region.column + region.width - 5, 5)
    focused, mirrored = (sum(light_at(middle, c, sign) for c in points) for sign in (1, -1))
    assert focused > 100 * mirrored


def test_a_bench_leaves_memory_when_it_is_let_go(quiet_settings, coarse_reed):
    bench = BenchModel(quiet_settings, PlainMotion(coarse_reed), np.random.default_rng(1))
    bench.displacement_m(Fraction(2000), 1.0)
    left = weakref.ref(bench.transform)
    gc.disable()
    try:
        del bench
        assert left() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("hours", [0.1, 1.0])
def test_a_drift_detunes_by_its_rate_times_the_time(quiet_settings, coarse_reed, hours):
    """Not by twice as much, as the phase ``2π·rate·t·t`` would: a phase is the frequency's sum."""
    rate_hz_h = 0.6
    drifting = with_part(quiet_settings, "clocks", detuning_hz_h=rate_hz_h)
    bench = BenchModel(drifting, PlainMotion(coarse_reed), np.random.default_rng(1))
    state = BenchState(FRAME_RATE_HZ / 4, Fraction(0), 0.0)
    edges_s = [3600 * hours + float(m / FRAME_RATE_HZ) for m in range(5)]
    rng = np.random.default_rng(2)
    frames = np.stack([bench.frame([Segment(*edges, state)], rng) for edges in pairwise(edges_s)])
    reconstruction = Reconstruction(bench.transform, bench.region)
    found = reconstruction.steady_turn(frames, reconstruction.quadratures(frames))
    detuning_hz = found.error_rad * float(FRAME_RATE_HZ) / (2 * np.pi)
    assert detuning_hz == pytest.approx(rate_hz_h * hours, rel=2e-3)
