"""Where a reed lies in the image, of speckle that was planted at known places."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.fft

from fitting.reed_place import ReedPlace, moves, nominal_place, reed_place
from physics.reed.geometry import ReedGeometry, half_width_m
from tests.numbers import complex_normal

PIXEL_M, FINER = np.array([0.3e-3, 0.25e-3]), 5
# Image, of which a part is kept: it goes on at its other side.
HEIGHT, WIDTH, HOLOGRAMS = 80, 160, 12
KEPT = slice(10, 70), slice(12, 140)
X_M = -0.2e-3 + PIXEL_M[0] * (np.arange(WIDTH) - KEPT[1].start)
# Rows from the reed's left side to its right side, as those of run files.
Y_M = PIXEL_M[1] * (0.5 * HEIGHT - np.arange(HEIGHT))
CLAMP_M = 38.2e-3


def placed(*numbers):
    return ReedPlace(*numbers, np.zeros((4, 4)))


def speckle(place, rng, noise=0.01):
    """Holograms (k, y, x) of scatterers between the pixels, on a reed at a place."""
    fine_x = X_M[0] + PIXEL_M[0] / FINER * np.arange(FINER * WIDTH)
    fine_y = Y_M[0] - PIXEL_M[1] / FINER * np.arange(FINER * HEIGHT)
    x, y = place.on_reed(*np.meshgrid(fine_x, fine_y))
    lit = (
        (x > 0)
        & (x < CLAMP_M)
        & (np.abs(y) < half_width_m(ReedGeometry().outline, np.maximum(x, 0.0)))
    )
    scatterers = lit * complex_normal(rng, *lit.shape)
    fields = []
    for k in range(HOLOGRAMS):
        # Each moves differently: in bending, and with a node that wanders along the reed.
        motion = (1 - x / 60e-3) * np.cos(0.1 * k * x / 1e-3) + 0.3 * y / 6e-3
        spectrum = scipy.fft.fft2(scatterers * motion) / FINER
        rows, columns = (np.r_[0 : n // 2, -(n // 2) : 0] for n in (HEIGHT, WIDTH))
        image = scipy.fft.ifft2(spectrum[np.ix_(rows, columns)]) / FINER
        fields.append((image / np.sqrt(np.mean(np.abs(image) ** 2)))[KEPT])
    return np.array(fields) + noise * complex_normal(rng, *np.shape(fields))


def found_in(fields):
    run = SimpleNamespace(
        x_m=X_M[KEPT[1]],
        y_m=Y_M[KEPT[0]],
        reed_file=lambda: SimpleNamespace(geometry=ReedGeometry),
        field=lambda position: fields[position],
    )
    steps = [SimpleNamespace(position=k, signal_to_noise=10.0 + k) for k in range(HOLOGRAMS)]
    return reed_place(run, steps)


def numbers(place):
    return np.array([place.along_m, place.across_m, place.turn_rad, place.larger])


def test_places_are_found_within_their_errors():
    rng, pulls, off = np.random.default_rng(1), [], []
    for _ in range(12):
        true = placed(*(np.array([2e-4, 2e-4, 5e-3, 8e-3]) * rng.standard_normal(4)))
        found = found_in(speckle(true, rng))
        off.append(numbers(found) - numbers(true))
        pulls.append(off[-1] @ np.linalg.solve(found.covariance, off[-1]))
    # The sum of squares of four numbers, of twelve reeds.
    assert 0.5 < np.mean(pulls) / 4 < 1.7
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    assert (rms < [0.06e-3, 0.06e-3, 3e-3, 4e-3]).all()
    assert np.abs(off).max() > 1e-6


def test_an_image_without_edges_tells_no_place():
    rng = np.random.default_rng(2)
    found = found_in(complex_normal(rng, HOLOGRAMS, 60, 128))
    assert (found.error > [0.1e-3, 0.1e-3, 3e-3, 4e-3]).all()
    # What is expected of hands and tapes is known all the same.
    assert (found.error < [0.5e-3, 0.5e-3, 10e-3, 0.018]).all()


@pytest.mark.parametrize("larger", [-0.06, 0.03, 0.08])
def test_an_image_of_another_size_is_found_though_few_are(larger):
    fields = speckle(placed(0.0, 0.0, 0.0, larger), np.random.default_rng(3))
    found = found_in(fields)
    # What is expected draws it towards zero by what it weighs; the rest may be the reed's.
    width = 0.1 / 13 / np.sqrt(3)
    of_image = 0.018**2 / (0.018**2 + width**2)
    own = np.sqrt(found.error[3] ** 2 - of_image * width**2) / of_image
    kept = of_image * (1 - own**2 / (0.018**2 + width**2))
    assert 4e-3 < found.error[3] < 9e-3
    assert abs(found.larger - kept * larger) < 3 * found.error[3]


def test_an_image_that_looks_larger_may_be_that_of_a_wider_reed():
    """Images and reeds as they are expected: errors are right for both together."""
    rng, pulls = np.random.default_rng(4), []
    for _ in range(12):
        size, width = 0.018 * rng.standard_normal(), 0.1 / 13 * rng.uniform(-1, 1)
        # Edges show the product.
        seen = (1 + size) * (1 + width) - 1
        found = found_in(speckle(placed(0.0, 0.0, 0.0, seen), rng))
        pulls.append((found.larger - size) / found.error[3])
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.4


def test_coordinates_on_the_reed_follow_its_place():
    place = placed(1e-3, -2e-3, 0.01, 0.0)
    assert place.on_reed(np.array([1e-3]), np.array([-2e-3])).ravel().tolist() == [0.0, 0.0]
    # A reed that is turned from x towards y has a point of its axis at positive y.
    x, y = place.on_reed(np.array([11e-3]), np.array([-1.9e-3]))
    assert (x[0], y[0]) == pytest.approx((10e-3, 0.0), abs=2e-6)
    assert nominal_place().on_reed(1.0, 2.0).tolist() == [1.0, 2.0]
    # In an image that is twice as large, all lies half as far from the tip on the reed.
    assert placed(1.0, 0.0, 0.0, 1.0).on_reed(2.0, 3.0).tolist() == [0.5, 1.5]


def test_moves_are_the_derivatives_of_coordinates_by_the_place():
    x, y = np.array([3e-3, 20e-3]), np.array([-4e-3, 1e-3])
    for number, step in enumerate((1e-6, 1e-6, 1e-5, 1e-6)):
        moved = np.zeros(4)
        moved[number] = step
        change = placed(*moved).on_reed(x, y) - np.stack([x, y])
        assert moves(x, y)[..., number] == pytest.approx(change / step, rel=3e-6, abs=1e-12)
