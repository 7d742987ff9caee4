"""False alarms against disorder: what counts as one."""

import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from studies.sealed import disorder_curve
from studies.sealed.disorder_curve import CleanBench, answered, line


def given(verdict, none):
    return {"verdict": verdict, "probability_of_what_shows": {"none": none, "crack": 1 - none}}


def test_alarms_are_counted_with_missing_answers():
    found = line(2.0, [given("none", 0.9), given("effect", 0.2), None])
    assert "× 2" in found
    assert "2 of 3 false alarms" in found
    assert "0.55" in found


def test_an_answer_that_is_there_is_not_made_again(tmp_path, monkeypatch):
    bench = CleanBench(0.3, 1)
    (tmp_path / "campaigns" / bench.name).mkdir(parents=True)
    (tmp_path / "answers").mkdir()
    (tmp_path / "answers" / f"{bench.name}.json").write_text('{"verdict": "none"}')
    monkeypatch.setattr(disorder_curve, "recorded", None)
    monkeypatch.setattr(disorder_curve, "answer", None)
    assert answered(bench, tmp_path) == {"verdict": "none"}
