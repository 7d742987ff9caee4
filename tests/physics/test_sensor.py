"""The sensor by the methods of a camera's data sheet (EMVA 1288)."""

from dataclasses import replace

import numpy as np
import pytest

from physics.parameters.sensor import Sensor
from physics.sensor import read_out, saturation_dn

SIDE = 256
SENSOR = Sensor(shape=(SIDE, SIDE))


def exposure(sensor, electrons, seed=13, side=SIDE):
    mean_e = np.full((side, side), electrons, dtype=np.float32)
    return read_out(sensor, mean_e, np.random.default_rng(seed))


def test_photon_transfer_gives_gain_and_read_noise():
    """Variance is a line over the mean: slope 1/gain, intercept (read noise/gain)² + 1/12."""
    sensor = replace(SENSOR, read_noise_e=6.0)
    levels = np.linspace(0, 12e3, 13)
    frames = [exposure(sensor, electrons, seed) for seed, electrons in enumerate(levels)]
    means = np.array([frame.mean() for frame in frames]) - sensor.offset_dn
    variances = np.array([frame.var() for frame in frames])
    slope, _ = np.polyfit(means, variances, 1)
    assert slope == pytest.approx(1 / sensor.gain_e_dn, rel=0.01)
    dark = exposure(sensor, 0.0, side=1024)
    # A million pixels: the variance of the dark is known to 0.14 %.
    assert dark.var() == pytest.approx((6.0 / 4.0) ** 2 + 1 / 12, rel=0.006)


def test_the_mean_is_linear_to_two_parts_in_a_thousand():
    levels = np.linspace(500, 12e3, 12)
    means = np.array([exposure(SENSOR, electrons, int(electrons)).mean() for electrons in levels])
    expected = levels / SENSOR.gain_e_dn
    assert np.abs((means - SENSOR.offset_dn) / expected - 1).max() < 2e-3


def test_dark_pixels_read_the_offset():
    dark = exposure(SENSOR, 0.0)
    assert dark.mean() == pytest.approx(SENSOR.offset_dn, abs=0.05)


def test_numbers_are_rounded_not_cut():
    """Without noise a ramp of electrons steps half way between two numbers."""
    sensor = replace(SENSOR, read_noise_e=0.0, offset_dn=0.0, gain_e_dn=1e6, full_well_e=1e12)
    ramp = np.linspace(0, 10e6, 20001, dtype=np.float32)[None]
    # Shot noise of 10⁶ electrons is 10⁻³ of a number.
    counts = read_out(sensor, ramp.copy(), np.random.default_rng(14))
    assert np.abs(counts - ramp / 1e6).max() < 0.51


@pytest.mark.parametrize(
    ("sensor", "limit"),
    [
        (SENSOR, 16000 / 4 + 50),
        (replace(SENSOR, full_well_e=1e5), 4095),
        (replace(SENSOR, bits=10), 1023),
        (replace(SENSOR, bits=16, full_well_e=1e9, gain_e_dn=1.0), 65535),
    ],
)
def test_pixels_saturate_at_the_full_well_or_at_the_converter(sensor, limit):
    assert saturation_dn(sensor) == limit
    assert np.all(exposure(sensor, 1e8) == limit)
    # Some of the pixels close below are at the limit, none above.
    near = exposure(sensor, (limit - sensor.offset_dn) * sensor.gain_e_dn)
    assert near.max() == limit
    assert near.min() < limit


def test_noise_below_zero_reads_zero():
    counts = exposure(replace(SENSOR, offset_dn=0.0, read_noise_e=40.0), 0.0)
    assert counts.dtype == np.uint16
    assert counts.min() == 0
    # Half of the pixels would be negative; none of them may wrap to a huge number.
    assert np.mean(counts == 0) == pytest.approx(0.5, abs=0.06)
    assert counts.max() < 100


def test_darker_than_dark_is_dark():
    np.testing.assert_array_equal(exposure(SENSOR, -500.0), exposure(SENSOR, 0.0))


def test_noise_is_white_and_independent_from_frame_to_frame():
    rng = np.random.default_rng(15)
    frames = [
        read_out(SENSOR, np.full((SIDE, SIDE), 6400, dtype=np.float32), rng).astype(float)
        for _ in range(2)
    ]
    noise = [frame - frame.mean() for frame in frames]
    limit = 5 * noise[0].var() / SIDE
    assert abs(np.mean(noise[0] * noise[1])) < limit
    assert abs(np.mean(noise[0][1:] * noise[0][:-1])) < limit
    assert abs(np.mean(noise[0][:, 1:] * noise[0][:, :-1])) < limit


def test_the_same_generator_gives_the_same_bits():
    np.testing.assert_array_equal(exposure(SENSOR, 6400.0), exposure(SENSOR, 6400.0))
    assert np.any(exposure(SENSOR, 6400.0) != exposure(SENSOR, 6400.0, seed=99))


def test_noise_is_normal():
    """Its moments up to the sixth, and nothing that repeats between pixels, rows or frames."""
    sensor = replace(SENSOR, gain_e_dn=0.25, offset_dn=0.0, bits=16, read_noise_e=0.0)
    # 10 000 electrons, of which the shot noise is 100.
    frames = [exposure(sensor, 1e4, seed, side=1024).astype(float) for seed in (1, 2)]
    noise, other = ((frame * sensor.gain_e_dn - 1e4) / 100 for frame in frames)
    count = noise.size
    for power, expected, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96), (6, 15, 10170)):
        found = np.mean(noise**power)
        assert abs(found - expected) < 4 * np.sqrt(variance / count)
    # Rows are read out in bands.
    neighbours = (noise[:, :-1], noise[:, 1:]), (noise[:-1], noise[1:]), (noise[:-32], noise[32:])
    for one, another in (*neighbours, (noise, other)):
        assert abs(np.mean(one * another)) < 4 / np.sqrt(one.size)
