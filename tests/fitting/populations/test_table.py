"""Tables of resonances: what is read, what is refused, and what a population's fit writes."""

import csv
import io
from itertools import product
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from fitting.acoustics.lines import SeenPeak, SweepPeaks
from fitting.acoustics.poles import ExcitationPeak
from fitting.cane.fit_runs import FIT_SWEEP
from fitting.errors import FitInputError
from fitting.forward import cents_of, hz_of
from fitting.paper.constants import adjusted_metamodel
from fitting.populations.population import fit_population
from fitting.populations.resonance_table import GRID_ERROR_CENTS, read_resonances
from fitting.populations.table import PopulationSummary, fit_table, metamodel_of
from fitting.resonance import Resonance
from fitting.statistics.synthetic import draw_components, observe
from physics.reed.mode_classification import PAPER_MODES
from protocols.reed import ReedFile
from reports.errors import OutputRefusedError
from reports.population_tables import (
    components_output,
    opened_table,
    remarks,
    write_components,
    write_resonances,
)
from runs.errors import RunFileError

METAMODEL = adjusted_metamodel(PAPER_MODES)
HEAD = "reed,series,mode,hz\n"


@pytest.fixture
def table(tmp_path):
    """Return a function that writes a table of resonances."""

    def write(text, name="table.csv"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8", newline="")
        return path

    return write


@pytest.fixture
def population(table):
    """A table of seven reeds, their components, and their resonances in cents."""
    rng = np.random.default_rng(4)
    components = draw_components(7, rng)
    cents = observe(components, METAMODEL, rng)
    cents[3, 1] = np.nan
    lines = [
        f"R{n},{series},{name},{hz_of(cents[n, s, m]):.6f}\n"
        for n in range(7)
        for s, series in enumerate("AB")
        for m, name in enumerate(PAPER_MODES)
        if np.isfinite(cents[n, s, m])
    ]
    return table(HEAD + "".join(lines)), components, cents


def fitted(path, metamodel=METAMODEL):
    out = io.StringIO(components_output(path).kind.mark)
    out.seek(0, io.SEEK_END)
    summary = fit_table(path, metamodel, lambda reeds, fit: write_components(out, reeds, fit))
    return summary, list(csv.DictReader(io.StringIO(out.getvalue())))


@pytest.mark.parametrize("reeds", [1, 3, 8192])
def test_a_table_is_read_in_pieces_and_nothing_is_lost(population, reeds):
    path, _, cents = population
    pieces = list(read_resonances(path, PAPER_MODES, reeds))
    assert max(len(piece.reeds) for piece in pieces) <= reeds
    assert [name for piece in pieces for name in piece.reeds] == [f"R{n}" for n in range(7)]
    np.testing.assert_allclose(np.concatenate([p.cents for p in pieces]), cents, atol=1e-4)
    assert all((piece.error_cents == GRID_ERROR_CENTS).all() for piece in pieces)


def test_errors_and_foreign_modes_are_read(table):
    text = "mode,hz,error_cents,series,reed\nF1,2000,3,A,x\nX6,17000,3,A,x\nF1,1990,4,B,x\n"
    (piece,) = read_resonances(table(text), PAPER_MODES)
    assert piece.passed_over == 1
    assert piece.cents[0, :, 0] == pytest.approx(cents_of(np.array([2000, 1990])))
    assert tuple(piece.error_cents[0, :, 0]) == (3, 4)
    assert np.isnan(piece.cents[0, :, 1:]).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("reed,series,hz\n", "line 1: has no column mode"),
        ("", "line 1: has no column reed, series, mode, hz"),
        (HEAD + "x,A,F1,abc\n", "line 2: hz 'abc'; write a frequency"),
        (HEAD + "x,A,F1,-3\n", "line 2: hz '-3'"),
        (HEAD + "x,A,F1,nan\n", "line 2: hz 'nan'"),
        (HEAD + "x,A,F1\n", "line 2: hz ''"),
        (HEAD + "x,C,F1,2000\n", "line 2: series 'C'; write A or B"),
        (HEAD + ",A,F1,2000\n", "line 2: reed ''"),
        (HEAD + "x,A,,2000\n", "line 2: mode ''"),
        (HEAD + "x,A,F1,2000\nx,A,F1,2001\n", "line 3: reed 'x' has a second F1 in series A"),
        (
            HEAD + "x,A,F1,2000\ny,A,F1,2000\nz,A,F1,2000\nx,A,T1,3000\n",
            "line 5: .* sort the table",
        ),
        ("reed,series,mode,hz,error_cents\nx,A,F1,2000,0\n", "line 2: error_cents '0'"),
        (HEAD + 'x,A,"F1,2000\n', "line [12]: .*mend the line"),
        (HEAD, "holds no resonances"),
        (HEAD + "x,A,F1,1996,2\n", "line 2: has more cells .*decimals with a point"),
        (HEAD + "x,A,F1,1_996\n", "line 2: hz '1_996'; write a frequency"),
        (HEAD + "x,A,F1,١٩٩٦\n", "line 2: hz '١٩٩٦'; write a frequency"),
        (HEAD + "x,A,F1,0x7cc\n", "line 2: hz '0x7cc'"),
        (HEAD + "x,A,F1,1.9962\n", "line 2: hz '1.9962'; write a frequency in Hz"),
        (HEAD + "x,A,F1,1996200\n", "line 2: hz '1996200'; write a frequency in Hz"),
        (HEAD + "x\0,A,F1,1996.2\n", "line 2: "),
        (HEAD + "x\x1b[2J,A,F1,1996.2\n", "line 2: holds the character U.001B"),
        (HEAD + "x,A,F1\u202e,1996.2\n", "line 2: holds the character U.202E"),
        ("reed,series,mode,hz,hz\nx,A,F1,1996.2,3\n", "line 1: has the column hz twice"),
        ("reed,series,mode,hz,error_cents\nx,A,F1,2000,1e-300\n", "line 2: error_cents '1e-300'"),
        ("reed,series,mode,hz,error_cents\nx,A,F1,2000,1e300\n", "line 2: error_cents '1e300'"),
    ],
)
def test_what_is_no_table_is_refused_with_its_line(table, text, words):
    path = table(text)
    with pytest.raises(FitInputError, match=words) as refusal:
        fitted(path)
    assert str(refusal.value).startswith(str(path))


def test_a_message_about_a_long_name_is_short(table):
    name = "x" * 100_000
    path = table(HEAD + f"{name},A,F1,2000\n{name},A,F1,2001\n")
    with pytest.raises(FitInputError, match="has a second F1") as refusal:
        fitted(path)
    assert len(str(refusal.value)) < 200 + len(str(path))


def test_a_table_of_a_spreadsheet_is_read(tmp_path):
    # With a byte order mark, ends of lines of Windows, and an empty cell behind the last column.
    path = tmp_path / "table.csv"
    path.write_bytes(
        b"\xef\xbb\xbf" + (HEAD + "x\u00a01,A,F1,2000,\n").replace("\n", "\r\n").encode()
    )
    (piece,) = read_resonances(path, PAPER_MODES)
    assert piece.cents[0, 0, 0] == pytest.approx(cents_of(2000))


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(FitInputError, match="No such file"):
        fitted(tmp_path / "none.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FitInputError, match="UTF-8"):
        fitted(tmp_path / "binary.csv")


def test_components_are_those_of_the_fit(population):
    path, _, cents = population
    summary, rows = fitted(path)
    fit = fit_population(cents, GRID_ERROR_CENTS, METAMODEL)
    for n, row in enumerate(rows):
        for k in range(4):
            value = float(row[f"e{k + 1}"] or "nan")
            assert value == pytest.approx(fit.components[n, k], rel=1e-3, abs=1e-4, nan_ok=True)
        assert int(row["resonances"]) == fit.used[n]
    # Without series B nothing is known of drying.
    assert rows[3]["e4"] == ""
    assert rows[3]["flags"] == "UNDETERMINED"
    assert summary.to_json()["flags"] == {"UNDETERMINED": 1}


def test_the_summary_is_that_of_the_components(population):
    path, _, _ = population
    summary, rows = fitted(path)
    answer = summary.to_json()
    assert answer["reeds"] == 7
    assert answer["resonances"] == sum(int(row["resonances"]) for row in rows)
    for name, row in answer["components"].items():
        values = np.array([float(r[name]) for r in rows if r[name]])
        assert row["reeds"] == len(values)
        assert row["mean"] == pytest.approx(values.mean(), abs=1e-4)
        assert row["sd"] == pytest.approx(values.std(ddof=1), abs=1e-4)
    squares = sum(float(r["rms_cents"]) ** 2 * int(r["resonances"]) for r in rows)
    assert answer["rms_cents"] == pytest.approx(np.sqrt(squares / answer["resonances"]), rel=1e-4)


def test_true_components_come_back_within_their_errors(population):
    path, components, _ = population
    _, rows = fitted(path)
    off = [
        (float(row[f"e{k + 1}"]) - components[n, k]) / float(row[f"e{k + 1}_error"])
        for n, row in enumerate(rows)
        for k in range(4)
        if row[f"e{k + 1}"]
    ]
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_table_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "out.csv"

    def break_off():
        with opened_table(components_output(path)) as file:
            file.write("half")
            raise FitInputError("broken off")

    with pytest.raises(FitInputError, match="broken off"):
        break_off()
    assert list(tmp_path.iterdir()) == []
    with opened_table(components_output(path)) as file:
        file.write("whole")
    assert path.read_text() == f"{components_output(path).kind.mark}whole"
    missing = opened_table(components_output(Path("/nowhere/out.csv")))
    with pytest.raises(OutputRefusedError, match="choose another place with --out"), missing:
        pass


@pytest.mark.slow
def test_a_folder_of_runs_becomes_a_table(sweep_a, fitted_a, tmp_path):
    said = []
    measured = write_resonances(sweep_a.parent, tmp_path / "table.csv", said.append, "picture")
    # Pictures show no lines.
    assert (measured.kind, measured.reeds) == (ReedFile.from_file(), 1)
    assert measured.acoustic_lines is None
    assert [path.name for _, path in measured.sweeps] == [sweep_a.name]
    assert measured.to_json() is None
    with (tmp_path / "table.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["run"] for row in rows} == {sweep_a.name}
    (piece,) = read_resonances(tmp_path / "table.csv", PAPER_MODES)
    assert piece.reeds == (fitted_a.reed,)
    found = {n: r for n, r in fitted_a.resonances.items() if n in PAPER_MODES}
    for m, name in enumerate(PAPER_MODES):
        if name in found:
            expected = float(cents_of(found[name].frequency_hz))
            assert piece.cents[0, 0, m] == pytest.approx(expected, abs=0.02)
            assert piece.error_cents[0, 0, m] == pytest.approx(found[name].error_cents, abs=0.01)
        else:
            assert np.isnan(piece.cents[0, 0, m])
    assert np.isnan(piece.cents[0, 1]).all()


class SweepWithLines:
    """Replaces a fit: one mode, and lines of the drive in Hz."""

    resonances: ClassVar = {"F1": Resonance("F1", 1800.0, 0.5, 7, 3.0)}

    def __init__(self, run, *lines_hz):
        self.reed, self.series = run.reed, run.series
        peaks = [ExcitationPeak(hz, 4.0, 25.0, 1.0, 0.0, 0.0, 8.0, 0.3) for hz in lines_hz]
        seen = tuple(SeenPeak(run.reed, run.path.name, peak, None) for peak in peaks)
        self.drive_peaks = SweepPeaks(run.reed, 1400.0, 20_000.0, seen)


@pytest.mark.slow
def test_lines_that_stay_from_reed_to_reed_are_reported(changed, monkeypatch, tmp_path):
    """What one reed shows in both series counts once; what the reeds show apart is not common."""
    for k, (reed, series) in enumerate(product(("R1", "R2", "R3"), "AB")):
        changed(f"{k}.h5", name=reed, series=series)
    own_hz = {"R1": 5000.0, "R2": 6000.0, "R3": 7000.0}

    def fit(run, reed, model):
        return SweepWithLines(run, own_hz[run.reed], 4280.0 + 2 * int(run.path.stem))

    monkeypatch.setitem(FIT_SWEEP, "joint", fit)
    measured = write_resonances(tmp_path, tmp_path / "table.csv")
    (line,) = measured.acoustic_lines
    assert (line.reeds, measured.reeds) == (3, 3)
    assert line.hz == pytest.approx(4285, abs=0.1)
    (answer,) = measured.to_json()
    assert (answer["hz"], answer["height_db"], answer["reeds"]) == (line.hz, 8.0, 3)
    (said,) = remarks(PopulationSummary(), measured)
    assert "Hz (+8.0 dB): 3 of 3 reeds" in said
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 7


def test_damaged_runs_are_reported_and_passed_over(changed, monkeypatch, tmp_path):
    for reed in ("R1", "R2", "R3"):
        changed(f"{reed}.h5", name=reed)

    def fit(run, reed, model):
        if run.reed == "R2":
            raise RunFileError(f"{run.path}: step 3 cannot be read")
        return SweepWithLines(run)

    monkeypatch.setitem(FIT_SWEEP, "joint", fit)
    said = []
    assert write_resonances(tmp_path, tmp_path / "table.csv", said.append).reeds == 2
    assert f"{tmp_path / 'R2.h5'}: passed over: step 3 cannot be read" in said
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 3


def test_a_folder_without_runs_is_refused(tmp_path):
    (tmp_path / "no.h5").write_text("no HDF5")
    said = []
    with pytest.raises(FitInputError, match="no run of series A or B"):
        write_resonances(tmp_path, tmp_path / "table.csv", said.append)
    assert any("no.h5" in line for line in said)


def test_the_finite_elements_have_a_metamodel_of_all_modes():
    clarinet = ReedFile.from_file()
    assert metamodel_of("fem", clarinet).modes == PAPER_MODES
    assert metamodel_of("paper", clarinet).modes == PAPER_MODES


def test_the_papers_metamodel_is_that_of_its_own_reed():
    with pytest.raises(FitInputError, match=r"this is another: bass clarinet; choose --model fem"):
        metamodel_of("paper", ReedFile.from_file("bass-clarinet"))
