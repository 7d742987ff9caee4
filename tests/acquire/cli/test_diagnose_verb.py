"""`acquire diagnose`: from runs to a page, JSON, and a campaign to run next."""

import pytest

from diagnosis.observable_groups import Observable
from protocols.campaign import CampaignFile, tasks_of


@pytest.mark.slow
def test_one_sweep_becomes_a_page_and_a_next_campaign(cli, measured, folder):
    page, following = folder / "page.html", folder / "next.yaml"
    done = cli("diagnose", measured.a, "--json", "--out", page, "--next", following)
    assert done.status == 0, done.err
    answer = done.json
    assert answer["verdict"] in {"none", "effect", "pair", "unknown", "not converged"}
    assert sum(answer["probability"].values()) == pytest.approx(1.0, abs=1e-3)
    assert set(answer["gap"]["observables"]) <= set(Observable)
    assert len(answer["effects"]) >= 20
    # One sweep says what it cannot say: nothing of the sensor, nor what needs a second sweep.
    assert any("dark frames" in what for what in answer["missing"])
    assert any("second sweep" in what for what in answer["missing"])
    assert "hot_pixels" not in answer["effects"]
    html = page.read_text(encoding="utf-8")
    assert "What to measure next" in html
    assert "more than chance explains" in html
    assert "<svg" in html or "data:image" in html
    best = next(w for w in answer["next"]["experiments"] if w["id"] != "microphone")
    tasks = tasks_of(CampaignFile.from_file(following))
    assert tasks
    assert best["description"].capitalize() in following.read_text(encoding="utf-8")


def test_a_bench_file_of_the_program_is_refused_before_anything_is_fitted(cli, measured):
    done = cli("diagnose", measured.a, "--adopt", "simulated")
    assert done.status == 2
    assert "copy it" in done.err
    assert len(done.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "--published"),
        (["nothing.h5"], "nothing.h5"),
        (["--published", "--next", "next.yaml"], "--next"),
        (["--published", "--bench", "nothing.yaml"], "--bench"),
        (["--published", "--adopt", "nothing.yaml"], "--adopt"),
        (["run.h5", "--adopt", "nothing.yaml"], "nothing.yaml"),
        (["run.h5", "--out", "nowhere/page.html"], "there is no folder nowhere"),
        (["run.h5", "--next", "nowhere/next.yaml"], "with --next"),
        (["."], "holds no run files"),
        (["a.csv", "b.h5"], "--published exclude"),
        (["a.csv", "b.csv"], "2 tables of resonances"),
    ],
)
def test_a_mistake_is_reported_in_one_line(cli, folder, arguments, words):
    done = cli("diagnose", *arguments)
    assert done.status == 2
    assert words in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert not list(folder.iterdir())
