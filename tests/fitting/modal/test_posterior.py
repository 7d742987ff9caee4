"""Joint covariance of parameters and drive, and displacements of modes at resonance."""

import numpy as np
import pytest

from fitting.modal.normal_equations import Equations
from fitting.modal.posterior import Posterior
from tests.fitting.modal.test_fit import DRIVE_HZ, planted


def test_the_covariance_is_that_of_all_unknowns_together():
    rng = np.random.default_rng(5)
    root = rng.standard_normal((9, 9))
    whole = root @ root.T + np.eye(9)
    here = Equations(whole[:5, :5], whole[:5, 5:], whole[5:, 5:])
    inverse = np.linalg.inv(whole)
    posterior = Posterior.of(here, inverse[:5, :5], 2.0)
    rows = rng.standard_normal((3, 9))
    found = posterior.of_combinations(rows[:, :5], rows[:, 5:])
    assert found == pytest.approx(2 * rows @ inverse @ rows.T, rel=1e-6)
    assert posterior.log_magnitude == pytest.approx(2 * inverse[5:7, 5:7], rel=1e-6)
    assert posterior.shared(2) == pytest.approx(2 * inverse[3:5, 3:5], rel=1e-6)
    assert posterior.shared(0).shape == (0, 0)


def true_displacements(sweep):
    """|d p| / η T of every mode within the sweep, with d and p between two holograms."""
    rows = []
    for m in range(5):
        moved = np.abs(sweep.drive * sweep.participation[:, m])
        size = np.exp(np.interp(np.log(sweep.hz[m]), np.log(DRIVE_HZ), np.log(moved)))
        rows.append(size / sweep.loss[m] * sweep.shapes[m])
    return np.array(rows)


@pytest.mark.slow
def test_displacements_at_resonance_are_found_within_their_errors():
    """Noise, and holograms whose drive scatters by 1 %, which the drive follows."""
    pulls = []
    for seed in range(1, 9):
        sweep = planted(seed)
        found = sweep.fit()
        true = true_displacements(sweep)
        for m in range(5):
            largest = np.abs(true[m]).argmax()
            error = np.sqrt(found.resonant.covariance[m, largest, largest])
            off = abs(found.resonant.amplitude_rad[m, largest]) - abs(true[m, largest])
            assert error < 0.1 * abs(true[m, largest])
            pulls.append(off / error)
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.5
    assert np.abs(pulls).max() < 5
