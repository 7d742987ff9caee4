"""Fringes against the paper's displacements and against images whose speckle is known."""

import numpy as np
import pytest
from scipy.special import jv

from holography.fringes import (
    block_mean,
    displacement_m,
    first_sideband_maxima_m,
    phase_amplitude,
)


def test_a_displacement_has_the_phase_that_it_came_from():
    assert displacement_m(phase_amplitude([0.0, 95.2e-9], 650e-9), 650e-9) == pytest.approx(
        [0.0, 95.2e-9]
    )


def test_bright_fringes_are_where_the_paper_has_them():
    maxima_nm = 1e9 * first_sideband_maxima_m(10, 650e-9)
    assert maxima_nm[[0, 4]] == pytest.approx([95.2, 768.8], abs=0.05)
    assert maxima_nm[9] == pytest.approx(1583, abs=0.5)


def test_bright_fringes_are_the_maxima_of_the_first_bessel_function():
    maxima_m = first_sideband_maxima_m(8, 532e-9)
    brightness = [
        np.abs(jv(1, phase_amplitude(maxima_m + shift, 532e-9))) for shift in (-1e-9, 0.0, 1e-9)
    ]
    assert np.all(brightness[1] > brightness[0])
    assert np.all(brightness[1] > brightness[2])
    # All of them: between two of them there is exactly one zero.
    fine = jv(1, phase_amplitude(np.linspace(1e-9, maxima_m[-1], 20_000), 532e-9))
    assert np.count_nonzero(np.diff(np.sign(fine))) == 7


def test_phase_amplitude_of_half_a_wavelength_is_one_turn():
    assert phase_amplitude([0.0, 325e-9], 650e-9) == pytest.approx([0.0, 2 * np.pi])


def test_no_fringes_are_refused():
    with pytest.raises(ValueError, match="count is 0"):
        first_sideband_maxima_m(0, 650e-9)


def test_block_mean_drops_what_does_not_fill_a_block():
    image = np.arange(7 * 9, dtype=np.float32).reshape(7, 9)
    means = block_mean(image, 3, 2)
    assert means.shape == (2, 4)
    assert means.dtype == np.float32
    assert means[1, 2] == np.mean(image[3:6, 4:6])


def test_block_mean_does_not_wrap_nor_round_full_scale_counts():
    frames = np.full((2, 64, 64), 65535, dtype=np.uint16)
    frames[1, 0, 0] = 65534
    means = block_mean(frames, 64, 64)
    assert means[:, 0, 0] == pytest.approx([65535.0, 65535 - 1 / 4096], abs=0.005)


@pytest.mark.parametrize("factors", [(0, 2), (2, 0), (8, 2), (2, 10)])
def test_blocks_that_do_not_fit_are_refused(factors):
    with pytest.raises(ValueError, match="does not fit an image of 7x9"):
        block_mean(np.zeros((7, 9)), *factors)


def test_block_mean_refuses_fields():
    with pytest.raises(ValueError, match="complex64"):
        block_mean(np.zeros((7, 9), np.complex64), 2, 2)
