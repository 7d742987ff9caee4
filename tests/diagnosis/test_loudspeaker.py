"""What a loudspeaker may do to the drive, by itself."""

import numpy as np
import pytest

from diagnosis.observables.drive import _BREAK_UP, _QUALITY, _WAVES, _loudspeaker

# 25 cents apart, from 1.4 to 16.5 kHz.
HZ = 1417.2 * 2 ** (np.arange(170) / 48)
APART = np.log(HZ)[:, None] - np.log(HZ)
# Of one hologram.
ERROR = 0.02


def covariance():
    """Covariance (n, n) of the log of a response, with its error."""
    waves, left = _loudspeaker(APART)
    most = sum(each.columns @ each.columns.T for each in waves)
    return most + left + ERROR**2 * np.eye(len(HZ))


def dome(rng):
    """Log response (n,) of a dome that breaks up in three resonances within two octaves."""
    s, response = 1j * HZ, np.ones(len(HZ), complex)
    for hz, quality in zip(rng.uniform(4e3, 16e3, 3), rng.uniform(3, 20, 3), strict=True):
        height, width = rng.choice([-1, 1]) * rng.uniform(0.2, 0.6), hz / quality
        response += height * s * width / (s**2 + s * width + hz**2)
    return np.log(np.abs(response))


def line(hz, quality, db):
    """Log response (n,) of one acoustic resonance, of a height at its peak."""
    s, width = 1j * HZ, hz / quality
    return np.log(np.abs(1 + (10 ** (db / 20) - 1) * s * width / (s**2 + s * width + hz**2)))


def test_resonances_that_are_left_out_of_the_columns_are_errors():
    expected = _WAVES[0] ** 2 * np.exp(-0.5 * (APART / _WAVES[1]) ** 2)
    expected += _BREAK_UP**2 / (1 + (_QUALITY * APART) ** 2)
    assert covariance() - ERROR**2 * np.eye(len(HZ)) == pytest.approx(expected, abs=1e-4)
    assert np.linalg.eigvalsh(_loudspeaker(APART)[1]).min() > -1e-9


def test_domes_that_break_up_are_within_the_errors():
    root = np.linalg.cholesky(covariance())
    rng = np.random.default_rng(0)
    squares = [np.sum(np.linalg.solve(root, dome(rng)) ** 2) for _ in range(60)]
    # Nine numbers decide a response; deep notches are not quite as expected.
    assert 4 < np.median(squares) < 18
    assert np.quantile(squares, 0.9) < 60


def test_a_narrow_line_is_more_than_a_loudspeaker_does():
    root = np.linalg.cholesky(covariance())
    narrow, wide = (np.linalg.solve(root, line(5000.0, q, 10.0)) for q in (60.0, 6.0))
    # In standard deviations of its own amplitude.
    assert np.linalg.norm(narrow) > 5
    assert np.linalg.norm(wide) < 5
