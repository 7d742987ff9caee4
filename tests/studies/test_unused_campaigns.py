"""What adopted effects explain on a campaign that was not used to find them."""

import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind.scoring import NONE
from studies.sealed import unused_campaigns
from studies.sealed.second_laboratory import drawn_set
from studies.sealed.unused_campaigns import Closed, closed_on_next, named_rightly


@pytest.fixture(scope="module")
def cases():
    return drawn_set(0.1)


def answer(probability, named, d_prime=9.0):
    return {
        "verdict": "effect",
        "effects_named": named,
        "probability": probability,
        "effects": {name: {"d_prime": d_prime} for name in named},
    }


def test_only_visible_effects_that_were_named_are_taken(cases):
    answers, expected = {}, set()
    for number, (name, each) in enumerate(cases.items()):
        true = [effect.id for effect in each.case.effects]
        right = each.case.kind in ("single", "pair") and number % 2 == 0
        if right:
            expected.add(name)
        answers[name] = answer({"+".join(true) if right else NONE: 1.0}, true if right else [])
    assert expected
    assert set(named_rightly(cases, answers)) == expected
    faint = {name: {**each, "effects": {}} for name, each in answers.items()}
    assert not list(named_rightly(cases, faint))


def test_a_ratio_needs_a_gap_and_an_oracle():
    assert Closed(0.6, 0.5, 0.7, 0.8).ratio == pytest.approx(0.75)
    assert Closed(None, None, None, 0.8).ratio is None
    assert Closed(0.6, 0.5, 0.7, None).ratio is None


def test_what_was_adopted_is_compared_with_the_truth_on_the_next_campaign(
    cases, tmp_path, monkeypatch
):
    sealed = next(each for each in cases.values() if each.case.kind == "pair")
    first, second = (each.id for each in sealed.case.effects)
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "a.h5").touch()
    measured = []

    class FakeRun:
        bench_text = "name: bench\n"

        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

    def diagnosed(kept, campaigns, *options):
        gap = {"fraction": 0.8, "before": 3.0, "after": 1.4}
        measured.append((campaigns[0].name, *options[:1]))
        return {
            "adopted": {first: {}},
            "known": {"explained_fraction": {"fraction": 0.6, "low": 0.5, "high": 0.7}},
            "explained_fraction": {
                "by": {first: {**gap, "fraction": 0.1}, f"{second}+{first}": gap}
            },
        }

    monkeypatch.setattr(unused_campaigns.Run, "open", lambda _path: FakeRun())
    monkeypatch.setattr(unused_campaigns, "diagnosed", diagnosed)
    monkeypatch.setattr(unused_campaigns.BenchFile, "from_file", lambda path: path)
    days = []

    def recorded(folder, _case, repeat, bench):
        days.append((repeat, bench.name))
        folder.mkdir()

    monkeypatch.setattr(unused_campaigns, "recorded", recorded)
    found = closed_on_next(sealed, tmp_path / "case", tmp_path / "work")
    assert found == Closed(0.6, 0.5, 0.7, 0.8)
    # On another day, with the bench file into which the cause was adopted.
    assert days == [(1, "bench.yaml")]
    assert measured == [("case", "--adopt"), ("next",), ("next", "--bench")]
