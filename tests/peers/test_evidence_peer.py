"""Evidence of effects against nested sampling by dynesty, with a likelihood written out here.

Nuisance, strength, and the factors on the noise of both groups are sampled; the diagnosis sums over
strengths, marginalises the nuisance exactly, and takes the likeliest factors.
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
# Log evidence may differ by this, for factors that are not sampled but the likeliest.
_NATS = 0.5


def own_log_bayes(problem: InferenceProblem, number: int) -> float:
    """Log Bayes factor of an effect of any strength, by the diagnosis."""
    null = fitted(problem)
    scan = scan_effect(problem, Start.without(problem, null.estimate), EFFECTS[number])
    assert scan is not None
    return float(np.logaddexp(scan.log_evidence, scan.log_hidden)) - null.log_evidence


def sampled(problem: InferenceProblem, number: int | None, seed: int) -> tuple[float, float]:
    """Log evidence and its standard error, without an effect or with one."""
    (lines, clocks), effect = problem.groups, None if number is None else EFFECTS[number]
    added = (np.zeros(60), np.zeros(20)) if effect is None else ADDED[effect.id]
    most = 0.0 if effect is None else effect.parameters[0].most
    signed = effect is not None and not effect.parameters[0].positive

    def drawn(u: np.ndarray) -> np.ndarray:
        strength = 0.0
        if effect is not None:
            half = abs(2 * u[3] - 1) if signed else u[3]
            sign = -1.0 if signed and u[3] < 0.5 else 1.0
            strength = sign * most * 0.01 * 100**half
        factors = MEASURED * norm.ppf(0.5 + 0.5 * u[1:3])
        return np.array([LEVEL.spread * norm.ppf(u[0]), *factors, strength][: len(u)])

    def log_likelihood(x: np.ndarray) -> float:
        strength = x[3] if effect is not None else 0.0
        first = (lines.values - x[0] - strength * added[0]) / NOISE * np.exp(-x[1])
        second = (clocks.values - strength * added[1]) / NOISE * np.exp(-x[2])
        return float(-0.5 * (first @ first + second @ second) - 60 * x[1] - 20 * x[2])

    with warnings.catch_warnings():
        # It warns that ellipsoids are large while the prior is still wide.
        warnings.simplefilter("ignore")
        sampler = dynesty.NestedSampler(
            log_likelihood, drawn, 3 if effect is None else 4, nlive=250, bound="single",
            sample="rwalk", bootstrap=0, rstate=np.random.default_rng(seed),
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
