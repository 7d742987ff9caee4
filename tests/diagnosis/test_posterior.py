"""The posterior of nuisances, some of which reach one group only."""

import numpy as np
import pytest

from diagnosis.inference.posterior import Posterior, Structure

N = 24


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes (24, 11) and groups: two blocks with nuisances of their own, two without."""
    rng = np.random.default_rng(seed)
    group = rng.permutation(np.repeat([0, 1, 2, 3], N // 4))
    slopes = rng.standard_normal((N, 11))
    slopes[:, 3:6] *= (group == 1)[:, None]
    slopes[:, 6:8] *= (group == 3)[:, None]
    slopes[:, 8] = 0.0
    return slopes, group


@pytest.mark.parametrize("shared", [True, False])
def test_the_posterior_is_that_of_the_whole_system(shared: bool) -> None:
    slopes, group = drawn(4)
    slopes = slopes if shared else slopes[:, 3:9]
    rng = np.random.default_rng(5)
    left, q = rng.standard_normal(N), slopes.shape[1]
    variance, prior = rng.uniform(0.5, 2, N), rng.uniform(0.3, 3, q)
    structure = Structure.of(slopes, group)
    assert len(structure.shared) == (5 if shared else 0)
    found = Posterior.of(structure, left, variance, prior)
    covariance = np.linalg.inv((slopes.T / variance) @ slopes + np.diag(1 / prior))
    of_numbers = np.linalg.inv(np.diag(variance) + (slopes * prior) @ slopes.T)
    np.testing.assert_allclose(found.mean, -covariance @ (slopes.T @ (left / variance)), atol=1e-12)
    assert found.log_det == pytest.approx(np.linalg.slogdet(covariance)[1])
    assert found.squares == pytest.approx(left @ of_numbers @ left)
    np.testing.assert_allclose(found.precision(), of_numbers, atol=1e-12)
    nuisances, numbers = found.variances()
    np.testing.assert_allclose(nuisances, np.diag(covariance), atol=1e-12)
    np.testing.assert_allclose(numbers, np.diag(slopes @ covariance @ slopes.T), atol=1e-12)
