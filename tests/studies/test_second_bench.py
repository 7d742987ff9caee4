"""Light, camera and instruments of the second laboratory, against what is known exactly."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.special import jv

import acquire
from drivers.errors import InstrumentError, LimitError
from studies.second_laboratory.bench import bench_file, mode_mm, protocol
from studies.second_laboratory.cane import Cane
from studies.second_laboratory.drive import Drive
from studies.second_laboratory.instruments import FreeRunningCamera, VirtualClock
from studies.second_laboratory.laboratory import Laboratory, Sensor, Settings
from studies.second_laboratory.light import (
    Geometry,
    Propagation,
    exposure_weights,
    vibration_samples,
)
from studies.second_laboratory.parameters import (
    BenchParameters,
    CameraParameters,
    Clamp,
    Disorder,
    LightParameters,
    Thickness,
    draw_bench,
    draw_reed,
)
from studies.second_laboratory.reed import Reed
from studies.second_laboratory.shape import Fineness

# Few elements: what is tested here does not depend on their number.
COARSE = Fineness(5.0, 2.0, 0.4, 5.0, 2, 3, (0.0, 0.8, 1.0), 2, 3)
CENTRE_HZ, RATE_HZ = Fraction(80_000_000), Fraction("12.4")
GEOMETRY = Geometry((64, 80), 26.8e-6, 650e-9, 1.0)


@pytest.fixture(scope="module")
def reed() -> Reed:
    return Reed(Cane(), Thickness(), Clamp(), COARSE)


def test_waves_of_scatterers_are_their_fresnel_sum():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-0.02, 0.02, 40), 0.022 + rng.uniform(-0.006, 0.006, 40)
    amplitudes = rng.standard_normal((2, 40)) + 1j * rng.standard_normal((2, 40))
    waves = Propagation(GEOMETRY, x, y)(amplitudes.astype(np.complex64))
    rate = GEOMETRY.wavelength_m * GEOMETRY.distance_m
    v, u = (GEOMETRY.axis(n) for n in GEOMETRY.shape)
    blur = np.sinc(GEOMETRY.pixel_m * x / rate) * np.sinc(GEOMETRY.pixel_m * y / rate)
    square = (u[None, :, None] - x) ** 2 + (v[:, None, None] - y) ** 2
    direct = np.exp(-1j * np.pi * square / rate) * blur @ amplitudes[1]
    assert np.linalg.norm(waves[1] - direct) < 1e-4 * np.linalg.norm(direct)


def test_light_of_all_orders_is_the_light_at_rest():
    # Σ J_n² = 1: over the phases of a vibration, the light's power does not depend on its size.
    samples = vibration_samples(7.0)
    light = np.exp(7j * np.cos(2 * np.pi * np.arange(samples) / samples))
    orders = np.fft.fft(light) / samples
    assert np.sum(np.abs(orders) ** 2) == pytest.approx(1)
    assert np.abs(orders[:4]) == pytest.approx(np.abs(jv(np.arange(4), 7.0)), abs=1e-3)


@pytest.mark.parametrize("phi", [0.02, 1.0, 12.0])
def test_locked_frames_hold_the_first_order(phi):
    # Brute force: the mean of the beating light over each exposure, by a fine sum.
    f, rate = 2143.7, 12.4
    beat, samples = f + rate / 4, vibration_samples(phi)
    starts = np.arange(4) / rate
    weights = exposure_weights(f, beat, starts, 1 / rate, samples)
    light = np.exp(1j * phi * np.cos(2 * np.pi * np.arange(samples) / samples + 0.3))
    t = (np.arange(200_000) + 0.5) / 200_000 / rate
    direct = [
        np.mean(
            np.exp(1j * (phi * np.cos(2 * np.pi * f * (s + t) + 0.3) - 2 * np.pi * beat * (s + t)))
        )
        for s in starts
    ]
    assert weights @ light == pytest.approx(np.array(direct), abs=2e-4)
    frames = 2 * np.real(weights @ light)
    hologram = frames[0] - frames[2] + 1j * (frames[1] - frames[3])
    if phi >= 1:
        assert abs(hologram) == pytest.approx(4 * abs(jv(1, phi)) * np.sinc(0.25), rel=0.02)


def test_sensor_counts_photons():
    camera = CameraParameters(electrons_per_dn=4.0, offset_dn=50.0, read_noise_e=5.0)
    sensor = Sensor(camera, (300, 300), np.random.default_rng(3))
    frame = sensor(np.full((300, 300), 8000.0)).astype(float)
    assert frame.mean() == pytest.approx(50 + 8000 / 4, abs=0.5)
    assert frame.var() == pytest.approx((8000 + 25) / 16 + 1 / 12, rel=0.02)


def test_an_amount_of_zero_switches_disorder_off():
    off = Disorder().scaled({"all": 0})
    reed, bench = draw_reed(off, "A", 7), draw_bench(off, 7)
    assert reed.cane == replace(Cane(), per_kelvin=reed.cane.per_kelvin)
    assert (reed.thickness, reed.clamp, reed.air) == (Thickness(), Clamp(), 1.0)
    assert bench.light == LightParameters()
    assert bench.drive.gain_sd == 0
    assert bench.drive.breakup == ()
    with pytest.raises(KeyError):
        Disorder().scaled({"no such disorder": 1})


def test_series_of_one_reed_have_one_cane():
    a, b = (draw_reed(Disorder(), series, 4) for series in "AB")
    assert a.cane.components == b.cane.components
    assert a.thickness == b.thickness
    assert (a.cane.dryness, b.cane.dryness) == (0.0, 1.0)
    assert a.clamp != b.clamp


class BlindCamera(FreeRunningCamera):
    saturation_dn = 4095

    def _prepare(self, shape):
        self.shape = shape

    def _expose(self, starts_s, exposure_s):
        return [np.zeros(self.shape, np.uint16) for _ in starts_s]


@pytest.mark.parametrize("name", ["F1", "T1"])
def test_a_mode_is_what_the_reed_moves_without_the_others(reed, name):
    """The response of the whole reed, solved at once, less what all other poles add to it.

    Each pole has the moduli of its own frequency, so that what the others add is known to some per
    cent: little where the mode moves most of the reed.
    """
    drive = Drive(BenchParameters().drive, clay=True)
    (own,) = (pole for pole in reed.poles if pole.name == name)
    hz = own.frequency_hz
    pressure = drive.pressure_mpa(hz, reed.load_x, reed.load_y)
    left = reed.response(hz, pressure)
    for pole in reed.poles:
        if pole is not own:
            square = (pole.frequency_hz / hz) ** 2 * (1 + 1j * pole.loss_factor)
            force = pole.vector @ reed.load(pressure) / (2 * np.pi * hz) ** 2
            left = left - pole.vector * force / (square - 1)
    x, y = np.meshgrid(np.linspace(0, 38, 100), np.linspace(-6.5, 6.5, 41))
    shapes = [reed.deflection(x.ravel(), y.ravel()), reed.deflection_of_nodes(38.0)]
    moved = np.abs(np.concatenate(shapes) @ left).max()
    assert mode_mm(reed, drive, own) == pytest.approx(moved, rel=0.005)


def test_the_corners_of_a_reed_move_more_than_its_inside(reed):
    """X3 is largest where the tip meets the sides: there a grid of points inside sees less."""
    (mode,) = (pole for pole in reed.poles if pole.name == "X3")
    x, y = np.meshgrid(np.linspace(0, 38, 153), np.linspace(-6.5, 6.5, 53))
    inside = np.abs(reed.deflection(x.ravel(), y.ravel()) @ mode.vector).max()
    at_nodes = np.abs(reed.deflection_of_nodes(38.0) @ mode.vector).max()
    assert 1.005 < at_nodes / inside < 1.1


@pytest.fixture
def blind_camera() -> BlindCamera:
    camera = bench_file("B", 1, 1, {}).instruments.camera
    return BlindCamera(camera.model_copy(update={"height": 64, "width": 80}), VirtualClock())


@pytest.mark.parametrize("shape", [(65, 80), (64, 81), (32, 81)])
def test_a_camera_refuses_more_than_its_sensor(blind_camera, shape):
    with pytest.raises(LimitError):
        blind_camera.configure(RATE_HZ, 1 / RATE_HZ, shape)
    with pytest.raises(LimitError):
        blind_camera.configure(RATE_HZ, 2 / RATE_HZ, (64, 80))


def test_a_camera_runs_while_nobody_looks(blind_camera):
    with pytest.raises(InstrumentError):
        blind_camera.start()
    blind_camera.configure(RATE_HZ, 1 / RATE_HZ, (64, 80))
    with pytest.raises(InstrumentError):
        blind_camera.grab(4, 0.0)
    blind_camera.start()
    first, late = blind_camera.grab(4, 0.0), blind_camera.grab(4, 1.0)
    assert [frame.id for frame in first + late] == [0, 1, 2, 3, 13, 14, 15, 16]
    assert late[0].timestamp_s == pytest.approx(13 / 12.4)
    assert blind_camera.now_s() == pytest.approx(17 / 12.4)
    with pytest.raises(InstrumentError):
        blind_camera.configure(RATE_HZ, 1 / RATE_HZ, (64, 80))


def test_bench_and_protocol_can_be_planned():
    plan = acquire.plan(protocol("B", "small"), bench_file("B", 1, 1, {"all": 0}))
    assert len(plan.steps) == 184
    assert not plan.violations


@pytest.mark.slow
@pytest.mark.parametrize("name", ["F1", "T1", "X1"])
def test_pole_is_found_again_in_frames(reed: Reed, name: str) -> None:
    # Motion so small that J1 is straight, light so bright that its noise is small, a quiet sensor.
    light = LightParameters(reference_e=4e8, object_share=0.5)
    camera = CameraParameters(electrons_per_dn=2e5, full_well_e=1e12, read_noise_e=0)
    bench = BenchParameters(light=light, camera=camera)
    settings = Settings(CENTRE_HZ, CENTRE_HZ, rf=True, sounding=True)
    rng = np.random.default_rng(1)
    laboratory = Laboratory(reed, bench, True, GEOMETRY, (0.022, 0.0), settings, rng)
    pole = next(p for p in reed.poles if p.name == name)
    settings.volts, settings.drive_hz = 1.0, Fraction(pole.frequency_hz)
    peak_rad = 4e-3 * np.pi * np.abs(laboratory.vibration_mm()).max() / GEOMETRY.wavelength_m
    settings.volts = 0.3 / peak_rad
    drive, holograms = Drive(bench.drive, clay=True), []
    hz = pole.frequency_hz * np.linspace(0.96, 1.04, 41)
    for k, each in enumerate(hz):
        settings.drive_hz = Fraction(each)
        settings.aom1_hz = CENTRE_HZ + settings.drive_hz + RATE_HZ / 4
        starts = [float((4 * k + m) / RATE_HZ) for m in range(4)]
        frames = [i.astype(float) for i in laboratory.expose(starts, float(1 / RATE_HZ))]
        hologram = frames[0] - frames[2] + 1j * (frames[1] - frames[3])
        holograms.append(hologram.ravel() / drive.loudspeaker(each))
    response = np.array(holograms) @ np.conj(holograms[20]) / np.linalg.norm(holograms[20]) ** 2
    # One pole p and a cubic polynomial: r·(x − p) = c(x).
    x = hz / pole.frequency_hz - 1
    known = np.column_stack([np.vander(x, 4), response])
    found = 1 + np.linalg.lstsq(known, response * x, rcond=None)[0][-1]
    assert 1200 * np.log2(found.real * pole.frequency_hz / pole.pole_hz) == pytest.approx(0, abs=1)
    assert 2 * found.imag / found.real == pytest.approx(pole.pole_loss, rel=0.03)
