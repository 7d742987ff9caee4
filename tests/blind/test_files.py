"""Sets of cases: keys fit what was sealed, and answers find their case."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from hashlib import sha256

import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind import files
from blind.cases import (
    CUT,
    drawn_label,
    hidden_seed,
)
from blind.files import (
    BlindError,
    answered_cases,
    make_set,
)


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Make a set of three cases without recordings."""
    monkeypatch.setattr(files, "record_case", lambda folder, name, _label: (folder / name).mkdir())
    monkeypatch.setattr(files, "ProcessPoolExecutor", ThreadPoolExecutor)
    make_set(tmp_path / "cases", tmp_path / "key.json", 1, 3, 7)
    return tmp_path


SAID = {
    "verdict": "effect",
    "effects_named": ["crack"],
    "probability": {"none": 0.1, "crack": 0.9},
    "likely": [["crack"]],
    "effects": {"crack": {"d_prime": 7.0, "detectable": {"depth": None},
                          "sizes": {"depth": {"value": 1e-4, "error": 1e-5}}}},
    "explained_fraction": {"by": {"crack": {"before": 4.0, "after": None}}},
}  # fmt: skip


def answer(folder, name, said=SAID):
    (folder / "answers").mkdir(exist_ok=True)
    (folder / "answers" / f"{name}.json").write_text(json.dumps(said))


def test_a_set_holds_names_and_hashes_and_nothing_else(made) -> None:
    sealed = json.loads((made / "cases" / "sealed.json").read_text())
    assert set(sealed) == {"cases"}
    assert all(len(commitment) == 64 for commitment in sealed["cases"].values())
    key = json.loads((made / "key.json").read_text())
    assert set(key["cases"]) == set(sealed["cases"])
    assert {p.name for p in (made / "cases").iterdir()} == {"sealed.json", *sealed["cases"]}


def test_answers_find_their_cases_and_those_without_stand_empty(made) -> None:
    names = list(json.loads((made / "key.json").read_text())["cases"])
    answer(made, names[1])
    cases = answered_cases(made / "cases", made / "answers", made / "key.json")
    assert [case.answer is not None for case in cases] == [name == names[1] for name in names]
    assert all(case.label.known and case.label.effects for case in cases)


def test_a_key_that_was_changed_is_refused(made) -> None:
    key = json.loads((made / "key.json").read_text())
    name = next(iter(key["cases"]))
    answer(made, name)
    key["cases"][name]["label"]["effects"] = [["crack", 1.0]]
    (made / "key.json").write_text(json.dumps(key))
    with pytest.raises(BlindError, match=f"case {name} is not what was sealed"):
        answered_cases(made / "cases", made / "answers", made / "key.json")


def test_bad_input_is_reported(made, tmp_path) -> None:
    with pytest.raises(BlindError, match="answers: there is no folder"):
        answered_cases(made / "cases", made / "answers", made / "key.json")
    (made / "answers").mkdir()
    with pytest.raises(BlindError, match="has no answer to any case"):
        answered_cases(made / "cases", made / "answers", made / "key.json")
    with pytest.raises(BlindError, match="is there already"):
        make_set(made / "cases", tmp_path / "other.json", 1, 3, 7)
    with pytest.raises(BlindError, match="no tier 5; choose one of 0, 1"):
        make_set(tmp_path / "more", tmp_path / "other.json", 5, 3, 7)


@pytest.mark.parametrize("content", ["{}", "[]", "no JSON", '{"elastic": 1}'])
def test_what_is_no_answer_is_reported(made, content) -> None:
    names = list(json.loads((made / "key.json").read_text())["cases"])
    answer(made, names[0])
    (made / "answers" / f"{names[1]}.json").write_text(content)
    with pytest.raises(BlindError, match=names[1]):
        answered_cases(made / "cases", made / "answers", made / "key.json")


@pytest.mark.parametrize(
    ("key", "value", "place"),
    [
        ("verdict", None, "verdict"),
        ("effects_named", "crack", "effects_named"),
        ("probability", [], "probability"),
        ("probability", {"none": None}, "probability.none"),
        ("probability", {"none": float("nan")}, "probability.none"),
        ("likely", ["crack"], "likely.0"),
        ("effects", [], "effects"),
        ("effects", {"crack": {"detectable": {}, "sizes": {}}}, "effects.crack.d_prime"),
        ("explained_fraction", {}, "explained_fraction.by"),
        ("explained_fraction", {"by": {"crack": None}}, "explained_fraction.by.crack"),
    ],
)
def test_an_answer_of_a_wrong_shape_is_reported_by_its_place(made, key, value, place) -> None:
    name = next(iter(json.loads((made / "key.json").read_text())["cases"]))
    answer(made, name, SAID | {key: value})
    with pytest.raises(BlindError, match=rf"{name}\.json: is no answer.*\({place}: "):
        answered_cases(made / "cases", made / "answers", made / "key.json")
    answer(made, name, {k: v for k, v in SAID.items() if k != key})
    with pytest.raises(BlindError, match=rf"\({key}: "):
        answered_cases(made / "cases", made / "answers", made / "key.json")


@pytest.mark.parametrize("content", ["{}", "[1]", '{"cases": {}}', "\xff"])
def test_what_is_no_key_is_reported(made, content) -> None:
    answer(made, next(iter(json.loads((made / "key.json").read_text())["cases"])))
    (made / "key.json").write_bytes(content.encode("latin-1"))
    with pytest.raises(BlindError, match=r"key\.json"):
        answered_cases(made / "cases", made / "answers", made / "key.json")
    (made / "key.json").write_bytes((made / "cases" / "sealed.json").read_bytes())
    with pytest.raises(BlindError, match="is no key"):
        answered_cases(made / "cases", made / "answers", made / "key.json")


def test_nothing_is_left_of_a_set_whose_key_cannot_be_written(tmp_path) -> None:
    with pytest.raises(BlindError, match="cannot be written"):
        make_set(tmp_path / "cases", tmp_path / "nowhere" / "key.json", 1, 3, 7)
    assert not list(tmp_path.iterdir())


def test_no_key_is_left_of_a_set_whose_folder_cannot_be_made(tmp_path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BlindError, match=r"file/cases: cannot be written"):
        make_set(tmp_path / "file" / "cases", tmp_path / "key.json", 1, 3, 7)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def _full(folder, name, label):
    raise OSError(28, "No space left on device")


def test_a_disk_that_is_full_is_reported(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(files, "record_case", _full)
    monkeypatch.setattr(files, "ProcessPoolExecutor", ThreadPoolExecutor)
    with pytest.raises(BlindError, match=r"cases: a case cannot be recorded .*No space left"):
        make_set(tmp_path / "cases", tmp_path / "key.json", 1, 3, 7)


def test_of_a_set_that_is_interrupted_whole_cases_stay(tmp_path, monkeypatch) -> None:
    begun = []

    def record(folder, name, _label):
        begun.append(name)
        if len(begun) == 1:
            (folder / name).mkdir()
            return
        (folder / f"{name}{CUT}").mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "record_case", record)
    monkeypatch.setattr(files, "ProcessPoolExecutor", ThreadPoolExecutor)
    with pytest.raises(KeyboardInterrupt):
        make_set(tmp_path / "cases", tmp_path / "key.json", 1, 9, 7)
    assert {path.name for path in (tmp_path / "cases").iterdir()} == {"sealed.json", begun[0]}


def test_a_nonce_makes_another_seed_of_the_same() -> None:
    seeds = {hidden_seed(7, "a"), hidden_seed(7, "b"), hidden_seed(8, "a")}
    assert len(seeds) == 3
    # Known beforehand: keys that are published draw their labels again.
    assert hidden_seed(7, "a") == int(sha256(b"7 a").hexdigest()[:16], 16)


def test_a_seed_alone_does_not_tell_the_labels(made) -> None:
    key = json.loads((made / "key.json").read_text())
    plain = [json.loads(json.dumps(asdict(drawn_label(1, k, 7)))) for k in range(3)]
    kept = [entry["label"] for entry in key["cases"].values()]
    assert not any(label in kept for label in plain)
    again = [drawn_label(1, k, hidden_seed(7, key["nonce"])) for k in range(3)]
    assert all(json.loads(json.dumps(asdict(label))) in kept for label in again)
