"""Light from a region of the object plane, against the transform of the whole plane."""

import numpy as np
import pytest

from holography.fresnel import FresnelTransform
from holography.fresnel_region import RegionTransform
from holography.region import Region

TRANSFORM = FresnelTransform((60, 77), 60e-6, 650e-9, 1.0)
REGION = Region(row=31, column=8, height=14, width=33)


@pytest.fixture(scope="module")
def light():
    rng = np.random.default_rng(5)
    parts = rng.standard_normal((2, REGION.height, REGION.width))
    return (parts[0] + 1j * parts[1]).astype(np.complex64)


def test_the_region_sends_what_it_sends_in_a_dark_plane(light):
    expected = TRANSFORM.to_sensor(REGION.paste(light, TRANSFORM.shape))
    field = RegionTransform(TRANSFORM, REGION).to_sensor(light)
    assert field.dtype == np.complex64
    assert np.abs(field - expected).max() < 2e-6 * np.abs(expected).max()


def test_light_is_not_changed(light):
    before = light.copy()
    RegionTransform(TRANSFORM, REGION).to_sensor(light)
    assert np.array_equal(light, before)


@pytest.mark.parametrize("offset", [(0.25, -0.25), (-0.5, 0.125), (1.0, 2.0)])
def test_an_offset_moves_the_source_of_a_wave(offset):
    """The sum over one point, by the Fresnel integral, but for the chirp of its pixel."""
    point = np.zeros((REGION.height, REGION.width), np.complex64)
    point[3, 20] = 1
    field = RegionTransform(TRANSFORM, REGION, offset).to_sensor(point)
    pitches = TRANSFORM.object_pitch_m
    pixels = (REGION.row + 3, REGION.column + 20)
    place_m = [
        (pixel + part - n // 2) * pitch
        for pixel, part, n, pitch in zip(pixels, offset, TRANSFORM.shape, pitches, strict=True)
    ]
    v, u = ((np.arange(n) - n // 2) * TRANSFORM.pixel_m for n in TRANSFORM.shape)
    away2 = (v[:, None] - place_m[0]) ** 2 + (u - place_m[1]) ** 2
    wave = np.exp(-1j * np.pi * away2 / (TRANSFORM.wavelength_m * TRANSFORM.distance_m))
    wave /= np.sqrt(wave.size)
    assert abs(np.vdot(wave, field)) == pytest.approx(1, abs=1e-5)


def test_light_of_another_shape_is_refused(light):
    with pytest.raises(ValueError, match=r"\(13, 33\).*\(14, 33\)"):
        RegionTransform(TRANSFORM, REGION).to_sensor(light[1:])


def test_a_region_that_leaves_the_plane_is_refused():
    with pytest.raises(ValueError, match="leaves the image"):
        RegionTransform(TRANSFORM, Region(row=50, column=0, height=20, width=5))
