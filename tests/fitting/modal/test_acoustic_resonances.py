"""Lines found in planted drives."""

import numpy as np
import pytest

from fitting.modal.acoustic_resonances import (
    ExcitationPeak,
    common_excitation_peaks,
    find_excitation_peaks,
)

DRIVE_HZ = 1400 * 2 ** (np.arange(1, 185) * 25 / 1200)
CENTS = 25.0 * np.arange(184)


def drive(*lines, seed=0, noise=0.01):
    """Log magnitude of a smooth drive with lines: cents, height in nepers, half width in cents."""
    smooth = 0.8 * np.sin(CENTS / 900) - 3e-4 * CENTS
    for at, height, width in lines:
        smooth = smooth + height / (1 + ((CENTS - at) / width) ** 2)
    return smooth + noise * np.random.default_rng(seed).standard_normal(len(CENTS))


def test_a_smooth_drive_has_no_line():
    assert find_excitation_peaks(DRIVE_HZ, drive()) == []


@pytest.mark.parametrize("at", [1500.0, 1512.0, 2507.0])
def test_a_line_is_found_between_steps_with_its_height(at):
    (line,) = find_excitation_peaks(DRIVE_HZ, drive((at, 1.2, 40.0)))
    true_hz = DRIVE_HZ[0] * 2 ** (at / 1200)
    assert abs(1200 * np.log2(line.hz / true_hz)) < 5
    # The median of what is around it has something of the line, and of the drive's bends.
    assert line.height_db == pytest.approx(1.2 * 20 / np.log(10), rel=0.25)


def test_what_is_wide_is_the_drive_itself():
    assert find_excitation_peaks(DRIVE_HZ, drive((2000.0, 1.0, 400.0))) == []


def test_a_height_common_to_all_steps_is_of_no_matter():
    plain = drive((1800.0, 0.9, 30.0))
    (louder,), (line,) = (
        find_excitation_peaks(DRIVE_HZ, plain + 7.0),
        find_excitation_peaks(DRIVE_HZ, plain),
    )
    assert (louder.hz, louder.height_db) == pytest.approx((line.hz, line.height_db))


def sweeps(count):
    """A line that stays, and one that is another reed's each time."""
    return [
        find_excitation_peaks(
            DRIVE_HZ,
            drive((1900.0 + 3 * k, 1.0, 40.0), (2600.0 + 120 * k, 0.8, 30.0), seed=k),
        )
        for k in range(count)
    ]


def test_what_stays_from_reed_to_reed_is_common():
    (line,) = common_excitation_peaks(sweeps(6))
    assert line.reeds == 6
    assert abs(1200 * np.log2(line.hz / DRIVE_HZ[0]) - 1907.5) < 10


@pytest.mark.parametrize("reeds", [2, 4])
def test_two_reeds_tell_of_no_common_line(reeds):
    """Neither alone nor among others that do not show it."""
    assert common_excitation_peaks([*sweeps(2), *([[]] * (reeds - 2))]) == []


def test_features_of_many_reeds_do_not_chain_to_a_line():
    rng = np.random.default_rng(8)
    scattered = [
        [ExcitationPeak(hz, 5.0) for hz in rng.uniform(1500, 19_000, 3)] for _ in range(300)
    ]
    assert common_excitation_peaks(scattered) == []
    with_one = [[*lines, ExcitationPeak(4300 + rng.normal(0, 5), 8.0)] for lines in scattered]
    (line,) = common_excitation_peaks(with_one)
    assert line.reeds >= 290
    assert line.hz == pytest.approx(4300, abs=3)


def test_several_common_lines_come_in_order_of_frequency():
    reeds = [
        [
            ExcitationPeak(9000.0 + k, 4.0),
            ExcitationPeak(4300.0 + k, 8.0),
            ExcitationPeak(4500.0 + k, 6.0),
        ]
        for k in range(5)
    ]
    assert [round(line.hz) for line in common_excitation_peaks(reeds)] == [4302, 4502, 9002]


def test_a_line_that_few_reeds_show_is_not_common():
    some = sweeps(6)
    assert common_excitation_peaks([*some, *([[]] * 6)]) == []


def test_a_sweep_with_two_near_lines_counts_once():
    near = [ExcitationPeak(4300.0, 8.0), ExcitationPeak(4310.0, 7.0)]
    assert common_excitation_peaks([near, near, [], []]) == []
