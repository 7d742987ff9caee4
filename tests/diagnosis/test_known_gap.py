"""Known effects in a diagnosis: their sizes are nuisances, and the page says what they explain."""

import numpy as np
import pytest

from diagnosis.campaign_diagnosis import CampaignSummary, diagnose_problem
from diagnosis.inference.problem import InferenceProblem
from physics.effects.catalogue import BY_ID
from physics.parameters.tree import BenchParameters
from physics.sized_effect import SizedEffect
from reports.diagnosis_json import to_json
from reports.diagnosis_page import document, words
from tests.diagnosis.toy import LEVEL, bench, fitted, measured

CROSSTALK = BY_ID["sideband_crosstalk"]


def known(fraction: float, error: float = 0.0) -> SizedEffect:
    values = {parameter.name: 0.0 for parameter in CROSSTALK.parameters}
    errors = {"fraction": error} if error else {}
    return SizedEffect(CROSSTALK, {**values, "fraction": fraction}, errors)


def with_known(problem: InferenceProblem, *effects: SizedEffect) -> InferenceProblem:
    return InferenceProblem(problem.groups, BenchParameters(), (LEVEL,), effects)


TRUE = measured(3, bench(crosstalk=0.3))


def test_a_known_effect_is_in_the_model_with_its_size() -> None:
    problem = with_known(TRUE, known(0.3))
    assert [nuisance.name for nuisance in problem.nuisances] == ["level"]
    assert problem.parameters(np.zeros(1)).optics.interference.crosstalk == pytest.approx(0.3)
    assert problem.without_known().parameters(np.zeros(1)) == BenchParameters()


def test_an_uncertain_size_is_a_nuisance_that_data_correct() -> None:
    problem = with_known(TRUE, known(0.2, 0.1))
    assert [n.spread for n in problem.nuisances] == [LEVEL.spread, 0.1]
    moved = problem.parameters(np.array([0.0, 2.0])).optics.interference.crosstalk
    assert moved == pytest.approx(0.4)
    null = fitted(problem)
    found = null.parameters(problem).optics.interference.crosstalk
    error = 0.1 * np.sqrt(null.estimate.covariance[1, 1])
    assert abs(found - 0.3) < 3 * error
    assert error < 0.05
    # The exact size of the same value leaves what the true one does not.
    exact = fitted(with_known(TRUE, known(0.2)))
    assert null.estimate.chi2 < exact.estimate.chi2


def test_two_uncertain_sizes_belong_to_their_effects() -> None:
    power = BY_ID["laser_power_drift"]
    other = SizedEffect(power, {p.name: 0.1 for p in power.parameters}, {"loss_rate": 0.05})
    problem = with_known(TRUE, known(0.2, 0.1), other)
    optics = problem.parameters(np.array([0.0, 1.0, -2.0])).optics.interference
    assert optics.crosstalk == pytest.approx(0.3)
    alone = SizedEffect(power, {**other.values, "loss_rate": 0.0}).change(BenchParameters())
    assert optics.fade_per_h == pytest.approx(alone.optics.interference.fade_per_h)


@pytest.mark.parametrize("foreseen", [False, True])
def test_a_known_effect_closes_the_gap_of_a_campaign_that_has_it(foreseen: bool) -> None:
    summary = CampaignSummary("t3", foreseen=foreseen)
    verdict = diagnose_problem(with_known(TRUE, known(0.3, 0.05)), summary)
    assert verdict.kind == "none"
    assert verdict.known.explained.fraction > 0.9
    assert verdict.known.explained.before > 5
    answer = to_json(verdict)["known"]
    assert answer["before_the_runs"] is foreseen
    stated = {"value": 0.3, "error": 0.05, "unit": ""}
    assert answer["effects"]["sideband_crosstalk"]["fraction"] == stated
    assert 0.9 < answer["explained_fraction"]["fraction"] <= 1.1
    (said,) = (line for line in words(verdict) if line.startswith("Known effects"))
    assert ("may have been used" in said) is not foreseen
    assert said in document(verdict, "Diagnosis")


def test_what_a_bench_has_not_explains_nothing() -> None:
    healthy = measured(3, bench(leak=0.5))
    verdict = diagnose_problem(with_known(healthy, known(0.5)), CampaignSummary("t3"))
    assert verdict.known.explained.after > verdict.known.explained.before


def test_without_known_effects_nothing_is_said_of_them() -> None:
    verdict = diagnose_problem(TRUE, CampaignSummary("t3"))
    assert verdict.known is None
    assert to_json(verdict)["known"] is None
    assert not any(line.startswith("Known effects") for line in words(verdict))
