"""What a proposed measurement is worth: which cases are taken, and what is compared."""

import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind.scoring import NONE
from diagnosis.experiment_design import EXPERIMENTS
from studies.sealed import next_campaigns
from studies.sealed.answer_cases import diagnosed
from studies.sealed.next_campaigns import PLAYABLE, Worth, sweeps_of, unsure, worth_of
from studies.sealed.second_laboratory import drawn_set


@pytest.fixture(scope="module")
def cases():
    return drawn_set(0.1)


def giving(sealed, probability):
    true = "+".join(each.id for each in sealed.case.effects) or NONE
    rest = {"hot_pixels": 1 - probability} if true != "hot_pixels" else {"vignetting": 0.0}
    return {"verdict": "effect", "probability": {true: probability, **rest}}


def test_cases_are_taken_in_which_more_data_can_help(cases):
    for given, taken in ((0.04, False), (0.5, True), (0.95, False)):
        answers = {name: giving(each, given) for name, each in cases.items()}
        known = {name for name, each in cases.items() if each.case.kind in ("single", "pair")}
        assert set(unsure(cases, answers)) == (known if taken else set())


def test_more_of_the_same_takes_as_long_as_what_is_proposed():
    assert len(sweeps_of(10.0).campaign_parts) == 4
    assert len(sweeps_of(5.0).campaign_parts) == 2
    assert len(sweeps_of(2.0).campaign_parts) == 1


def test_what_hands_can_do_are_experiments_that_software_runs():
    for name in PLAYABLE:
        (found,) = [each for each in EXPERIMENTS if each.id == name]
        assert found.campaign_parts


def fakes(monkeypatch, sealed, proposed):
    asked = []

    class FakeRun:
        protocol_text, reed = "", "R1"

        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

    def answer(kept, campaigns, *_options):
        asked.append([campaign.name for campaign in campaigns])
        given = {"before": 0.5, "next": 0.8, "same": 0.6}[kept.stem]
        experiments = [{"id": "microphone", "minutes": 15.0}, {"id": proposed, "minutes": 2.0}]
        return giving(sealed, given) | {"next": {"experiments": experiments}}

    monkeypatch.setattr(next_campaigns.Run, "open", lambda _path: FakeRun())
    monkeypatch.setattr(next_campaigns, "diagnosed", answer)
    monkeypatch.setattr(next_campaigns, "write_next", lambda *_: None)
    monkeypatch.setattr(next_campaigns, "load_campaign", lambda path: path)
    monkeypatch.setattr(
        next_campaigns, "recorded", lambda folder, _case, repeat, campaign: folder.mkdir()
    )
    return asked


def test_both_are_measured_and_diagnosed_with_the_first_campaign(cases, tmp_path, monkeypatch):
    sealed = next(each for each in cases.values() if each.case.kind == "pair")
    asked = fakes(monkeypatch, sealed, "long_rest")
    found = worth_of(sealed, tmp_path / "case", tmp_path / "work")
    # What software cannot run is passed over.
    assert found == Worth("long_rest", 2.0, 0.5, 0.8, 0.6)
    assert asked == [["case"], ["case", "next"], ["case", "same"]]


def test_what_hands_cannot_do_is_said_so(cases, tmp_path, monkeypatch):
    sealed = next(each for each in cases.values() if each.case.kind == "single")
    fakes(monkeypatch, sealed, "known_mass")
    found = worth_of(sealed, tmp_path / "case", tmp_path / "work")
    assert (found.experiment, found.after, found.repeated) == ("known_mass", None, None)


def test_an_answer_that_is_kept_is_read(tmp_path):
    (tmp_path / "kept.json").write_text('{"verdict": "none"}')
    assert diagnosed(tmp_path / "kept.json", [tmp_path / "none"]) == {"verdict": "none"}


def test_what_cannot_be_diagnosed_ends_with_the_reason(tmp_path):
    with pytest.raises(SystemExit, match="nothing"):
        diagnosed(tmp_path / "kept.json", [tmp_path / "nothing"])
    assert not (tmp_path / "kept.json").exists()
