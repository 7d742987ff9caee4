"""Waves of points that scatter, against the sum of their Fresnel waves."""

from dataclasses import replace

import numpy as np
import pytest

from holography.fresnel import FresnelTransform
from physics.parameters.optics import Layout
from physics.reed.geometry import Outline
from physics.scatterers import Scatterers

SHAPE, PIXEL_M = (72, 80), 60e-6
LAYOUT = replace(Layout(), distance_m=1.0, reed_centre_m=(0.0, 0.0), reed_size_m=(8e-3, 9e-3))
SMALL = replace(
    Outline(), tip_radius_m=3.2e-3, corner_radius_m=0.6e-3, corner_x_m=0.9e-3,
    side_half_width_m=1.7e-3, length_m=20e-3,
)  # fmt: skip


@pytest.fixture(scope="module")
def transform():
    return FresnelTransform(SHAPE, PIXEL_M, LAYOUT.wavelength_m, LAYOUT.distance_m)


def points_of(transform, lattices):
    return Scatterers.of(LAYOUT, transform, SMALL, lattices)


def wave_of_one(points, number):
    """The sum over one point, by the Fresnel integral; of unit power on the whole sensor."""
    v, u = ((np.arange(n) - n // 2) * PIXEL_M for n in SHAPE)
    # The middle of the reed's image lies on the axis.
    x_m = points.x_m[number] - 0.5 * LAYOUT.reed_size_m[1]
    away2 = (v[:, None] - points.y_m[number]) ** 2 + (u - x_m) ** 2
    phase = -np.pi * away2 / (LAYOUT.wavelength_m * LAYOUT.distance_m)
    return np.exp(1j * phase) / np.sqrt(np.prod(SHAPE))


@pytest.mark.parametrize("lattices", [1, 2])
def test_each_point_sends_the_wave_of_its_place(transform, lattices):
    points = points_of(transform, lattices)
    for number in np.linspace(0, len(points.x_m) - 1, 9).astype(int):
        light = np.zeros(len(points.x_m), np.complex64)
        light[number] = 1
        overlap = np.vdot(wave_of_one(points, number), points.to_sensor(light))
        # But for a phase, which the phase of a rough point contains.
        assert abs(overlap) == pytest.approx(1, abs=1e-4)


def test_points_of_two_lattices_lie_between_pixels(transform):
    one, two = points_of(transform, 1), points_of(transform, 2)
    pitch_y, pitch_x = transform.object_pitch_m
    assert len(two.x_m) == pytest.approx(2 * len(one.x_m), rel=0.05)
    for values, middles, pitch in ((two.x_m, one.x_m, pitch_x), (two.y_m, one.y_m, pitch_y)):
        off = np.mod((values - middles[0]) / pitch, 1)
        assert np.sort(np.unique(np.round(off, 6) % 1)) == pytest.approx([0.25, 0.75])


def test_waves_add_up_and_two_lattices_share_the_power(transform):
    points, rng = points_of(transform, 2), np.random.default_rng(3)
    count = len(points.x_m)
    light = (rng.standard_normal((2, count)) + 1j * rng.standard_normal((2, count))).astype(
        np.complex64
    )
    one, other = (points.to_sensor(each) for each in light)
    assert points.to_sensor(light.sum(axis=0)) == pytest.approx(one + other, abs=1e-4)
    assert np.sum(np.abs(one) ** 2) == pytest.approx(np.sum(np.abs(light[0]) ** 2), rel=0.1)


def test_light_between_pixels_has_side_lobes(transform):
    """Of a point in the middle of a pixel, only this one is bright."""
    bright = []
    for lattices in (1, 2):
        points = points_of(transform, lattices)
        light = np.zeros(len(points.x_m), np.complex64)
        light[len(light) // 4] = 1
        image = np.abs(transform.to_object(points.to_sensor(light))) ** 2
        bright.append(float(image.max() / image.sum()))
    assert bright[0] == pytest.approx(1, abs=1e-4)
    # sinc²(1/4) along each axis.
    assert bright[1] == pytest.approx(np.sinc(0.25) ** 4, abs=1e-3)
