"""`acquire population`: a table or a folder of runs in, components of every reed out."""

import csv
import shutil
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from drivers.simulated.settings import Simulation
from fitting.acoustics.lines import SeenPeak, SweepPeaks, acoustic_lines
from fitting.acoustics.poles import ExcitationPeak
from fitting.forward import (
    PaperModel,
    hz_of,
    viscoelastic_cents,
)
from fitting.populations.table import Measured
from fitting.statistics.synthetic import modal_cents
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    viscoelastic_cane,
)
from physics.reed.reduced.stored import reduced_reed
from physics.reed.reduction.log_polynomial import finite_element_polynomial
from protocols.reed import ReedFile

COARSE = Simulation(mesh="coarse").finite_elements
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


@pytest.mark.slow
def test_a_folder_of_runs_is_fitted(cli, measured, folder):
    said = cli("population", measured.a.parent, "--json", "--out", "components.csv")
    assert said.status == 0
    assert said.json["reeds"] == 1
    # One reed shows no common line.
    assert said.json["acoustic_lines"] == []
    table = Path(said.json["files"]["resonances"])
    assert table == measured.a.parent / "resonances.csv"
    table.unlink()


def test_acoustic_lines_of_a_folder_are_reported(cli, folder, monkeypatch, measured):
    asked = []
    peak = ExcitationPeak(4285.0, 3.0, 25.0, 1.0, 0.0, 0.0, 8.5, 0.3)
    sweeps = [
        SweepPeaks(f"R{k}", 1e3, 2e4, (SeenPeak(f"R{k}", "run.h5", peak, None),) * (k < 4))
        for k in range(5)
    ]
    lines = tuple(acoustic_lines(sweeps))

    def write(source, table, announce, method):
        asked.append(method)
        shutil.copy("reeds.csv", table)
        return Measured(ReedFile.from_file(), (), 5, lines)

    monkeypatch.setattr("acquire.analysis.write_resonances", write)
    columns = "reed,series,mode,hz,error_cents,run"
    Path("reeds.csv").write_text(f"{columns}\nR1,A,F1,1850,3,R1.h5\n")
    Path("runs").mkdir()
    said = cli("population", "runs", "--model", "paper", "--method", "picture")
    assert "4285.0 ± 1.5 Hz (+8.5 dB): 4 of 5 reeds" in said.out
    answer = cli("population", "runs", "--model", "paper", "--json").json
    (line,) = answer["acoustic_lines"]
    assert (line["hz"], line["reeds"], line["of"]) == (pytest.approx(4285.0), 4, 5)
    assert line["verdict"] == "bench"
    assert asked == ["picture", "joint"]


def test_a_table_is_not_fitted_in_any_way(cli, table):
    said = cli("population", table, "--method", "picture")
    assert (said.status, said.out) == (2, "")
    assert "method: a table already holds resonances; leave it out" in said.err


@pytest.mark.slow
def test_a_population_of_another_reed_is_fitted_with_its_modes(cli, folder, monkeypatch):
    asked = []

    def note(kind, announce=None):
        asked.append(kind.name)
        return reduced_reed(kind.geometry(), *COARSE, announce)

    monkeypatch.setattr("fitting.populations.table.basis_of", note)
    bass = ReedFile.from_file("bass-clarinet")
    model = finite_element_polynomial(reduced_reed(bass.geometry(), *COARSE))
    components = np.array([[e.e1, e.e2, e.e3, e.e4] for e in REEDS.values()])
    cents = modal_cents(components, model)
    with Path("bass.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["reed", "series", "mode", "hz"])
        for (reed, name), (s, series), (m, mode) in product(
            enumerate(REEDS), enumerate(Series), enumerate(model.modes)
        ):
            out.writerow([name, series, mode, hz_of(cents[reed, s, m])])
    said = cli("population", "bass.csv", "--kind", "bass-clarinet", "--json")
    assert said.status == 0
    assert asked == ["bass clarinet"]
    with Path("bass-components.csv").open(newline="") as file:
        rows = {row["reed"]: row for row in csv.DictReader(file)}
    for name, cane in REEDS.items():
        for component in ("e1", "e2", "e3", "e4"):
            expected = getattr(cane, component)
            assert float(rows[name][component]) == pytest.approx(expected, abs=0.02)


def test_run_files_say_themselves_which_reed_they_measured(cli, measured, folder):
    said = cli("population", measured.a.parent, "--kind", "clarinet")
    assert (said.status, said.out) == (2, "")
    assert "run files say which reed they measured; leave it out" in said.err


def test_runs_of_several_kinds_are_no_population(cli, measured, folder, resealed):
    for run in (measured.a, measured.b):
        shutil.copy(run, folder)
    with resealed(folder / measured.b.name) as file:
        del file["entry/provenance/reed"]
        file["entry/provenance/reed"] = ReedFile.from_file("bass-clarinet").text
    said = cli("population", folder)
    assert (said.status, said.out) == (2, "")
    assert "several kinds of reeds (clarinet in" in said.err
    assert "bass clarinet in" in said.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["reeds.csv", "--kind", "bassoon"], "bassoon: there is no such file, nor a shipped reed"),
        (
            ["reeds.csv", "--kind", "alto-saxophone", "--model", "paper"],
            "is that of its clarinet reed, and this is another: alto saxophone; choose --model fem",
        ),
        (["none.csv"], "none.csv: No such file"),
        (["reeds.csv", "--model", "magic"], "no forward model 'magic'"),
        (
            ["reeds.csv", "--out", "nowhere/x.csv"],
            "nowhere/x.csv: cannot be written (there is no folder",
        ),
    ],
)
def test_mistakes_are_reported_in_one_line_and_leave_nothing(cli, table, folder, arguments, words):
    before = sorted(folder.rglob("*"))
    said = cli("population", *arguments)
    assert (said.status, said.out) == (2, "")
    (line,) = [line for line in said.err.splitlines() if "kept for the next time" not in line]
    assert words in line
    assert sorted(folder.rglob("*")) == before
