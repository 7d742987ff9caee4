"""Writes run files: one sweep in one HDF5 file that explains itself (``docs/run-file.md``).

Everything is allocated before the first step, so a step overwrites bytes and
moves nothing. Its verdict is written, and flushed, after its data: a program that is killed at any
moment leaves a file that opens with plain h5py, in which every step with a verdict is whole. A step
that is taken again is copied to a spare place first.
"""

import contextlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Self

import h5py
import numpy as np
import numpy.typing as npt

from acquire.errors import RunFileError
from acquire.plan import Plan
from acquire.provenance import git_revision, package_versions
from acquire.quality import Judgement, ReadBack, Verdict
from acquire.reconstruction import Reconstruction
from acquire.run_layout import (
    EXACT_BYTES,
    EXPOSURE,
    FORMAT,
    FORMAT_VERSION,
    MEASURED,
    PLANNED_HZ,
    READ_BACK_HZ,
    SEAMS,
    SEAMS_MAX,
    Kind,
    RunLabels,
    Seam,
    Status,
    exact_text,
    short_reason,
)
from drivers.roles import Bench, Frame
from physics.optics import reed_axes_m

# h5py raises the second kind where the disk refuses what it had kept back.
_DISK_ERRORS: Final = (OSError, RuntimeError)
# For what HDF5 writes besides a step: a few pages.
_RESERVE_BYTES: Final = 1_000_000
_VERDICT_BYTES: Final = 16
_SENTENCE_BYTES: Final = 240
_TIME_BYTES: Final = 40
# Positions of `/entry/retakes`. A step that is being set aside has _UNDER_WAY less its position, so
# that `resume` can finish what a process was killed in.
_FREE, _UNDER_WAY = -1, -2


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredStep:
    """What one acquisition gave.

    Attributes
    ----------
    read_back : ReadBack
    changed_s : float
        When the last setting was changed, on the camera's clock.
    frames : sequence of Frame
    field : (height, width) complex64
        Around the reed.
    signal_to_noise, noise_level : float
        Mean ``|H|²`` in the reed's region over that of an empty pixel, and the latter, in dn².
    saturated_share : float
    lock_error_hz, lock_error_se_hz : float
        By how much f_AOM1 − f_AOM2 missed the lock, as the frames show it, and its standard error.
    judgement : Judgement
    """

    read_back: ReadBack
    changed_s: float
    frames: Sequence[Frame]
    field: npt.NDArray[np.complex64]
    signal_to_noise: float
    noise_level: float
    saturated_share: float
    lock_error_hz: float
    lock_error_se_hz: float
    judgement: Judgement


class RunWriter:
    """A run file that is being written. Used by one thread at a time.

    Attributes
    ----------
    path : Path
    """

    def __init__(self, path: Path, file: Any, keep: str) -> None:
        self.path = path
        self._file = file
        self._steps, self._retakes = file["entry/steps"], file["entry/retakes"]
        self._keep = keep
        self._name = "field" if keep == "holograms" else "frames"
        self._signal = file["entry/data"][self._name]

    @classmethod
    def create(
        cls,
        path: str | Path,
        plan: Plan,
        bench: Bench,
        labels: RunLabels,
        reconstruction: Reconstruction,
        uid: str,
    ) -> Self:
        """Make the file with everything that is known before the first step.

        Parameters
        ----------
        path : str or Path
        plan : Plan
        bench : Bench
            Open, with its camera configured.
        labels : RunLabels
        reconstruction : Reconstruction
            Supplies the geometry that a reader needs to interpret pixels.
        uid : str
            Identifies the run everywhere.

        Raises
        ------
        RunFileError
            If the file exists already or cannot be made; none is left behind.
        """
        path = Path(path)
        if path.exists():
            raise RunFileError(
                f"{path}: exists already and is never overwritten; choose another name or move it"
            )
        # A file has its name only once it is whole: killed before, a run leaves none.
        unborn = path.with_name(f".{path.name}.part")
        try:
            with h5py.File(unborn, "w") as file:
                _write_entry(file, plan, bench, labels, uid)
                _write_instruments(file["entry"], plan, bench)
                _write_steps(file["entry"], plan)
                _write_retakes(file["entry"], plan)
                _write_seams(file["entry"])
                _write_data(file["entry"], plan, reconstruction)
            unborn.rename(path)
            return cls(path, h5py.File(path, "r+"), plan.protocol.keep)
        except _DISK_ERRORS as error:
            raise _cannot_make(path, error) from error
        finally:
            unborn.unlink(missing_ok=True)

    @classmethod
    def resume(cls, path: str | Path, plan: Plan) -> Self:
        """Open the file of a run that is not complete, to go on with it.

        Parameters
        ----------
        path : str or Path
        plan : Plan
            The one that the run was begun with.

        Raises
        ------
        RunFileError
            If another program has the file open, or it cannot be written.
        """
        path = Path(path)
        try:
            file = h5py.File(path, "r+")
        except _DISK_ERRORS as error:
            raise RunFileError(
                f"{path}: cannot be gone on with ({short_reason(error)}); see whether another "
                "program has it open"
            ) from error
        writer = cls(path, file, plan.protocol.keep)
        for place in np.flatnonzero(writer._retakes["position"][()] <= _UNDER_WAY):
            writer._finish_setting_aside(int(place))
        return writer

    @property
    def spare(self) -> int:
        """How many takes may still be set aside."""
        return int(np.count_nonzero(self._retakes["position"][()] == _FREE))

    def reopen(self, seam: Seam) -> None:
        """Note that the run goes on, and where.

        Raises
        ------
        RunFileError
            If the disk refuses.
        """
        self._set_status("running")
        self.add_seam(seam)

    def add_seam(self, seam: Seam) -> None:
        """Note where the run was not carried on at once; those beyond the last place are lost.

        Raises
        ------
        RunFileError
            If the disk refuses.
        """
        seams = self._file["entry/seams"]
        free = np.flatnonzero(seams["position"][()] < 0)
        if not free.size:
            return
        try:
            for name in SEAMS[1:]:
                value = str(getattr(seam, name)).encode()[:_SENTENCE_BYTES].decode(errors="ignore")
                seams[name][free[0]] = value
            seams["position"][free[0]] = seam.position
            self._file.flush()
        except _DISK_ERRORS as error:
            raise RunFileError(f"{self.path}: cannot be written ({short_reason(error)})") from error

    def set_aside(self, position: int) -> None:
        """Copy a step to a spare place, and make its own place that of a step to come.

        Raises
        ------
        RunFileError
            If there is no spare place, or the disk refuses.
        """
        free = np.flatnonzero(self._retakes["position"][()] == _FREE)
        if not free.size:
            raise RunFileError(
                f"{self.path}: has no room for another take of step {position + 1}; measure the "
                "sweep again"
            )
        try:
            for name in _taken_columns():
                self._retakes[name][free[0]] = self._steps[name][position]
            self._retakes[self._name][free[0]] = self._signal[position]
            self._file.flush()
            self._retakes["position"][free[0]] = _UNDER_WAY - position
            self._file.flush()
            self._finish_setting_aside(int(free[0]))
        except _DISK_ERRORS as error:
            raise RunFileError(
                f"{self.path}: step {position + 1} cannot be set aside ({short_reason(error)}); "
                "make room on the disk"
            ) from error

    def write(self, position: int, step: MeasuredStep) -> None:
        """Write one step; on return all of it is with the operating system.

        Parameters
        ----------
        position : int
            Place in the plan, from 0.
        step : MeasuredStep

        Raises
        ------
        RunFileError
            If the disk refuses.
        """
        self._require_room()
        try:
            if self._keep == "holograms":
                self._signal[position] = step.field
            else:
                self._signal[position] = self._stacked(step.frames)
            self._write_numbers(position, step)
            self._file.flush()
            self._write_judgement(position, step.judgement)
        except _DISK_ERRORS as error:
            raise RunFileError(
                f"{self.path}: step {position + 1} cannot be written ({short_reason(error)}); "
                "make room on the disk; the steps before it are safe"
            ) from error

    def mark(self, position: int, verdict: Verdict, reason: str) -> None:
        """Note that a step was begun and given up (interrupted), or is done without (skipped).

        Raises
        ------
        RunFileError
            If the disk refuses.
        """
        try:
            self._write_judgement(position, Judgement(verdict, reason))
        except _DISK_ERRORS as error:
            raise RunFileError(f"{self.path}: cannot be written ({short_reason(error)})") from error

    def finish(self, status: Status) -> None:
        """Write how the run ended, and close the file. Does nothing to a closed one.

        Raises
        ------
        RunFileError
            If the disk refuses.
        """
        if not self._file:
            return
        try:
            self._set_status(status)
            self._file.close()
        except _DISK_ERRORS as error:
            # What cannot be written now cannot be written later; trying again would raise anew.
            with contextlib.suppress(*_DISK_ERRORS):
                self._file.close()
            _make_openable(self.path)
            raise RunFileError(f"{self.path}: cannot be closed ({short_reason(error)})") from error

    def discard(self) -> None:
        """Close and remove a file that holds nothing worth keeping."""
        self._file.close()
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file as it is. May be called twice."""
        self._file.close()

    def _finish_setting_aside(self, place: int) -> None:
        """Free a step whose take is whole at a place of `/entry/retakes`."""
        position = _UNDER_WAY - int(self._retakes["position"][place])
        # First: a step with a verdict has the sentence that goes with it.
        self._steps["verdict"][position] = str(Verdict.PENDING)
        self._file.flush()
        self._write_judgement(position, Judgement(Verdict.PENDING, "to be taken again"))
        self._retakes["position"][place] = position
        self._file.flush()

    def _require_room(self) -> None:
        """Refuse a step for which the disk has no room, while the file can still be closed."""
        step_bytes = int(self._signal.dtype.itemsize * np.prod(self._signal.shape[1:]))
        free_bytes = shutil.disk_usage(self.path.parent).free
        if free_bytes < step_bytes + _RESERVE_BYTES:
            raise RunFileError(
                f"{self.path}: its disk has {free_bytes / 1e6:.1f} MB left, too little for another "
                "step; make room on the disk; the steps before are safe"
            )

    def _stacked(self, frames: Sequence[Frame]) -> npt.NDArray[np.uint16]:
        """Frames of one step in one array, with zeros for those that did not come.

        Written together, as they lie in the file.
        """
        stack = np.zeros(self._signal.shape[1:], dtype=np.uint16)
        for place, frame in zip(stack, frames, strict=False):
            place[...] = frame.image
        return stack

    def _set_status(self, status: Status) -> None:
        self._file["entry/status"][()] = status
        self._file["entry/end_time"][()] = "" if status == "running" else now()
        self._file.flush()

    def _write_numbers(self, position: int, step: MeasuredStep) -> None:
        for column in READ_BACK_HZ:
            hz: Fraction = getattr(step.read_back, column.removeprefix("read_"))
            self._steps[column][position] = float(hz)
            self._steps[f"{column}_exact"][position] = exact_text(hz)
        self._steps["read_volts"][position] = step.read_back.volts
        for column in MEASURED:
            if column != "read_volts":
                self._steps[column][position] = getattr(step, column)
        times, ids = self._steps["timestamp_s"], self._steps["frame_id"]
        for number in range(ids.shape[1]):
            # Nothing of an earlier take may stay.
            there = number < len(step.frames)
            times[position, number] = step.frames[number].timestamp_s if there else np.nan
            ids[position, number] = step.frames[number].id if there else -1

    def _write_judgement(self, position: int, judgement: Judgement) -> None:
        sentence = judgement.sentence.encode()[:_SENTENCE_BYTES].decode(errors="ignore")
        self._steps["sentence"][position] = sentence
        self._file.flush()
        self._steps["verdict"][position] = str(judgement.verdict)
        self._file.flush()


def _make_openable(path: Path) -> None:
    """Make a file as long as it says that it is.

    HDF5 refuses a file that ends before the place where its superblock (version 0: eight bytes
    from byte 40) says that it does. A disk that refused data may have left one so. What is missing
    belongs to a step without a verdict, and zeros at the end of a file need no room.
    """
    with contextlib.suppress(OSError), path.open("r+b") as file:
        head = file.read(48)
        if head[:8] == b"\x89HDF\r\n\x1a\n" and head[8] == 0:
            end = int.from_bytes(head[40:48], "little")
            if file.seek(0, os.SEEK_END) < end:
                file.truncate(end)


def _cannot_make(path: Path, error: Exception) -> RunFileError:
    return RunFileError(
        f"{path}: cannot be made ({short_reason(error)}); check folder, rights and room on the disk"
    )


def _write_entry(file: Any, plan: Plan, bench: Bench, labels: RunLabels, uid: str) -> None:
    file.attrs.update(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "default": "entry",
            "NX_class": "NXroot",
        }
    )
    protocol, preparation = plan.protocol, bench.preparation
    entry = _group(file, "entry", "NXentry")
    entry.attrs["default"] = "data"
    _put(entry, "title", protocol.name)
    _put(entry, "entry_identifier_uuid", uid)
    _put(entry, "start_time", now())
    entry.create_dataset("end_time", data="", dtype=_text(_TIME_BYTES))
    entry.create_dataset("status", data="running", dtype=_text(_VERDICT_BYTES))
    _put(entry, "program_name", "reedbench")
    _put(_group(entry, "user", "NXuser"), "name", labels.operator)
    sample = _group(entry, "sample", "NXsample")
    _put(sample, "name", preparation.reed)
    _put(sample, "strength", np.nan if labels.strength is None else labels.strength)
    _put(sample, "series", preparation.series)
    _put(sample, "chamber", preparation.chamber)
    _put(sample, "note", labels.note)
    acquisition = _group(entry, "acquisition", "NXcollection")
    _put(acquisition, "kind", str(_kind_of(plan)))
    for name in ("campaign", "part", "clamping"):
        _put(acquisition, name, getattr(labels, name))
    origin = _group(entry, "provenance", "NXcollection")
    _put(origin, "protocol", protocol.text)
    _put(origin, "protocol_sha256", protocol.sha256)
    _put(origin, "reed", plan.reed.text)
    _put(origin, "reed_sha256", plan.reed.sha256)
    _put(origin, "bench", plan.bench.text)
    _put(origin, "bench_fingerprint", bench.fingerprint)
    _put(origin, "git_revision", git_revision() or "")
    _put(origin, "package_versions", json.dumps(package_versions()))
    _put(origin, "seed", bench.seed)


def _kind_of(plan: Plan) -> Kind:
    calibration = plan.protocol.calibration
    return Kind.SWEEP if calibration is None else Kind(calibration.kind)


def _write_instruments(entry: Any, plan: Plan, bench: Bench) -> None:
    camera, optics, limits = plan.bench.instruments.camera, plan.bench.optics, plan.bench.limits
    instrument = _group(entry, "instrument", "NXinstrument")
    _put(instrument, "name", bench.name)
    _put(instrument, "acoustic_lines", [float(hz) for hz in plan.bench.acoustic_lines_hz], "Hz")
    for role, identity in bench.identities.items():
        kind = "NXdetector" if role == "camera" else "NXcollection"
        _put(_group(instrument, role, kind), "identity", identity)
    detector, rows_columns = instrument["camera"], plan.frame_shape
    _put(detector, "frame_rate", float(plan.protocol.camera.frame_rate_hz), "Hz")
    _put(detector, "frame_rate_exact", exact_text(plan.protocol.camera.frame_rate_hz))
    _put(detector, "count_time", float(plan.protocol.exposure_s), "s")
    _put(detector, "bit_depth_readout", camera.bits)
    _put(detector, "saturation_value", bench.camera.saturation_dn)
    _put(detector, "pixel_size", float(camera.pixel_m), "m")
    _put(detector, "rows", rows_columns[0])
    _put(detector, "columns", rows_columns[1])
    _put(instrument["synthesizers"], "sideband_order", plan.protocol.sideband.order)
    _put(instrument["generator"], "volts_max", float(limits.volts_max_v), "V")
    laser = _group(instrument, "laser", "NXsource")
    _put(laser, "wavelength", float(optics.wavelength_m), "m")
    _put(laser, "distance", float(optics.distance_m), "m")


def _write_steps(entry: Any, plan: Plan) -> None:
    steps = _group(entry, "steps", "NXcollection")
    _put(steps, "index", [step.index for step in plan.steps])
    _put(steps, "order", [step.order for step in plan.steps])
    _put(steps, "volts", [step.volts for step in plan.steps], "V")
    _put(steps, "carrier_leak", [step.carrier_leak for step in plan.steps])
    if any(step.exposure_s != plan.protocol.exposure_s for step in plan.steps):
        _put(steps, EXPOSURE, [float(step.exposure_s) for step in plan.steps], "s")
    for name in PLANNED_HZ:
        _put_exact(steps, name, [getattr(step, name) for step in plan.steps])
    _allocate_taken(steps, len(plan.steps), plan)


def _write_retakes(entry: Any, plan: Plan) -> None:
    """Places for takes that were taken again; position -1 is a free one."""
    retakes, count = _group(entry, "retakes", "NXcollection"), plan.spare_takes
    _allocate(retakes, "position", (count,), np.int64, -1)
    _allocate_taken(retakes, count, plan)
    if count:
        name, dtype, shape = _kept(plan)
        _allocate_signal(retakes, name, dtype, (count, *shape))


def _write_seams(entry: Any) -> None:
    seams = _group(entry, "seams", "NXcollection")
    _allocate(seams, "position", (SEAMS_MAX,), np.int64, -1)
    for name in SEAMS[1:]:
        _allocate(seams, name, (SEAMS_MAX,), _text(_SENTENCE_BYTES), "")


def _taken_columns() -> tuple[str, ...]:
    """Names of what is measured of a step besides its pictures."""
    exact = (f"{name}_exact" for name in READ_BACK_HZ)
    return (*READ_BACK_HZ, *exact, *MEASURED, "timestamp_s", "frame_id", "verdict", "sentence")


def _allocate_taken(group: Any, count: int, plan: Plan) -> None:
    frames = (count, max(step.frames for step in plan.steps))
    for name in READ_BACK_HZ:
        _allocate(group, name, (count,), np.float64, np.nan, "Hz")
        _allocate(group, f"{name}_exact", (count,), _text(EXACT_BYTES), "")
    for name, unit in MEASURED.items():
        _allocate(group, name, (count,), np.float64, np.nan, unit)
    _allocate(group, "timestamp_s", frames, np.float64, np.nan, "s")
    _allocate(group, "frame_id", frames, np.int64, -1)
    _allocate(group, "verdict", (count,), _text(_VERDICT_BYTES), str(Verdict.PENDING))
    _allocate(group, "sentence", (count,), _text(_SENTENCE_BYTES), "")


def _write_data(entry: Any, plan: Plan, reconstruction: Reconstruction) -> None:
    region, transform = reconstruction.region, reconstruction.transform
    y_m, x_m = reed_axes_m(plan.layout, region, transform)
    data = _group(entry, "data", "NXdata")
    # Soft, so that the axis is stored once.
    data["drive_hz"] = h5py.SoftLink("/entry/steps/drive_hz")
    _put(data, "y_m", y_m, "m")
    _put(data, "x_m", x_m, "m")
    where = _group(entry, "region", "NXcollection")
    for name in ("row", "column", "height", "width"):
        _put(where, name, getattr(region, name))
    name, dtype, shape = _kept(plan)
    axes = ["drive_hz", "y_m", "x_m"] if name == "field" else ["drive_hz", ".", ".", "."]
    data.attrs.update({"signal": name, "axes": axes})
    _allocate_signal(data, name, dtype, (len(plan.steps), *shape))


def _kept(plan: Plan) -> tuple[str, Any, tuple[int, ...]]:
    """Name, type and shape of what is kept of each step."""
    if plan.protocol.keep == "holograms":
        return "field", np.complex64, (plan.region.height, plan.region.width)
    return "frames", np.uint16, (max(step.frames for step in plan.steps), *plan.frame_shape)


def _allocate_signal(group: Any, name: str, dtype: Any, shape: tuple[int, ...]) -> None:
    """Make room for the pictures of every step, a chunk each.

    Not compressed: chunks that take their place when they come make HDF5 split its index now and
    then, and a program killed at that moment leaves steps that cannot be read (decision 0010).
    """
    early = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    early.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    # Zeros for steps to come are not written, the file system supplies them.
    dataset = group.create_dataset(
        name, shape, dtype, chunks=(1, *shape[1:]), dcpl=early, fill_time="never"
    )
    dataset.attrs["units"] = "dn"


def _group(parent: Any, name: str, kind: str) -> Any:
    group = parent.create_group(name)
    group.attrs["NX_class"] = kind
    return group


def _put(group: Any, name: str, value: object, unit: str = "") -> None:
    dataset = group.create_dataset(name, data=value)
    if unit:
        dataset.attrs["units"] = unit


def _put_exact(group: Any, name: str, values: Sequence[Fraction]) -> None:
    _put(group, name, [float(value) for value in values], "Hz")
    texts = [exact_text(value) for value in values]
    group.create_dataset(f"{name}_exact", data=texts, dtype=_text(EXACT_BYTES))


def _allocate(
    group: Any, name: str, shape: tuple[int, ...], dtype: Any, empty: object, unit: str = ""
) -> None:
    """Make a column and write it, so that HDF5 allocates its bytes now."""
    dataset = group.create_dataset(name, shape, dtype)
    dataset[...] = empty
    if unit:
        dataset.attrs["units"] = unit


def _text(length: int) -> Any:
    return h5py.string_dtype("utf-8", length)


def now() -> str:
    """Return the time, ISO 8601 and UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")
