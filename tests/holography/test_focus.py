"""Focus of simulated reeds whose distance is known."""

import numpy as np
import pytest
from scipy.special import jv

from holography.focus import (
    best_distance,
    focus_scan,
    sharpness,
)
from holography.fresnel import FresnelTransform
from holography.region import region_from_metres

PIXEL_M, WAVELENGTH_M, DISTANCE_M = 6.7e-6, 650e-9, 1.0
CENTRE_M, AROUND_M = (0.024, 0.020), (0.030, 0.040)


def reed_hologram(rng, *, noise_to_signal=0.3):
    """Hologram of a rough 12 mm x 30 mm surface with Bessel fringes, off axis; and its region."""
    transform = FresnelTransform((1024, 1280), PIXEL_M, WAVELENGTH_M, DISTANCE_M)
    rows, columns = transform.shape
    dy, dx = transform.object_pitch_m
    y = (np.arange(rows)[:, None] - rows // 2) * dy - CENTRE_M[0]
    x = (np.arange(columns) - columns // 2) * dx - CENTRE_M[1]
    along = (x + 0.015) / 0.030
    amplitude = (np.abs(y) < 0.006) * (np.abs(x) < 0.015) * np.abs(jv(1, 20 * along**2))
    roughness, noise = (
        rng.standard_normal(transform.shape) + 1j * rng.standard_normal(transform.shape)
        for _ in range(2)
    )
    hologram = transform.to_sensor(amplitude * roughness)
    signal_rms = np.sqrt(np.mean(np.abs(hologram) ** 2))
    hologram = hologram / signal_rms + np.sqrt(0.5) * noise_to_signal * noise
    return hologram, region_from_metres(CENTRE_M, AROUND_M, transform)


@pytest.mark.parametrize("seed", [0, 4])
def test_reed_is_found_at_its_distance(seed):
    hologram, region = reed_hologram(np.random.default_rng(seed))
    distance_m = best_distance(hologram, PIXEL_M, WAVELENGTH_M, np.arange(0.9, 1.11, 0.04), region)
    assert distance_m == pytest.approx(DISTANCE_M, abs=3e-3)


@pytest.mark.parametrize("lo_to_signal", [5, 500])
def test_a_single_off_axis_frame_focuses_as_a_hologram_does(lo_to_signal):
    hologram, region = reed_hologram(np.random.default_rng(1))
    frame = np.abs(lo_to_signal + hologram) ** 2
    distances_m = np.array([0.9, 1.0, 1.1])
    single = focus_scan(frame, PIXEL_M, WAVELENGTH_M, distances_m, region)
    assert np.argmax(single) == 1
    assert single[1] > 1.2 * single[[0, 2]].max()


def test_more_noise_than_signal_moves_focus_by_less_than_its_depth():
    hologram, region = reed_hologram(np.random.default_rng(2), noise_to_signal=2.0)
    distances_m = np.array([0.94, 0.98, 1.02, 1.06])
    distance_m = best_distance(hologram, PIXEL_M, WAVELENGTH_M, distances_m, region)
    assert distance_m == pytest.approx(DISTANCE_M, abs=0.01)


def test_sharpness_does_not_depend_on_brightness_and_is_zero_without_detail():
    image = np.random.default_rng(3).exponential(size=(64, 80))
    assert sharpness(1e4 * image) == pytest.approx(sharpness(image), rel=1e-4)
    assert sharpness(np.full((64, 80), 7)) == pytest.approx(0, abs=1e-12)


def test_sharpness_prefers_a_dark_line_to_a_filled_one():
    speckle = np.random.default_rng(4).exponential(size=(64, 80))
    dark, filled = np.ones(80), np.ones(80)
    dark[38:42] = 0
    filled[34:46] = 2 / 3
    assert sharpness(speckle * dark) > 1.2 * sharpness(speckle * filled)


def test_a_dark_image_has_no_sharpness():
    with pytest.raises(ValueError, match="region with light"):
        sharpness(np.zeros((8, 8)))


def test_a_scan_that_ends_before_the_focus_is_refused():
    hologram, region = reed_hologram(np.random.default_rng(5))
    with pytest.raises(ValueError, match="scan further"):
        best_distance(hologram, PIXEL_M, WAVELENGTH_M, [0.88, 0.92, 0.96], region)
