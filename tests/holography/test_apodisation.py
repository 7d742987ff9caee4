"""Windows on the sensor, and what they do to images."""

import numpy as np
import pytest
import scipy.integrate
from scipy.linalg import toeplitz

from holography.apodisation import Taper, apodised, least_taper
from holography.fresnel import FresnelTransform
from holography.region import Region
from tests.numbers import complex_normal

TRANSFORM = FresnelTransform((96, 128), 6.7e-6, 532e-9, 0.5)
REGION = Region(30, 40, 30, 50)
FRACTIONS = [0.0, 0.28, 0.7, 1.0]


@pytest.fixture
def hologram():
    """A hologram of light that comes from the region alone."""
    image = np.zeros(TRANSFORM.shape, np.complex64)
    image[REGION.slices] = complex_normal(np.random.default_rng(1), REGION.height, REGION.width)
    return TRANSFORM.to_sensor(image)


@pytest.mark.parametrize("fraction", FRACTIONS)
def test_the_image_is_that_of_a_hologram_under_the_window(hologram, fraction):
    rows, columns = Taper(fraction), Taper(0.5)
    windowed = hologram * rows.window(96)[:, None] * columns.window(128)
    expected = REGION.crop(TRANSFORM.to_object(windowed) / TRANSFORM.object_chirp)
    field = REGION.crop(TRANSFORM.to_object(hologram))
    found = apodised(field, TRANSFORM, REGION, (rows, columns))
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


def test_a_taper_of_the_whole_sensor_is_a_hann_window() -> None:
    window = Taper(1.0).window(64)
    hann = np.sin(np.pi * np.arange(64) / 64) ** 2
    np.testing.assert_allclose(window, hann * np.sqrt(8 / 3), atol=1e-12)


@pytest.mark.parametrize("fraction", FRACTIONS)
def test_noise_keeps_its_power_and_is_correlated_as_stated(fraction):
    taper, rng = Taper(fraction), np.random.default_rng(2)
    noise = complex_normal(rng, 2000, 64) * taper.window(64)
    image = np.fft.fft(noise, norm="ortho")
    power = np.mean(np.abs(image) ** 2)
    assert power == pytest.approx(1, abs=0.01)
    rho = [np.mean(image[:, : 64 - k] * image[:, k:].conj()).real for k in range(4)]
    np.testing.assert_allclose(rho, taper.noise_correlation(4), atol=0.01)


@pytest.mark.parametrize("fraction", FRACTIONS[1:])
def test_the_spread_is_that_of_the_image_of_a_point(fraction):
    taper, finer = Taper(fraction), 32
    image = np.abs(np.fft.fft(taper.window(512), 512 * finer)) ** 2
    pixels = np.fft.fftfreq(512 * finer, 1 / 512)
    variance = np.sum(image * pixels**2) / np.sum(image)
    _, second = taper.light_moments(1)
    assert second[0, 0] == pytest.approx(variance, rel=0.02)


def test_without_a_window_each_pixel_shows_its_own_place() -> None:
    first, second = Taper(0.0).light_moments(3)
    np.testing.assert_allclose(first, np.diag([-1.0, 0.0, 1.0]), atol=1e-9)
    np.testing.assert_allclose(second, np.diag([1.0, 0.0, 1.0]), atol=1e-9)


@pytest.mark.parametrize("pixels", [2, 3])
def test_light_of_a_sum_comes_from_where_its_pixels_say(pixels):
    """Scatterers between pixels, and sums weighted with what the pixels show of them."""
    taper, rng, count, finer = Taper(0.9), np.random.default_rng(4), 32, 8
    middle = count / 2 + 0.5 * (pixels - 1)
    place = np.arange(count * finer) / finer - middle
    image = np.fft.fft(
        taper.window(count)
        * np.exp(2j * np.pi * np.outer(place + middle, np.arange(count)) / count)
    )[:, count // 2 : count // 2 + pixels]
    light = complex_normal(rng, 4000, len(place))
    shown = light @ image
    sums = np.array([np.sum(shown.conj() * ((light * place**n) @ image), axis=1) for n in range(3)])
    power, weights = sums[0].real, np.abs(shown) ** 2
    at = np.arange(pixels) - 0.5 * (pixels - 1)
    first, second = taper.light_moments(pixels)
    for matrix, found, by_weight in (
        (first, sums[1].real, weights @ at),
        (second, sums[2].real, weights @ (at**2 + taper.light_moments(1)[1][0, 0])),
    ):
        expected = np.einsum("np,pq,nq->n", shown.conj(), matrix, shown).real
        # It is known on average, and for each sum better than without what its pixels show.
        assert np.sum(found - expected) == pytest.approx(0, abs=0.02 * np.sum(power))
        usual = np.trace(matrix @ toeplitz(taper.noise_correlation(pixels))) / pixels * power
        assert np.sum((found - expected) ** 2) < 0.9 * np.sum((found - usual) ** 2)
        # Weights of pixels leave out that images of neighbours overlap.
        assert np.sum((found - expected) ** 2) < 0.95 * np.sum((found - by_weight) ** 2)


@pytest.mark.parametrize("pixels", [1, 2, 5])
@pytest.mark.parametrize("fraction", FRACTIONS)
def test_sums_of_speckle_are_as_independent_as_stated(fraction, pixels):
    """Noise of all sums together, weighted with speckle, over that of each alone."""
    taper, rng, count = Taper(fraction), np.random.default_rng(3), 240
    light, noise = (
        np.fft.fft(complex_normal(rng, 1500, count) * taper.window(count), norm="ortho")
        for _ in range(2)
    )
    sums = np.sum((light.conj() * noise).reshape(1500, -1, pixels), axis=2)
    together = np.mean(np.abs(sums.sum(axis=1)) ** 2) / (count // pixels)
    assert np.mean(np.abs(sums) ** 2) / together == pytest.approx(
        taper.independent_fraction(pixels), rel=0.12
    )


def test_without_a_window_nothing_is_shared() -> None:
    taper = Taper(0.0)
    np.testing.assert_allclose(taper.window(32), 1)
    np.testing.assert_allclose(taper.noise_correlation(3), [1, 0, 0], atol=1e-12)
    assert taper.independent_fraction(4) == pytest.approx(1)


@pytest.mark.parametrize("fraction", [-0.1, 1.1, np.nan])
def test_a_fraction_beyond_the_sensor_is_refused(fraction):
    with pytest.raises(ValueError, match="fraction"):
        Taper(fraction)


@pytest.mark.parametrize("pixels", [1, 2, 5])
@pytest.mark.parametrize("fraction", FRACTIONS)
def test_light_from_beyond_some_pixels_is_what_the_image_of_a_point_has_there(fraction, pixels):
    taper, finer = Taper(fraction), 64
    image = np.abs(np.fft.fft(taper.window(1024), 1024 * finer)) ** 2
    distance = np.abs(np.fft.fftfreq(1024 * finer, 1 / 1024))
    share = (distance > pixels) + 0.5 * (distance == pixels)
    beyond = np.sum(share * image) / np.sum(image)
    assert taper.light_from_beyond(pixels) == pytest.approx(beyond, rel=0.02, abs=1e-5)


def test_without_a_window_a_twentieth_of_the_light_comes_from_beyond_two_pixels() -> None:
    expected = 1 - 2 * scipy.integrate.quad(lambda x: np.sinc(x) ** 2, 0, 2)[0]
    assert Taper(0.0).light_from_beyond(2) == pytest.approx(expected, abs=2e-4)
    assert expected == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize("pixels", [2, 3, 5])
@pytest.mark.parametrize("share", [0.01, 0.0025])
def test_the_least_taper_lets_just_so_much_light_in(pixels, share):
    found = least_taper(pixels, share)
    assert share - 1e-4 < found.light_from_beyond(pixels) <= share


def test_there_is_a_least_taper_of_no_window_and_none_within_one_pixel() -> None:
    assert least_taper(2, 0.06).fraction == 0
    assert least_taper(60, 0.0025).fraction == 0
    with pytest.raises(ValueError, match="take more pixels"):
        least_taper(1, 0.0025)
