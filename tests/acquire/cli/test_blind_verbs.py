"""`acquire blind score`: sets of answers become scores in words, JSON and a picture."""

import json

import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind.cases import drawn_label, seal


@pytest.fixture
def sets(folder):
    """Make two clean cases, of which one was answered, and three sick ones, all taken for clean."""
    return _made(folder, 0, 2, 1), _made(folder, 1, 3, 3)


def _made(folder, tier, count, answered):
    sealed, kept = seal([drawn_label(tier, number, 11) for number in range(count)])
    made, answers, key = (folder / f"{what}{tier}" for what in ("cases", "answers", "key.json"))
    made.mkdir()
    answers.mkdir()
    (made / "sealed.json").write_text(json.dumps(sealed))
    key.write_text(json.dumps(kept))
    said = {"verdict": "none", "probability": {"none": 0.9, "unknown": 0.1}, "likely": [["none"]],
            "effects": {}, "effects_named": [], "explained_fraction": {"by": {}}}  # fmt: skip
    for name in list(sealed["cases"])[:answered]:
        (answers / f"{name}.json").write_text(json.dumps(said))
    return made, answers, key


def _options(*made):
    folders, answers, keys = zip(*made, strict=True)
    options = [word for path in answers for word in ("--answers", path)]
    return [*folders, *options, *(word for path in keys for word in ("--key", path))]


def test_one_set_is_scored_in_words_and_json(cli, folder, sets):
    picture = folder / "plot.png"
    done = cli("blind", "score", *_options(sets[0]), "--json", "--picture", picture)
    assert done.status == 0, done.err
    alarms = done.json["false_alarms"]
    # What was not answered is an alarm.
    assert (alarms["hits"], alarms["cases"]) == (1, 2)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "False alarms: 1 of 2 (50%" in cli("blind", "score", *_options(sets[0])).out


def test_sets_are_scored_as_one(cli, sets):
    answer = cli("blind", "score", *_options(*sets), "--json").json
    assert (answer["cases"], answer["answered"]) == (5, 4)
    assert answer["false_alarms"]["cases"] == 2
    assert answer["class_right"]["all"] == pytest.approx(
        {"hits": 0, "cases": 3, "low": 0.0, "high": 0.5615, "share": 0.0}, abs=1e-4
    )
    # Sure by 0.9 in four, by 1 in the fifth, and right once.
    assert answer["calibration_error"] == pytest.approx((0.1 + 3 * 0.9 + 1) / 5)


def test_a_key_of_another_set_and_too_few_keys_are_bad_input(cli, sets):
    (made, answers, _), (_, _, key) = sets
    done = cli("blind", "score", made, "--answers", answers, "--key", key)
    assert (done.status, done.out) == (2, "")
    assert "is the key of other cases" in done.err
    done = cli("blind", "score", made, made, "--answers", answers, "--key", key)
    assert done.status == 2
    assert "2 sets of cases, 1 --answers and 1 --key" in done.err


@pytest.mark.parametrize(
    ("picture", "words"),
    [(".", "ends in .png"), ("a.txt", "ends in .png"), ("none/a.png", "there is no folder none")],
)
def test_a_picture_that_cannot_be_drawn_is_reported_before_anything_is_scored(
    cli, sets, picture, words
):
    done = cli("blind", "score", *_options(sets[0]), "--picture", picture)
    assert (done.status, done.out) == (2, "")
    assert words in done.err


def test_no_case_counts_twice(cli, sets):
    done = cli("blind", "score", *_options(sets[0], sets[0]))
    assert (done.status, done.out) == (2, "")
    assert "is in two sets; give each set once" in done.err
