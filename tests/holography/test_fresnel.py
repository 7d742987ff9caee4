"""The Fresnel transform against its invariants and against a Gaussian beam in closed form."""

import dataclasses

import numpy as np
import pytest

from holography.demodulation import four_phase
from holography.fresnel import FresnelTransform
from tests.numbers import relative_error

BENCH = FresnelTransform((1024, 1280), 6.7e-6, 650e-9, 1.0)
# Even and odd sizes, as crops are; distances well inside validity.
SMALL = [
    FresnelTransform((96, 128), 6.7e-6, 650e-9, 0.02),
    FresnelTransform((97, 128), 6.7e-6, 650e-9, 0.02),
    FresnelTransform((95, 101), 5.0e-6, 633e-9, 0.01),
    FresnelTransform((1, 64), 6.7e-6, 650e-9, 0.1, workers=2),
]


def random_field(rng, shape):
    field = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    return field.astype(np.complex64)


def grid_m(shape, pitch_m):
    rows, columns = ((np.arange(n) - n // 2) * d for n, d in zip(shape, pitch_m, strict=True))
    return rows[:, None], columns[None, :]


def gaussian_beam(y, x, z_m, waist_m, wavelength_m):
    """Paraxial Gaussian beam, exp(+ikz) convention, unit amplitude at the centre of the waist."""
    rayleigh_m = np.pi * waist_m**2 / wavelength_m
    q_m = z_m - 1j * rayleigh_m
    k = 2 * np.pi / wavelength_m
    beam = (-1j * rayleigh_m / q_m) * np.exp(1j * k * (z_m + (x**2 + y**2) / (2 * q_m)))
    # Textbooks write amplitudes of exp(-2πiνt); this software those of exp(+2πiνt).
    return beam.conj()


@pytest.mark.parametrize("transform", SMALL)
def test_transform_is_unitary(transform):
    rng = np.random.default_rng(1)
    field = random_field(rng, transform.shape)
    hologram = transform.to_sensor(field)
    assert hologram.dtype == np.complex64
    assert np.linalg.norm(hologram) == pytest.approx(np.linalg.norm(field), rel=1e-6)
    assert relative_error(transform.to_object(hologram), field) < 1e-6
    assert relative_error(transform.to_sensor(transform.to_object(field)), field) < 1e-6


@pytest.mark.parametrize("transform", SMALL)
def test_to_object_is_the_adjoint_of_to_sensor(transform):
    rng = np.random.default_rng(2)
    field, hologram = random_field(rng, transform.shape), random_field(rng, transform.shape)
    there = np.vdot(hologram, transform.to_sensor(field))
    back = np.vdot(transform.to_object(hologram), field)
    assert abs(there - back) < 1e-6 * np.linalg.norm(field) * np.linalg.norm(hologram)


@pytest.mark.parametrize("direction", ["to_object", "to_sensor"])
def test_transform_is_linear(direction):
    rng = np.random.default_rng(3)
    apply = getattr(SMALL[0], direction)
    u, v = random_field(rng, SMALL[0].shape), random_field(rng, SMALL[0].shape)
    assert relative_error(apply(2 * u - 3j * v), 2 * apply(u) - 3j * apply(v)) < 1e-6


@pytest.mark.parametrize("transform", SMALL)
def test_transform_is_the_discretised_fresnel_integral(transform):
    """Against the double sum over the kernel itself, for one row and one column of the sensor."""
    rng = np.random.default_rng(4)
    field = random_field(rng, transform.shape)
    z, wavelength = transform.distance_m, transform.wavelength_m
    pitch_m = transform.object_pitch_m
    y_object, x_object = grid_m(transform.shape, pitch_m)
    y_sensor, x_sensor = grid_m(transform.shape, (transform.pixel_m, transform.pixel_m))
    row, column = transform.shape[0] // 3, transform.shape[1] // 5
    r_squared = (y_sensor[row, 0] - y_object) ** 2 + (x_sensor[0, column] - x_object) ** 2
    kernel = np.exp(2j * np.pi * z / wavelength) / (1j * wavelength * z)
    kernel = kernel * np.exp(1j * np.pi * r_squared / (wavelength * z))
    integral = np.sum(kernel.conj() * field) * pitch_m[0] * pitch_m[1]
    per_metre = np.sqrt(pitch_m[0] * pitch_m[1]) / transform.pixel_m
    value = transform.to_sensor(field)[row, column] * per_metre
    assert abs(value - integral) < 1e-5 * per_metre * np.sqrt(np.mean(np.abs(field) ** 2))


@pytest.mark.parametrize(
    ("distance_m", "wavelength_m"), [(1.0, 650e-9), (0.8, 633e-9), (1.0, 532e-9)]
)
def test_gaussian_beam_off_axis_arrives_with_its_phase(distance_m, wavelength_m):
    """Complex field, so width, curvature, Gouy phase, position and sign convention at once."""
    transform = FresnelTransform((1024, 1280), 6.7e-6, wavelength_m, distance_m)
    waist_m, centre_y, centre_x = 0.4e-3, 0.6e-3, -0.9e-3
    y, x = grid_m(transform.shape, transform.object_pitch_m)
    at_object = gaussian_beam(y - centre_y, x - centre_x, 0.0, waist_m, wavelength_m)
    y, x = grid_m(transform.shape, (transform.pixel_m, transform.pixel_m))
    at_sensor = gaussian_beam(y - centre_y, x - centre_x, distance_m, waist_m, wavelength_m)
    dy, dx = transform.object_pitch_m
    per_metre = np.sqrt(dy * dx) / transform.pixel_m
    assert relative_error(transform.to_sensor(at_object) * per_metre, at_sensor) < 1e-5
    assert relative_error(transform.to_object(at_sensor) / per_metre, at_object) < 1e-5


def test_point_source_lands_on_its_pixel_at_the_pitch_of_the_wavelength():
    """The carrier sin(angle)/λ of a tilted wave is seen at z·sin(angle), in every colour."""
    for wavelength_m in (532e-9, 650e-9):
        transform = FresnelTransform((256, 320), 6.7e-6, wavelength_m, 0.5)
        dy, dx = transform.object_pitch_m
        assert dy == pytest.approx(wavelength_m * 0.5 / (256 * 6.7e-6))
        assert dx == pytest.approx(wavelength_m * 0.5 / (320 * 6.7e-6))
        y, x = grid_m(transform.shape, (6.7e-6, 6.7e-6))
        at_y, at_x = 20 * dy, -33 * dx
        wave = np.exp(-1j * np.pi * ((y - at_y) ** 2 + (x - at_x) ** 2) / (wavelength_m * 0.5))
        image = transform.intensity(wave)
        brightest = np.unravel_index(np.argmax(image), image.shape)
        assert brightest == (128 + 20, 160 - 33)
        assert image.max() > 0.999 * image.sum()


def test_the_conjugate_wave_is_not_focused():
    transform = SMALL[0]
    point = np.zeros(transform.shape, dtype=np.complex64)
    point[60, 50] = 1
    hologram = transform.to_sensor(point)
    assert transform.intensity(hologram).max() == pytest.approx(1, rel=1e-5)
    assert transform.intensity(hologram.conj()).max() < 0.05


def test_frames_of_real_waves_hold_the_diverging_wave():
    """Interference of ``cos(2πνt - kr)`` from a point with a plane LO, a quarter frame rate above.

    Only real cosines and their intensity: no convention for the sign of a phase enters.
    """
    transform = FresnelTransform((96, 128), 6.7e-6, 650e-9, 0.02)
    y, x = grid_m(transform.shape, (transform.pixel_m, transform.pixel_m))
    dy, dx = transform.object_pitch_m
    kr = np.pi * ((y - 7 * dy) ** 2 + (x + 20 * dx) ** 2) / (650e-9 * 0.02)
    # Mean over an optical period of (cos(2πν_LO t) + cos(2πνt - kr))², with the beat at frame m.
    frames = np.stack([1 + np.cos(-np.pi / 2 * m - kr) for m in range(4)]).astype(np.float32)
    hologram = four_phase(frames)
    assert transform.intensity(hologram)[48 + 7, 64 - 20] > 0.99 * 4 * hologram.size
    assert transform.intensity(hologram.conj()).max() < 0.05 * 4 * hologram.size


def test_intensity_is_the_squared_modulus_of_the_object_field():
    hologram = random_field(np.random.default_rng(5), BENCH.shape)
    image = BENCH.intensity(hologram)
    expected = np.abs(BENCH.to_object(hologram)) ** 2
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-6 * expected.max())


def test_leading_axes_and_other_number_types_are_transformed_image_by_image():
    rng = np.random.default_rng(6)
    transform = SMALL[1]
    frames = rng.integers(0, 4096, (3, *transform.shape), dtype=np.uint16)
    together = transform.to_object(frames)
    assert together.dtype == np.complex64
    for frame, field in zip(frames, together, strict=True):
        np.testing.assert_array_equal(field, transform.to_object(frame.astype(np.complex128)))


def test_input_is_left_as_it_was():
    hologram = random_field(np.random.default_rng(7), SMALL[0].shape)
    before = hologram.copy()
    for direction in (SMALL[0].to_object, SMALL[0].to_sensor, SMALL[0].intensity):
        direction(hologram)
        np.testing.assert_array_equal(hologram, before)


def test_wrong_shape_is_refused_with_both_shapes():
    for direction in (SMALL[0].to_object, SMALL[0].to_sensor, SMALL[0].intensity):
        with pytest.raises(ValueError, match=r"\(128, 96\).*\(96, 128\)"):
            direction(np.zeros((128, 96)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distance_m": 0.0}, "distance_m is 0.0"),
        ({"distance_m": -1.0}, "distance_m is -1.0"),
        ({"distance_m": float("nan")}, "distance_m is nan"),
        ({"pixel_m": 0.0}, "pixel_m is 0.0"),
        ({"wavelength_m": -650e-9}, "wavelength_m is"),
        ({"workers": 0}, "workers is 0"),
        ({"shape": (0, 5)}, "shape is"),
        ({"shape": (5,)}, "shape is"),
        ({"distance_m": 0.088}, "below 0.0884"),
    ],
)
def test_parameters_outside_validity_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(BENCH, **change)


def test_validity_ends_where_the_sensor_chirp_turns_by_pi_per_pixel():
    shortest_m = 1280 * 6.7e-6**2 / 650e-9
    edge_m = 1280 / 2 * 6.7e-6
    turn = np.pi / (650e-9 * shortest_m) * (edge_m**2 - (edge_m - 6.7e-6) ** 2)
    assert turn == pytest.approx(np.pi, rel=1e-3)
    dataclasses.replace(BENCH, distance_m=shortest_m * 1.0001)
    with pytest.raises(ValueError, match="aliases"):
        dataclasses.replace(BENCH, distance_m=shortest_m * 0.9999)
