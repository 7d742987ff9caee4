"""`acquire acoustics`: runs of several reeds in, lines of the bench out."""

from pathlib import Path

import numpy as np
import pytest

import acquire
from fitting.acoustics.lines import NearMode, SeenPeak, SweepPeaks, acoustic_lines
from fitting.acoustics.poles import ExcitationPeak
from fitting.errors import FitError
from fitting.populations.acoustic_lines import MeasuredLines, RunPeaks


def measured_lines(reeds, passed_over=()):
    """Lines of the bench at 4308.6 Hz, and one of the first reed that is next to a mode."""
    runs = []
    for k in range(reeds):
        name = f"R{k}"
        peak = ExcitationPeak(4308.6 + 0.5 * (-1) ** k, 3.0, 25.0, 1.0, 0.0, 0.0, 10.4, 0.3)
        seen = [SeenPeak(name, f"{name}.h5", peak, NearMode("F2", -400.0))]
        if k == 0:
            high = ExcitationPeak(3221.0, 5.0, 33.0, 2.0, 0.0, 0.0, 21.0, 0.4)
            seen.append(SeenPeak(name, f"{name}.h5", high, NearMode("T1", 4.0)))
        runs.append(RunPeaks(Path(f"{name}.h5"), "A", SweepPeaks(name, 1.4e3, 2e4, tuple(seen))))
    lines = acoustic_lines([run.peaks for run in runs])
    return MeasuredLines(tuple(runs), tuple(lines), dict(passed_over))


@pytest.fixture
def four_reeds(monkeypatch):
    asked = []

    def measure(paths, announce):
        asked.append(list(paths))
        return measured_lines(4, {Path("bad.h5"): "too few holograms"})

    monkeypatch.setattr("acquire.analysis.measure_acoustic_lines", measure)
    return asked


def test_lines_are_listed_with_what_they_belong_to(cli, four_reeds):
    said = cli("acoustics", "R0.h5", "R1.h5")
    assert said.status == 0
    assert "4308.6" in said.out
    assert "4 of 4" in said.out
    assert "bench" in said.out
    assert "T1" in said.out
    assert four_reeds == [[Path("R0.h5"), Path("R1.h5")]]


def test_json_has_the_documented_keys(cli, four_reeds):
    answer = cli("acoustics", "R0.h5", "--json").json
    assert set(answer) == {"reeds", "lines", "runs", "passed_over"}
    assert answer["reeds"] == 4
    assert answer["passed_over"] == [{"path": "bad.h5", "reason": "too few holograms"}]
    by_verdict = {line["verdict"]: line for line in answer["lines"]}
    assert by_verdict["bench"]["hz"] == pytest.approx(4308.6, abs=0.5)
    assert by_verdict["suspect"]["hz"] == pytest.approx(3221.0)
    assert [run["reed"] for run in answer["runs"]] == ["R0", "R1", "R2", "R3"]


def test_a_result_has_rows_and_a_plot(four_reeds):
    found = acquire.acoustics("R0.h5")
    assert [row["verdict"] for row in found.rows()] == ["suspect", "bench"]
    assert "1 of them of the bench" in found.title
    assert "dB" in found.plot().get_ylabel()


def test_bad_input_ends_with_one_line(cli, folder, sweep_a):
    said = cli("acoustics", "nothing.h5")
    assert said.status == 2
    assert "nothing.h5" in said.err
    said = cli("acoustics", sweep_a, sweep_a)
    assert said.status == 2
    assert "named twice" in said.err


def test_runs_of_different_benches_are_refused(cli, changed, sweep_a, resealed):
    other = changed("other.h5", name="R2")
    with resealed(other) as file:
        del file["entry/instrument/name"]
        file["entry/instrument/name"] = "another bench"
    said = cli("acoustics", sweep_a, other)
    assert said.status == 2
    assert "another bench" in said.err


def test_runs_that_cannot_be_fitted_are_passed_over(cli, changed, monkeypatch):
    paths = [changed(f"{k}.h5", name=f"R{k}") for k in range(2)]

    def fail(run, reed, model):
        raise FitError(f"{run.path}: too few holograms")

    monkeypatch.setattr("fitting.populations.acoustic_lines.fit_sweep_jointly", fail)
    said = cli("acoustics", *paths)
    assert (said.status, said.out) == (1, "")
    assert said.err.count("too few holograms") == 2


@pytest.mark.slow
def test_one_reed_of_the_simulated_bench_decides_nothing(cli, sweep_a):
    answer = cli("acoustics", sweep_a, "--json").json
    line = min(answer["lines"], key=lambda each: abs(each["hz"] - 4308.6))
    assert {each["verdict"] for each in answer["lines"]} <= {"undecided", "suspect"}
    assert abs(line["hz"] - 4308.6) < 3.5 * line["error_hz"]
    assert np.isfinite(line["quality"])
