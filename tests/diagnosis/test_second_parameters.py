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


@pytest.mark.parametrize("part", [-1.0, 1.0, 2.0, -3.0])
def test_a_second_parameter_costs_as_much_in_the_fit_as_in_the_scan(part: float) -> None:
    """A scan begins at none, with the noise as it seems without the effect; a fit does not."""
    less = []
    for own in (0.0, part):
        problem = of_slope(own)
        found = searched(problem, SLOPE, without_effects(problem, [np.zeros(1)]))
        full = again(problem, found)
        assert full.sizes == pytest.approx(found.sizes, abs=0.2)
        less.append(full.log_evidence - found.log_evidence)
    assert found.sizes[1] == pytest.approx(part, abs=0.7)
    assert less[1] == pytest.approx(less[0], abs=0.3)


@pytest.mark.parametrize("part", [0.0, 2.0, -3.0])
def test_a_pair_is_as_likely_in_either_order(part: float) -> None:
    """Though the second of these alone hardly shows in the noise that the first leaves."""
    problem, ends = of_slope(part, detuning_hz=0.1), []
    null = without_effects(problem, [np.zeros(1)])
    for one, other in ((SLOPE, EFFECTS[2]), (EFFECTS[2], SLOPE)):
        first = again(problem, searched(problem, one, null))
        pair = searched(problem, other, first)
        ends += [pair.log_evidence, again(problem, pair).log_evidence]
    assert ends == pytest.approx([ends[1]] * 4, abs=1.5)
    assert ends[3] == pytest.approx(ends[1], abs=0.6)


def test_what_is_less_expected_is_less_likely() -> None:
    """By half of the square of how many standard deviations it is from what is expected."""
    usual, far = (
        again(problem, searched(problem, SLOPE, without_effects(problem, [np.zeros(1)])))
        for problem in (of_slope(0.0), of_slope(2.0))
    )
    assert usual.log_evidence - far.log_evidence == pytest.approx(2.0, abs=0.5)
