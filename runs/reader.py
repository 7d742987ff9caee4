"""Read run files: one sweep in one self-describing HDF5 file (``docs/reference/run-file.md``)."""

import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
import numpy.typing as npt

from holography.fresnel import FresnelTransform
from holography.reconstruction import Reconstruction
from holography.region import Region
from protocols.errors import ProtocolError
from protocols.reed import ReedFile
from runs.disk import error_class
from runs.errors import RunFileError
from runs.integrity.checks import require_run
from runs.integrity.checksums import PIXEL_CHECKSUM, ROW_CHECKSUM, pixel_checksum, whole_rows
from runs.labelled_arrays import fields_dataset, steps_frame
from runs.layout import FREE, UNDER_WAY, RunLabels, short_reason, verdict_of
from runs.measured_step import MeasuredStep
from runs.opening import DAMAGE, DamagedStepError, absent, failure, open_file, status_of
from runs.records import (
    Column,
    StepRecord,
    measured_fields,
    read_acquisition,
    read_columns,
    read_interruptions,
    read_text,
    settled_columns,
    step_records,
)
from runs.verdict import Verdict
from runs.writer import RunWriter

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

__all__ = ["MeasuredStep", "Run", "RunLabels", "RunWriter", "StepRecord"]

# While a step is measured again, its row changes for a few milliseconds. A running run that cannot
# be read after this many attempts, with these pauses, is damaged. Chosen: 0.1 s in total.
_MAX_READINGS: Final = 6
_READING_PAUSE_S: Final = 0.02


class Run:
    """A run file that is open for reading; a context manager.

    Attributes
    ----------
    path : Path
    steps : tuple of StepRecord
        All planned steps, measured or not; the last attempt of those that were measured again.
    earlier_attempts : tuple of StepRecord
        Earlier attempts, in the order in which their steps were measured again. Their `position` is
        that of their step. `earlier_field` returns their fields, by index in this tuple.
    interruptions : tuple of Interruption
        Places where measuring stopped and continued later.
    acquisition : Acquisition
        What the run measures, and its part in a campaign.
    uid, title, start_time, end_time : str
        Times are ISO 8601; `end_time` is empty if the run was killed.
    format_version : int
    status : {'running', 'complete', 'interrupted', 'failed'}
        The file of a run that was killed also says ``running``.
    reed, series, chamber : str
        Preparation of the bench: name of the reed, series (A or B), excitation chamber.
    reed_text : str or None
        Text of the reed file, see `reed_file`.
    reed_sha256 : str
        SHA-256 of `reed_text`; empty if there is none.
    labels : RunLabels
    bench_name, bench_fingerprint, bench_text, protocol_text, protocol_sha256 : str
    identities : dict of str to str
        Identity that each instrument reported, by role.
    git_revision : str
        Empty if unknown.
    package_versions : dict of str to str
    seed : int
    keep : {'holograms', 'frames'}
    acoustic_resonances_hz : tuple of float
        Known resonances of the excitation device.
    frame_rate_hz : Fraction
    exposure_s : float
    sideband_order : int
        Sideband of the images that are shown; each step has its own order.
    saturation_dn : int
    reconstruction : Reconstruction
        Geometry of frames and fields.
    y_m, x_m : (height,) and (width,) float64
        Reed coordinates of the rows and columns of a field, in m.
    """

    def __init__(self, path: Path, file: Any, *, damaged_as_pending: bool = False) -> None:
        self.path = path
        self._file = file
        entry = file["entry"]
        # Read first: if the status is complete, everything else that is read is final.
        self.status = read_text(entry, "status")
        self.uid = read_text(entry, "entry_identifier_uuid")
        self.title = read_text(entry, "title")
        self.start_time = read_text(entry, "start_time")
        self.end_time = read_text(entry, "end_time")
        self._read_sample(entry)
        self._read_provenance(entry["provenance"])
        self._read_instrument(entry["instrument"])
        self._read_geometry(entry)
        self.format_version = int(file.attrs["format_version"])
        self._read_steps(entry, damaged_as_pending=damaged_as_pending)
        self.interruptions = (
            tuple(read_interruptions(entry["interruptions"])) if "interruptions" in entry else ()
        )
        self.acquisition = read_acquisition(entry["acquisition"])

    @classmethod
    def open(cls, path: str | Path, *, damaged_as_pending: bool = False) -> Self:
        """Open a run file; also one that another process is measuring.

        Only steps that are measured by now are seen. Open the file again to see later steps.

        Parameters
        ----------
        path : str or Path
        damaged_as_pending : bool
            True reads steps with damaged numbers as steps that are not measured; False raises an
            error.

        Raises
        ------
        RunFileError
            If there is no such file, it is not a run file, or parts are missing or damaged.
        DiskError
            If the disk cannot be read.
        """
        path = Path(path)
        if path.is_dir():
            raise RunFileError(f"{path}: is a folder; name a run file in it")
        if not path.is_file():
            raise absent(path)
        readings = 0
        while True:
            readings += 1
            file = open_file(path)
            try:
                require_run(path, file)
                return cls(path, file, damaged_as_pending=damaged_as_pending)
            except (KeyError, *DAMAGE) as error:
                status = status_of(file)
                file.close()
                if not path.exists():
                    raise absent(path) from error
                if status != "running" or readings == _MAX_READINGS:
                    raise failure(path, error, status) from error
                # The runner may just have changed a step that is measured again, so that half of
                # the row belongs to one attempt and half to the next: wait and read again.
                time.sleep(_READING_PAUSE_S)
            except BaseException:
                file.close()
                raise

    def reed_file(self) -> ReedFile:
        """Return the description of the reed that was measured.

        Raises
        ------
        RunFileError
            If this software does not understand the description in the run file.
        """
        if self.reed_text is None:
            return ReedFile.from_file()
        try:
            return ReedFile.from_text(self.reed_text, f"{self.path}: reed")
        except ProtocolError as error:
            raise RunFileError(f"{error}; this software does not understand that reed") from None

    @property
    def region(self) -> Region:
        """Return the part of the object image that the fields hold."""
        return self.reconstruction.region

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Return the number of rows and columns of a frame."""
        return self.reconstruction.transform.shape

    @property
    def good(self) -> npt.NDArray[np.bool_]:
        """Return which steps have the verdict ok, (steps,) bool."""
        return np.array([step.verdict is Verdict.OK for step in self.steps], dtype=bool)

    def field(self, position: int) -> npt.NDArray[np.complex64]:
        """Return the complex field around the reed at one step, (height, width) complex64, in dn.

        Parameters
        ----------
        position : int
            `StepRecord.position`.

        Raises
        ------
        RunFileError
            If the step holds no data or is damaged.
        """
        if self.keep == "frames":
            return self.reconstruction.field(self.frames(position))
        field: npt.NDArray[np.complex64] = self._read("field", position)
        return field

    def exposure_of(self, step: StepRecord) -> float:
        """Return the exposure of a step in s."""
        return self.exposure_s if step.exposure_s is None else step.exposure_s

    def earlier_field(self, number: int) -> npt.NDArray[np.complex64]:
        """Return the complex field of one of `earlier_attempts`, (height, width) complex64, in dn.

        Raises
        ------
        RunFileError
            If the attempt is damaged, or the file is closed.
        """
        step, name = (
            self.earlier_attempts[number],
            "field" if self.keep == "holograms" else "frames",
        )
        self._require_open()
        label = f"an earlier attempt of step {step.index}"
        place, checksum = self._earlier_places[number], self._earlier_checksums[number]
        pixels = self._pixels(f"earlier_attempts/{name}", place, checksum, label)
        return pixels if name == "field" else self.reconstruction.field(pixels)

    def frames(self, position: int) -> npt.NDArray[np.uint16]:
        """Return the frames of one step, (4, ny, nx) uint16, in dn.

        Raises
        ------
        RunFileError
            If the run kept holograms, or the step holds no data or is damaged.
        """
        if self.keep != "frames":
            raise RunFileError(
                f"{self.path}: kept holograms, so it has no frames; measure with 'keep: frames'"
            )
        frames: npt.NDArray[np.uint16] = self._read("frames", position)
        return frames

    def to_dataframe(self) -> "pd.DataFrame":
        """Return one row for each planned step, see `runs.labelled_arrays.steps_frame`."""
        return steps_frame(self)

    def to_xarray(self) -> "xr.Dataset":
        """Return the fields of all measured steps, see `runs.labelled_arrays.fields_dataset`."""
        return fields_dataset(self)

    def __repr__(self) -> str:
        good = int(self.good.sum())
        return f"<Run {str(self.path)!r}: {self.reed!r}, {self.status}, {good} of {len(self)} good>"

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._file.close()

    def __iter__(self) -> Iterator[StepRecord]:
        return iter(self.steps)

    def __len__(self) -> int:
        return len(self.steps)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _read(self, name: str, position: int) -> Any:
        step = self.steps[position]
        if not step.verdict.measured:
            raise RunFileError(
                f"{self.path}: step {step.index} is {step.verdict} and holds no data; "
                "use steps that were measured"
            )
        self._require_open()
        checksum = self._pixel_checksums[position]
        try:
            return self._pixels(f"data/{name}", position, checksum, f"step {step.index}")
        except RunFileError as error:
            if self._has_changed(position):
                raise RunFileError(
                    f"{self.path}: step {step.index} was measured again since the file was opened; "
                    "open it again"
                ) from error
            raise

    def _pixels(self, name: str, place: int, checksum: int, label: str) -> Any:
        """Return the pixels of one attempt, if they match their checksum."""
        try:
            pixels = self._file["entry"][name][place]
        except (KeyError, *DAMAGE) as error:
            raise error_class(error)(
                f"{self.path}: {label} is damaged ({short_reason(error)}); "
                "use another copy of the file or do without this step"
            ) from error
        if pixel_checksum(pixels) != checksum:
            raise RunFileError(
                f"{self.path}: {label} is damaged (its pixels do not have the checksum that was "
                "written with them); use another copy of the file or do without this step"
            )
        return pixels

    def _has_changed(self, position: int) -> bool:
        """Return whether another process has changed a step since this file was opened."""
        with contextlib.suppress(KeyError, *DAMAGE):
            steps = self._file["entry/steps"]
            verdict = Verdict(steps["verdict"].asstr()[position])
            checksum = int(steps[ROW_CHECKSUM][position])
            return checksum != self._row_checksums[position] or not verdict.measured
        return False

    def _require_open(self) -> None:
        if not self._file:
            raise RunFileError(f"{self.path}: is closed; open it again with Run.open")

    def _read_steps(self, entry: Any, *, damaged_as_pending: bool) -> None:
        """Read and check all steps, then their earlier attempts.

        This order matters: another process may be moving a step to the earlier attempts.
        """
        columns, found = settled_columns(entry["steps"])
        intact, verdicts = whole_rows(columns), []
        for position, verdict in enumerate(found):
            damaged = verdict is None or (verdict.measured and not intact[position])
            if damaged and not damaged_as_pending:
                index = columns["index"][position]
                raise DamagedStepError(f"step {index} (row {position})")
            verdicts.append(Verdict.PENDING if verdict is None or damaged else verdict)
        self.steps = tuple(step_records(columns, verdicts))
        self._pixel_checksums: list[int] = columns[PIXEL_CHECKSUM].tolist()
        self._row_checksums: list[int] = columns[ROW_CHECKSUM].tolist()
        self._read_earlier_attempts(entry, columns, damaged_as_pending=damaged_as_pending)

    def _read_earlier_attempts(
        self, entry: Any, steps: dict[str, Column], *, damaged_as_pending: bool
    ) -> None:
        """Read and check earlier attempts."""
        self.earlier_attempts: tuple[StepRecord, ...] = ()
        self._earlier_places: list[int] = []
        self._earlier_checksums: list[int] = []
        # Files of other programs may have no such group.
        positions = (
            entry["earlier_attempts/position"][()] if "earlier_attempts" in entry else np.array([])
        )
        if np.all(positions == FREE):
            return
        columns = read_columns(entry["earlier_attempts"])
        of_step = np.where(positions <= UNDER_WAY, UNDER_WAY - positions, positions)
        planned = steps.keys() - columns.keys()
        known = np.clip(of_step, 0, len(self.steps) - 1)
        intact = whole_rows(columns | {name: steps[name][known] for name in planned})
        verdicts = [verdict_of(content) for content in columns["verdict"].tolist()]
        taken = list(measured_fields(columns, [verdict or Verdict.PENDING for verdict in verdicts]))
        found = []
        for place in np.flatnonzero((of_step >= 0) & (of_step < len(self.steps))):
            step = self.steps[of_step[place]]
            same = (
                columns[ROW_CHECKSUM][place] == self._row_checksums[step.position]
                and taken[place]["verdict"] is step.verdict
            )
            # An attempt that another process is copying is in both places, and counts once.
            if step.verdict.measured and (same or positions[place] <= UNDER_WAY):
                continue
            if intact[place] and verdicts[place] is not None:
                found.append(replace(step, **taken[place]))
                self._earlier_places.append(int(place))
            elif not damaged_as_pending:
                raise DamagedStepError(f"an earlier attempt of step {step.index}")
        self.earlier_attempts = tuple(found)
        self._earlier_checksums = columns[PIXEL_CHECKSUM][self._earlier_places].tolist()

    def _read_sample(self, entry: Any) -> None:
        sample = entry["sample"]
        self.reed, self.series = read_text(sample, "name"), read_text(sample, "series")
        self.chamber = read_text(sample, "chamber")
        strength = float(sample["strength"][()])
        self.labels = RunLabels(
            None if np.isnan(strength) else strength,
            read_text(sample, "note"),
            read_text(entry["user"], "name"),
        )

    def _read_provenance(self, origin: Any) -> None:
        self.protocol_text = read_text(origin, "protocol")
        self.protocol_sha256 = read_text(origin, "protocol_sha256")
        # Files of other programs may lack the reed.
        self.reed_text = read_text(origin, "reed") if "reed" in origin else None
        self.reed_sha256 = read_text(origin, "reed_sha256") if "reed" in origin else ""
        self.bench_text = read_text(origin, "bench")
        self.bench_fingerprint = read_text(origin, "bench_fingerprint")
        self.git_revision = read_text(origin, "git_revision")
        self.package_versions: dict[str, str] = json.loads(read_text(origin, "package_versions"))
        self.seed = int(origin["seed"][()])

    def _read_instrument(self, instrument: Any) -> None:
        detector = instrument["camera"]
        self.bench_name = read_text(instrument, "name")
        self.identities = {
            role: read_text(instrument[role], "identity")
            for role in ("synthesizers", "generator", "camera")
        }
        self.acoustic_resonances_hz = tuple(
            float(hz) for hz in instrument["acoustic_resonances"][()]
        )
        self.frame_rate_hz = Fraction(read_text(detector, "frame_rate_exact"))
        self.exposure_s = float(detector["count_time"][()])
        self.saturation_dn = int(detector["saturation_value"][()])
        self.sideband_order = int(instrument["synthesizers"]["sideband_order"][()])

    def _read_geometry(self, entry: Any) -> None:
        detector, laser = entry["instrument"]["camera"], entry["instrument"]["laser"]
        data, region = entry["data"], entry["region"]
        self.keep = "holograms" if data.attrs["signal"] == "field" else "frames"
        self.y_m: npt.NDArray[np.float64] = data["y_m"][()]
        self.x_m: npt.NDArray[np.float64] = data["x_m"][()]
        self.reconstruction = Reconstruction(
            FresnelTransform(
                shape=(int(detector["rows"][()]), int(detector["columns"][()])),
                pixel_m=float(detector["pixel_size"][()]),
                wavelength_m=float(laser["wavelength"][()]),
                distance_m=float(laser["distance"][()]),
            ),
            Region(*(int(region[name][()]) for name in ("row", "column", "height", "width"))),
        )
