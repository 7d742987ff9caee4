"""A run as labelled arrays: a table of its steps, and its fields with coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from holography.errors import MissingLibraryError
from runs.errors import RunFileError
from runs.verdict import Verdict

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from runs.reader import Run
    from runs.records import StepRecord

# Numbers of each step, each with its unit in its name; see `runs.records.StepRecord`.
_NUMBERS = (
    "volts", "read_volts", "signal_to_noise", "noise_level", "saturated_share", "brightness_dn",
    "lock_error_hz", "lock_error_se_hz",
)  # fmt: skip


def data_frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows as a pandas data frame.

    Raises
    ------
    MissingLibraryError
        If pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise _missing("pandas") from None
    return pd.DataFrame(rows)


def steps_frame(run: Run) -> pd.DataFrame:
    """Return one row for each planned step: index, frequencies in Hz, volts, verdict.

    Raises
    ------
    MissingLibraryError
        If pandas is not installed.
    """
    return data_frame([_row(step) for step in run.steps]).set_index("position")


def fields_dataset(run: Run) -> xr.Dataset:
    """Return the fields of all measured steps, with coordinates.

    Returns
    -------
    xarray.Dataset
        ``field`` (step, y, x) complex64 in dn; coordinates ``drive_hz`` (step), ``y`` and ``x`` in
        m, and the columns of `steps_frame` along ``step``.

    Raises
    ------
    MissingLibraryError
        If xarray is not installed.
    RunFileError
        If no step was measured.
    """
    try:
        import xarray as xr
    except ImportError:
        raise _missing("xarray") from None
    measured = [step for step in run.steps if step.verdict.measured]
    if not measured:
        raise RunFileError(f"{run.path}: no step was measured, so there are no fields")
    rows = [_row(step) for step in measured]
    columns: dict[str, Any] = {name: ("step", [row[name] for row in rows]) for name in rows[0]}
    return xr.Dataset(
        {"field": (("step", "y", "x"), np.stack([run.field(step.position) for step in measured]))},
        coords={"y": ("y", run.y_m, {"units": "m"}), "x": ("x", run.x_m, {"units": "m"})} | columns,
        attrs={"reed": run.reed, "series": run.series, "title": run.title, "uid": run.uid},
    )


def _missing(library: str) -> MissingLibraryError:
    return MissingLibraryError(
        f"{library} is not installed; pip install 'reedbench[notebook]' installs it"
    )


def _row(step: StepRecord) -> dict[str, Any]:
    return (
        {"position": step.position, "index": step.index, "order": step.order}
        | {"drive_hz": float(step.drive_hz)}
        | {name: getattr(step, name) for name in _NUMBERS}
        | {"verdict": str(step.verdict), "good": step.verdict is Verdict.OK}
    )
