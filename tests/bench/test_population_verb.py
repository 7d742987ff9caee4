"""`acquire population`: a table or a folder of runs in, components of every reed out."""

import csv
from pathlib import Path

import pytest

from fitting.forward import PaperModel, hz_of, viscoelastic_cents
from physics.reed.viscoelastic import Components, Series, viscoelastic_cane

REEDS = {"R1": Components(0.5, -0.4, 0.3, 0.2), "R2": Components(-1.0, 0.6, -0.2, -0.7)}


@pytest.fixture
def table(folder):
    """Resonances of two reeds, exact, by the paper's model."""
    model = PaperModel(iterations=30)
    with Path("reeds.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["reed", "series", "mode", "hz"])
        for name, cane in REEDS.items():
            for series in Series:
                cents = viscoelastic_cents(model, viscoelastic_cane(cane, series), series)
                for mode, hz in zip(model.modes, hz_of(cents), strict=True):
                    out.writerow([name, series, mode, hz])
    return "reeds.csv"


def test_a_table_becomes_components(cli, table):
    said = cli("population", table, "--model", "paper", "--json")
    assert said.status == 0
    assert set(said.json) == {
        "reeds", "resonances", "passed_over", "rms_cents", "components", "flags", "files",
    }  # fmt: skip
    assert said.json["reeds"] == 2
    assert said.json["resonances"] == 44
    assert said.json["files"] == {"components": "reeds-components.csv"}
    with Path("reeds-components.csv").open(newline="") as file:
        rows = {row["reed"]: row for row in csv.DictReader(file)}
    for name, cane in REEDS.items():
        for component in ("e1", "e2", "e3", "e4"):
            expected = getattr(cane, component)
            assert float(rows[name][component]) == pytest.approx(expected, abs=0.01)


def test_people_are_shown_the_same(cli, table):
    said = cli("population", table, "--model", "paper", "--out", "mine.csv")
    assert said.status == 0
    for word in ("2 reeds", "44 resonances", "e4", "mine.csv"):
        assert word in said.out
    assert Path("mine.csv").exists()


def test_a_folder_of_runs_is_fitted(cli, measured, folder):
    said = cli("population", measured.a.parent, "--json", "--out", "components.csv")
    assert said.status == 0
    assert said.json["reeds"] == 1
    table = Path(said.json["files"]["resonances"])
    assert table == measured.a.parent / "resonances.csv"
    table.unlink()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.csv"], "none.csv: No such file"),
        (["reeds.csv", "--model", "magic"], "no forward model 'magic'"),
        (["reeds.csv", "--out", "nowhere/x.csv"], "nowhere/x.csv: No such file"),
    ],
)
def test_mistakes_are_told_in_one_line_and_leave_nothing(cli, table, folder, arguments, words):
    before = sorted(folder.rglob("*"))
    said = cli("population", *arguments)
    assert (said.status, said.out) == (2, "")
    (line,) = [line for line in said.err.splitlines() if "kept for the next time" not in line]
    assert words in line
    assert sorted(folder.rglob("*")) == before
