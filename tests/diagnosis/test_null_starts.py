"""Starts of the fit without effects, where more than one chamber explains nearly the same."""

from functools import partial

import numpy as np
import pytest

from diagnosis.inference.candidates import without_effects
from diagnosis.inference.estimation import LEAST_DECREMENT
from diagnosis.inference.model_selection import select_model
from diagnosis.inference.nuisances import Nuisance
from diagnosis.inference.null_starts import starts_without_effects
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import Coordinates, Observable, observable_group
from physics.errors import ImpossibleReedError
from physics.parameters.tree import BenchParameters, more
from tests.diagnosis.toy import AT, COUNT, EFFECTS, LEVEL, bench, measured

NOISE, PLACE, SLOPE = 0.02, 1.6, -0.4


def moved(parameters: BenchParameters, value: float, impossible: bool = False) -> BenchParameters:
    if impossible and value > 1.0:
        raise ImpossibleReedError("no such reed")
    return more(parameters, "optics.interference", crosstalk=value)


def peak(parameters: BenchParameters) -> np.ndarray:
    """A narrow peak, whose place is far from linear, on a straight line, which is linear."""
    beams = parameters.optics.interference
    return beams.fade_per_h * AT + np.exp(-(((AT - 0.5 * beams.crosstalk) / 0.1) ** 2))


def of_peak(impossible: bool = False, spread: float = 1.0) -> InferenceProblem:
    rng = np.random.default_rng(1)
    truth = bench(fade_per_h=SLOPE, crosstalk=PLACE)
    group = observable_group(
        "lines",
        Observable.MAPS,
        peak(truth) + NOISE * rng.standard_normal(COUNT),
        np.full(COUNT, NOISE),
        [Coordinates("line")] * COUNT,
        ("optics",),
        peak,
    )
    place = Nuisance("place", "", spread, partial(moved, impossible=impossible), "", "bypass")
    return InferenceProblem([group], BenchParameters(), (LEVEL, place))


def test_a_search_from_the_centre_ends_elsewhere_and_one_of_the_starts_does_not() -> None:
    problem = of_peak()
    *best, centre = starts_without_effects(problem)
    assert not centre.any()
    assert without_effects(problem, [centre]).estimate.cost > 1000
    found = without_effects(problem, [best[0]]).estimate
    assert found.cost < 2 * COUNT
    # In units of priors: the level's is 2.
    np.testing.assert_allclose(found.z, [SLOPE / 2, PLACE], atol=0.02)
    # What is linear was fitted already.
    assert best[0][1] == pytest.approx(PLACE, abs=0.1)
    assert best[0][0] == pytest.approx(SLOPE / 2, abs=0.05)


def test_the_model_without_effects_is_fitted_from_them() -> None:
    null = select_model(of_peak(), EFFECTS[:1]).null
    assert null.estimate.cost < 2 * COUNT
    assert null.estimate.starts == 3


def test_starts_lie_apart_and_are_of_the_prior() -> None:
    for spread in (1.0, 2.0):
        starts = starts_without_effects(of_peak(spread=spread))
        assert len(starts) == 3
        assert abs(starts[0][1] - starts[1][1]) > 0.5
        assert starts[0][1] == pytest.approx(PLACE / spread, abs=0.1)


def test_impossible_ones_are_left_out() -> None:
    starts = starts_without_effects(of_peak(impossible=True))
    assert len(starts) == 3
    assert max(start[1] for start in starts) <= 1.0


def test_where_all_is_linear_there_is_one_start() -> None:
    (start,) = starts_without_effects(measured(1, bench()))
    np.testing.assert_array_equal(start, np.zeros(1))


def test_one_search_begins_with_a_soft_clamp() -> None:
    """In the best chamber, everything else at the prior's centre; where there is a clamp."""
    clamp = Nuisance("clamp", "", 1.0, lambda parameters, _value: parameters, "")
    problem = of_peak()
    with_clamp = InferenceProblem(problem.groups, BenchParameters(), (*problem.nuisances, clamp))
    first, _second, soft, centre = starts_without_effects(with_clamp)
    assert not centre.any()
    np.testing.assert_array_equal(soft, [0.0, first[1], 2.0])
    even = measured(1, bench())
    alone = InferenceProblem(even.groups, BenchParameters(), (*even.nuisances, clamp))
    centre, soft = starts_without_effects(alone)
    assert not centre.any()
    np.testing.assert_array_equal(soft, [0.0, 2.0])


def test_a_search_goes_on_while_a_step_would_gain_something() -> None:
    problem = of_peak()
    z = np.array([SLOPE / 2, PLACE])
    for off in (0.05, 0.14, 0.17, 0.2):
        found = without_effects(problem, [np.add(z, (0.0, off))]).estimate
        assert found.decrement < LEAST_DECREMENT
        assert found.converged


def test_of_two_that_explain_nearly_as_much_the_one_nearer_to_the_prior_is_first() -> None:
    """One place is 0.6 priors off; the other one 1.8, and explains a little more (χ² less by 1)."""

    def either(parameters: BenchParameters) -> np.ndarray:
        place = parameters.optics.interference.crosstalk
        near, far = (np.exp(-(((place - at) / 0.4) ** 2)) for at in (0.6, -1.8))
        return np.full(COUNT, 0.97 * near + far)

    group = observable_group(
        "lines",
        Observable.MAPS,
        np.ones(COUNT),
        np.full(COUNT, 0.03 * np.sqrt(COUNT)),
        [Coordinates("line")] * COUNT,
        ("optics",),
        either,
    )
    place = Nuisance("place", "", 1.0, moved, "", "bypass")
    problem = InferenceProblem([group], BenchParameters(), (place,))
    first, second, _ = starts_without_effects(problem)
    assert first[0] == pytest.approx(0.6, abs=0.3)
    assert abs(second[0] - first[0]) > 0.5
