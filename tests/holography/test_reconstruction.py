"""From frames to fields: what is light, what is noise, and where there is nothing but noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holography.demodulation import four_phase
from holography.fresnel import FresnelTransform
from holography.reconstruction import (
    Quadratures,
    Reconstruction,
    empty_region,
    mean_power,
)
from holography.region import Region

TRANSFORM = FresnelTransform((64, 80), 6.7e-6, 650e-9, 1.0)
RECONSTRUCTION = Reconstruction(TRANSFORM, Region(42, 20, 12, 40))


def complex_noise(rng, shape):
    parts = rng.standard_normal((2, *shape), dtype=np.float32)
    return (parts[0] + 1j * parts[1]).astype(np.complex64)


def hann_window():
    """Window of the sensor along the axis on which the empty region lies beyond the reed."""
    empty, (rows, columns) = RECONSTRUCTION.empty, TRANSFORM.shape
    if empty.width == columns:
        return np.sin(np.pi * np.arange(rows) / rows)[:, None] ** 2
    return np.sin(np.pi * np.arange(columns) / columns) ** 2


@pytest.fixture
def frames():
    return np.random.default_rng(1).integers(0, 4096, (4, 64, 80), dtype=np.uint16)


# --- Fields ------------------------------------------------------------------------------------


def test_the_field_is_the_hologram_in_the_object_plane(frames):
    image = TRANSFORM.to_object(four_phase(frames))
    field = RECONSTRUCTION.field(frames)
    assert field.dtype == np.complex64
    assert field.shape == (12, 40)
    scale = np.abs(image).max()
    np.testing.assert_allclose(field, RECONSTRUCTION.region.crop(image), atol=1e-5 * scale)


def test_the_halves_are_the_images_of_both_differences(frames):
    counts = frames.astype(np.float32)
    halves = RECONSTRUCTION.quadratures(frames)
    scale = np.abs(halves.field).max()
    pairs = ((halves.even, counts[0] - counts[2]), (halves.odd, counts[1] - counts[3]))
    for number, (half, difference) in enumerate(pairs):
        image = TRANSFORM.to_object(difference)
        np.testing.assert_allclose(half, RECONSTRUCTION.region.crop(image), atol=1e-5 * scale)
        windowed = TRANSFORM.to_object(difference * hann_window())
        empty = RECONSTRUCTION.empty.crop(windowed) / np.sqrt(3 / 8)
        np.testing.assert_allclose(halves.empty[number], empty, atol=1e-5 * scale)
    np.testing.assert_array_equal(halves.field, halves.even + np.complex64(1j) * halves.odd)


def test_a_field_holds_no_more_memory_than_its_region(frames):
    """A recorder keeps some of them: views would keep the images that they were cut from."""
    halves = RECONSTRUCTION.quadratures(frames)
    assert halves.even.base is None
    assert halves.odd.base is None


def test_frames_of_another_shape_are_refused(frames):
    with pytest.raises(ValueError, match="shape"):
        RECONSTRUCTION.field(frames[:, :-1])
    with pytest.raises(ValueError, match="four"):
        RECONSTRUCTION.field(frames[:3])


# --- Light and noise ---------------------------------------------------------------------------


def test_signal_and_noise_are_mean_powers():
    even = np.full((2, 3), 3 + 4j, np.complex64)
    empty = np.zeros((2, 2, 10), np.complex64)
    empty[0] = 2
    halves = Quadratures(even, 0 * even, empty)
    assert mean_power(halves.field) == pytest.approx(25)
    assert halves.noise == pytest.approx(4)
    # With both halves the field is even + j odd: (3 + 4j) + j (3 + 4j) = -1 + 7j.
    both = Quadratures(even, even, np.stack([empty[0], empty[0]]))
    assert mean_power(both.field) == pytest.approx(50)
    assert both.noise == pytest.approx(8)
    assert Quadratures(even, even, 0 * empty).noise == 0, "a dead camera"


def test_mean_power_is_that_of_every_pixel():
    field = complex_noise(np.random.default_rng(2), (30, 40))
    assert mean_power(field) == pytest.approx(np.mean(np.abs(field.astype(complex)) ** 2))


# The empty region lies next to the first, and above the second, which spans nearly all columns.
REEDS = pytest.mark.parametrize("region", [Region(160, 80, 60, 160), Region(108, 10, 40, 300)])


@REEDS
def test_noise_of_the_camera_is_that_of_the_empty_region_and_of_the_reed_s(region):
    """White noise stays white: its power per pixel is that on the sensor, wherever one looks."""
    rng = np.random.default_rng(4)
    white = np.rint(rng.normal(1000, 20, (4, 256, 320))).astype(np.uint16)
    transform = FresnelTransform((256, 320), 6.7e-6, 650e-9, 1.0)
    halves = Reconstruction(transform, region).quadratures(white)
    # Four frames of variance 400 and 1/12 of rounding.
    assert halves.noise == pytest.approx(4 * (400 + 1 / 12), rel=0.02)
    assert mean_power(halves.field) == pytest.approx(halves.noise, rel=0.04)


@pytest.mark.parametrize("region", [Region(42, 20, 12, 40), Region(24, 4, 16, 72)])
def test_noise_scatters_as_that_of_independent_pixels(region):
    """Of 2000 frames of white noise, along either axis: of a Hann window 35 of 18 pixels."""
    rng, reconstruction = np.random.default_rng(7), Reconstruction(TRANSFORM, region)
    empty = reconstruction.empty
    assert 1.6 < empty.height * empty.width / reconstruction.independent_noise < 35 / 18
    images = complex_noise(rng, (2000, *TRANSFORM.shape))
    powers = [mean_power(reconstruction.only_noise(image)) for image in images]
    scatter = np.std(powers) / np.mean(powers)
    assert scatter == pytest.approx(reconstruction.independent_noise**-0.5, rel=0.06)


@REEDS
def test_side_lobes_of_the_reed_s_light_are_no_noise(region):
    """Scatterers between pixels of the image, whose light ends at the edges of the sensor."""
    rng = np.random.default_rng(6)
    transform = FresnelTransform((256, 320), 6.7e-6, 650e-9, 1.0)
    reconstruction = Reconstruction(transform, region)
    at = [(np.arange(n) - n // 2) * 6.7e-6 for n in (256, 320)]
    pitch_m = transform.object_pitch_m
    light = np.zeros((256, 320), complex)
    first = region.row + 5, region.column + 5
    last = region.row + region.height - 5, region.column + region.width - 5
    for y, x in rng.uniform(first, last, (200, 2)):
        place_m = (y - 128) * pitch_m[0], (x - 160) * pitch_m[1]
        chirps = [
            np.exp(-1j * np.pi * (u - p) ** 2 / 650e-9) for u, p in zip(at, place_m, strict=True)
        ]
        light += np.exp(2j * np.pi * rng.random()) * np.multiply.outer(*chirps)
    image = transform.to_object(light)
    lit = mean_power(reconstruction.region.crop(image))
    assert mean_power(reconstruction.empty.crop(image)) > 1e-5 * lit
    assert mean_power(reconstruction.only_noise(image)) < 1e-8 * lit


@pytest.mark.parametrize("error_rad", [0.0, 0.2, -0.2])
def test_the_phase_advance_is_that_of_the_light(error_rad):
    """Frames of an object off the axis, whose twin image falls elsewhere."""
    region, rng = RECONSTRUCTION.region, np.random.default_rng(5)
    reed = complex_noise(rng, (region.height, region.width))
    light = 1000 * TRANSFORM.to_sensor(region.paste(reed, TRANSFORM.shape))
    advance_rad = np.pi / 2 + error_rad
    frames = [5000 + 2 * (light * np.exp(-1j * m * advance_rad)).real for m in range(4)]
    stack = np.stack(frames).astype(np.float32)
    turn = RECONSTRUCTION.steady_turn(stack, RECONSTRUCTION.quadratures(stack))
    # What the twin image leaves in the region turns the other way.
    assert turn.error_rad == pytest.approx(error_rad, abs=5e-3)


# --- The empty region --------------------------------------------------------------------------


@given(
    shape=st.tuples(st.integers(16, 200), st.integers(16, 200)),
    centre=st.tuples(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25)),
    size=st.tuples(st.floats(0.05, 0.35), st.floats(0.05, 0.35)),
)
def test_the_empty_region_meets_neither_image_nor_twin(shape, centre, size):
    starts, counts = [], []
    for count, middle, extent in zip(shape, centre, size, strict=True):
        starts.append(int((0.5 + middle - extent / 2) * count))
        counts.append(max(int(extent * count), 1))
    region = Region(*starts, *counts)
    empty = empty_region(shape, region)
    image = np.zeros(shape, bool)
    empty.crop(image)[...] = True
    rows, columns = np.nonzero(image)
    assert len(rows) == empty.height * empty.width > 0
    for sign in (1, -1):
        # Pixels are reflected in the optical axis at (ny//2, nx//2).
        r = sign * (rows - shape[0] // 2) + shape[0] // 2 - region.row
        c = sign * (columns - shape[1] // 2) + shape[1] // 2 - region.column
        assert not ((r >= 0) & (r < region.height) & (c >= 0) & (c < region.width)).any()
