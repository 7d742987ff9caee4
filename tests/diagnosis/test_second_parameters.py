"""Effects with a second parameter that is far from what is expected of it."""

from collections.abc import Mapping

import numpy as np
import pytest

from diagnosis.inference.candidate_search import search_alone
from diagnosis.inference.candidates import Candidate, refitted, start_with, without_effects
from diagnosis.inference.effect_scan import Start
from diagnosis.inference.problem import InferenceProblem
from physics.effects.effect import Effect, Parameter, Stage
from physics.parameters.tree import BenchParameters, more
from tests.diagnosis.toy import EFFECTS, bench, measured

SPREAD = 0.25


def _change(parameters: BenchParameters, values: Mapping[str, float]) -> BenchParameters:
    size = values["size"]
    return more(parameters, "optics.interference", leak=size, crosstalk=size * values["part"])


SLOPE = Effect(
    id="slope",
    title="a slope with a bump in proportion",
    stage=Stage.OPTICS,
    parameters=(
        Parameter("size", "", 1.0, "toy", most=6.0),
        Parameter("part", "", SPREAD, "toy"),
    ),
    change=_change,
    reference="",
)


def of_slope(part: float, **changes: float) -> InferenceProblem:
    """Measure a slope of 0.3 whose second parameter is some of its standard deviations."""
    return measured(3, bench(leak=0.3, crosstalk=0.3 * SPREAD * part, **changes))


def searched(problem: InferenceProblem, effect: Effect, before: Candidate) -> Candidate:
    """Look for an effect in addition to those of a candidate."""
    start = start_with(problem, before) if before.effects else Start.without(
        problem, before.estimate
    )  # fmt: skip
    found = search_alone(problem, start, before, effect)
    assert found is not None
    return found


def again(problem: InferenceProblem, candidate: Candidate) -> Candidate:
    return refitted(problem, candidate, [candidate.estimate.z])


@pytest.mark.parametrize("part", [0.0, 1.0, 2.0])
def test_a_fit_in_full_has_the_evidence_of_the_scan(part: float) -> None:
    """Its second parameter costs as much as it did, where the scan began at none."""
    problem = of_slope(part)
    found = searched(problem, SLOPE, without_effects(problem, [np.zeros(1)]))
    assert found.sizes[1] == pytest.approx(part, abs=0.3)
    full = again(problem, found)
    assert full.sizes == pytest.approx(found.sizes, abs=0.2)
    assert full.log_evidence == pytest.approx(found.log_evidence, abs=0.4)


def test_a_pair_has_it_too() -> None:
    problem = of_slope(2.0, detuning_hz=0.1)
    first = again(problem, searched(problem, SLOPE, without_effects(problem, [np.zeros(1)])))
    pair = searched(problem, EFFECTS[2], first)
    assert again(problem, pair).log_evidence == pytest.approx(pair.log_evidence, abs=0.8)
    # As much as without what is added.
    alone = of_slope(0.0, detuning_hz=0.1)
    first = again(alone, searched(alone, SLOPE, without_effects(alone, [np.zeros(1)])))
    usual = again(alone, searched(alone, EFFECTS[2], first))
    less = usual.log_evidence - again(problem, pair).log_evidence
    assert less == pytest.approx(2.0, abs=0.7)


def test_what_is_less_expected_is_less_likely() -> None:
    """By half of the square of how many standard deviations it is from what is expected."""
    usual, far = (
        again(problem, searched(problem, SLOPE, without_effects(problem, [np.zeros(1)])))
        for problem in (of_slope(0.0), of_slope(2.0))
    )
    assert usual.log_evidence - far.log_evidence == pytest.approx(2.0, abs=0.5)
