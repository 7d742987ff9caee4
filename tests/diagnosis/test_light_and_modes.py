"""Noise beside the image, light at rest, and levels of sweeps, beside what can be said by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis.taps.light import brightness_block, noise_block
from diagnosis.taps.modes import _levels
from diagnosis.taps.vibration import at_highest_level, loudest
from physics.twin import Chip, Twin

COUNT = 184


def sweep(name, noise_dn2, fringe_dn2, clamping=0, loudness=1.0):
    """Say what a reading says of a sweep's noise, without one."""
    at = np.arange(COUNT, dtype=float)
    return SimpleNamespace(
        name=name, clamping=clamping, loudness=loudness, time_s=60.0 + at, volts=np.ones(COUNT),
        noise_dn2=noise_dn2 * np.exp(0.01 * np.sin(17 * at)),
        fringe_dn2=np.full(COUNT, float(fringe_dn2)),
        drive_hz=1000.0 * 2 ** (at / 48), signal=0.01 * np.sin(at),
    )  # fmt: skip


def test_pixels_that_differ_spread_fringes_by_the_square_of_what_they_differ_by() -> None:
    # Of two sweeps one has bright fringes; what p of them is spread out is p² of their power.
    p, noise, fringes = 0.05, 1600.0, 2e5
    block = noise_block([sweep("dim", noise, 0.0), sweep("up", noise + p**2 * fringes, fringes)])
    half = len(block.values) // 2
    told = block.predict(Twin(chip=Chip(pattern=p)))
    assert np.mean(told[half:]) - np.mean(told[:half]) == pytest.approx(
        np.log1p(p**2 * fringes / noise), abs=3e-3
    )
    assert (
        np.abs(block.values[half:] - told[half:] - block.values[:half] + told[:half]).max() < 1e-2
    )
    assert np.ptp(block.predict(Twin())) == pytest.approx(0.0, abs=1e-12)


def test_runs_at_rest_are_averaged_by_themselves_however_long_they_are() -> None:
    still = SimpleNamespace(
        clamping=0, time_s=np.arange(12.0), brightness=np.r_[np.zeros(4), np.full(8, -0.2)],
        run=np.repeat([0, 1], [4, 8]), run_time_s=np.array([1.5, 7.5]),
    )  # fmt: skip
    block = brightness_block([sweep("up", 1.0, 0.0), sweep("down", 1.0, 0.0)], [still])
    rest = [v for v, p in zip(block.values, block.places, strict=True) if p.quantity == "order 0"]
    assert rest == pytest.approx([0.0, -0.2])


def test_levels_count_once_whatever_a_few_lost_steps_do_to_their_mean() -> None:
    np.testing.assert_array_equal(_levels([1.004, 0.996, -0.39, 1.05, -0.35]), [1, 1, 0, 1, 0])
    sweeps = [sweep("a", 1, 0), sweep("b", 1, 0, loudness=-0.4), sweep("c", 1, 0, clamping=1),
              sweep("d", 1, 0, loudness=1.05)]  # fmt: skip
    assert [s.name for s in at_highest_level(sweeps)] == ["a", "c", "d"]
    assert [s.name for s in loudest(sweeps)] == ["a", "d"]
