"""Light from a vibrating surface: Bessel sidebands, their exposure, speckle, the layout."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import jv

from holography.fresnel import FresnelTransform
from physics.optics import beat_integral, kept_orders, reed_axes_m, reed_region, sidebands, speckle
from physics.parameters.optics import Layout

WAVELENGTH_M = 650e-9
PHASES = np.concatenate([np.geomspace(1e-9, 1, 60), np.linspace(1, 200, 400)])


def displacement(phi, direction_rad=0.0):
    """Complex displacement whose phase modulation has an amplitude and a direction."""
    return (phi * WAVELENGTH_M / (4 * np.pi) * np.exp(1j * direction_rad)).astype(np.complex64)


def true_phase(moved):
    """Phase amplitude of a displacement as rounded to complex64."""
    return 4 * np.pi / WAVELENGTH_M * np.abs(moved.astype(np.complex128))


@pytest.mark.parametrize("peak_rad", [0.1, 3.0, 25.0])
def test_sidebands_share_the_light_without_loss(peak_rad):
    reach = int(peak_rad + 20)
    phi = np.linspace(0, peak_rad, 30)
    parts = sidebands(range(-reach, reach + 1), displacement(phi), WAVELENGTH_M)
    power = np.sum([np.abs(part.astype(np.complex128)) ** 2 for part in parts], axis=0)
    np.testing.assert_allclose(power, 1, rtol=2e-6)


@pytest.mark.parametrize("direction_rad", [0.0, 0.7, -2.4])
def test_sidebands_add_up_to_the_modulated_light(direction_rad):
    """Jacobi and Anger: the light of a surface that moves by ``Re(w e^{iωt})``, at any moment.

    Moving towards the camera by z shortens the path by 2z: the phase is ``+4πz/λ``.
    """
    moved = displacement(np.array([1e-3, 0.4, 2.4, 9.0]), direction_rad)
    orders = range(-30, 31)
    parts = sidebands(orders, moved, WAVELENGTH_M)
    for turn in np.linspace(0, 2 * np.pi, 9):
        summed = sum(part * np.exp(1j * n * turn) for n, part in zip(orders, parts, strict=True))
        position_m = np.real(moved.astype(np.complex128) * np.exp(1j * turn))
        np.testing.assert_allclose(
            summed, np.exp(4j * np.pi / WAVELENGTH_M * position_m), atol=3e-6
        )


@pytest.mark.parametrize("order", [0, 1, 2, 3, 7, 20])
def test_bessel_functions_are_exact_from_tiny_to_huge(order):
    moved = displacement(PHASES)
    (part,) = sidebands([order], moved, WAVELENGTH_M)
    expected = np.abs(jv(order, true_phase(moved)))
    # Below the smallest single of full precision there is nothing to compare.
    seen = expected > 1e-30
    np.testing.assert_allclose(np.abs(part[seen]), expected[seen], rtol=1e-5, atol=1e-7)
    small = seen & (PHASES < 0.1)
    np.testing.assert_allclose(np.abs(part[small]), expected[small], rtol=1e-5)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_opposite_sidebands_mirror_each_other(order):
    """``iⁿ J_n e^{inψ}`` and its mirror ``i^{−n} J_{−n} e^{−inψ}``, with ``J_{−n} = (−1)ⁿ J_n``."""
    moved = displacement(np.linspace(0, 8, 25), 0.9)
    upper, lower = sidebands([order, -order], moved, WAVELENGTH_M)
    np.testing.assert_allclose(lower, upper * np.exp(-2j * order * 0.9), atol=1e-5)
    np.testing.assert_allclose(
        lower, 1j**-order * jv(-order, true_phase(moved)) * np.exp(-0.9j * order), atol=1e-5
    )


def test_a_small_motion_makes_a_first_sideband_of_half_its_phase():
    w = np.array([1e-12, 3e-11j, -2e-10], dtype=np.complex64)
    (first,) = sidebands([1], w, WAVELENGTH_M)
    np.testing.assert_allclose(first, 0.5j * 4 * np.pi / WAVELENGTH_M * w, rtol=1e-4)


def test_a_surface_at_rest_keeps_its_light():
    rest, first, second, back = sidebands(
        [0, 1, 2, -1], np.zeros(3, dtype=np.complex64), WAVELENGTH_M
    )
    np.testing.assert_array_equal(rest, 1)
    assert not np.any([first, second, back])


def test_brightest_at_the_papers_displacements():
    """±95 nm for the first bright fringe of sideband 1, ±770 nm for the fifth."""
    z = np.linspace(0, 0.9e-6, 90001)
    (first,) = sidebands([1], z.astype(np.complex64), WAVELENGTH_M)
    light = np.abs(first)
    bright = z[1:-1][(light[1:-1] > light[:-2]) & (light[1:-1] >= light[2:])]
    assert bright[0] == pytest.approx(95e-9, abs=1e-9)
    far = bright[(bright > 740e-9) & (bright < 800e-9)]
    assert far.mean() == pytest.approx(770e-9, abs=2e-9)


OFFSETS = st.fractions(Fraction(-500), Fraction(500), max_denominator=1000)


@settings(deadline=None)
@given(OFFSETS, st.floats(0, 2), st.floats(1e-3, 0.2))
def test_beat_integral_is_the_integral(offset_hz, start_s, length_s):
    end_s = start_s + length_s

    def beat(t, part):
        return part(np.exp(2j * np.pi * float(offset_hz) * t))

    expected = sum(
        factor * quad(beat, start_s, end_s, args=(part,), limit=400)[0]
        for factor, part in ((1, np.real), (1j, np.imag))
    )
    assert beat_integral(offset_hz, start_s, end_s) == pytest.approx(expected, abs=1e-9)


@settings(deadline=None)
@given(OFFSETS, st.floats(0, 2), st.floats(1e-3, 0.1), st.floats(1e-3, 0.1))
def test_beat_integrals_of_two_stretches_add(offset_hz, start_s, first_s, second_s):
    middle_s, end_s = start_s + first_s, start_s + first_s + second_s
    parts = beat_integral(offset_hz, start_s, middle_s) + beat_integral(offset_hz, middle_s, end_s)
    assert beat_integral(offset_hz, start_s, end_s) == pytest.approx(parts, abs=1e-12)


def test_beat_integral_of_no_offset_is_the_exposure():
    assert beat_integral(Fraction(0), 3.0, 3.08) == pytest.approx(0.08)


def test_a_beat_long_after_the_start_keeps_its_phase():
    """Two hours on: 20 kHz have turned 144 million times."""
    late_s = 7200.0
    for offset in (Fraction(20_000), Fraction(25, 8)):
        early = beat_integral(offset, 0.0, 0.04)
        # Both offsets turn a whole number of times in two hours.
        assert beat_integral(offset, late_s, late_s + 0.04) == pytest.approx(early, abs=1e-9)


@settings(deadline=None)
@given(st.integers(-40, 40), st.fractions(Fraction(500), Fraction(20_000), max_denominator=10))
def test_kept_orders_hold_the_selected_one_and_its_neighbours(order, drive_hz):
    kept = kept_orders(order * drive_hz + Fraction(25, 8), drive_hz)
    assert {order - 1, order, order + 1} <= set(kept)
    assert {-1, 0, 1} <= set(kept)
    assert list(kept) == sorted(set(kept))


def test_kept_orders_without_a_drive_hold_the_carrier():
    assert 0 in kept_orders(Fraction(25, 8), Fraction(0))


@pytest.fixture(scope="module")
def rough():
    return speckle((500, 400), np.random.default_rng(12))


def test_speckle_has_mean_power_one(rough):
    assert rough.dtype == np.complex64
    # 200 000 cells of exponential intensity: a standard error of 0.22 %.
    assert np.mean(np.abs(rough) ** 2) == pytest.approx(1, abs=0.01)


def test_speckle_intensity_is_exponential(rough):
    intensity = np.sort((np.abs(rough) ** 2).ravel())
    rank = (np.arange(intensity.size) + 0.5) / intensity.size
    # Kolmogorov and Smirnov: 0.0044 is exceeded once in a thousand samples of this size.
    assert np.abs(rank - (1 - np.exp(-intensity))).max() < 0.0044


def test_speckle_is_circular_and_cells_are_independent(rough):
    cells = rough.size
    assert abs(np.mean(rough)) < 4 / np.sqrt(cells)
    assert abs(np.mean(rough**2)) < 6 / np.sqrt(cells)
    for neighbour in (rough[1:, :] * rough[:-1, :].conj(), rough[:, 1:] * rough[:, :-1].conj()):
        assert abs(np.mean(neighbour)) < 4 / np.sqrt(cells)


def test_speckle_is_a_pure_function_of_its_generator():
    first, again, other = (speckle((8, 8), np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


@pytest.mark.parametrize("shape", [(256, 320), (1024, 1280)])
def test_the_reeds_tip_lies_on_the_left_edge_of_its_region(shape):
    layout = Layout(reed_centre_m=(22e-3, 5e-3))
    transform = FresnelTransform(shape, 6.7e-6, layout.wavelength_m, layout.distance_m)
    region = reed_region(layout, transform)
    y, x = reed_axes_m(layout, region, transform)
    pitch_y, pitch_x = transform.object_pitch_m
    assert (len(y), len(x)) == (region.height, region.width)
    np.testing.assert_allclose(np.diff(x), pitch_x)
    np.testing.assert_allclose(np.diff(y), pitch_y)
    assert abs(x[0]) <= pitch_x
    assert x[-1] == pytest.approx(38e-3, abs=pitch_x)
    assert y[0] == pytest.approx(-7e-3, abs=pitch_y)
    assert y[-1] == pytest.approx(7e-3, abs=pitch_y)


def test_the_reed_image_keeps_clear_of_zero_order_and_twin():
    layout = Layout()
    transform = FresnelTransform((1024, 1280), 6.7e-6, layout.wavelength_m, layout.distance_m)
    region = reed_region(layout, transform)
    twin_end = 2 * 512 - region.row
    assert region.row > 512
    assert twin_end < 512
