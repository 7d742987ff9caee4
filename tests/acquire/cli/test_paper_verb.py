"""`acquire paper`: what it prints and writes, and how it refuses; computed elsewhere."""

import json

import pytest

from reproduction.rows import (
    Group,
    from_text,
    not_reproducible,
)
from reproduction.whole import PaperComparison

ROWS = (
    from_text("Table 1", "x", 5, 5.1, 0.2, "Hz"),
    from_text("Table 1", "y", 5, 6, 0.2, "Hz"),
    not_reproducible("Table 1", "z", 5, "Hz", "no data"),
)


@pytest.fixture
def computed(monkeypatch):
    """How often the comparison was computed; it takes a minute in earnest."""
    calls = []

    def compare(announce):
        calls.append(announce)
        announce("solving finite elements")
        group = Group("numbers", "Numbers: some", "How.", ROWS)
        return PaperComparison((group,), ("One finding.",))

    monkeypatch.setattr("reproduction.whole.compare_paper", compare)
    return calls


def test_the_page_is_written_and_summed_up(cli, folder, computed):
    answer = cli("paper", "--out", "here.html")
    assert answer.status == 0, answer.err
    assert (folder / "here.html").read_text(encoding="utf-8").startswith("<!doctype html>")
    assert "here.html" in answer.out
    assert "- One finding." in answer.out
    line = next(line for line in answer.out.splitlines() if "Numbers" in line)
    assert [word for word in line.split() if word.isdigit()] == ["1", "1", "0", "1", "0"]
    assert "solving finite elements" in answer.err
    assert "solving" not in answer.out


def test_without_a_place_it_is_written_here(cli, folder, computed):
    assert cli("paper").status == 0
    assert [path.name for path in folder.iterdir()] == ["paper.html"]


def test_json_is_all_there_is(cli, folder, computed):
    answer = cli("paper", "--json")
    assert answer.status == 0
    assert list(folder.iterdir()) == []
    assert list(answer.json) == ["counts", "findings", "groups", "page"]
    assert answer.json["page"] is None
    assert answer.json["counts"]["reproduced"] == 1
    assert answer.json["findings"] == ["One finding."]
    (group,) = answer.json["groups"]
    assert [row["agreement"] for row in group["rows"]] == [
        "reproduced",
        "differs",
        "not reproducible",
    ]
    assert json.dumps(answer.json, allow_nan=False)


def test_json_and_page_go_together(cli, folder, computed):
    answer = cli("paper", "--json", "--out", "page.html")
    assert answer.json["page"] == "page.html"
    assert (folder / "page.html").exists()


@pytest.mark.parametrize(
    ("place", "words"), [("nowhere/page.html", "there is no folder nowhere"), (".", "a folder")]
)
def test_a_place_that_cannot_be_written_is_refused_at_once(cli, folder, computed, place, words):
    answer = cli("paper", "--out", place)
    assert answer.status == 2
    assert answer.out == ""
    (line,) = answer.err.strip().splitlines()
    assert words in line
    assert "choose another place with --out" in line
    assert computed == []


def test_help_names_its_options(cli):
    text = cli("paper", "--help").out
    assert "--out" in text
    assert "--json" in text
