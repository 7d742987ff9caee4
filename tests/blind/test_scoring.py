"""Scores beside what can be counted by hand."""

import numpy as np
import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind.cases import Label
from blind.scoring import (
    Case,
    Classes,
    brier,
    calibration_error,
    confident_wrong,
    false_alarms,
    mean_probability,
    named,
    open_set,
    sets,
    share,
)

CLASSES = Classes([("air_load", "stiffening"), ("crack",)])


def case(truth, probability, likely=(), known=True, verdict="effect", d_prime=9.0):
    effects = tuple((name, 1.0) for name in truth.split("+")) if truth else ()
    answer = {
        "verdict": verdict,
        "probability": probability,
        "likely": [list(group) for group in likely],
        "effects": {name: {"d_prime": d_prime} for name, _ in effects},
    }
    return Case("c", Label(1, effects, known, 0), answer)


def missing(truth):
    return Case("c", Label(1, ((truth, 1.0),) if truth else (), True, 0), None)


def test_intervals_are_wilsons() -> None:
    found = share([True] * 184 + [False] * 16)
    assert (found.value, round(found.low, 2), round(found.high, 2)) == (0.92, 0.87, 0.95)
    assert share([True] * 2 + [False] * 298).high == pytest.approx(0.024, abs=5e-4)
    assert np.isnan(share([]).value)


def test_a_false_alarm_is_anything_but_nothing_and_silence_too() -> None:
    calm = case("", {"none": 0.6, "crack": 0.4})
    loud = case("", {"none": 0.3, "unknown": 0.7})
    stuck = case("", {"none": 1.0}, verdict="not converged")
    found = false_alarms([calm, loud, stuck, missing(""), case("crack", {"none": 1.0})])
    assert (found.hits, found.cases) == (3, 4)


def test_a_member_of_the_class_counts_and_shares_add_up() -> None:
    split = case("air_load", {"stiffening": 0.35, "air_load": 0.25, "crack": 0.4})
    assert named([split], CLASSES).hits == 1
    assert named([split], Classes([])).hits == 0
    assert named([split], Classes([]), first=3).hits == 1
    assert mean_probability([split, missing("crack")], CLASSES)[0] == pytest.approx(0.3)


def test_pairs_count_by_their_classes_in_any_order() -> None:
    pair = case("crack+air_load", {"stiffening+crack": 0.7, "crack": 0.3}, verdict="pair")
    assert named([pair], CLASSES).hits == 1
    assert named([pair], Classes([])).hits == 0


def test_the_open_set_opens_for_few_of_the_known() -> None:
    known = [case("crack", {"crack": 1 - u, "unknown": u}) for u in np.linspace(0, 0.2, 40)]
    found, threshold, area = open_set(
        [*known, case("x", {"unknown": 0.9}, known=False), case("x", {"crack": 1.0}, known=False)]
    )
    assert (found.hits, found.cases) == (1, 2)
    assert np.mean([c.probability["unknown"] > threshold for c in known]) <= 0.05
    assert area == pytest.approx(0.5 * (1 + 0.5 / 40), abs=1e-9)


def test_sure_and_wrong_about_an_unknown_kind() -> None:
    sure = case("x", {"crack": 0.95, "unknown": 0.05}, known=False)
    unsure = case("x", {"crack": 0.6, "unknown": 0.4}, known=False)
    assert (confident_wrong([sure, unsure]).hits, confident_wrong([sure, unsure]).cases) == (1, 2)


def test_calibrated_answers_have_no_error_and_sure_wrong_ones_have_all() -> None:
    rng = np.random.default_rng(0)
    right = rng.random(4000) < 0.7
    cases = [case("crack" if r else "air_load", {"crack": 0.7, "air_load": 0.3}) for r in right]
    assert calibration_error(cases, CLASSES) < 0.05
    wrong = [case("crack", {"air_load": 1.0})] * 20
    assert calibration_error(wrong, CLASSES) == pytest.approx(1.0)
    assert brier(wrong, CLASSES) == pytest.approx(2.0)
    assert brier([case("crack", {"crack": 1.0})], CLASSES) == 0.0


def test_sets_cover_by_class() -> None:
    cases = [case("air_load", {"crack": 1.0}, likely=[("crack",), ("stiffening",)]),
             case("air_load", {"crack": 1.0}, likely=[("crack",)]), missing("crack")]  # fmt: skip
    covered, size = sets(cases, CLASSES)
    assert (covered.hits, covered.cases) == (1, 3)
    assert size == pytest.approx(1.0)


def test_an_answer_tells_what_it_could_have_seen() -> None:
    assert case("crack", {}, d_prime=5.0).resolved
    assert not case("crack", {}, d_prime=4.9).resolved
    assert missing("crack").resolved, "what was not answered counts"
