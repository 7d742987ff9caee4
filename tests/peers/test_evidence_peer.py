"""Evidence of effects against nested sampling by dynesty, with a likelihood written out here.

Nuisance, strength, how far the form deviates, and the factors on the noise of both groups are
sampled; the diagnosis sums over strengths, marginalises the nuisance exactly and factors as
Gaussian, and takes the likeliest deviations.
"""

import warnings

import numpy as np
import pytest
from scipy.stats import norm

from diagnosis.inference.effect_scan import Start, scan_effect
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import MEASURED
from tests.diagnosis.toy import AT, EFFECTS, LEVEL, bench, fitted, measured

dynesty = pytest.importorskip("dynesty", reason="needs dynesty, of the extra peers (make peers)")

BUMP = np.exp(-((AT / 0.2) ** 2))
# What one unit of each effect adds to the numbers of both groups.
ADDED = {
    "slope": (AT, 0.3 * AT[:20]),
    "bump": (BUMP, np.zeros(20)),
    "offset": (np.zeros(60), np.ones(20)),
}
NOISE = 0.05
# Numbers that the form of an effect may change together: those of a band, and of a time.
TOGETHER = np.array([
    AT < 0, AT >= 0, *((4 * np.abs(AT)).astype(int) == time for time in range(5))
], dtype=float).T  # fmt: skip
# Shares by which a form deviates, and the standard deviation of their logs (decision 0106).
SHARE, SHARE_FREEDOM, MOST = 0.0315, 1.175, 2.0
# Log evidence may differ by this, for deviations that are not sampled but the likeliest.
_NATS = 0.5


def own_log_bayes(problem: InferenceProblem, number: int) -> float:
    """Log Bayes factor of an effect of any strength, by the diagnosis."""
    null = fitted(problem)
    scan = scan_effect(problem, Start.without(problem, null.estimate), EFFECTS[number])
    assert scan is not None
    return float(np.logaddexp(scan.log_evidence, scan.log_hidden)) - null.log_evidence


def logpdf(x: np.ndarray, variance: np.ndarray, common: np.ndarray) -> float:
    """Log density, but for a constant, of Gaussian numbers of which some deviate together."""
    # The matrix determinant lemma: seven numbers in common are fewer than sixty.
    weighed = common / variance[:, None]
    root = np.linalg.cholesky(np.eye(common.shape[1]) + common.T @ weighed)
    deviate = np.linalg.solve(root, weighed.T @ x)
    squares = x @ (x / variance) - deviate @ deviate
    return float(-0.5 * squares - 0.5 * np.log(variance).sum() - np.log(np.diag(root)).sum())


def sampled(problem: InferenceProblem, number: int | None, seed: int) -> tuple[float, float]:
    """Log evidence and its standard error, without an effect or with one."""
    (lines, clocks), effect = problem.groups, None if number is None else EFFECTS[number]
    added = (np.zeros(60), np.zeros(20)) if effect is None else ADDED[effect.id]
    # The level absorbs a mean, also where the form deviates.
    seen = added[0] - added[0].mean(), added[1]
    most = 0.0 if effect is None else effect.parameters[0].most
    signed = effect is not None and not effect.parameters[0].positive

    def drawn(u: np.ndarray) -> np.ndarray:
        level, factors = LEVEL.spread * norm.ppf(u[0]), MEASURED * norm.ppf(0.5 + 0.5 * u[1:3])
        if effect is None:
            return np.array([level, *factors])
        half = abs(2 * u[3] - 1) if signed else u[3]
        sign = -1.0 if signed and u[3] < 0.5 else 1.0
        ends = norm.cdf([-MOST, MOST])
        shares = SHARE * np.exp(SHARE_FREEDOM * norm.ppf(ends[0] + np.ptp(ends) * u[4:6]))
        return np.array([level, *factors, sign * most * 0.01 * 100**half, *shares])

    def log_likelihood(x: np.ndarray) -> float:
        strength, together, alone = x[3:] if effect is not None else (0.0, 0.0, 0.0)
        total = 0.0
        for values, factor, shape, form, labels in (
            (lines.values - x[0], x[1], added[0], seen[0], TOGETHER),
            (clocks.values, x[2], added[1], seen[1], np.zeros((20, 0))),
        ):
            common = strength * together * form[:, None] * labels
            variance = (NOISE * np.exp(factor)) ** 2 + (strength * alone * form) ** 2
            total += logpdf(values - strength * shape, variance, common)
        return total

    with warnings.catch_warnings():
        # It warns that ellipsoids are large while the prior is still wide.
        warnings.simplefilter("ignore")
        sampler = dynesty.NestedSampler(
            log_likelihood, drawn, 3 if effect is None else 6, nlive=250, bound="multi",
            sample="unif", bootstrap=0, rstate=np.random.default_rng(seed),
        )  # fmt: skip
        sampler.run_nested(print_progress=False, dlogz=0.1)
    found = sampler.results
    return float(found.logz[-1]), float(found.logzerr[-1])


CASES = (
    (3, {}, 0), (3, {}, 1), (4, {}, 2), (5, {"leak": 0.05}, 0), (6, {"leak": 0.1}, 0),
    (7, {"crosstalk": 0.1}, 1), (8, {"crosstalk": 0.2}, 1), (9, {"leak": -0.15}, 0),
    (10, {"detuning_hz": 0.05}, 2), (11, {"crosstalk": 0.1}, 0),
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "truth", "number"), CASES)
def test_log_bayes_factors_are_those_of_nested_sampling(seed, truth, number) -> None:
    problem = measured(seed, bench(**truth), noise=NOISE)
    (none, none_error), (some, some_error) = (
        sampled(problem, which, seed) for which in (None, number)
    )
    error = np.hypot(none_error, some_error)
    assert own_log_bayes(problem, number) == pytest.approx(some - none, abs=_NATS + 3 * error)
