"""Fringes counted in pictures that are drawn by the formula, from shapes that no reed has."""

import numpy as np
import pytest
from scipy.special import j1

from fitting.fringes.fringes import (
    FIRST_FRINGE,
    count_fringes,
    misfit_without,
)

# The first pictures hold a little of shape 0 alone, as below the reed's first resonance. Then come
# one resonance each, of up to 40 rad, and one of two shapes a quarter of a period apart in the same
# picture, as T3 and F3 of many reeds. Nothing ever excites the last shape.
PICTURES, ALONE, SMALL_RAD = 64, 8, 0.3
SINGLE = {0: (14, 16.0), 1: (26, 14.0), 2: (39, 40.0)}
TOGETHER, PAIR = 53, {1: 10.0, 2: 12.0j}
ABSENT = 3
HALF_WIDTH = 2.5


def shapes_at(x, y):
    """Four smooth shapes of a clamped plate, (n, 4), largest magnitude 1."""
    u = 1 - x
    columns = [u**2, u**1.5 * y, u**2 * (1 - 2.2 * u), u * y * np.cos(3.5 * u)]
    shapes = np.stack(columns, axis=1)
    return (shapes / np.abs(shapes).max(axis=0)).astype(np.float32)


def amplitudes():
    """Phase amplitudes (k, 4) of the sweep, rad."""
    k = np.arange(PICTURES)
    a = np.zeros((PICTURES, 4), complex)
    resonances = [(shape, *where) for shape, where in SINGLE.items()]
    resonances += [(shape, TOGETHER, peak_rad) for shape, peak_rad in PAIR.items()]
    for shape, centre, peak_rad in resonances:
        a[:, shape] += peak_rad * 1j / (1j + (k - centre) / HALF_WIDTH)
    a[:ALONE] = [SMALL_RAD, 0, 0, 0]
    return a


@pytest.fixture(scope="module")
def scene():
    """Light (n,), shapes (n, 4), amplitudes (k, 4) and pictures without noise (k, n)."""
    rng = np.random.default_rng(7)
    x, y = rng.uniform(0.02, 0.75, 450), rng.uniform(-1, 1, 450)
    # Blocks of some twenty speckles in a beam that does not light the plate evenly.
    light = 5e3 * np.exp(-((x - 0.5) ** 2)) * rng.gamma(18, 1 / 18, len(x))
    shapes, a = shapes_at(x, y), amplitudes()
    return light, shapes, a, light * j1(np.abs(a @ shapes.T)) ** 2


def noisy(scene, share, seed=3):
    """Pictures with noise of a share of what their brightest fringe is at each point."""
    light, _, _, pictures = scene
    brightest = (pictures / light).max(axis=1, keepdims=True)
    noise = np.random.default_rng(seed).standard_normal(pictures.shape)
    return (pictures + share * brightest * light * noise).astype(np.float32)


@pytest.fixture(scope="module")
def clean(scene):
    return count_fringes(noisy(scene, 0.0), scene[1])


@pytest.fixture(scope="module")
def with_noise(scene):
    return count_fringes(noisy(scene, 0.03), scene[1])


def peak_of(shape):
    return SINGLE[shape][0]


def relative_error(fringes, a, picture, shape):
    return abs(abs(fringes.amplitude_rad[picture, shape]) / abs(a[picture, shape]) - 1)


# --- Amplitudes --------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SINGLE)
def test_resonances_are_counted_to_one_percent_without_noise(scene, clean, shape):
    assert relative_error(clean, scene[2], peak_of(shape), shape) < 0.01


@pytest.mark.parametrize("shape", SINGLE)
def test_resonances_are_counted_to_a_few_percent_with_noise(scene, with_noise, shape):
    assert relative_error(with_noise, scene[2], peak_of(shape), shape) < 0.03


def test_a_third_of_a_radian_is_counted_to_one_percent_without_noise(scene, clean):
    for picture in range(ALONE):
        assert relative_error(clean, scene[2], picture, 0) < 0.01


def test_a_third_of_a_radian_is_counted_to_a_few_percent_with_noise(scene, with_noise):
    errors = [relative_error(with_noise, scene[2], picture, 0) for picture in range(ALONE)]
    assert np.sqrt(np.mean(np.square(errors))) < 0.04


def test_two_shapes_a_quarter_period_apart_are_both_counted(scene, clean, with_noise):
    for fringes, allowed in ((clean, 0.01), (with_noise, 0.03)):
        for shape in PAIR:
            assert relative_error(fringes, scene[2], TOGETHER, shape) < allowed


def test_the_phase_between_two_shapes_is_known_but_for_its_sign(scene, clean):
    def between_deg(a):
        return abs(np.degrees(np.angle(np.divide(*a[TOGETHER, list(PAIR)]))))

    # Not exactly 90: the tails of other resonances are in the picture too.
    assert between_deg(clean.amplitude_rad) == pytest.approx(between_deg(scene[2]), abs=1)


def test_the_light_of_every_point_comes_out_of_the_pictures(scene, clean):
    ratio = clean.light / scene[0]
    assert np.median(ratio) == pytest.approx(1, abs=0.02)
    assert np.quantile(np.abs(ratio - 1), 0.9) < 0.1


def test_the_rms_phase_is_that_of_the_sum_of_all_shapes(scene, clean):
    _, shapes, a, _ = scene
    true_rad = np.sqrt(np.mean(np.abs(a @ shapes.T) ** 2, axis=1))
    for shape in SINGLE:
        picture = peak_of(shape)
        assert clean.phase_rad[picture] == pytest.approx(true_rad[picture], rel=0.01)


# --- Invariance --------------------------------------------------------------------------------


def test_a_common_phase_of_a_picture_is_not_seen(scene, clean):
    light, shapes, a, _ = scene
    turns = np.exp(2j * np.pi * np.random.default_rng(5).uniform(size=(len(a), 1)))
    pictures = light * j1(np.abs((turns * a) @ shapes.T)) ** 2
    turned = count_fringes(pictures.astype(np.float32), shapes)
    for shape in SINGLE:
        there, here = (np.abs(f.amplitude_rad[peak_of(shape), shape]) for f in (turned, clean))
        assert there == pytest.approx(here, rel=0.005)


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_the_unit_of_brightness_is_of_no_matter(scene, clean, factor):
    scaled = count_fringes((factor * noisy(scene, 0.0)).astype(np.float32), scene[1])
    for shape in SINGLE:
        there, here = (np.abs(f.amplitude_rad[peak_of(shape), shape]) for f in (scaled, clean))
        assert there == pytest.approx(here, rel=0.005)
    assert np.median(scaled.light / clean.light) == pytest.approx(factor, rel=0.01)


# --- Misfit ------------------------------------------------------------------------------------


def test_the_misfit_is_the_square_of_the_noise(scene, clean, with_noise):
    more = count_fringes(noisy(scene, 0.09), scene[1])
    picture = peak_of(0)
    none, little, much = (fringes.misfit[picture] for fringes in (clean, with_noise, more))
    assert none < 0.2 * little
    assert little == pytest.approx((0.03 * FIRST_FRINGE) ** 2, rel=0.3)
    assert much == pytest.approx((0.09 * FIRST_FRINGE) ** 2, rel=0.3)


@pytest.mark.parametrize("shape", SINGLE)
def test_a_picture_cannot_do_without_the_shape_that_resonates(scene, with_noise, shape):
    picture = peak_of(shape)
    without = misfit_without(noisy(scene, 0.03), scene[1], with_noise, shape, picture)
    assert without > 2 * with_noise.misfit[picture]


def test_both_of_two_shapes_a_quarter_period_apart_are_needed(scene, with_noise):
    for shape in PAIR:
        without = misfit_without(noisy(scene, 0.03), scene[1], with_noise, shape, TOGETHER)
        assert without > 2 * with_noise.misfit[TOGETHER]


def test_every_picture_can_do_without_a_shape_that_is_not_there(scene, with_noise):
    pictures = noisy(scene, 0.03)
    for picture in (0, *(peak_of(shape) for shape in SINGLE), TOGETHER):
        without = misfit_without(pictures, scene[1], with_noise, ABSENT, picture)
        assert without / with_noise.misfit[picture] == pytest.approx(1, abs=0.2)


def test_points_that_never_move_do_not_spoil_the_misfit(scene):
    """Nothing shows their light, so their noise must not be taken relative to darkness."""
    light, shapes, a, _ = scene
    moving = np.arange(len(light)) >= 20
    shapes = np.where(moving[:, None], shapes, np.float32(1e-4) * shapes)
    still_scene = light, shapes, a, light * j1(np.abs(a @ shapes.T)) ** 2
    fringes = count_fringes(noisy(still_scene, 0.03), shapes)
    assert fringes.misfit[peak_of(0)] < 10 * (0.03 * FIRST_FRINGE) ** 2
