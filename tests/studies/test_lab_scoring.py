"""What a fit states, compared with the truth of the second laboratory."""

import math

import pytest

from studies.second_laboratory.scoring import (
    HIGHEST_HZ,
    STRONG,
    Comparison,
    comparisons,
    goal_lines,
    goals,
    scores,
)

TRUTH = {
    "modes": {
        "F1": {"hz": 2000.0, "loss_factor": 0.02, "nm_per_volt": 200.0},
        "X6": {"hz": 15_000.0, "loss_factor": 0.02},
        "T4": {"hz": HIGHEST_HZ + 1, "loss_factor": 0.02},
    },
    "components_over_rho": {"e1": 0.5},
    "moduli": {"E1_mpa": 10_000.0},
    "density_kg_m3": 520.0,
    "loss_E": 0.02,
    "loss_G": 0.03,
}


def value(value, error):
    return {"value": value, "error": error}


def mode(hz):
    found = {"hz": hz, "error_cents": 1.0, "loss_factor": 0.022, "loss_error": 0.05}
    return found | {"nm_per_v": 210.0, "nm_per_v_error": 4.2}


FIT = {
    "modes": {"F1": mode(2000 * 2 ** (3 / 1200)), "X6": mode(14_000.0), "T4": mode(15_000.0)},
    "components": {"e1": value(0.7, 0.1)},
    "moduli": {"A": {"E1_mpa": value(10_100.0, 50.0)}},
    "losses": {"A": {"normal": value(0.021, 0.001), "shear": value(0.03, 0.002)}},
}


@pytest.fixture
def by_quantity():
    return {each.quantity: each for each in comparisons("one", "A", FIT, TRUTH)}


def test_differences_and_errors_have_one_unit(by_quantity):
    assert by_quantity["F1"].difference == pytest.approx(3.0)
    assert by_quantity["loss F1"].difference == pytest.approx(100 * math.log(1.1))
    assert by_quantity["loss F1"].error == pytest.approx(5.0)
    assert by_quantity["nm F1"].difference == pytest.approx(100 * math.log(1.05))
    assert by_quantity["nm F1"].error == pytest.approx(2.0)
    assert by_quantity["e1"].difference == pytest.approx(0.2)
    assert by_quantity["E1/rho"].difference == pytest.approx(1.0)
    assert by_quantity["loss normal"].difference == pytest.approx(100 * math.log(1.05))
    assert by_quantity["loss normal"].error == pytest.approx(100 / 21)
    assert by_quantity["loss shear"].difference == pytest.approx(0.0)


def test_modes_above_the_range_are_not_compared_and_a_wrong_name_is_an_error(by_quantity):
    assert not {"T4", "loss T4"} & set(by_quantity)
    assert by_quantity["X6"].difference == pytest.approx(1200 * math.log2(14 / 15))


def test_displacements_are_compared_where_the_truth_has_them(by_quantity):
    assert "nm X6" not in by_quantity


def test_coverage_counts_sweeps_and_refusals():
    found = comparisons("one", "A", FIT, TRUTH) + comparisons("two", "A", FIT, TRUTH)
    (f1,) = [row for row in scores(found, {"F1": 3}, 3) if row.quantity == "F1"]
    assert (f1.stated, f1.of, f1.coverage) == (2, 3, 0.0)
    assert f1.rms_pull == pytest.approx(3.0)


def stated(quantity, pulls, error=1.0):
    """As many sweeps as there are pulls."""
    return [Comparison(quantity, f"s{k}", pull * error, error) for k, pull in enumerate(pulls)]


def missed(found):
    return [not goal.reached for goal in goals(found, scores(found, {}, len(found)))]


# Seven of ten within one standard error, and a mean square of 1.
RIGHT = [0.0, 0.5, -0.5, 0.6, -0.6, 0.7, -0.7, 1.5, -1.5, 1.7]


def right(*others):
    """Every strong mode, a loss and E/ρ with errors that are right, but for others."""
    found = [c for name in STRONG for c in stated(name, RIGHT)]
    found += stated("loss F1", RIGHT) + stated("E_4kHz/rho", RIGHT, 0.5)
    changed = {c.quantity for c in others}
    return [c for c in found if c.quantity not in changed] + list(others)


def test_goals_are_reached_by_errors_that_are_right():
    assert missed(right()) == [False] * 5


def test_what_states_nothing_reaches_no_goal():
    assert missed([]) == [True] * 5
    assert not any("reached" in line for line in goal_lines(goals([], [])))


def test_a_strong_mode_must_be_stated():
    assert missed([c for c in right() if c.quantity != "X1"]) == [False, False, True, False, False]


@pytest.mark.parametrize(
    ("found", "which"),
    [
        (stated("F1", [0.2] * 10), [0]),
        (stated("F1", [1.2, -1.2] * 5), [0]),
        (stated("nm F1", [0.5, -0.5] * 5), [1]),
        (stated("e2", [1.4, -1.4] * 5), [1]),
        (stated("F1", RIGHT, 4.0), [2]),
        (stated("F1", [*RIGHT, 8.1]), [3]),
        (stated("E_4kHz/rho", [x + 1.01 for x in RIGHT]), [1, 4]),
    ],
)
def test_each_goal_can_be_missed(found, which):
    assert [k for k, each in enumerate(missed(right(*found))) if each] == which


def test_a_large_error_or_a_few_cents_are_not_far_off():
    assert not missed(right(*stated("F4", [*RIGHT, 4.9], 5.0), *stated("T1", [*RIGHT, 7.9])))[3]


def test_what_misses_a_goal_is_named():
    found = stated("T1", [*RIGHT, 8.1])
    (line,) = [x for x in goal_lines(goals(found, scores(found, {}, 11))) if "T1 of s10" in x]
    assert "+8.1 ± 1.0" in line
