"""Run files: one sweep in one HDF5 file that explains itself (``docs/run-file.md``)."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
import numpy.typing as npt

from acquire.errors import ProtocolError, RunFileError
from acquire.quality import Verdict
from acquire.reconstruction import Reconstruction
from acquire.reed_file import ReedFile
from acquire.run_layout import (
    EXPOSURE,
    FORMAT,
    FORMAT_VERSION,
    MEASURED,
    PLANNED_HZ,
    READ_BACK_HZ,
    READABLE_VERSIONS,
    SEAMS,
    SINCE_VERSION_2,
    Acquisition,
    Kind,
    RunLabels,
    Seam,
    short_reason,
)
from acquire.run_writer import MeasuredStep, RunWriter
from holography.fresnel import FresnelTransform
from holography.region import Region

__all__ = ["MeasuredStep", "Run", "RunLabels", "RunWriter", "StepRecord"]

# What h5py, and whoever makes sense of what it reads, raise where bytes are not what was written.
_DAMAGE = OSError, RuntimeError, ValueError, TypeError, ArithmeticError


@dataclass(frozen=True, slots=True)
class StepRecord:
    """One step of a run file.

    Attributes
    ----------
    position : int
        Place in the file, from 0; what `Run.field` wants.
    index : int
        k of the protocol's sweep.
    asked_hz, drive_hz, aom1_hz, aom2_hz, difference_hz, lock_residual_hz : Fraction
        As planned.
    volts : float
        Peak volts at the load, as planned.
    carrier_leak : float
        See `acquire.plan.Step`.
    read_aom1_hz, read_aom2_hz, read_drive_hz : Fraction or None
        What the instruments said; None if the step was not measured.
    read_volts : float
        NaN if the step was not measured, like all numbers below.
    exposure_s : float or None
        Of this step alone; None if it was that of the run.
    changed_s : float
        When the last setting was changed, on the camera's clock.
    timestamps_s : tuple of float
        Starts of the exposures, on the camera's clock.
    frame_ids : tuple of int
        -1 where there is no frame.
    signal_to_noise, noise_level, saturated_share, lock_error_hz, lock_error_se_hz : float
        See `MeasuredStep`.
    verdict : Verdict
    sentence : str
        Why that verdict.
    """

    position: int
    index: int
    order: int
    asked_hz: Fraction
    drive_hz: Fraction
    aom1_hz: Fraction
    aom2_hz: Fraction
    difference_hz: Fraction
    lock_residual_hz: Fraction
    volts: float
    carrier_leak: float
    read_aom1_hz: Fraction | None
    read_aom2_hz: Fraction | None
    read_drive_hz: Fraction | None
    read_volts: float
    exposure_s: float | None
    changed_s: float
    timestamps_s: tuple[float, ...]
    frame_ids: tuple[int, ...]
    signal_to_noise: float
    noise_level: float
    saturated_share: float
    lock_error_hz: float
    lock_error_se_hz: float
    verdict: Verdict
    sentence: str


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
    seams : tuple of Seam
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
    acoustic_lines_hz : tuple of float
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

    def __init__(self, path: Path, file: Any) -> None:
        self.path = path
        self._file = file
        entry = file["entry"]
        self.uid = _string(entry, "entry_identifier_uuid")
        self.title = _string(entry, "title")
        self.start_time, self.end_time = _string(entry, "start_time"), _string(entry, "end_time")
        self.status = _string(entry, "status")
        self._read_sample(entry)
        self._read_provenance(entry["provenance"])
        self._read_instrument(entry["instrument"])
        self._read_geometry(entry)
        self.format_version = int(file.attrs["format_version"])
        self.steps = tuple(_records(entry["steps"], self.sideband_order))
        self.retakes = tuple(_retaken(entry["retakes"], self.steps)) if "retakes" in entry else ()
        self.seams = tuple(_seams(entry["seams"])) if "seams" in entry else ()
        self.acquisition = _acquisition(entry)

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open a run file.

        Raises
        ------
        RunFileError
            If there is no such file, it is no HDF5 or no run file, or parts are missing or
            damaged.
        """
        path = Path(path)
        if path.is_dir():
            raise RunFileError(f"{path}: is a folder; name a run file in it")
        if not path.is_file():
            raise RunFileError(f"{path}: there is no such file; check the name")
        try:
            file = h5py.File(path, "r")
        except OSError as error:
            raise RunFileError(
                f"{path}: is no HDF5 file, or is being written ({short_reason(error)}); "
                "name a finished run file"
            ) from error
        try:
            _require_ours(path, file)
            return cls(path, file)
        except KeyError as error:
            file.close()
            raise RunFileError(
                f"{path}: is incomplete ({short_reason(error)}); measure again or use another copy"
            ) from error
        except _DAMAGE as error:
            file.close()
            raise RunFileError(
                f"{path}: is damaged ({short_reason(error)}); use another copy of the file"
            ) from error
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
        try:
            kept = self._file["entry/retakes"][name][number]
        except (KeyError, *_DAMAGE) as error:
            raise RunFileError(
                f"{self.path}: an earlier take of step {step.index} is damaged "
                f"({short_reason(error)}); use another copy of the file or do without it"
            ) from error
        field: npt.NDArray[np.complex64] = (
            kept if name == "field" else self.reconstruction.field(kept)
        )
        return field

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
        try:
            return self._file["entry/data"][name][step.position]
        except (KeyError, *_DAMAGE) as error:
            raise RunFileError(
                f"{self.path}: step {step.index} is damaged ({short_reason(error)}); "
                "use another copy of the file or do without this step"
            ) from error

    def _require_open(self) -> None:
        if not self._file:
            raise RunFileError(f"{self.path}: is closed; open it again with Run.open")

    def _read_sample(self, entry: Any) -> None:
        sample = entry["sample"]
        self.reed, self.series = _string(sample, "name"), _string(sample, "series")
        self.chamber = _string(sample, "chamber")
        strength = float(sample["strength"][()])
        self.labels = RunLabels(
            None if np.isnan(strength) else strength,
            _string(sample, "note"),
            _string(entry["user"], "name"),
        )

    def _read_provenance(self, origin: Any) -> None:
        self.protocol_text = _string(origin, "protocol")
        self.protocol_sha256 = _string(origin, "protocol_sha256")
        # Runs that do not say which reed they measured are of the time of one kind of reed.
        self.reed_text = _string(origin, "reed") if "reed" in origin else None
        self.reed_sha256 = _string(origin, "reed_sha256") if "reed" in origin else ""
        self.bench_text = _string(origin, "bench")
        self.bench_fingerprint = _string(origin, "bench_fingerprint")
        self.git_revision = _string(origin, "git_revision")
        self.package_versions: dict[str, str] = json.loads(_string(origin, "package_versions"))
        self.seed = int(origin["seed"][()])

    def _read_instrument(self, instrument: Any) -> None:
        detector = instrument["camera"]
        self.bench_name = _string(instrument, "name")
        self.identities = {
            role: _string(instrument[role], "identity")
            for role in ("synthesizers", "generator", "camera")
        }
        self.acoustic_lines_hz = tuple(float(hz) for hz in instrument["acoustic_lines"][()])
        self.frame_rate_hz = Fraction(_string(detector, "frame_rate_exact"))
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


def _require_ours(path: Path, file: Any) -> None:
    if file.attrs.get("format") != FORMAT:
        raise RunFileError(f"{path}: is HDF5 but no run file; name one that acquire wrote")
    found = file.attrs.get("format_version")
    if found not in READABLE_VERSIONS:
        raise RunFileError(
            f"{path}: has format version {found}, this software reads up to {FORMAT_VERSION}; "
            "update it"
        )


def _acquisition(entry: Any) -> Acquisition:
    """What the run is of; runs that do not say it are sweeps that stand alone."""
    if "acquisition" not in entry:
        return Acquisition()
    said = entry["acquisition"]
    return Acquisition(
        Kind(_string(said, "kind")),
        _string(said, "campaign"),
        _string(said, "part"),
        int(said["clamping"][()]),
    )


def _string(group: Any, name: str) -> str:
    value: str = group[name].asstr()[()]
    return value


def _records(steps: Any, order: int) -> Iterator[StepRecord]:
    """Read all columns at once, then give one record per step.

    `order` is that of runs which do not say it of every step.
    """
    planned = {n: steps[f"{n}_exact"].asstr()[()] for n in PLANNED_HZ}
    numbers = {n: steps[n][()] for n in ("index", "volts", "carrier_leak")}
    numbers["order"] = (
        steps["order"][()] if "order" in steps else np.full(len(numbers["index"]), order)
    )
    for position, taken in enumerate(_taken(steps)):
        # Of any type, for mypy: both mappings supply fields of several types.
        asked: dict[str, Any] = {n: _fraction(t[position]) for n, t in planned.items()}
        asked |= {name: column[position].item() for name, column in numbers.items()}
        yield StepRecord(position=position, **asked, **taken)


def _retaken(retakes: Any, steps: Sequence[StepRecord]) -> Iterator[StepRecord]:
    """Earlier takes, each as a record of its step."""
    positions = retakes["position"][()]
    for position, taken in zip(positions, _taken(retakes), strict=True):
        if position >= 0:
            yield replace(steps[position], **taken)


def _taken(group: Any) -> Iterator[dict[str, Any]]:
    """Fields of `StepRecord` that tell what was measured."""
    exact = {n: group[f"{n}_exact"].asstr()[()] for n in READ_BACK_HZ}
    count = len(group["verdict"])
    absent = np.full(count, np.nan)
    numbers = {
        n: group[n][()] if n in group or n not in SINCE_VERSION_2 else absent for n in MEASURED
    }
    exposure = group[EXPOSURE][()] if EXPOSURE in group else absent
    verdicts, sentences = (group[name].asstr()[()] for name in ("verdict", "sentence"))
    times, ids = group["timestamp_s"][()], group["frame_id"][()]
    for row in range(count):
        yield {
            "timestamps_s": tuple(float(time) for time in times[row]),
            "frame_ids": tuple(int(id) for id in ids[row]),
            "verdict": Verdict(verdicts[row]),
            "sentence": str(sentences[row]),
            **{name: _fraction(text[row]) for name, text in exact.items()},
            **{name: column[row].item() for name, column in numbers.items()},
            "exposure_s": None if np.isnan(exposure[row]) else float(exposure[row]),
        }


def _seams(group: Any) -> Iterator[Seam]:
    texts = [group[name].asstr()[()] for name in SEAMS[1:]]
    for position, kind, *others in zip(group["position"][()], *texts, strict=True):
        if position >= 0:
            yield Seam(int(position), kind, *others)


def _fraction(text: str) -> Fraction | None:
    return Fraction(text) if text else None
