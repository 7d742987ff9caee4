"""`import acquire`: what scripts call, and what they get."""

import json
import subprocess
import sys

import pytest
from matplotlib.figure import Figure

import acquire
from acquire.errors import UsageError
from acquire.results.base import Result
from holography.errors import MissingLibraryError
from protocols.errors import ProtocolError
from protocols.protocol import Protocol
from reports.figures.drawing import png_of
from runs.errors import RunFileError
from runs.reader import Run

SMALL = {"camera.width": 160, "camera.height": 128, "sweep.first": 20, "sweep.last": 32}


@pytest.fixture(scope="module")
def results(tmp_path_factory, sweep_a, fit_once):
    """One result of every kind that is quick to make, by name."""
    path = tmp_path_factory.mktemp("front") / "R07.h5"
    plan = acquire.plan(acquire.load("quick").replace(SMALL))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("acquire.analysis.fit_runs", fit_once)
        fit = acquire.fit(sweep_a, method="picture")
    return {
        "plan": plan,
        "campaign": acquire.plan_campaign(acquire.load_campaign("campaign")),
        "run": acquire.run(plan, path, reed="R07", labels=acquire.RunLabels(3.5, "new box")),
        "fit": fit,
        "modes": acquire.modes("clarinet", {"cane.E_L": "13 GPa"}, mesh="fast"),
    }


@pytest.mark.parametrize("name", ["plan", "campaign", "run", "fit", "modes"])
def test_every_result_prints_tabulates_and_plots(results, name):
    result: Result = results[name]
    assert result.title in repr(result)
    rows = result.rows()
    assert rows
    assert all(set(row) == set(rows[0]) for row in rows)
    html = result._repr_html_()
    assert html.count("<tr>") == len(rows) + 1
    json.dumps(result.to_json())
    axes = Figure().add_subplot()
    assert result.plot(axes) is axes
    assert axes.get_xlabel()
    assert result.plot().figure is not axes.figure


def test_rows_become_a_data_frame(results):
    pytest.importorskip("pandas", reason="the extra 'notebook' is not installed")
    plan = results["plan"]
    frame = plan.to_dataframe()
    assert len(frame) == len(plan.steps)
    assert frame["volts"].tolist() == [step.volts for step in plan.steps]


def test_without_pandas_the_remedy_is_named(results, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingLibraryError, match="pandas"):
        results["plan"].to_dataframe()


@pytest.mark.parametrize("name", ["run", "fit", "modes"])
def test_a_hostile_name_is_shown_as_text(results, name, monkeypatch):
    result = results[name]
    monkeypatch.setattr(type(result), "title", "R07 $\\frac$ \x1b[31m")
    assert "\x1b" not in repr(result)
    figure = Figure()
    axes = result.plot(figure.add_subplot())
    # Drawing fails on words between dollar signs that are no mathematics.
    assert png_of(figure).startswith(b"\x89PNG")
    assert "\x1b" not in axes.get_title()


def test_a_run_keeps_what_it_was_given(results):
    measured = results["run"]
    assert (str(measured.status), measured.exit_status, measured.unconfirmed) == ("complete", 0, ())
    with acquire.open_run(measured.path) as run:
        assert isinstance(run, Run)
        assert (run.reed, run.labels.strength, run.labels.note) == ("R07", 3.5, "new box")
        assert len(run) == len(results["plan"].steps)


def test_changes_of_a_reed_change_its_modes(results):
    stiffer = {row["mode"]: row["frequency_hz"] for row in results["modes"].rows()}
    as_is = {row["mode"]: row["frequency_hz"] for row in acquire.modes(mesh="fast").rows()}
    assert stiffer["F1"] != pytest.approx(as_is["F1"], rel=1e-3)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"reed": " "}, "reed"),
        ({"reed": "a\0b"}, "reed"),
        ({"labels": acquire.RunLabels(strength=-1.0)}, "strength"),
        ({"labels": acquire.RunLabels(strength=float("nan"))}, "strength"),
        ({"labels": acquire.RunLabels(note="\ud800")}, "note"),
        ({"labels": acquire.RunLabels(operator="\0")}, "operator"),
    ],
)
def test_what_a_run_file_cannot_hold_is_refused_first(results, tmp_path, given, named):
    with pytest.raises(UsageError) as refused:
        acquire.run(results["plan"], tmp_path / "new" / "run.h5", **given)
    assert str(refused.value).startswith(f"{named}:")
    assert refused.value.exit_status == 2
    assert not (tmp_path / "new").exists()


def test_errors_are_those_of_the_packages(tmp_path):
    with pytest.raises(ProtocolError):
        acquire.plan("no-such-protocol")
    with pytest.raises(RunFileError):
        acquire.open_run(tmp_path / "none.h5")
    with pytest.raises(UsageError, match="method"):
        acquire.population(tmp_path / "table.csv", method="joint")


def test_every_public_name_is_there():
    assert {name: getattr(acquire, name).__doc__ is not None for name in acquire.__all__} == (
        dict.fromkeys(acquire.__all__, True)
    )
    assert isinstance(acquire.load("quick"), Protocol)
    with pytest.raises(AttributeError, match="nothing"):
        acquire.nothing  # noqa: B018 - the look-up is what is tested


def test_the_front_door_opens_at_once():
    """`acquire --help` must not wait for numerical libraries."""
    code = "import acquire, sys; print(sorted({'numpy', 'scipy', 'h5py'} & set(sys.modules)))"
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert said.stdout.strip() == "[]"


def test_analysis_imports_no_library_of_instruments():
    """A computer without instruments fits and diagnoses all the same."""
    code = (
        "import sys, acquire.analysis, acquire.diagnosing; "
        "print(sorted({'pyvisa', 'usb', 'serial', 'sounddevice'} & set(sys.modules)))"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert said.stdout.strip() == "[]"
