"""What a diagnosis says of a bench whose truth is known: verdict, words, page and JSON."""

import errno
import html
import json
import math
import os
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis.campaign_diagnosis import (
    CampaignSummary,
    Diagnosis,
    _touched,
    condition_of,
    diagnose_problem,
)
from diagnosis.effect_notes import notes_of
from diagnosis.experiment_design import (
    EXPERIMENTS,
    Experiment,
    RankedExperiment,
    _expected_nats,
    rank_experiments,
    unseen_effects,
)
from diagnosis.explained_fraction import gaps_in_units
from diagnosis.gap_map import LadderStep
from diagnosis.inference.candidates import without_effects
from diagnosis.inference.model_selection import each_alone, signatures_of
from diagnosis.inference.nuisances import Nuisance
from diagnosis.inference.problem import InferenceProblem
from diagnosis.inference.similarity import DETECTION_SIGMA, confusable_classes, detectability_of
from diagnosis.observable_groups import (
    DISORDER,
    Coordinates,
    Errors,
    GroupNuisances,
    Observable,
    observable_group,
)
from physics.effects.catalogue import BY_ID
from physics.parameters.chamber import Filling
from physics.parameters.tree import BenchParameters, with_part
from reports.diagnosis_json import to_json
from reports.diagnosis_page import (
    GROUP_WORDS,
    document,
    words,
    write_page,
)
from reports.errors import OutputFailedError, OutputRefusedError
from reports.figures.gap_map import draw_map
from tests.diagnosis.toy import AT, COUNT, EFFECTS, bench, fitted, measured

SUMMARY = CampaignSummary("t3", ("a second sweep",), ("x.h5: too few good steps",))


def diagnosed(extra: float = 0.0, extra_clock: float = 0.0, **changes: float) -> Diagnosis:
    problem = measured(3, bench(**changes), extra=extra, extra_clock=extra_clock)
    return diagnose_problem(problem, SUMMARY)


@pytest.fixture(scope="module")
def nothing() -> Diagnosis:
    return diagnosed()


@pytest.fixture(scope="module")
def mixed() -> Diagnosis:
    return diagnosed(crosstalk=0.3)


@pytest.fixture(scope="module")
def both() -> Diagnosis:
    return diagnosed(leak=0.3, crosstalk=0.3)


@pytest.fixture(scope="module")
def strange() -> Diagnosis:
    return diagnosed(extra=0.5)


@pytest.fixture(scope="module")
def strange_beside() -> Diagnosis:
    return diagnosed(crosstalk=0.6, extra_clock=0.15)


def test_each_truth_has_its_verdict(nothing, mixed, both, strange) -> None:
    assert (nothing.kind, nothing.effects) == ("none", ())
    assert (mixed.kind, mixed.effects) == ("effect", ("sideband_crosstalk",))
    assert (both.kind, set(both.effects)) == ("pair", {"carrier_leak", "sideband_crosstalk"})
    assert (strange.kind, strange.effects) == ("unknown", ())


def test_probabilities_add_up_and_likely_classes_have_90_percent_and_no_more(
    nothing, mixed, both, strange
) -> None:
    for verdict in (nothing, mixed, both, strange):
        assert sum(verdict.probability.values()) == pytest.approx(1.0)
        given = [sum(verdict.probability[n] for n in group) for group in verdict.likely]
        assert sum(given) >= 0.9
        assert sum(given[:-1]) < 0.9
        assert given == sorted(given, reverse=True)


def test_something_unknown_is_seen_together_with_a_known_effect(strange, strange_beside) -> None:
    assert (strange.unknown_with, strange.unknown_in) == ("none", "lines")
    found = strange_beside
    assert found.kind == "unknown"
    # Alone it would be in the lines, which the next sideband moves.
    worst = max(
        found.selection.group_log_bayes, key=lambda name: found.selection.group_log_bayes[name]
    )
    assert (worst, found.unknown_with, found.unknown_in) == (
        "lines",
        "sideband_crosstalk",
        "clocks",
    )
    p = found.probability_of_what_shows["unknown"]
    for part in (f"({p:.0%})", BY_ID["sideband_crosstalk"].title, "clocks"):
        assert part in words(found)[0]
    answer = to_json(found)["unknown"]
    assert (answer["with"], answer["group"]) == ("sideband_crosstalk", "clocks")


def test_the_first_words_say_what_is_likeliest_and_how_likely(nothing, mixed, both) -> None:
    p = nothing.probability_of_what_shows["none"]
    assert p > 0.9
    assert f"({p:.0%})" in words(nothing)[0]
    p = mixed.probability_of_what_shows["sideband_crosstalk"]
    assert p > 0.5
    title = BY_ID["sideband_crosstalk"].title
    assert f"{title} ({p:.0%})" in words(mixed)[0]
    name = next(n for n in both.probability_of_what_shows if set(n.split("+")) == set(both.effects))
    assert f"({both.probability_of_what_shows[name]:.0%})" in words(both)[0]
    assert title in words(both)[0]


def test_what_is_likeliest_but_not_likely_is_called_so(mixed) -> None:
    name = "sideband_crosstalk"
    shares = {name: 0.31, "none": 0.3, "carrier_leak": 0.15, "unknown": 0.24}
    alone = replace(
        mixed, probability_of_what_shows=shares, shown=((name,), ("none",), ("unknown",))
    )
    cause = f"{BY_ID[name].title} (31%)"
    assert cause in words(alone)[0]
    assert "not certain" in words(alone)[0]
    # With what is confusable it is likelier than not; but not with 0.46.
    together = (name, "carrier_leak")
    assert "not certain" in words(replace(alone, shown=(together, ("none",))))[0]
    shares = shares | {"carrier_leak": 0.25, "unknown": 0.14}
    likelier = replace(alone, probability_of_what_shows=shares, shown=(together, ("none",)))
    assert cause in words(likelier)[0]
    assert "not certain" not in words(likelier)[0]
    # Then both are named, with what they have together and with the size of the likeliest.
    for part in (BY_ID["carrier_leak"].title, "(56%)", f"{cause}, fraction 0."):
        assert part in words(likelier)[0]


def test_words_tell_where_how_far_and_what_was_not_measured(mixed) -> None:
    said = words(mixed)
    assert re.search(r"sideband maps, by \d\.\d times .* in lines", said[2])
    assert any(re.search(r"explains (9\d|100)%.* does not prove the cause", line) for line in said)
    assert said[-2:] == ["Not measured: a second sweep.", "Not used: x.h5: too few good steps."]


def test_json_has_sizes_in_their_units(mixed) -> None:
    answer = to_json(mixed)
    assert json.loads(json.dumps(answer, allow_nan=False)) == answer
    assert answer["effects_named"] == ["sideband_crosstalk"]
    effect_found = answer["effects"]["sideband_crosstalk"]
    size = effect_found["sizes"]["fraction"]
    # With a level that is not known, of numbers with errors of 0.05.
    bump = np.exp(-((AT / 0.2) ** 2)) / 0.05
    level = np.full(COUNT, 2.0) / 0.05
    alone = bump @ bump - (bump @ level) ** 2 / (1 + level @ level)
    assert size["value"] == pytest.approx(0.3, abs=3 / math.sqrt(alone))
    found = mixed.selection.single["sideband_crosstalk"]
    by_noise = found.size_estimates["sideband_crosstalk"][0][0].scale * math.sqrt(
        found.estimate.covariance[-1, -1]
    )
    assert by_noise == pytest.approx(1 / math.sqrt(alone), rel=0.2)
    # The noise, and a form that deviates by a tenth at least in all numbers of a band or a time.
    form = 0.1 * size["value"]
    assert math.hypot(1 / math.sqrt(alone), form) < size["error"]
    assert size["error"] < math.hypot(1 / math.sqrt(alone), 2 * form)
    # The size that would stand out by five deviations, and how far the fitted one does.
    assert effect_found["detectable"]["fraction"] == pytest.approx(5 / math.sqrt(alone), rel=0.01)
    assert effect_found["d_prime"] == pytest.approx(size["value"] * math.sqrt(alone), rel=0.1)
    assert answer["probability"] == dict(
        sorted(answer["probability"].items(), key=lambda item: -item[1])
    )
    assert answer["explained_fraction"]["left_out"]["fraction"] == pytest.approx(1.0, abs=0.15)
    assert answer["missing"] == ["a second sweep"]
    assert answer["gap"]["first_failing_observable"] == "maps"


def rows_of(html: str) -> list[tuple[str, ...]]:
    """Cells of every row of every table."""
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", html, flags=re.DOTALL)
    return [tuple(re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)) for row in rows]


def test_the_page_has_all_of_it(mixed, tmp_path) -> None:
    page = tmp_path / "page.html"
    write_page(mixed, "A <reed>", page, ["up.h5", "dark.h5"])
    html = page.read_text(encoding="utf-8")
    assert html == document(mixed, "A <reed>", ["up.h5", "dark.h5"])
    assert "<h1>A &lt;reed&gt;</h1>" in html
    assert words(mixed)[0] in html
    assert "up.h5, dark.h5" in html
    p = mixed.probability_of_what_shows["sideband_crosstalk"]
    size = to_json(mixed)["effects"]["sideband_crosstalk"]["sizes"]["fraction"]
    row = (
        BY_ID["sideband_crosstalk"].title,
        f"{p:.1%}",
        f"fraction {size['value']:.2g} ± {size['error']:.1g}",
    )
    assert row in {cells[:3] for cells in rows_of(html)}
    ladder = (
        LadderStep(Observable.HOLOGRAM, 0.25, 0.1, 0.05),
        LadderStep(Observable.MAPS, 0.75, 0.9, 0.05),
    )
    html = document(replace(mixed, gap=replace(mixed.gap, ladder=ladder)), "A reed")
    for rung in ladder:
        numbers = (f"{rung.forward:.0%}", f"{rung.backward:.0%}")
        assert any(
            cells[0] == GROUP_WORDS[rung.observable] and cells[1:3] == numbers
            for cells in rows_of(html)
        )
    with pytest.raises(OutputRefusedError, match="choose another place with --out"):
        write_page(mixed, "A reed", tmp_path / "nowhere" / "page.html")


def test_a_sentence_an_action_and_a_picture_are_seen_and_all_else_is_folded(mixed, nothing) -> None:
    for verdict in (mixed, nothing):
        page = document(verdict, "A reed")
        seen = re.sub(r"<details>.*?</details>", "", page, flags=re.DOTALL)
        assert words(verdict)[0] in seen
        assert seen.count("<p") == 2
        assert seen.count("<img") == page.count("<img") == 1
        assert "<table" in page
        assert "<table" not in seen


def test_the_action_fits_the_verdict(mixed, nothing) -> None:
    def action(verdict: Diagnosis) -> str:
        return re.findall(r'<p class="action">(.*?)</p>', document(verdict, "A reed"))[0]

    check = notes_of(BY_ID["sideband_crosstalk"]).check
    assert check in action(mixed)
    assert "--adopt" in action(mixed)
    # A verdict that is not sure needs what separates it from the next one.
    experiment = Experiment("wax", "put wax on the tip", 10.0, (), lambda parameters: parameters)
    best = RankedExperiment(experiment, expected_nats=2.0, nats_per_minute=0.2)
    unsure = replace(mixed, shown=(*mixed.shown, ("none",)), next_experiments=(best,))
    assert "put wax on the tip (10 min)" in action(unsure)
    assert nothing.missing[0] in action(nothing)
    assert "nothing" in action(replace(nothing, missing=(), next_experiments=()))


def test_an_older_page_is_replaced_and_nothing_else(mixed, nothing, tmp_path, monkeypatch) -> None:
    page, mine = tmp_path / "page.html", tmp_path / "mine.html"
    write_page(nothing, "A reed", page)
    write_page(mixed, "A reed", page)
    assert page.read_text(encoding="utf-8") == document(mixed, "A reed")
    mine.write_text("<!doctype html>mine", encoding="utf-8")
    with pytest.raises(OutputRefusedError, match="move it away"):
        write_page(mixed, "A reed", mine)
    assert mine.read_text(encoding="utf-8") == "<!doctype html>mine"

    def refuse(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OutputFailedError, match="No space left"):
        write_page(nothing, "A reed", page)
    assert page.read_text(encoding="utf-8") == document(mixed, "A reed")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.html", "page.html"]


def test_names_are_text_on_the_page_and_in_its_picture(mixed) -> None:
    hostile, shown = "<script>$\\frac$\x1b", "<script>$\\frac$\\x1b"
    cells = tuple(
        replace(cell, label=hostile) if cell.axis != "group" else cell for cell in mixed.gap.cells
    )
    verdict = replace(mixed, gap=replace(mixed.gap, cells=cells), missing=(hostile,))
    page = document(verdict, hostile, [hostile])
    assert "<script" not in page
    assert "\x1b" not in page
    # Title, heading, sentence and sources.
    assert page.count(html.escape(shown)) == 4
    labels = [text.get_text() for ax in draw_map(verdict.gap).axes for text in ax.get_xticklabels()]
    assert shown in labels


def test_sizes_of_two_effects_say_whose_they_are(both) -> None:
    html = document(both, "A reed")
    for effect in both.effects:
        size = to_json(both)["pairs"]["+".join(both.effects)]["sizes"][effect]["fraction"]
        line = f"{BY_ID[effect].title}: fraction {size['value']:.2g} ± {size['error']:.1g}"
        assert line in html
        assert notes_of(BY_ID[effect]).check in html


def test_a_gap_of_nothing_has_no_shares(nothing) -> None:
    assert "the gap is not divided among stages" in document(nothing, "A reed")


def test_the_map_is_in_the_order_of_taps(mixed) -> None:
    axes = draw_map(mixed.gap).axes
    rows = [label.get_text() for label in axes[0].get_yticklabels()]
    assert rows == ["clocks  hologram", "lines  maps"]


def test_the_sweep_that_is_left_out_is_of_another_clamping_or_the_weakest() -> None:
    def sweeps(*named_sweeps):
        return SimpleNamespace(
            sweeps=[
                SimpleNamespace(name=name, clamping=clamping, loudness=loudness)
                for name, clamping, loudness in named_sweeps
            ]
        )

    assert condition_of(sweeps(("up", 0, 1.0))) == ""
    assert condition_of(sweeps(("up", 0, 1.0), ("quiet", 0, -0.4), ("down", 0, 1.0))) == "quiet"
    assert (
        condition_of(sweeps(("up", 0, 1.0), ("again", 1, 1.0), ("last", 2, 1.0), ("q", 0, -1.0)))
        == "last"
    )


def test_an_optimum_that_one_start_alone_has_found_is_searched_for_again(monkeypatch) -> None:
    def found_once(problem, starts):
        found = without_effects(problem, starts)
        alone = replace(found.estimate, consistent_starts=1, starts=3)
        return replace(found, estimate=alone)

    monkeypatch.setattr("diagnosis.campaign_diagnosis.without_effects", found_once)
    found = diagnosed()
    assert found.selection.null.estimate.converged
    assert found.kind == "none"


def test_what_an_effect_touches_is_what_nuisances_do_not() -> None:
    # The level, far from where it usually is, is of no effect.
    problem = measured(3, bench(fade_per_h=9.0, crosstalk=0.5))
    null = fitted(problem)
    bump = fitted(problem, EFFECTS[1])
    touched = _touched(problem, null, bump)
    size = EFFECTS[1].sizes[0].scale * bump.sizes[0]
    moved = size * np.exp(-((AT / 0.2) ** 2)) / 0.05
    expected = np.concatenate([moved, np.zeros(20)]) > 0.5
    assert (touched == (expected | (np.abs(null.whitened_residual) > 3))).all()
    assert 10 < np.count_nonzero(touched) < 40


def test_gaps_are_reported_in_units_that_people_know() -> None:
    """Two nepers, three cents, and shares of shapes, of which an effect takes half."""
    places = [
        Coordinates("force"),
        Coordinates("frequency, cents"),
        Coordinates("share of F2"),
        Coordinates("share of T1"),
        Coordinates("no one's"),
    ]
    half = np.array([1.0, 1.5, 0.1, 0.2, 1.0])
    none = Nuisance("none", "", 1.0, lambda parameters, _: parameters, "nothing")
    numbers = observable_group(
        "all",
        Observable.MODES,
        2 * half,
        np.full(5, 0.01),
        places,
        ("optics",),
        lambda parameters: parameters.optics.interference.leak * half,
    )
    problem = InferenceProblem([numbers], BenchParameters(), (none,))
    null = fitted(problem)
    candidate = replace(
        null, estimate=replace(null.estimate, residuals=null.estimate.residuals / 2)
    )
    by_quantity = {gap.quantity: gap for gap in gaps_in_units(problem, null, candidate)}
    assert set(by_quantity) == {"response, dB", "resonances, cents", "shapes, 1 - MAC"}
    decibels = by_quantity["response, dB"]
    # A neper is 8.686 dB.
    assert (decibels.before, decibels.after) == pytest.approx((2 * 8.6859, 8.6859), rel=1e-4)
    assert decibels.error == pytest.approx(0.086859, rel=1e-4)
    cents = by_quantity["resonances, cents"]
    assert (cents.before, cents.after, cents.error) == pytest.approx((3.0, 1.5, 0.01))
    # What a shape has of others adds up.
    shapes = by_quantity["shapes, 1 - MAC"]
    assert shapes.before == pytest.approx(0.2**2 + 0.4**2)
    assert shapes.after == pytest.approx(0.1**2 + 0.2**2)


def test_actions_are_ranked_by_what_they_tell_in_a_minute() -> None:
    problem = measured(3, bench(leak=0.3))
    slope, bump = (fitted(problem, EFFECTS[k]) for k in (0, 1))

    def same(parameters: BenchParameters) -> BenchParameters:
        return parameters

    known, long, sharp, other = (
        Experiment("known", "", 10.0, ("lines",), same),
        Experiment("long", "", 20.0, ("lines",), same),
        Experiment("sharp", "", 10.0, ("lines",), same, sd_factor=0.5),
        Experiment("other", "", 10.0, ("no such block",), same),
    )
    worths = rank_experiments(problem, slope, bump, (long, other, known, sharp))
    assert [worth.experiment.id for worth in worths] == ["sharp", "known", "long"]
    by_id = {worth.experiment.id: worth for worth in worths}
    assert by_id["known"].expected_nats == pytest.approx(by_id["long"].expected_nats)
    assert by_id["known"].nats_per_minute == pytest.approx(by_id["known"].expected_nats / 10)
    # As many nats as half the square of the distance between predictions of all numbers, less
    # for what is uncertain of them.
    lines = problem.groups[0]
    apart = lines.predict(slope.parameters(problem)) - lines.predict(bump.parameters(problem))
    most = 0.5 * float(np.sum((apart / 0.05) ** 2))
    assert 0.2 * most < by_id["known"].expected_nats < most


@pytest.mark.parametrize("common", [0.0, 0.1, 10.0])
def test_repeating_does_not_measure_what_all_repeats_have_in_common(common: float) -> None:
    """Such as the gain of a camera: two candidates differ by as much as it may be off."""
    level = GroupNuisances("gain", np.full((3, 1), common), DISORDER, "toy")
    group = observable_group(
        "lines", Observable.SENSOR, np.zeros(3), Errors(np.full(3, 0.1), (level,)),
        [Coordinates("gain")] * 3, ("optics",),
        lambda parameters: np.full(3, parameters.optics.interference.leak),
    )  # fmt: skip
    none = Nuisance("none", "", 1.0, lambda parameters, _: parameters, "nothing")
    problem = InferenceProblem([group], BenchParameters(), (none,))
    null = fitted(problem)
    models = BenchParameters(), with_part(BenchParameters(), "optics.interference", leak=0.3)

    def same(parameters: BenchParameters) -> BenchParameters:
        return parameters

    repeat = Experiment("repeat", "", 10.0, ("lines",), same)
    found = _expected_nats(problem, group, null, models, repeat)
    # Of the mean of three: what one more repeat adds to one, by the formula of two numbers.
    noise, own = 0.1**2 / 3, common**2
    both = 0.5 * 0.3**2 / (noise / 2 + own)
    assert found == pytest.approx(both - 0.5 * 0.3**2 / (noise + own), rel=1e-6)


def test_clay_is_taken_out_only_where_there_is_some() -> None:
    (without,) = (each for each in EXPERIMENTS if each.id == "without_clay")
    for filling in Filling:
        parameters = with_part(BenchParameters(), "chamber", filling=filling)
        assert without.possible(parameters) == (filling is Filling.ASYMMETRIC)


def test_what_would_show_an_effect_that_is_too_small() -> None:
    """A slope of at most 0.02: five of 60 numbers' standard errors need 2.8 of it."""
    problem, null = measured(3, bench()), fitted(measured(3, bench()))
    (size,) = EFFECTS[0].parameters
    small = replace(EFFECTS[0], parameters=(replace(size, most=0.02),))
    effects = (small, EFFECTS[1], EFFECTS[3])
    alone = each_alone(problem, null, effects)
    reach = detectability_of(effects, signatures_of(null, alone))

    def same(parameters: BenchParameters) -> BenchParameters:
        return parameters

    repeat = Experiment("repeat", "", 10.0, ("lines", "clocks"), same)
    sharp = Experiment("sharp", "", 30.0, ("lines",), same, sd_factor=0.1)
    slope, nothing = unseen_effects(problem, null, effects, reach, (repeat, sharp))
    assert (slope.effect, nothing.effect) == ("slope", "nothing")
    expected = 0.02 * np.sqrt(np.sum(AT**2) + 0.09 * np.sum(AT[:20] ** 2)) / 0.05
    assert slope.deviations == pytest.approx(expected, rel=0.02)
    # A hundred times the nats, but for what the level is uncertain by.
    assert (slope.experiment, slope.times, slope.minutes) == (sharp, 1, 30.0)
    again = unseen_effects(problem, null, effects, reach, (repeat,))[0]
    assert again.times == pytest.approx(25 / expected**2, abs=1.0)
    assert again.minutes == 10.0 * again.times
    # It changes nothing, whatever is done.
    assert (nothing.experiment, nothing.times, nothing.minutes) == (None, 0, 0.0)
    assert nothing.deviations == 0.0


def test_a_class_holds_similar_effects_and_the_detectable_size_is_five_deviations() -> None:
    east = np.array([[1.0], [0.0], [0.0]])
    near = np.array([[0.9], [math.sqrt(1 - 0.81)], [0.0]])
    # Similar to the second alone: cosines of 0.9, 0.9 and 0.62.
    far = np.array([[0.62], [math.sqrt(1 - 0.62**2)], [0.0]])
    signatures = {
        name: (table, table)
        for name, table in (("air_load", east), ("density", near), ("viscoelastic_stiffening", far))
    }
    effects = [BY_ID[name] for name in (*signatures, "crack")]
    reach = detectability_of(effects, signatures)
    classes = confusable_classes(reach)
    assert sorted(map(len, classes)) == [1, 1, 2]
    of = {entry.effect: entry for entry in reach}
    assert set(of["density"].confusable) == {"air_load", "viscoelastic_stiffening"}
    (parameter,) = BY_ID["density"].sizes
    # A deviation of the prior moves by one deviation of the noise.
    assert of["density"].detectable["density"] == pytest.approx(DETECTION_SIGMA * parameter.scale)
    assert math.isinf(of["crack"].detectable["depth"])
    half = detectability_of([BY_ID["density"]], {"density": (near, near / 2)})[0]
    assert half.absorbed == pytest.approx(0.75)
    assert half.detectable["density"] == pytest.approx(2 * DETECTION_SIGMA * parameter.scale)
