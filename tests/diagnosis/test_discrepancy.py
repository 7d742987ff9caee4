"""What no effect explains, and its signs, on a bench whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from diagnosis.inference.candidates import fit_model
from diagnosis.inference.discrepancy import (
    _gains,
    _Left,
    group_discrepancies,
    log_bayes_any_unknown,
)
from diagnosis.inference.importance_sampling import sampled
from diagnosis.inference.predictive_checks import predictive_checks
from diagnosis.inference.problem import InferenceProblem, LocatedEffect
from diagnosis.observable_groups import Coordinates
from physics.parameters.tree import BenchParameters
from tests.diagnosis.toy import EFFECTS, LEVEL, bench, measured

SLOPE, BUMP, OFFSET = (LocatedEffect(effect, {}) for effect in EFFECTS[:3])


def fitted(problem, *effects):
    count = 1 + len(effects)
    return fit_model(problem, effects, [np.full(count, 0.1)], exact=True)


def signs(problem, *effects, condition=None):
    null, candidate = fitted(problem), fitted(problem, *effects)
    groups = condition or [""] * len(null.whitened_residual)
    return {sign.id: sign for sign in predictive_checks(problem, candidate, groups)}


def test_something_unknown_is_likelier_only_where_numbers_are_off() -> None:
    plain, off = measured(1, bench()), measured(1, bench(), extra=0.4)
    assert log_bayes_any_unknown(plain, fitted(plain)) < 0
    found = group_discrepancies(off, fitted(off))
    assert float(found["lines"][0]) > 20
    assert float(found["clocks"][0]) < 0


def test_an_effect_leaves_nothing_unknown_and_a_wrong_one_does() -> None:
    problem = measured(2, bench(crosstalk=0.6))
    right = log_bayes_any_unknown(problem, fitted(problem, BUMP))
    assert right < 0 < 20 < log_bayes_any_unknown(problem, fitted(problem, SLOPE))


def test_one_time_may_be_moved_alone(monkeypatch) -> None:
    problem = measured(2, bench())
    lines, clocks = problem.groups
    then = np.array([place.time == "t2" for place in lines.coordinates])
    moved = replace(lines, values=lines.values + 0.07 * then)
    problem = InferenceProblem((moved, clocks), BenchParameters(), (LEVEL,))
    candidate = fitted(problem)
    alone = float(group_discrepancies(problem, candidate)["lines"][0])
    monkeypatch.setattr("diagnosis.inference.discrepancy._ONE_ALONE", ())
    assert alone > float(group_discrepancies(problem, candidate)["lines"][0]) + 1
    assert alone > 1


@pytest.mark.parametrize("deviation", [1.0, 1e4])
def test_where_nothing_is_off_nothing_unknown_gains(deviation: float) -> None:
    problem = measured(2, bench())
    candidate = fitted(problem)
    residuals = np.zeros((len(candidate.estimate.residuals), 1))
    left = _Left(residuals, candidate.free_jacobian, deviation * candidate.deviation)
    for block in problem.groups:
        gains = [float(gain[0]) for gain, _ in _gains(left, problem.slices[block.name], block)]
        assert max(gains) < 0


def test_what_moves_two_blocks_counts_once_for_each() -> None:
    both = measured(3, bench(crosstalk=0.6, detuning_hz=0.3))
    lines, clocks = (
        float(factor[0]) for factor in group_discrepancies(both, fitted(both)).values()
    )
    total = log_bayes_any_unknown(both, fitted(both))
    assert total > max(lines, clocks) + 10
    # No likelihood is greater than that of numbers that are where they should be.
    assert total + fitted(both).log_evidence < 0


@pytest.mark.parametrize("seed", range(4))
def test_chance_fires_no_sign_next_to_the_truth(seed: int) -> None:
    found = signs(measured(seed, bench(crosstalk=0.5)), BUMP)
    assert set(found) == {"discrepancy", "largest", "implausible"}
    assert not any(sign.significant for sign in found.values())


def test_each_sign_fires_for_its_own_cause() -> None:
    problem = measured(5, bench(), extra=0.4)
    assert signs(problem, SLOPE)["discrepancy"].significant
    huge = measured(5, bench(detuning_hz=4.5))
    assert signs(huge, OFFSET)["implausible"].significant
    names = ["gone" if k >= 60 else "" for k in range(80)]
    assert signs(measured(5, bench(detuning_hz=0.4)), SLOPE, condition=names)[
        "transfer"
    ].significant
    assert not signs(measured(5, bench()), SLOPE, condition=names)["transfer"].significant


def test_sampled_evidence_of_a_straight_model_is_laplaces() -> None:
    problem = measured(6, bench(leak=0.2))
    for effects in ((SLOPE,), (SLOPE, OFFSET)):
        found = sampled(problem, fitted(problem, *effects), draws=400)
        assert found.gain == pytest.approx(0.0, abs=0.15)
        assert found.effective > 100


def test_sampled_evidence_minds_a_bound() -> None:
    # A size that cannot be negative and is best at 0: half of its posterior is cut off.
    problem = measured(7, bench())
    candidate = fitted(problem, BUMP)
    found = sampled(problem, candidate, draws=2000)
    assert found.gain == pytest.approx(0.0, abs=0.5)


def test_a_drift_that_no_effect_makes_is_looked_for_along_time() -> None:
    problem = measured(8, bench())
    lines, clocks = problem.groups
    # In an order of time that no effect knows.
    order = np.random.default_rng(0).permutation(60)
    places = tuple(Coordinates("line", time=f"t{k}") for k in range(60))
    still = replace(lines, coordinates=places)
    slow = 0.1 * (np.arange(60) / 59 - 0.5)

    def found(values: np.ndarray) -> float:
        block = replace(still, values=values)
        moved = InferenceProblem([block, clocks], BenchParameters(), (LEVEL,))
        return float(group_discrepancies(moved, fitted(moved))["lines"][0])

    assert found(still.values) < 0
    assert found(still.values + slow) > 3
    assert found(still.values + slow[order]) < 1
