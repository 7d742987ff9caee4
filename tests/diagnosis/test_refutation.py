"""Effects that one group of observables refutes."""

import pytest

from diagnosis.inference.model_selection import select_model
from diagnosis.inference.predictive_checks import refutations
from tests.diagnosis.toy import EFFECTS, bench, fitted, measured

# It tilts the lines, and the clocks by three tenths of that.
SLOPE = EFFECTS[0]


def test_an_effect_that_is_there_is_not_refuted() -> None:
    for seed in range(10):
        problem = measured(seed, bench(leak=2.0))
        assert refutations(problem, fitted(problem, SLOPE)) == ()


def test_an_effect_is_refuted_where_it_does_not_show() -> None:
    problem = measured(3, bench(leak=2.0), clock_truth=bench())
    (found,) = refutations(problem, fitted(problem, SLOPE))
    assert (found.effect, found.group) == ("slope", "clocks")
    # The fit to both groups takes a little from the lines.
    assert found.share == pytest.approx(0.0, abs=3 * found.error + 0.01)
    assert found.error < 0.05


def test_a_group_that_would_not_show_an_effect_refutes_nothing() -> None:
    """In clocks of such noise the effect is four standard deviations."""
    problem = measured(3, bench(leak=0.3), noise=0.1, clock_truth=bench())
    assert refutations(problem, fitted(problem, SLOPE)) == ()


def test_a_refuted_effect_is_not_named() -> None:
    truth = measured(3, bench(leak=2.0))
    found = select_model(truth, EFFECTS)
    assert found.probability["slope"] > 0.9
    assert found.refuted == {}
    other = measured(3, bench(leak=2.0), clock_truth=bench())
    found = select_model(other, EFFECTS)
    assert {each.group for each in found.refuted["slope"]} == {"clocks"}
    assert found.single["slope"].log_evidence <= found.null.log_evidence
    assert found.probability["slope"] < 0.1
    assert found.probability["unknown"] > 0.5
