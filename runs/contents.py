"""Write everything that a run file holds before its first step, and prove that the disk has it.

The layout is described in ``docs/reference/run-file.md``. All space is allocated here, so that
writing a step only overwrites bytes.
"""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import numpy.typing as npt

from drivers.roles import Bench
from holography.reconstruction import Reconstruction
from physics.optics import reed_axes_m
from protocols.plan import Plan
from runs.errors import DiskError
from runs.integrity.checksums import (
    CHECKSUMS,
    HEADER_CHECKSUM,
    header_checksum,
    in_header,
)
from runs.integrity.proof import differing, missing_bytes
from runs.layout import (
    EXACT_BYTES,
    EXPOSURE,
    FORMAT,
    FORMAT_VERSION,
    FREE,
    INTERRUPTIONS,
    INTERRUPTIONS_MAX,
    MEASURED,
    PLANNED_HZ,
    READ_BACK_HZ,
    SENTENCE_BYTES,
    RunKind,
    RunLabels,
    exact_text,
    short_reason,
)
from runs.verdict import Verdict

# Chosen: the longest verdict and status ("interrupted") has 11 bytes.
_VERDICT_BYTES: Final = 16
# Chosen: an ISO 8601 time in UTC, as `writer.now` returns it, has 25 bytes.
_TIME_BYTES: Final = 40
# Errors that h5py raises when bytes differ from those that were written.
_UNREADABLE: Final = (OSError, RuntimeError, KeyError, ValueError, TypeError)


@dataclass(frozen=True)
class NewRun:
    """Everything that is known about a run before its first step.

    Attributes
    ----------
    plan : Plan
    bench : Bench
        Open bench; supplies its names and the preparation.
    identities : mapping of str to str
        Identity of each instrument by role, read once: a driver may not return the same text twice.
    saturation_dn : int
        Value of a saturated pixel, read once.
    labels : RunLabels
    reconstruction : Reconstruction
    uid : str
        Unique identifier of the run.
    began : str
        Time of the start, ISO 8601.
    origin : mapping of str to object
        ``git_revision`` and ``package_versions``, see `runs.provenance`.
    """

    plan: Plan
    bench: Bench
    identities: Mapping[str, str]
    saturation_dn: int
    labels: RunLabels
    reconstruction: Reconstruction
    uid: str
    began: str
    origin: Mapping[str, Any]


def fill(file: Any, new: NewRun, *, allocate: bool) -> None:
    """Write everything that is known before the first step.

    Parameters
    ----------
    file : h5py.File
        Empty file, open for writing.
    new : NewRun
    allocate : bool
        Whether space for the images of all steps is allocated now.
    """
    _write_entry(file, new)
    _write_instruments(file["entry"], new)
    _write_steps(file["entry"], new.plan)
    _write_earlier_attempts(file["entry"], new.plan, allocate=allocate)
    _write_interruptions(file["entry"])
    _write_data(file["entry"], new.plan, new.reconstruction, allocate=allocate)
    written: dict[str, Any] = {}
    file.visititems(lambda name, node: _add_header(written, name, node))
    _put(file, HEADER_CHECKSUM, np.uint64(header_checksum(written)))


def _add_header(values: dict[str, Any], name: str, node: Any) -> None:
    """Add the value of a dataset to `values` if the header checksum covers it."""
    if isinstance(node, h5py.Dataset) and in_header(name):
        values[name] = node[()]


def prove(path: Path, unborn: Path, new: NewRun) -> None:
    """Read a new file back and compare it with the content that should have been written.

    Parameters
    ----------
    path : Path
        Final path of the run file; used in messages.
    unborn : Path
        Path of the new file, see `runs.integrity.unborn`.
    new : NewRun

    Raises
    ------
    DiskError
        If anything differs, is missing, or cannot be read.
    """
    pictures = frozenset(
        f"/entry/{group}/{_kept(new.plan)[0]}" for group in ("data", "earlier_attempts")
    )
    try:
        short = missing_bytes(unborn)
        wrong = f"its last {short} bytes" if short else ""
        if not wrong:
            with (
                h5py.File(unborn, "r", locking=False) as found,
                h5py.File(io.BytesIO(), "w") as expected,
            ):
                fill(expected, new, allocate=False)
                wrong = differing(found, expected, pictures) or _unallocated(found, pictures)
    except _UNREADABLE as error:
        wrong = f"everything: {short_reason(error)}"
    if wrong:
        raise DiskError(
            f"{path}: cannot be made: the disk does not give back what was written (wrong: {wrong})"
            "; use another disk"
        )


def _unallocated(file: Any, pictures: frozenset[str]) -> str:
    """Return the name of an image dataset that is not fully allocated; empty if there is none."""
    found = [file[name] for name in sorted(pictures) if name in file]
    return next((p.name for p in found if p.id.get_storage_size() != p.nbytes), "")


def _write_entry(file: Any, new: NewRun) -> None:
    file.attrs.update(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "default": "entry",
            "NX_class": "NXroot",
        }
    )
    plan, bench, labels = new.plan, new.bench, new.labels
    protocol, preparation = plan.protocol, bench.preparation
    entry = _group(file, "entry", "NXentry")
    entry.attrs["default"] = "data"
    _put(entry, "title", protocol.name)
    _put(entry, "entry_identifier_uuid", new.uid)
    _put(entry, "start_time", new.began)
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
    _put(origin, "git_revision", new.origin["git_revision"])
    _put(origin, "package_versions", json.dumps(new.origin["package_versions"]))
    _put(origin, "seed", bench.seed)
    if bench.simulated_disorder:
        _put(origin, "simulated_disorder", bench.simulated_disorder)


def _kind_of(plan: Plan) -> RunKind:
    calibration = plan.protocol.calibration
    return RunKind.SWEEP if calibration is None else RunKind(calibration.kind)


def _write_instruments(entry: Any, new: NewRun) -> None:
    plan = new.plan
    camera, optics, limits = plan.bench.instruments.camera, plan.bench.optics, plan.bench.limits
    instrument = _group(entry, "instrument", "NXinstrument")
    _put(instrument, "name", new.bench.name)
    _put(
        instrument,
        "acoustic_resonances",
        [float(hz) for hz in plan.bench.acoustic_resonances_hz],
        "Hz",
    )
    for role, identity in new.identities.items():
        kind = "NXdetector" if role == "camera" else "NXcollection"
        _put(_group(instrument, role, kind), "identity", identity)
    detector, rows_columns = instrument["camera"], plan.frame_shape
    _put(detector, "frame_rate", float(plan.protocol.camera.frame_rate_hz), "Hz")
    _put(detector, "frame_rate_exact", exact_text(plan.protocol.camera.frame_rate_hz))
    _put(detector, "count_time", float(plan.protocol.exposure_s), "s")
    _put(detector, "bit_depth_readout", camera.bits)
    _put(detector, "saturation_value", new.saturation_dn)
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
    for name, (values, unit) in planned_columns(plan).items():
        _put(steps, name, values, unit)
    _allocate_measured(steps, len(plan.steps), plan)


def planned_columns(plan: Plan) -> dict[str, tuple[npt.NDArray[Any], str]]:
    """Return values and unit of each column of ``/entry/steps`` that the plan determines."""
    steps = plan.steps
    columns: dict[str, tuple[npt.NDArray[Any], str]] = {
        "index": (np.array([step.index for step in steps]), ""),
        "order": (np.array([step.order for step in steps]), ""),
        "volts": (np.array([float(step.volts) for step in steps]), "V"),
        "carrier_leak": (np.array([float(step.carrier_leak) for step in steps]), ""),
    }
    if any(step.exposure_s != plan.protocol.exposure_s for step in steps):
        columns[EXPOSURE] = (np.array([float(step.exposure_s) for step in steps]), "s")
    for name in PLANNED_HZ:
        values: list[Fraction] = [getattr(step, name) for step in steps]
        texts = [exact_text(value).encode() for value in values]
        columns[name] = (np.array([float(value) for value in values]), "Hz")
        columns[f"{name}_exact"] = (np.array(texts, dtype=_text(EXACT_BYTES)), "")
    return columns


def _write_earlier_attempts(entry: Any, plan: Plan, *, allocate: bool) -> None:
    """Allocate places for earlier attempts of repeated steps; position -1 is free."""
    earlier_attempts, count = _group(entry, "earlier_attempts", "NXcollection"), plan.spare_attempts
    _allocate(earlier_attempts, "position", (count,), np.int64, FREE)
    _allocate_measured(earlier_attempts, count, plan)
    if count:
        name, dtype, shape = _kept(plan)
        _allocate_signal(earlier_attempts, name, dtype, (count, *shape), allocate=allocate)


def _write_interruptions(entry: Any) -> None:
    interruptions = _group(entry, "interruptions", "NXcollection")
    _allocate(interruptions, "position", (INTERRUPTIONS_MAX,), np.int64, -1)
    for name in INTERRUPTIONS[1:]:
        _allocate(interruptions, name, (INTERRUPTIONS_MAX,), _text(SENTENCE_BYTES), "")


def _allocate_measured(group: Any, count: int, plan: Plan) -> None:
    """Allocate the columns of everything that is measured, with `count` rows."""
    frames = (count, max(step.frames for step in plan.steps))
    for name in READ_BACK_HZ:
        _allocate(group, name, (count,), np.float64, np.nan, "Hz")
        _allocate(group, f"{name}_exact", (count,), _text(EXACT_BYTES), "")
    for name, unit in MEASURED.items():
        _allocate(group, name, (count,), np.float64, np.nan, unit)
    _allocate(group, "timestamp_s", frames, np.float64, np.nan, "s")
    _allocate(group, "frame_id", frames, np.int64, -1)
    for name in CHECKSUMS:
        _allocate(group, name, (count,), np.uint64, 0)
    _allocate(group, "verdict", (count,), _text(_VERDICT_BYTES), str(Verdict.PENDING))
    _allocate(group, "sentence", (count,), _text(SENTENCE_BYTES), "")


def _write_data(entry: Any, plan: Plan, reconstruction: Reconstruction, *, allocate: bool) -> None:
    region, transform = reconstruction.region, reconstruction.transform
    y_m, x_m = reed_axes_m(plan.layout, region, transform)
    data = _group(entry, "data", "NXdata")
    # A soft link, so that the axis is stored once.
    data["drive_hz"] = h5py.SoftLink("/entry/steps/drive_hz")
    _put(data, "y_m", y_m, "m")
    _put(data, "x_m", x_m, "m")
    region_group = _group(entry, "region", "NXcollection")
    for name in ("row", "column", "height", "width"):
        _put(region_group, name, getattr(region, name))
    name, dtype, shape = _kept(plan)
    axes = ["drive_hz", "y_m", "x_m"] if name == "field" else ["drive_hz", ".", ".", "."]
    data.attrs.update({"signal": name, "axes": axes})
    _allocate_signal(data, name, dtype, (len(plan.steps), *shape), allocate=allocate)


def _kept(plan: Plan) -> tuple[str, Any, tuple[int, ...]]:
    """Return name, type and shape of the images that the run keeps of each step."""
    if plan.protocol.keep == "holograms":
        return "field", np.complex64, (plan.region.height, plan.region.width)
    return "frames", np.uint16, (max(step.frames for step in plan.steps), *plan.frame_shape)


def _allocate_signal(
    group: Any, name: str, dtype: Any, shape: tuple[int, ...], *, allocate: bool
) -> None:
    """Allocate space for the images of all steps, one chunk for each step.

    The chunks are not compressed. HDF5 allocates a compressed chunk when it is written, and
    sometimes splits its chunk index for it; a program that is killed at that moment leaves steps
    that cannot be read (decision 0010).
    """
    early = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    if allocate:
        early.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    # Without fill values: the file system returns zeros for steps that are not written yet.
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


def _allocate(
    group: Any, name: str, shape: tuple[int, ...], dtype: Any, empty: object, unit: str = ""
) -> None:
    """Create a column and write its empty values, so that HDF5 allocates its bytes now."""
    content = np.full(shape, empty.encode() if isinstance(empty, str) else empty, dtype)
    dataset = group.create_dataset(name, data=content, dtype=dtype)
    if unit:
        dataset.attrs["units"] = unit


def _text(length: int) -> Any:
    return h5py.string_dtype("utf-8", length)
