"""Which difference of the two AOM frequencies selects sideband n: decision 0001, by brute force.

Light from a point that vibrates as ``z cos(2πft)`` is ``Σ_n i^n J_n(φ) exp(2πi n f t)`` times the
carrier. On the sensor it beats with the LO, shifted by a difference d. Frames are the exact
integrals of ``2 Re Σ_n i^n J_n(φ) exp(2πi(n f - d)t)``.
"""

import numpy as np
import pytest
from scipy.special import jv

from holography.demodulation import four_phase, sideband_gain

FRAME_RATE_HZ = 12.5
ORDERS = np.arange(-40, 41)
# The carrier is nulled at odd multiples of a quarter of the frame rate.
DRIVE_HZ = 171.25 * FRAME_RATE_HZ
GAIN = sideband_gain(-FRAME_RATE_HZ / 4, FRAME_RATE_HZ, 1 / FRAME_RATE_HZ) / 4


def integrated_frames(drive_hz, phase_rad, difference_hz):
    """Four frames of full exposure, means over the frame, shape (4, 1, 1)."""
    beat_hz = ORDERS * drive_hz - difference_hz
    edges_s = np.arange(5) / FRAME_RATE_HZ
    turns = np.exp(2j * np.pi * beat_hz * edges_s[:, None])
    means = np.diff(turns, axis=0) * FRAME_RATE_HZ / (2j * np.pi * beat_hz)
    light = means @ (1j**ORDERS * jv(ORDERS, phase_rad))
    return (2 * light.real).reshape(4, 1, 1)


def hologram(drive_hz, phase_rad, difference_hz):
    """H over 4, the gain of a short exposure: |H| should be J_n sinc(1/4)."""
    return complex(four_phase(integrated_frames(drive_hz, phase_rad, difference_hz))[0, 0]) / 4


def correct_hz(drive_hz, order=1):
    return order * drive_hz + FRAME_RATE_HZ / 4


def printed_hz(drive_hz):
    """As the paper prints it: a misplaced parenthesis."""
    return (drive_hz + FRAME_RATE_HZ) / 4


@pytest.mark.parametrize("order", [-1, 0, 1, 2, 5])
def test_difference_of_n_f_plus_a_quarter_frame_rate_selects_sideband_n(order):
    phase_rad = 1.0 + abs(order)
    selected = hologram(DRIVE_HZ, phase_rad, correct_hz(DRIVE_HZ, order))
    assert abs(selected) == pytest.approx(abs(jv(order, phase_rad)) * np.sinc(0.25), rel=3e-3)
    assert selected == pytest.approx(1j**order * jv(order, phase_rad) * GAIN, rel=3e-3)


def test_figure_of_the_decision_record():
    """1 rad at 2143.7 Hz: what is missing is the carrier's leak, half a frame rate away."""
    selected = hologram(2143.7, 1.0, correct_hz(2143.7))
    assert abs(selected) == pytest.approx(jv(1, 1.0) * np.sinc(0.25), rel=3e-3)


def test_minus_a_quarter_frame_rate_gives_the_conjugate():
    field = 1j * jv(1, 1.0)
    plus = hologram(DRIVE_HZ, 1.0, correct_hz(DRIVE_HZ))
    minus = hologram(DRIVE_HZ, 1.0, DRIVE_HZ - FRAME_RATE_HZ / 4)
    assert plus == pytest.approx(field * GAIN, rel=3e-3)
    assert minus == pytest.approx(np.conj(field) * GAIN, rel=3e-3)


def test_printed_difference_destroys_the_signal():
    rng = np.random.default_rng(11)
    drives_hz = rng.uniform(200, 12_000, 400)
    phases_rad = rng.uniform(0.05, 12, 400)
    expected = np.abs(jv(1, phases_rad)) * np.sinc(0.25)

    def measured(difference_hz):
        return np.array(
            [
                abs(hologram(f, phase, difference_hz(f)))
                for f, phase in zip(drives_hz, phases_rad, strict=True)
            ]
        )

    correct, printed = measured(correct_hz), measured(printed_hz)
    assert np.corrcoef(correct, expected)[0, 1] > 0.9999
    assert np.sqrt(np.mean((correct - expected) ** 2)) < 2e-3
    assert np.median(printed / expected) < 0.01
    assert abs(np.corrcoef(printed, expected)[0, 1]) < 0.15


def test_printed_difference_at_the_decision_records_frequency():
    printed = abs(hologram(2143.7, 1.0, printed_hz(2143.7)))
    assert printed < 0.01 * jv(1, 1.0) * np.sinc(0.25)
