"""Modes that are not in phase, because one kind of strain loses more than another."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from fitting.holograms.object_field import CommonModeError
from fitting.holograms.shape_basis import _loss_mixing
from fitting.modal.loss_difference import drift_with_losses, with_losses
from tests.fitting.modal.test_fit import DRIVE_HZ, MODE_HZ, planted

# Loss factors of the literature differ by about this.
DIFFERENCE = 0.025


def test_modes_mix_as_those_of_the_complex_stiffness():
    """Compared with the eigenvectors of a system of four masses."""
    rng = np.random.default_rng(2)
    hz = np.array([1000.0, 1700.0, 2500.0, 3600.0])
    root = rng.standard_normal((4, 4))
    shear = root @ root.T * (2 * np.pi * 700) ** 2
    stiffness = np.diag((2 * np.pi * hz) ** 2)
    values, vectors = linalg.eig(stiffness + 1e-3j * shear)
    mixing = _loss_mixing(hz, shear)
    for m in range(4):
        exact = vectors[:, np.abs(values.real - stiffness[m, m]).argmin()]
        exact = exact / exact[m]
        expected = np.eye(4)[m] + 1e-3j * mixing[m]
        assert exact == pytest.approx(expected, abs=0.02 * np.abs(mixing[m]).max() * 1e-3)


def test_modes_of_one_frequency_do_not_mix():
    mixing = _loss_mixing(np.array([1000.0, 1000.0, 3000.0]), np.full((3, 3), 1e6))
    assert np.isfinite(mixing).all()
    assert mixing[0, 1] == 0


def test_the_difference_is_known_as_well_as_literature_knows_it():
    common_mode = CommonModeError(
        np.ones((7, 4, 2)), np.tile(np.eye(2), (7, 1, 1)), np.full((7, 2), 5.0)
    )
    both = with_losses(common_mode, np.full((7, 4), 3.0))
    assert both.response[..., :2].tolist() == common_mode.response.tolist()
    assert both.response[..., 2].tolist() == np.full((7, 4), 3.0).tolist()
    assert both.precision.sum(axis=0)[2] == pytest.approx([0, 0, 0.03**-2])
    assert both.pull.tolist() == [[5.0, 5.0, 0.0]] * 7


def test_it_is_one_more_value_that_no_hologram_changes():
    displacements = planted().displacements
    drift = drift_with_losses(displacements)
    shift = drift.shift(np.arange(1.0, drift.parameters + 1))
    assert shift.shape == (len(DRIVE_HZ), 1)
    assert np.ptp(shift) == 0


def out_of_phase(seed):
    """A planted sweep whose modes mix with a phase."""
    sweep = planted(seed, noise=0.005, mixing=0.1)
    count = len(sweep.hz)
    squares = MODE_HZ**2
    apart = np.subtract.outer(squares, squares) + np.diag(np.full(count, np.inf))
    rng = np.random.default_rng(100 + seed)
    shear = rng.uniform(-0.3, 0.3, (count, count))
    mixing = (shear + shear.T) * np.sqrt(np.outer(squares, squares)) / apart
    shapes = 1j * DIFFERENCE * mixing @ sweep.shapes
    more = np.zeros_like(sweep.displacements.amplitude_rad)
    for m in range(count):
        h = 1 / (1 + 1j * sweep.loss[m] - (DRIVE_HZ / sweep.hz[m]) ** 2)
        more += np.outer(sweep.drive * h * sweep.participation[:, m], shapes[m])
    displacements = replace(
        sweep.displacements, amplitude_rad=sweep.displacements.amplitude_rad + more
    )
    basis = replace(sweep.basis, loss_mixing=mixing)
    return replace(sweep, displacements=displacements, basis=basis)


@pytest.mark.parametrize("seed", [2, 3])
def test_losses_are_right_where_modes_are_out_of_phase(seed):
    sweep = out_of_phase(seed)
    real = replace(sweep, basis=replace(sweep.basis, loss_mixing=np.zeros((6, 6))))
    found, without = sweep.fit(), real.fit()
    pulls = [
        np.sqrt(np.mean((np.log(each.loss_factor / sweep.loss[:5]) / each.loss_error) ** 2))
        for each in (found, without)
    ]
    assert pulls[0] < 2
    assert pulls[1] > 3
    assert found.discrepancy < 0.3 * without.discrepancy
    assert found.state.common_mode_shift[-1] == pytest.approx(DIFFERENCE, rel=0.1)
    # It is no error of the light.
    assert found.common_mode_shift.shape == (len(DRIVE_HZ), 0)
    assert found.common_mode_covariance.shape == (len(DRIVE_HZ), 0, 0)
