"""Scores compared with what can be counted by hand."""

import json

import numpy as np
import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind.cases import Label, true_sizes
from blind.drawing import draw_reliability
from blind.report import report, sentences
from blind.scoring import (
    Case,
    Classes,
    brier,
    calibration_error,
    closures,
    confident_wrong,
    false_alarms,
    mean_probability,
    named,
    open_set,
    sets,
    share,
    shuffled,
    size_errors,
    sure_and_right,
    sure_of_wrong,
    surest_right,
)

CLASSES = Classes([("air_load", "viscoelastic_stiffening"), ("crack",)])


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
    quiet = case("", {"none": 0.6, "crack": 0.4}, verdict="none")
    loud = case("", {"none": 0.3, "unknown": 0.7}, verdict="unknown")
    stuck = case("", {"none": 1.0}, verdict="not converged")
    # Each by itself is less likely than nothing, the class is more.
    split = case(
        "", {"none": 0.4, "air_load": 0.3, "viscoelastic_stiffening": 0.3}, verdict="effect"
    )
    one = split.answer | {"verdict": "none"}
    cases = [quiet, loud, stuck, split, Case("c", split.label, one), missing("")]
    found = false_alarms([*cases, case("crack", {"none": 1.0})], CLASSES)
    assert (found.hits, found.cases) == (5, 6)


def test_a_member_of_the_class_counts_and_shares_add_up() -> None:
    split = case("air_load", {"viscoelastic_stiffening": 0.35, "air_load": 0.25, "crack": 0.4})
    assert named([split], CLASSES).hits == 1
    assert named([split], Classes([])).hits == 0
    assert named([split], Classes([]), first=3).hits == 1
    assert mean_probability([split, missing("crack")], CLASSES)[0] == pytest.approx(0.3)


def test_pairs_count_by_their_classes_in_any_order() -> None:
    pair = case(
        "crack+air_load", {"viscoelastic_stiffening+crack": 0.7, "crack": 0.3}, verdict="pair"
    )
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
    faint = case("x", {"unknown": 0.5}, known=False)
    assert open_set([*known, faint])[0].hits == 1
    assert (
        open_set([*known, missing("crack"), missing("crack"), missing("crack"), faint])[0].hits == 0
    )


def test_sure_and_wrong_about_an_unknown_kind() -> None:
    sure = case("x", {"crack": 0.95, "unknown": 0.05}, known=False)
    unsure = case("x", {"crack": 0.6, "unknown": 0.4}, known=False)
    split = case(
        "x", {"air_load": 0.5, "viscoelastic_stiffening": 0.45, "unknown": 0.05}, known=False
    )
    found = confident_wrong([sure, unsure, split], CLASSES)
    assert (found.hits, found.cases) == (2, 3)


def test_sure_of_a_wrong_class_and_right_where_surest() -> None:
    cases = [
        case("crack", {"crack": 0.995, "air_load": 0.005}),
        case("crack", {"crack": 0.02, "air_load": 0.98}),
        case("crack", {"crack": 0.005, "air_load": 0.995}),
        case("crack", {"crack": 0.2, "air_load": 0.8}),
        missing("crack"),
    ]
    wrong, surest = sure_of_wrong(cases, CLASSES), surest_right(cases, CLASSES)
    assert (wrong.hits, wrong.cases) == (3, 5)
    assert (surest.hits, surest.cases) == (1, 3)


def test_calibrated_answers_have_no_error_and_sure_wrong_ones_have_all() -> None:
    rng = np.random.default_rng(0)
    right = rng.random(4000) < 0.7
    cases = [case("crack" if r else "air_load", {"crack": 0.7, "air_load": 0.3}) for r in right]
    assert calibration_error(cases, CLASSES) < 0.05
    wrong = [case("crack", {"air_load": 1.0})] * 20
    assert calibration_error(wrong, CLASSES) == pytest.approx(1.0)
    assert brier(wrong, CLASSES) == pytest.approx(2.0)
    assert calibration_error([missing("crack")] * 20, CLASSES) == pytest.approx(1.0)
    assert brier([case("crack", {"crack": 1.0})], CLASSES) == 0.0


def test_sets_cover_by_class() -> None:
    cases = [case("air_load", {"crack": 1.0}, likely=[("crack",), ("viscoelastic_stiffening",)]),
             case("air_load", {"crack": 1.0}, likely=[("crack",)]), missing("crack"),
             case("crack", {}, likely=[("crack",)], verdict="not converged")]  # fmt: skip
    covered, size = sets(cases, CLASSES)
    assert (covered.hits, covered.cases) == (1, 4)
    assert size == pytest.approx(0.75)


def test_an_answer_lists_what_it_could_have_seen() -> None:
    assert case("crack", {}, d_prime=5.0).resolved
    assert not case("crack", {}, d_prime=4.9).resolved
    assert missing("crack").resolved, "what was not answered counts"


# --- Reports -----------------------------------------------------------------------------------


def gap(before, after):
    return {"before": before, "after": after}


def answered(truth, named, by, sizes=None, **more):
    """A case with what its answer says of gaps and sizes."""
    probability = {named or "none": 0.9, "unknown": 0.1}
    made = case(truth, probability, likely=[(named or "none",)], **more)
    made.answer["explained_fraction"] = {"by": by}
    made.answer["effects_named"] = named.split("+") if named else []
    for name, size in (sizes or {}).items():
        made.answer["effects"][name]["sizes"] = size
    return made


def test_closing_less_than_the_truth_counts_less_and_silence_nothing() -> None:
    by = {"crack": gap(11.0, 1.0), "air_load": gap(11.0, 6.0)}
    cases = [
        answered("crack", "crack", by),
        answered("crack", "air_load", by),
        answered("crack", "", by),
        # The truth hardly shows: nothing says what it closes.
        answered("tip_mass", "crack", by, d_prime=1.0),
    ]
    found = closures(cases)
    assert found["cases"] == 3
    assert found["median"] == pytest.approx(0.5)
    # It shows, and was not fitted.
    missed = closures([*cases, answered("tip_mass", "crack", by)])
    assert missed["cases"] == 4
    assert missed["median"] == pytest.approx(0.25)


def test_pairs_close_gaps_whichever_comes_first() -> None:
    by = {"crack+air_load": gap(9.0, 1.0), "crack": gap(9.0, 5.0)}
    assert closures([answered("air_load+crack", "crack", by)])["median"] == pytest.approx(0.5)


def test_sizes_are_compared_with_what_the_laboratory_had() -> None:
    label = Label(1, (("laser_power_drift", 2.0),), True, 5)
    true = true_sizes(label)["laser_power_drift"]["loss_rate"]
    made = answered("laser_power_drift", "laser_power_drift", {})
    made.answer["effects"]["laser_power_drift"]["sizes"] = {
        "loss_rate": {"value": 1.1 * true, "error": 0.03}
    }
    found = size_errors([Case("c", label, made.answer)], CLASSES)
    assert found["sizes"] == 1
    assert found["bias"] == pytest.approx(0.1)
    assert found["chi2"] == pytest.approx((0.1 * true / 0.03) ** 2)


def test_a_report_has_all_scores_and_says_them() -> None:
    by = {"crack": gap(11.0, 1.0)}
    cases = [
        answered("crack", "crack", by),
        answered("", "", {}, verdict="none"),
        missing("tip_mass"),
        answered("x", "crack", {}, known=False),
    ]
    scores = report(cases, CLASSES)
    assert (scores["cases"], scores["answered"]) == (4, 3)
    assert scores["class_right"]["resolved"]["hits"] == 1
    assert scores["class_right"]["resolved"]["cases"] == 2
    assert scores["by_effect"]["tip_mass"]["answers"] == ["none given"]
    assert scores["by_unknown"]["x"]["right"]["hits"] == 0
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores
    said = "\n".join(sentences(scores))
    assert "3 of 4 cases answered" in said
    assert "False alarms: 0 of 1 " in said


def test_shuffled_labels_score_at_chance() -> None:
    truths = [f"e{k}" for k in range(8)] * 20
    cases = [case(name, {name: 0.9, "none": 0.1}) for name in truths]
    assert named(cases, Classes(())).value == 1.0
    mean, low, high = shuffled(cases, Classes(()))
    assert mean == pytest.approx(1 / 8, abs=0.003)
    # As many are right as of equally many draws with that probability.
    scatter = np.sqrt(7 / 64 / len(cases))
    assert [low, high] == pytest.approx([1 / 8 - 2 * scatter, 1 / 8 + 2 * scatter], abs=0.01)


def test_labels_that_are_all_the_same_cannot_be_shuffled() -> None:
    assert shuffled([case("crack", {"crack": 1.0})] * 5, Classes(())) == (1.0, 1.0, 1.0)
    assert np.isnan(shuffled([], Classes(()))[0])
    assert shuffled([Case("c", Label(1, (("crack", 1.0),), True, 0), None)], CLASSES)[0] == 0.0


def test_what_is_not_answered_is_sure_and_wrong() -> None:
    cases = [case("crack", {"crack": 0.8, "none": 0.2}), missing("crack"), missing("")]
    sure, right = sure_and_right([*cases, case("crack", {"none": 0.7, "crack": 0.3})], CLASSES)
    assert sure.tolist() == [0.8, 1.0, 1.0, 0.7]
    assert right.tolist() == [True, False, False, False]


def test_an_unknown_gap_closes_nothing() -> None:
    gap = {"before": 4.0, "after": 1.0}
    both = answered("crack", "crack", {"crack": gap})
    assert closures([both])["median"] == 1.0
    # The truth stands out, and its gap is unknown.
    none = answered("crack", "crack", {"crack": gap | {"after": None}})
    assert closures([none])["median"] == 0.0


def test_a_reliability_plot_is_drawn() -> None:
    cases = [answered("crack", "crack", {}) for _ in range(20)]
    picture = draw_reliability(cases, CLASSES, "ours")
    assert picture.startswith(b"\x89PNG")
    assert b"tEXtSoftware\0ours" in picture
    assert len(picture) > 5000


def test_what_should_stand_out_does_not_depend_on_whether_it_was_found() -> None:
    label = Label(1, (("laser_power_drift", 4.0),), True, 0)
    (true,) = true_sizes(label)["laser_power_drift"].values()

    def answered(least):
        effects = {"laser_power_drift": {"d_prime": 0.0, "detectable": {"loss_rate": least}}}
        return Case("c", label, {"verdict": "none", "probability": {"none": 1.0}, "likely": [],
                                 "effects": effects})  # fmt: skip

    assert answered(0.9 * abs(true)).foreseen
    assert not answered(1.1 * abs(true)).foreseen
    assert not answered(None).foreseen
    assert not answered(0.9 * abs(true)).resolved
    assert Case("c", label, None).foreseen
    scores = report([answered(0.9 * abs(true)), answered(1.1 * abs(true))], CLASSES)
    assert scores["class_right"]["foreseen"]["cases"] == 1
    assert scores["class_right"]["foreseen"]["hits"] == 0
