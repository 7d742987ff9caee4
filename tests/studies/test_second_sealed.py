"""Sealed sets of the second laboratory: seals, answers that must be committed, and scores."""

import json
import subprocess

import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind.scoring import NONE, UNKNOWN
from studies.sealed import second_laboratory
from studies.sealed.commitments import committed_answers, hashes_of
from studies.sealed.commitments import main as print_hashes
from studies.sealed.second_laboratory import (
    COUNTS,
    SEALED,
    drawn_set,
    make,
    opened,
    read_cases,
    recorded,
)
from studies.sealed.second_scores import begun, by_level, lines, opened_set


@pytest.fixture(scope="module")
def cases():
    return drawn_set(0.1)


def answer(cases, name, probability, d_prime=9.0):
    case = cases[name].case
    return {
        "verdict": "none" if max(probability, key=probability.get) == NONE else "effect",
        "effects_named": [],
        "probability": probability,
        "likely": [],
        "effects": {each.id: {"d_prime": d_prime} for each in case.effects},
        "explained_fraction": {"by": {}},
    }


def truth(sealed):
    if sealed.case.kind == "unknown":
        return UNKNOWN
    return "+".join(each.id for each in sealed.case.effects) or NONE


def test_a_set_has_cases_of_every_kind_and_level(cases):
    found = [(each.case.kind, each.level) for each in cases.values()]
    assert {pair: found.count(pair) for pair in COUNTS} == {
        pair: round(0.1 * count) for pair, count in COUNTS.items()
    }
    assert sum(COUNTS.values()) == 190
    assert len({each.salt for each in cases.values()}) == len(cases)


def test_two_sets_share_no_seed(cases):
    seeds = {each.case.seed for each in cases.values()}
    assert not seeds & {each.case.seed for each in drawn_set(0.1).values()}


def test_a_key_opens_only_what_it_was_sealed_with(cases, tmp_path):
    make(tmp_path / "cases", tmp_path / "key.json", 0.1)
    sealed = read_cases(tmp_path / "cases" / SEALED)
    key = read_cases(tmp_path / "key.json")
    assert opened(sealed, key).keys() == sealed.keys()
    name = next(name for name, entry in key.items() if entry["case"]["kind"] == "clean")
    key[name]["level"] = "rough" if key[name]["level"] != "rough" else "quiet"
    with pytest.raises(SystemExit):
        opened(sealed, key)


def test_sealed_cases_say_nothing_of_their_labels(tmp_path):
    make(tmp_path / "cases", tmp_path / "key.json", 0.1)
    text = (tmp_path / "cases" / SEALED).read_text(encoding="utf-8")
    for word in ("clean", "single", "quiet", "salt", "seed"):
        assert word not in text


def test_nothing_is_replaced(tmp_path):
    make(tmp_path / "cases", tmp_path / "key.json", 0.1)
    before = (tmp_path / "key.json").read_bytes()
    with pytest.raises(SystemExit):
        make(tmp_path / "others", tmp_path / "key.json", 0.1)
    assert (tmp_path / "key.json").read_bytes() == before


def test_a_case_is_recorded_whole_or_not_at_all(cases, tmp_path, monkeypatch):
    case = next(iter(cases.values())).case

    def interrupted(_case, folder):
        folder.mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(second_laboratory, "record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        recorded(tmp_path / "0.3-1", case)
    # What was begun has the whole name of its case: others are recorded at the same time.
    assert [path.name for path in tmp_path.iterdir()] == ["0.3-1.cut"]


def test_a_campaign_that_ended_early_is_kept_and_said_so(cases, tmp_path, monkeypatch):
    def ended(_case, folder):
        folder.mkdir()
        raise RuntimeError("the campaign ended early")

    monkeypatch.setattr(second_laboratory, "record", ended)
    said = recorded(tmp_path / "one", next(iter(cases.values())).case)
    assert "ended early" in said
    assert [path.name for path in tmp_path.iterdir()] == ["one"]


@pytest.fixture
def repository(tmp_path):
    def git(*asked):
        subprocess.run(
            ["git", "-c", "user.name=x", "-c", "user.email=x@example.org", *asked],
            cwd=tmp_path, check=True, capture_output=True,
        )  # fmt: skip

    git("init")
    (tmp_path / "answers").mkdir()
    for name in ("one", "two"):
        (tmp_path / "answers" / f"{name}.json").write_text(json.dumps({"is": name}))
    return tmp_path, git


def test_answers_are_read_once_their_hashes_are_committed(repository):
    folder, git = repository
    hashes = folder / "answered.json"
    hashes.write_text(json.dumps(hashes_of(folder / "answers")))
    git("add", "answered.json")
    # What is staged is not committed.
    with pytest.raises(SystemExit):
        committed_answers(folder / "answers", hashes)
    git("commit", "-m", "answers")
    assert committed_answers(folder / "answers", hashes)["two"] == {"is": "two"}


def test_another_answer_than_the_committed_one_is_refused(repository):
    folder, git = repository
    hashes = folder / "answered.json"
    hashes.write_text(json.dumps(hashes_of(folder / "answers")))
    git("add", "answered.json")
    git("commit", "-m", "answers")
    (folder / "answers" / "one.json").write_text(json.dumps({"is": "better"}))
    # Nor does it help to change the file of hashes: what counts is committed.
    hashes.write_text(json.dumps(hashes_of(folder / "answers")))
    with pytest.raises(SystemExit):
        committed_answers(folder / "answers", hashes)


def test_what_was_committed_once_stays_whatever_is_committed_later(repository):
    folder, git = repository
    hashes, answers = folder / "answered.json", hashes_of(folder / "answers")
    for name, entries in {
        "a part": {"one": answers["one"]},
        "all": answers,
    }.items():
        hashes.write_text(json.dumps(entries))
        git("add", "answered.json")
        git("commit", "-m", name)
    assert committed_answers(folder / "answers", hashes).keys() == {"one", "two"}
    (folder / "answers" / "one.json").write_text(json.dumps({"is": "better"}))
    hashes.write_text(json.dumps(hashes_of(folder / "answers")))
    git("add", "answered.json")
    git("commit", "-m", "better")
    with pytest.raises(SystemExit, match="earlier commit"):
        committed_answers(folder / "answers", hashes)


def test_a_file_that_was_removed_and_committed_again_is_refused(repository):
    folder, git = repository
    hashes = folder / "answered.json"
    for name in ("first", "again"):
        hashes.write_text(json.dumps(hashes_of(folder / "answers")))
        git("add", "answered.json")
        git("commit", "-m", name)
        if name == "first":
            git("rm", "answered.json")
            git("commit", "-m", "away")
    with pytest.raises(SystemExit, match="earlier commit"):
        committed_answers(folder / "answers", hashes)


@pytest.mark.parametrize("commits", [["answered.json", SEALED], [f"answered.json {SEALED}"]])
def test_a_seal_that_is_no_older_than_its_answers_is_refused(repository, commits):
    folder, git = repository
    (folder / "answered.json").write_text(json.dumps(hashes_of(folder / "answers")))
    (folder / SEALED).write_text(json.dumps({"cases": {}}))
    for names in commits:
        git("add", *names.split())
        git("commit", "-m", names)
    with pytest.raises(SystemExit, match="not committed before"):
        opened_set(folder / "key.json", folder / "answers", folder)


def test_a_missing_answer_is_refused(repository):
    folder, git = repository
    hashes = folder / "answered.json"
    hashes.write_text(json.dumps(hashes_of(folder / "answers")))
    git("add", "answered.json")
    git("commit", "-m", "answers")
    (folder / "answers" / "one.json").unlink()
    with pytest.raises(SystemExit):
        committed_answers(folder / "answers", hashes)


def test_no_key_is_read_before_answers_are_committed(repository):
    folder, git = repository
    hashes = hashes_of(folder / "answers")
    (folder / "answered.json").write_text(json.dumps(hashes))
    (folder / SEALED).write_text(json.dumps({"cases": {}}))
    # The key is not there: what is missed first is not the key.
    with pytest.raises(SystemExit):
        opened_set(folder / "key.json", folder / "answers", folder)
    for name in (SEALED, "answered.json"):
        git("add", name)
        git("commit", "-m", name)
    with pytest.raises(FileNotFoundError):
        opened_set(folder / "key.json", folder / "answers", folder)


def test_a_key_must_fit_the_seal_that_was_committed(repository):
    folder, git = repository
    for name in ("cases", "others"):
        make(folder / name, folder / f"{name}.key.json", 0.1)
    (folder / "answered.json").write_text(json.dumps(hashes_of(folder / "answers")))
    (folder / SEALED).write_bytes((folder / "cases" / SEALED).read_bytes())
    for name in (SEALED, "answered.json"):
        git("add", name)
        git("commit", "-m", name)
    cases, _ = opened_set(folder / "cases.key.json", folder / "answers", folder)
    assert cases.keys() == read_cases(folder / "cases" / SEALED).keys()
    # Another seal in its place, with its own key, opens nothing.
    (folder / SEALED).write_bytes((folder / "others" / SEALED).read_bytes())
    with pytest.raises(SystemExit):
        opened_set(folder / "others.key.json", folder / "answers", folder)


def test_a_set_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(SystemExit):
        committed_answers(tmp_path, tmp_path / "none" / "answered.json")


def test_hashes_of_no_answers_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["commitments", str(tmp_path)])
    with pytest.raises(SystemExit):
        print_hashes()


def test_right_answers_have_the_best_scores(cases):
    answers = {name: answer(cases, name, {truth(cases[name]): 1.0}) for name in cases}
    scores = by_level(cases, answers)
    for level in ("quiet", "ordinary", "rough", "all"):
        own = scores[level]
        assert own["false alarms"]["value"] == 0
        assert own["class right at d' of 5 or more"]["value"] == 1
        assert own["probability on the truth, there"]["value"] == 1
        assert own["sure of a wrong class"]["value"] == 0
        assert own["right where 99 % sure"]["value"] == 1
        assert own["calibration error"]["value"] == 0
    assert scores["all"]["cases"] == len(cases) == len(answers)
    assert len(lines(scores)) == 1 + len(scores["all"])


def test_wrong_and_missing_answers_count_as_wrong(cases):
    answers = {name: answer(cases, name, {"crack": 0.95, NONE: 0.05}) for name in cases}
    clean = [name for name, each in cases.items() if each.case.kind == "clean"]
    del answers[clean[0]]
    scores = by_level(cases, answers)["all"]
    assert scores["false alarms"]["hits"] == scores["false alarms"]["cases"] == len(clean)
    right = sum(truth(each) == "crack" for each in cases.values())
    assert scores["sure of a wrong class"]["hits"] == len(cases) - right
    assert scores["answered"] == len(cases) - 1
    # The missing one counts as sure; 95 % is not sure enough.
    surest = scores["right where 99 % sure"]
    assert (surest["hits"], surest["cases"]) == (0, 1)


def test_of_a_set_that_was_begun_only_cases_that_were_not_asked_are_left_out(cases):
    names = sorted(cases)
    answers: dict[str, dict[str, object]] = {name: {} for name in (*names[:3], names[4])}
    assert list(begun(cases, answers)) == names[:5]


def test_effects_that_do_not_stand_out_are_not_counted(cases):
    answers = {name: answer(cases, name, {truth(cases[name]): 1.0}, 4.9) for name in cases}
    scores = by_level(cases, answers)["all"]
    assert scores["class right at d' of 5 or more"]["cases"] == 0
    assert scores["pairs where both stand out"]["cases"] == 0
