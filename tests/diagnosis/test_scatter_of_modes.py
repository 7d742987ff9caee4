"""How much of a fit's error sweeps do not share: seen by sweeps that are repeated."""

import numpy as np
import pytest

from diagnosis.observables.modes import _own_shares, _scatter, modes_group
from physics.parameters.tree import BenchParameters
from tests.diagnosis.test_odd_runs import MODES, NO_LEAKS, FewModes, sweep

NAMES = ("F1", "T1", "F2", "T2", "X1", "T3", "F3", "X2")
HZ = np.array([1800.0, 2900.0, 5200.0, 6300.0, 7100.0, 9500.0, 9900.0, 11700.0])
BY_E = np.array([0.47, 0.18, 0.45, 0.11, 0.2, 0.08, 0.41, 0.14])
MOVED = np.stack([BY_E, 0.5 - BY_E], axis=1)
ERROR = 1e-4


def swept(name, log_hz, log_loss=0.0):
    """A sweep whose modes are off by logs (8,)."""
    return sweep(
        name,
        names=NAMES,
        hz=HZ * np.exp(log_hz),
        loss_factor=0.02 * np.exp(np.zeros(8) + log_loss),
        covariance=ERROR**2 * np.eye(16),
    )


def shares(*log_hz, log_loss=(0.0, 0.0, 0.0)):
    sweeps = [
        swept(str(k), hz, loss) for k, (hz, loss) in enumerate(zip(log_hz, log_loss, strict=True))
    ]
    return _own_shares(sweeps, NAMES, MOVED).reshape(2, -1)


def test_sweeps_that_agree_share_nearly_all_of_their_errors() -> None:
    found = shares(np.zeros(8), np.zeros(8), np.zeros(8))
    assert np.all(found < 0.3)
    assert np.all(found > 0)


def test_sweeps_that_scatter_as_they_say_share_nothing() -> None:
    rng = np.random.default_rng(1)
    drawn = np.array([shares(*(ERROR * rng.standard_normal((3, 8))))[0] for _ in range(200)])
    assert np.sqrt(np.mean(drawn**2)) == pytest.approx(0.9, abs=0.1)


def test_a_mode_that_is_off_in_one_sweep_has_a_larger_error_and_the_others_have_not() -> None:
    off = np.zeros(8)
    off[3] = 12 * ERROR
    found = shares(np.zeros(8), np.zeros(8), off)[0]
    assert found[3] > 2.5
    assert np.all(np.delete(found, 3) < 2)
    assert np.argmax(found) == 3


def test_what_a_change_of_cane_moves_is_no_scatter() -> None:
    still = shares(np.zeros(8), np.zeros(8), np.zeros(8))
    dry = 0.01 * BY_E * (1 + np.log(HZ / 4e3)) - 0.004 * MOVED[:, 1]
    np.testing.assert_allclose(shares(np.zeros(8), 0.3 * dry, -dry), still, rtol=1e-6)
    np.testing.assert_allclose(
        shares(*np.zeros((3, 8)), log_loss=(0.1, 0.0, -0.2)), still, rtol=1e-6
    )


def test_losses_have_shares_of_their_own() -> None:
    off = np.zeros(8)
    off[5] = 20 * ERROR
    found = shares(*np.zeros((3, 8)), log_loss=(off, np.zeros(8), np.zeros(8)))
    assert found[1, 5] > 3
    assert np.all(found[0] < 0.3)


def test_one_sweep_or_few_modes_say_nothing() -> None:
    assert np.all(shares(np.zeros(8), log_loss=(0.0,)) == 1)
    few = [sweep(name, names=NAMES[:3], hz=HZ[:3]) for name in ("up", "down")]
    for each in few:
        each.loss_factor, each.covariance = np.full(3, 0.02), ERROR**2 * np.eye(6)
    assert np.all(_own_shares(few, NAMES[:3], MOVED[:3])[:3] == 1)


def test_freedoms_are_what_means_and_columns_leave() -> None:
    squares, freedoms = _scatter(np.zeros((3, 8)), np.ones((3, 8)), MOVED)
    assert np.all(squares == 0)
    assert freedoms.sum() == pytest.approx((3 - 1) * (8 - 2))


def test_errors_of_a_sweep_grow_with_the_scatter_of_its_mode() -> None:
    hz = np.array(list(MODES.values()))
    odd = sweep("down", hz=hz * np.exp([0.0, 0.0, 2e-3, 0.0]))
    groups = [
        modes_group([sweep(), other, sweep("shuffled")], FewModes(), NO_LEAKS, BenchParameters())
        for other in (sweep("down"), odd)
    ]
    even, scattered = (np.sqrt(np.diag(group.errors.noise)) for group in groups)
    names = [place.mode for place in groups[0].coordinates[:4]]
    assert scattered[names.index("F2")] > 3 * even[names.index("F2")]
