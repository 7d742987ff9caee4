"""The lock condition in exact rationals: n·f + f_CCD/4 on the grids of real instruments."""

import math
from fractions import Fraction

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from protocols.frequency_lock import (
    COARSEST_GRID_HZ,
    difference_hz,
    exact_drive_grid,
    lock_residual_hz,
    nearest_multiple,
    phase_error_rad,
    snap_drive,
)

TENTH_HZ = Fraction(1, 10)
MICROHERTZ = Fraction(1, 10**6)
AD9959_STEP_HZ = Fraction(500_000_000, 2**32)
GHZ_STEP_HZ = Fraction(10**9, 2**32)

drives = st.fractions(min_value=20, max_value=20_000, max_denominator=10**6)
orders = st.integers(0, 5)
# Frame rates and steps in hundredths and thousandths of a hertz: many pairs, some without a grid.
frame_rates = st.integers(100, 20_000).map(lambda n: Fraction(n, 1000))
steps = st.integers(1, 500).map(lambda n: Fraction(n, 1000))


def residual_after_snapping(asked, order, frame_rate, synthesizer_step, generator_step):
    drive = snap_drive(asked, order, frame_rate, synthesizer_step, generator_step)
    realised = difference_hz(drive, order, frame_rate, synthesizer_step)
    return drive, lock_residual_hz(drive, order, frame_rate, realised)


@pytest.mark.parametrize(
    ("drive", "frame_rate", "step", "residual"),
    [
        # Measured table of real step sizes, to its printed digits.
        ("2033", "12.5", TENTH_HZ, -0.025),
        ("2033.075", "12.5", TENTH_HZ, 0.0),
        ("2033", "12.4", TENTH_HZ, 0.0),
        ("2033", "12.5", AD9959_STEP_HZ, -0.0210),
        ("2033.075", "12.5", AD9959_STEP_HZ, +0.0204),
        ("2033", "12.4", AD9959_STEP_HZ, +0.0040),
        ("2033", "12.5", GHZ_STEP_HZ, -0.0210),
        ("2033.075", "12.5", GHZ_STEP_HZ, -0.0960),
    ],
)
def test_residual_of_real_synthesizers(drive, frame_rate, step, residual):
    drive, frame_rate = Fraction(drive), Fraction(frame_rate)
    realised = difference_hz(drive, 1, frame_rate, step)
    found = lock_residual_hz(drive, 1, frame_rate, realised)
    assert float(found) == pytest.approx(residual, abs=5e-5)
    assert realised / step == int(realised / step)


def test_phase_error_of_four_frames():
    # 0.025 Hz over 4 frames at 12.5 Hz: 0.050 rad in the same table.
    error = phase_error_rad(Fraction(-1, 40), 4, Fraction(25, 2))
    assert error == pytest.approx(2 * math.pi * 0.025 * 0.32)
    assert phase_error_rad(Fraction(0), 4, Fraction(25, 2)) == 0


@given(drives, st.integers(1, 5))
def test_paper_frame_rate_locks_exactly_near_every_drive(asked, order):
    drive, residual = residual_after_snapping(asked, order, Fraction("12.4"), TENTH_HZ, MICROHERTZ)
    assert residual == 0
    assert abs(drive - asked) <= TENTH_HZ / 2


def test_exact_grids_of_the_paper():
    assert exact_drive_grid(1, Fraction("12.4"), TENTH_HZ, MICROHERTZ) == (0, TENTH_HZ)
    assert exact_drive_grid(2, Fraction("12.4"), TENTH_HZ, MICROHERTZ) == (0, TENTH_HZ / 2)
    # 12.5 Hz shifts the grid: f = k·0.1 Hz − 3.125 Hz, good for one order only.
    assert exact_drive_grid(1, Fraction("12.5"), TENTH_HZ, MICROHERTZ) == (
        Fraction("0.075"),
        TENTH_HZ,
    )
    assert exact_drive_grid(0, Fraction("12.5"), TENTH_HZ, MICROHERTZ) is None
    assert exact_drive_grid(0, Fraction("12.4"), TENTH_HZ, MICROHERTZ) == (0, MICROHERTZ)


@given(drives, orders, frame_rates, steps, steps)
def test_snapping_is_exact_where_it_can_be(asked, order, frame_rate, synthesizer, generator):
    grid = exact_drive_grid(order, frame_rate, synthesizer, generator)
    assume(grid is not None)
    assume(grid[1] <= COARSEST_GRID_HZ)
    drive, residual = residual_after_snapping(asked, order, frame_rate, synthesizer, generator)
    assert residual == 0
    assert abs(drive - asked) <= grid[1] / 2
    assert (drive / generator).denominator == 1


@given(orders, frame_rates, steps, steps)
def test_exact_grid_is_complete(order, frame_rate, synthesizer, generator):
    """Every drive on the generator's grid, tried one by one, agrees with the congruence."""
    grid = exact_drive_grid(order, frame_rate, synthesizer, generator)
    for multiple in range(300):
        drive = multiple * generator
        exact = ((order * drive + frame_rate / 4) / synthesizer).denominator == 1
        assert exact == (grid is not None and ((drive - grid[0]) / grid[1]).denominator == 1)


@given(drives, st.integers(1, 5), frame_rates)
def test_without_a_grid_a_fine_generator_still_locks(asked, order, frame_rate):
    # The step of a binary synthesizer meets the generator's grid only every 30 kHz.
    drive, residual = residual_after_snapping(asked, order, frame_rate, GHZ_STEP_HZ, MICROHERTZ)
    assert abs(residual) <= order * MICROHERTZ / 2
    assert abs(drive - asked) <= (GHZ_STEP_HZ / order + MICROHERTZ) / 2
    assert (drive / MICROHERTZ).denominator == 1


@given(drives, drives, orders, frame_rates, st.sampled_from([TENTH_HZ, GHZ_STEP_HZ]), steps)
def test_snapping_never_swaps_two_drives(one, other, order, frame_rate, synthesizer, generator):
    low, high = sorted((one, other))
    assert snap_drive(low, order, frame_rate, synthesizer, generator) <= snap_drive(
        high, order, frame_rate, synthesizer, generator
    )


@given(drives, orders, frame_rates, steps, steps)
def test_snapping_again_changes_nothing(asked, order, frame_rate, synthesizer, generator):
    once = snap_drive(asked, order, frame_rate, synthesizer, generator)
    grid = exact_drive_grid(order, frame_rate, synthesizer, generator)
    assume(grid is not None)
    assume(grid[1] <= COARSEST_GRID_HZ)
    assert snap_drive(once, order, frame_rate, synthesizer, generator) == once


@given(drives, steps)
def test_nearest_multiple(value, step):
    found = nearest_multiple(value, step)
    assert (found / step).denominator == 1
    assert abs(found - value) <= step / 2
