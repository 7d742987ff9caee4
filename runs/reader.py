"""Run files: one sweep in one HDF5 file that explains itself (``docs/run-file.md``)."""

import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import h5py
import numpy as np
import numpy.typing as npt

from holography.fresnel import FresnelTransform
from holography.reconstruction import Reconstruction
from holography.region import Region
from protocols.errors import ProtocolError
from protocols.reed import ReedFile
from runs.checks import require_run
from runs.checksums import (
    PIXEL_CHECKSUM,
    ROW_CHECKSUM,
    pixel_checksum,
    whole_rows,
)
from runs.disk import error_class
from runs.errors import RunFileError
from runs.layout import (
    FREE,
    UNDER_WAY,
    RunLabels,
    short_reason,
    verdict_of,
)
from runs.measured_step import MeasuredStep
from runs.records import (
    Column,
    StepRecord,
    read_acquisition,
    read_columns,
    read_interruptions,
    read_text,
    settled_columns,
    step_records,
    taken_fields,
)
from runs.verdict import Verdict
from runs.writer import RunWriter

__all__ = ["MeasuredStep", "Run", "RunLabels", "RunWriter", "StepRecord"]

# What h5py, and whoever makes sense of what it reads, raise where bytes are not what was written.
_DAMAGE = OSError, RuntimeError, ValueError, TypeError, ArithmeticError
# A step that is being taken again is written within some milliseconds. A run that is still not read
# after this many times, so long apart, is damaged.
_READINGS: Final = 6
_BETWEEN_READINGS_S: Final = 0.02


class Run:
    """A run file that is open for reading; a context manager.

    Attributes
    ----------
    path : Path
    steps : tuple of StepRecord
        All that were planned, measured or not; of those that were taken again, the last take.
    retakes : tuple of StepRecord
        Takes before the last one, in the order in which they were taken again. Their `position` is
        that of their step; what they look like, `retaken_field` tells by their place here.
    interruptions : tuple of Interruption
        Where the run was not carried on at once.
    acquisition : Acquisition
        What it is of.
    uid, title, start_time, end_time : str
        Times are ISO 8601; `end_time` is empty if the run was killed.
    format_version : int
    status : {'running', 'complete', 'interrupted', 'failed'}
        ``running`` also stands in the file of a run that was killed.
    reed, series, chamber : str
    reed_text : str or None
        Description of the kind of reed, see `reed_file`.
    reed_sha256 : str
        Its hash; empty where there is none.
    labels : RunLabels
    bench_name, bench_fingerprint, bench_text, protocol_text, protocol_sha256 : str
    identities : dict
        What each instrument said that it is, by role.
    git_revision : str
        Empty if unknown.
    package_versions : dict
    seed : int
    keep : {'holograms', 'frames'}
    acoustic_resonances_hz : tuple of float
        Known resonances of the excitation device.
    frame_rate_hz : Fraction
    exposure_s : float
    sideband_order : int
        The one that pictures are made of; each step has its own.
    saturation_dn : int
    reconstruction : Reconstruction
        Geometry of frames and fields.
    y_m, x_m : (height,) and (width,) float64
        Reed coordinates of the rows and columns of a field.
    """

    def __init__(self, path: Path, file: Any, *, damaged_as_pending: bool = False) -> None:
        self.path = path
        self._file = file
        entry = file["entry"]
        # First: of a run that is complete, nothing changes any more.
        self.status = read_text(entry, "status")
        self.uid = read_text(entry, "entry_identifier_uuid")
        self.title = read_text(entry, "title")
        self.start_time, self.end_time = (
            read_text(entry, "start_time"),
            read_text(entry, "end_time"),
        )
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

        What is read are the steps that were measured by now; open it again to see those that came
        later.

        Parameters
        ----------
        path : str or Path
        damaged_as_pending : bool
            Whether steps whose numbers are damaged are read as steps that were not measured,
            instead of being refused.

        Raises
        ------
        RunFileError
            If there is no such file, it is no HDF5 or no run file, or parts are missing or
            damaged.
        DiskError
            If its disk refuses to be read.
        """
        path = Path(path)
        if path.is_dir():
            raise RunFileError(f"{path}: is a folder; name a run file in it")
        if not path.is_file():
            raise _absent(path)
        readings = 0
        while True:
            readings += 1
            file = _opened(path)
            try:
                require_run(path, file)
                return cls(path, file, damaged_as_pending=damaged_as_pending)
            except (KeyError, *_DAMAGE) as error:
                status = _status(file)
                file.close()
                # Of a run in work a step may just be taken again: what is read of it is half of
                # one take and half of the next.
                if not path.exists():
                    raise _absent(path) from error
                if status != "running" or readings == _READINGS:
                    raise _failure(path, error, status) from error
                time.sleep(_BETWEEN_READINGS_S)
            except BaseException:
                file.close()
                raise

    def reed_file(self) -> ReedFile:
        """Kind of reed that was measured.

        Raises
        ------
        RunFileError
            If this software does not understand the description that the run carries.
        """
        if self.reed_text is None:
            return ReedFile.from_file()
        try:
            return ReedFile.from_text(self.reed_text, f"{self.path}: reed")
        except ProtocolError as error:
            raise RunFileError(f"{error}; this software does not understand that reed") from None

    @property
    def region(self) -> Region:
        """Part of the object image that the fields hold."""
        return self.reconstruction.region

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns of one frame."""
        return self.reconstruction.transform.shape

    @property
    def good(self) -> npt.NDArray[np.bool_]:
        """Which steps have the verdict ok, (steps,) bool."""
        return np.array([step.verdict is Verdict.OK for step in self.steps], dtype=bool)

    def field(self, position: int) -> npt.NDArray[np.complex64]:
        """Complex field around the reed of one step, (height, width) complex64.

        Parameters
        ----------
        position : int
            `StepRecord.position`.

        Raises
        ------
        RunFileError
            If that step holds no data, or the file keeps it damaged.
        """
        if self.keep == "frames":
            return self.reconstruction.field(self.frames(position))
        field: npt.NDArray[np.complex64] = self._read("field", position)
        return field

    def exposure_of(self, step: StepRecord) -> float:
        """Exposure of a step in s."""
        return self.exposure_s if step.exposure_s is None else step.exposure_s

    def retaken_field(self, number: int) -> npt.NDArray[np.complex64]:
        """Complex field around the reed of one of `retakes`, (height, width) complex64.

        Raises
        ------
        RunFileError
            If the file keeps it damaged, or is closed.
        """
        step, name = self.retakes[number], "field" if self.keep == "holograms" else "frames"
        self._require_open()
        what = f"an earlier take of step {step.index}"
        place, said = self._retake_places[number], self._retake_checksums[number]
        kept = self._pixels(f"retakes/{name}", place, said, what)
        return kept if name == "field" else self.reconstruction.field(kept)

    def frames(self, position: int) -> npt.NDArray[np.uint16]:
        """Frames of one step, (4, ny, nx) uint16.

        Raises
        ------
        RunFileError
            If the run kept holograms, or that step holds no data.
        """
        if self.keep != "frames":
            raise RunFileError(
                f"{self.path}: kept holograms, so it has no frames; measure with 'keep: frames'"
            )
        frames: npt.NDArray[np.uint16] = self._read("frames", position)
        return frames

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
        said = self._pixel_checksums[position]
        try:
            return self._pixels(f"data/{name}", position, said, f"step {step.index}")
        except RunFileError as error:
            if self._taken_again(position):
                raise RunFileError(
                    f"{self.path}: step {step.index} was taken again since the file was opened; "
                    "open it again"
                ) from error
            raise

    def _pixels(self, name: str, place: int, said: int, what: str) -> Any:
        """Pixels of one take, if they are what was written."""
        try:
            pixels = self._file["entry"][name][place]
        except (KeyError, *_DAMAGE) as error:
            raise error_class(error)(
                f"{self.path}: {what} is damaged ({short_reason(error)}); "
                "use another copy of the file or do without this step"
            ) from error
        if pixel_checksum(pixels) != said:
            raise RunFileError(
                f"{self.path}: {what} is damaged (its pixels do not have the checksum that was "
                "written with them); use another copy of the file or do without this step"
            )
        return pixels

    def _taken_again(self, position: int) -> bool:
        """Whether another process has changed a step since this file was opened."""
        with contextlib.suppress(KeyError, *_DAMAGE):
            steps = self._file["entry/steps"]
            verdict = Verdict(steps["verdict"].asstr()[position])
            said = int(steps[ROW_CHECKSUM][position])
            return said != self._row_checksums[position] or not verdict.measured
        return False

    def _require_open(self) -> None:
        if not self._file:
            raise RunFileError(f"{self.path}: is closed; open it again with Run.open")

    def _read_steps(self, entry: Any, *, damaged_as_pending: bool) -> None:
        """Read what was planned and measured, and check it.

        Earlier takes are read after the steps: another process may be setting one aside.
        """
        columns, found = settled_columns(entry["steps"])
        whole, verdicts = whole_rows(columns), []
        for position, verdict in enumerate(found):
            damaged = verdict is None or (verdict.measured and not whole[position])
            if damaged and not damaged_as_pending:
                index = columns["index"][position]
                raise _DamagedStepError(f"step {index} (row {position})")
            verdicts.append(Verdict.PENDING if verdict is None or damaged else verdict)
        self.steps = tuple(step_records(columns, verdicts))
        self._pixel_checksums: list[int] = columns[PIXEL_CHECKSUM].tolist()
        self._row_checksums: list[int] = columns[ROW_CHECKSUM].tolist()
        self._read_retakes(entry, columns, damaged_as_pending=damaged_as_pending)

    def _read_retakes(
        self, entry: Any, steps: dict[str, Column], *, damaged_as_pending: bool
    ) -> None:
        """Read earlier takes, and check them."""
        self.retakes: tuple[StepRecord, ...] = ()
        self._retake_places: list[int] = []
        self._retake_checksums: list[int] = []
        # Files in which no step can be taken twice need no such group.
        positions = entry["retakes/position"][()] if "retakes" in entry else np.array([])
        if np.all(positions == FREE):
            return
        columns = read_columns(entry["retakes"])
        of_step = np.where(positions <= UNDER_WAY, UNDER_WAY - positions, positions)
        planned = steps.keys() - columns.keys()
        known = np.clip(of_step, 0, len(self.steps) - 1)
        whole = whole_rows(columns | {name: steps[name][known] for name in planned})
        verdicts = [verdict_of(said) for said in columns["verdict"].tolist()]
        taken = list(taken_fields(columns, [verdict or Verdict.PENDING for verdict in verdicts]))
        found = []
        for place in np.flatnonzero((of_step >= 0) & (of_step < len(self.steps))):
            step = self.steps[of_step[place]]
            same = (
                columns[ROW_CHECKSUM][place] == self._row_checksums[step.position]
                and taken[place]["verdict"] is step.verdict
            )
            # A take that is just being set aside stands in both places, and counts once.
            if step.verdict.measured and (same or positions[place] <= UNDER_WAY):
                continue
            if whole[place] and verdicts[place] is not None:
                found.append(replace(step, **taken[place]))
                self._retake_places.append(int(place))
            elif not damaged_as_pending:
                raise _DamagedStepError(f"an earlier take of step {step.index}")
        self.retakes = tuple(found)
        self._retake_checksums = columns[PIXEL_CHECKSUM][self._retake_places].tolist()

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
        # Other programs write files that do not say it.
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
        data, where = entry["data"], entry["region"]
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
            Region(*(int(where[name][()]) for name in ("row", "column", "height", "width"))),
        )


class _DamagedStepError(ValueError):
    """The numbers of a take are not what was written; the message says of which."""


def _opened(path: Path) -> Any:
    """Open a file for reading, whoever is writing it.

    Raises
    ------
    RunFileError
        If it is no HDF5 file.
    """
    try:
        try:
            file = h5py.File(path, "r", locking=False)
        except OSError as error:
            # This process has it open already, with a lock: HDF5 has one way of locking for both.
            if "locking" not in str(error):
                raise
            return h5py.File(path, "r")
        return _shareable(path, file)
    except OSError as error:
        # Removed after it was looked for, by whatever call of HDF5 that came first.
        if not path.exists():
            raise _absent(path) from None
        raise error_class(error)(
            f"{path}: is no HDF5 file, or cannot be read ({short_reason(error)}); name a run file"
        ) from error


def _shareable(path: Path, file: Any) -> Any:
    """Open a complete run as other programs of this process do by default: with a shared lock.

    HDF5 opens a file twice in one process only with the same way of locking. Nothing writes to a
    complete run any more, so the lock keeps no run from being continued.
    """
    if _status(file) != "complete":
        return file
    file.close()
    try:
        return h5py.File(path, "r")
    except OSError:
        # A file system that knows no locks, or somebody opened it without one just now.
        return h5py.File(path, "r", locking=False)


def _absent(path: Path) -> RunFileError:
    return RunFileError(f"{path}: there is no such file; check the name")


def _status(file: Any) -> str:
    """How a run ended that cannot be read; empty if that cannot be read either."""
    with contextlib.suppress(KeyError, *_DAMAGE):
        return read_text(file["entry"], "status")
    return ""


def _failure(path: Path, error: Exception, status: str) -> RunFileError:
    """Say why a run file cannot be read, and what to do."""
    if isinstance(error, _DamagedStepError):
        instead = "measure again"
        if status not in ("complete", ""):
            instead = "continue the run (acquire run … --resume), which measures the step again"
        return RunFileError(
            f"{path}: the numbers of {error} are damaged: they do not have the checksum that was "
            f"written with them; use another copy of the file, or {instead}"
        )
    if isinstance(error, KeyError):
        return RunFileError(
            f"{path}: is incomplete ({short_reason(error)}); measure again or use another copy"
        )
    return error_class(error)(
        f"{path}: is damaged ({short_reason(error)}); use another copy of the file"
    )
