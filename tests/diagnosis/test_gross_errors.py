"""Results of fits may be wrong: one number decides nothing, many do."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from diagnosis.floor_certificate import floor_certificate
from diagnosis.inference.candidates import _beyond, start_with, without_effects
from diagnosis.inference.effect_scan import Start
from diagnosis.inference.gross_errors import TIMES, with_gross_errors
from diagnosis.inference.linear_model import GROSS, weigh, weighed_at
from diagnosis.inference.model_selection import select_model
from diagnosis.inference.problem import InferenceProblem
from diagnosis.observable_groups import Coordinates, Errors, Observable, observable_group
from physics.parameters.tree import BenchParameters
from tests.diagnosis.toy import COUNT, EFFECTS, LEVEL, bench

NOISE = 0.05
TRIED = EFFECTS[:2]
# What the second effect moves: one number, and those next to it a little.
AT, SPIKE = 30, np.zeros(COUNT)
SPIKE[AT - 2 : AT + 3] = 0.1, 0.3, 1.0, 0.3, 0.1


def lines(parameters: BenchParameters) -> np.ndarray:
    """A level, a slope, and a spike."""
    beams = parameters.optics.interference
    slope = np.linspace(-1, 1, COUNT)
    return beams.fade_per_h + beams.leak * slope + beams.crosstalk * SPIKE


def measured(
    wrong: dict[int, float], truth: BenchParameters | None = None, *, of_fits: bool = True
) -> InferenceProblem:
    """Lines of which some are off by a number of standard errors."""
    rng = np.random.default_rng(3)
    y = lines(truth or bench()) + NOISE * rng.standard_normal(COUNT)
    for place, times in wrong.items():
        y[place] += times * NOISE
    errors = Errors(np.full(COUNT, NOISE), of_fits=of_fits)
    places = [Coordinates("line", time=f"t{k}") for k in range(COUNT)]
    group = observable_group("lines", Observable.MAPS, y, errors, places, ("optics",), lines)
    return InferenceProblem([group], BenchParameters(), (LEVEL,))


def at_rest(problem: InferenceProblem) -> Start:
    null = without_effects(problem, [np.zeros(1)])
    return Start.without(problem, null.estimate)


def test_what_is_right_stays_right() -> None:
    assert not np.any(at_rest(measured({})).model.family == GROSS)


@pytest.mark.parametrize("wrong", [{5: 9.0}, {5: -9.0, 17: 12.0}, {2: 9.0, 5: 8.0, 17: 30.0}])
def test_numbers_that_are_far_off_are_wrong(wrong: dict[int, float]) -> None:
    start = at_rest(measured(wrong))
    columns = start.model.slopes[:, start.model.family == GROSS]
    assert {int(np.argmax(np.abs(column))) for column in columns.T} == set(wrong)
    assert start.model.log_prior == pytest.approx(len(wrong) * np.log(0.01 / 0.99))


def test_no_more_than_three_are() -> None:
    start = at_rest(measured(dict.fromkeys((2, 5, 9, 14, 17), 40.0)))
    assert np.count_nonzero(start.model.family == GROSS) <= 3


def test_a_wrong_number_has_the_evidence_of_a_larger_error_and_its_prior() -> None:
    problem = measured({5: 9.0})
    start = at_rest(problem)
    right = start.model.without_gross_errors()
    usual = right.usual
    found = weighed_at(start.model, usual).log_evidence - weighed_at(right, usual).log_evidence
    plain = np.eye(COUNT) + right.slopes @ right.slopes.T
    larger = plain.copy()
    larger[5, 5] += TIMES**2
    logs = [multivariate_normal.logpdf(right.left, cov=each) for each in (larger, plain)]
    assert found == pytest.approx(logs[0] - logs[1] + np.log(0.01 / 0.99), rel=1e-6)


def test_of_correlated_numbers_one_is_wrong() -> None:
    """Errors of one fit are correlated: what is wrong is a number, not a mixture of them."""
    rng = np.random.default_rng(1)
    root = rng.standard_normal((COUNT, COUNT)) * 0.02 + NOISE * np.eye(COUNT)
    noise = root @ root.T
    y = root @ rng.standard_normal(COUNT)
    y[7] += 12 * np.sqrt(noise[7, 7])
    places = [Coordinates("line", time=f"t{k}") for k in range(COUNT)]
    errors = Errors(noise, of_fits=True)
    group = observable_group("lines", Observable.MAPS, y, errors, places, ("optics",), lines)
    problem = InferenceProblem([group], BenchParameters(), (LEVEL,))
    start = at_rest(problem)
    columns = start.model.slopes[:, start.model.family == GROSS]
    back = np.linalg.solve(group.noise_whitening, columns)
    assert [int(np.argmax(np.abs(column))) for column in back.T] == [7]
    assert np.count_nonzero(np.abs(back) > 1e-9) == 1


def test_one_number_decides_nothing() -> None:
    """Of an effect that moves it most; unless it was counted, not fitted."""
    sure, doubted = (
        select_model(measured({AT: 7.0}, of_fits=of_fits), TRIED) for of_fits in (False, True)
    )
    assert sure.probability["bump"] > 0.8
    assert doubted.probability["bump"] < 0.3
    gain = [
        found.single["bump"].log_evidence - found.null.log_evidence for found in (sure, doubted)
    ]
    assert gain[1] < gain[0] - 5


def test_many_numbers_decide_as_before() -> None:
    truth = bench(leak=0.1)
    sure, doubted = (
        select_model(measured({}, truth, of_fits=of_fits), TRIED) for of_fits in (False, True)
    )
    for found in (sure, doubted):
        assert found.probability["slope"] > 0.9
    assert not np.any(doubted.single["slope"].model.family == GROSS)
    assert doubted.single["slope"].log_evidence == pytest.approx(
        sure.single["slope"].log_evidence, abs=0.5
    )


def test_an_effect_that_explains_a_number_makes_it_right() -> None:
    """Wrong without the effect, because it stands alone; right with it, which moves others too."""
    problem = measured({}, bench(crosstalk=30 * NOISE))
    found = select_model(problem, TRIED)
    assert np.any(at_rest(problem).model.family == GROSS)
    assert not np.any(found.single["bump"].model.family == GROSS)
    assert found.probability["bump"] > 0.9


def test_a_model_without_results_of_fits_is_as_it_was() -> None:
    problem = measured({5: 9.0}, of_fits=False)
    assert problem.errors_of_fits.shape == (COUNT, 0)
    model = at_rest(problem).model
    weighed = weigh(model)
    assert with_gross_errors(problem, model, weighed) == (model, weighed)


def test_wrong_numbers_of_one_model_are_those_of_another() -> None:
    start = at_rest(measured({5: 9.0}))
    right = start.model.without_gross_errors()
    assert right.log_prior == 0
    again = right.with_errors_of(start.model)
    np.testing.assert_array_equal(again.family, start.model.family)
    np.testing.assert_array_equal(again.slopes, start.model.slopes)
    assert again.log_prior == start.model.log_prior
    twice = replace(again, form=again.form).with_errors_of(start.model)
    assert twice.slopes.shape == again.slopes.shape


def test_what_is_taken_to_be_wrong_is_said() -> None:
    problem = measured({5: 9.0, 17: -12.0})
    null = without_effects(problem, [np.zeros(1)])
    (floor,) = floor_certificate(problem, null)
    assert set(floor.wrong) == {"line t5", "line t17"}
    (even,) = floor_certificate(measured({}), without_effects(measured({}), [np.zeros(1)]))
    assert even.wrong == ()


def test_what_is_added_to_an_effect_finds_the_same_number_wrong() -> None:
    """In pairs, and where an effect is scanned again at its full fit."""
    problem = measured({AT + 12: 15.0}, bench(leak=0.1))
    slope = select_model(problem, TRIED).single["slope"]
    assert np.count_nonzero(slope.model.family == GROSS) == 1
    for start in (start_with(problem, slope), _beyond(problem, slope, slope.estimate)):
        assert start is not None
        column = start.model.slopes[:, start.model.family == GROSS]
        assert int(np.argmax(np.abs(column))) == AT + 12
        assert start.bare.log_evidence == pytest.approx(start.weighed.log_evidence, abs=1.0)
