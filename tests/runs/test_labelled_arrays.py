"""A run as a data frame and as an xarray data set."""

import sys

import numpy as np
import pytest

from holography.errors import MissingLibraryError
from runs.reader import Run


def test_every_planned_step_is_a_row(sweep_a):
    pytest.importorskip("pandas", reason="the extra 'notebook' is not installed")
    with Run.open(sweep_a) as run:
        frame = run.to_dataframe()
        assert frame.index.tolist() == [step.position for step in run.steps]
        assert frame["drive_hz"].tolist() == [float(step.drive_hz) for step in run.steps]
        assert frame["good"].tolist() == run.good.tolist()
        assert run.reed in repr(run)


def test_fields_have_coordinates(changed):
    xarray = pytest.importorskip("xarray", reason="the extra 'notebook' is not installed")
    with Run.open(changed(only=(60, 64))) as run:
        data = run.to_xarray()
        assert isinstance(data, xarray.Dataset)
        measured = [step for step in run.steps if step.verdict.measured]
        assert data.sizes == {"step": len(measured), "y": run.y_m.size, "x": run.x_m.size}
        assert np.array_equal(data["field"][1], run.field(measured[1].position))
        assert data["field"].dtype == np.complex64
        assert data["y"].attrs["units"] == "m"
        assert np.array_equal(data["x"], run.x_m)
        assert data["drive_hz"].values.tolist() == [float(step.drive_hz) for step in measured]
        assert data.attrs["reed"] == run.reed


@pytest.mark.parametrize(
    ("library", "method"), [("pandas", "to_dataframe"), ("xarray", "to_xarray")]
)
def test_without_the_library_the_remedy_is_named(sweep_a, monkeypatch, library, method):
    monkeypatch.setitem(sys.modules, library, None)
    with Run.open(sweep_a) as run, pytest.raises(MissingLibraryError, match=library):
        getattr(run, method)()
