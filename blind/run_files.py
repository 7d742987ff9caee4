"""Recordings as run files, by what ``docs/reference/run-file.md`` says and nothing else."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from blind.laboratory import (
    FRAME_S,
    Laboratory,
    Recording,
    Shot,
    step_hz,
)
from blind.optics import DISTANCE_M, WAVELENGTH_M

# No case was measured on any day.
_DAY = datetime(2000, 1, 1, 9, tzinfo=UTC)
_CENTRE_HZ = Fraction(80_000_000)
_FRAME_RATE = Fraction(62, 5)
_TEXT = h5py.string_dtype("utf-8", 200)
_BENCH = """\
name: laboratory {name}
instruments:
  synthesizers: {{driver: simulated, step: 0.1 Hz, centre: 80 MHz, window: 5 MHz}}
  generator: {{driver: simulated, step: 1 uHz}}
  camera:
    {{driver: simulated, width: {rows}, height: {rows}, pixel: 6.7 um, bits: 12,
      max_frame_rate: 12.5 Hz,
      data_sheet: {{offset_dn: 50, gain_e_dn: 4, read_noise_e: 12, full_well_e: 16000}}}}
optics:
  {{wavelength: 650 nm, distance: 0.8 m, reed_centre: {{y: 22 mm, x: 0 mm}}}}
limits: {{volts_are: peak, volts_min: 0 V, volts_max: 16 V, drive_min: 20 Hz, drive_max: 20 kHz}}
acoustic_resonances: [4308.6 Hz]
twin: {{light: {{local_oscillator_e_s: 80000.0, object_e_s: 6000.0}}}}
"""


# Units of what a laboratory may state of its effects.
_UNITS = {
    "laser_power_drift": "1/h",
    "synthesizer_detuning": "Hz",
    "phase_step_error": "rad",
    "tip_mass": "kg",
}


def bench_text(case: str, laboratory: Laboratory, stated: Mapping[str, Mapping[str, float]]) -> str:
    """Return the bench file of a laboratory, with what it states of its effects."""
    text = _BENCH.format(name=case, rows=laboratory.world.chip.rows)
    if not stated:
        return text
    lines = ["known:"]
    for effect, sizes in stated.items():
        unit = _UNITS.get(effect, "")
        values = (
            f"{name}: {f'{value:.6g} {unit}' if unit else repr(float(value))}"
            for name, value in sizes.items()
        )
        lines.append(f"  {effect}: {{{', '.join(values)}}}")
    return "\n".join([text.rstrip(), *lines, ""])


def write_recording(
    path: Path,
    case: str,
    laboratory: Laboratory,
    recording: Recording,
    stated: Mapping[str, Mapping[str, float]],
) -> None:
    """Write one recording as a run file.

    Parameters
    ----------
    path : Path
        Must not exist.
    case : str
        Name of the reed and of the campaign.
    laboratory : Laboratory
    recording : Recording
    stated : mapping
        Sizes of effects that the laboratory knows of, by their names.
    """
    with h5py.File(path, "x") as file:
        file.attrs.update(
            format="reedbench-run", format_version=5, default="entry", NX_class="NXroot"
        )
        entry = _group(file, "entry", "NXentry", default="data")
        shots = recording.shots
        began = _DAY + timedelta(seconds=min(shot.began_s for shot in shots))
        ended = _DAY + timedelta(seconds=max(shot.began_s for shot in shots) + 4 * FRAME_S)
        _texts(
            entry,
            title=recording.name,
            entry_identifier_uuid=hashlib.sha256(f"{case} {recording.name}".encode()).hexdigest()[
                :32
            ],
            start_time=began.isoformat(timespec="seconds"),
            end_time=ended.isoformat(timespec="seconds"),
            status="complete",
            program_name="a laboratory",
        )
        _texts(_group(entry, "user", "NXuser"), name="")
        sample = _group(entry, "sample", "NXsample")
        _texts(sample, name=case, series="A", chamber="asymmetric", note="")
        sample["strength"] = np.nan
        acquisition = _group(entry, "acquisition", "NXcollection")
        _texts(acquisition, kind=recording.kind, campaign=case, part=recording.name)
        acquisition["clamping"] = recording.clamping
        _provenance(entry, bench_text(case, laboratory, stated))
        _instrument(entry, laboratory)
        _data(entry, laboratory, shots)
        entry["header_checksum"] = _header_checksum(entry)
        _steps(entry, recording)


def _provenance(entry: Any, bench: str) -> None:
    origin = _group(entry, "provenance", "NXcollection")
    _texts(
        origin,
        protocol="",
        protocol_sha256="",
        bench=bench,
        bench_fingerprint="",
        git_revision="",
        package_versions=json.dumps({}),
    )
    origin["seed"] = 0


def _instrument(entry: Any, laboratory: Laboratory) -> None:
    chip = laboratory.world.chip
    instrument = _group(entry, "instrument", "NXinstrument")
    _texts(instrument, name="laboratory")
    _number(instrument, "acoustic_resonances", [4308.6], "Hz")
    camera = _group(instrument, "camera", "NXdetector")
    _texts(camera, identity="a camera", frame_rate_exact="62/5")
    _number(camera, "frame_rate", float(_FRAME_RATE), "Hz")
    _number(camera, "count_time", FRAME_S, "s")
    _number(camera, "pixel_size", chip.pixel_m, "m")
    for name, value in (
        ("bit_depth_readout", chip.bits),
        (
            "saturation_value",
            int(min(chip.full_e / chip.gain_e_dn + chip.offset_dn, 2**chip.bits - 1)),
        ),
        ("rows", chip.rows),
        ("columns", chip.rows),
    ):
        camera[name] = value
    synthesizers = _group(instrument, "synthesizers", "NXcollection")
    _texts(synthesizers, identity="two synthesizers")
    synthesizers["sideband_order"] = 1
    generator = _group(instrument, "generator", "NXcollection")
    _texts(generator, identity="a generator")
    _number(generator, "volts_max", 16.0, "V")
    laser = _group(instrument, "laser", "NXsource")
    _number(laser, "wavelength", WAVELENGTH_M, "m")
    _number(laser, "distance", DISTANCE_M, "m")


def _steps(entry: Any, recording: Recording) -> None:
    steps, shots = _group(entry, "steps", "NXcollection"), recording.shots
    rate = _FRAME_RATE / 4
    hz = [Fraction(f"{shot.hz:.1f}") for shot in shots]
    difference = [shot.order * f + rate for shot, f in zip(shots, hz, strict=True)]
    asked = [Fraction(step_hz(shot.index)) if shot.hz else Fraction(0) for shot in shots]
    columns = {
        "asked_hz": asked,
        "drive_hz": hz,
        "aom1_hz": [_CENTRE_HZ + d for d in difference],
        "aom2_hz": [_CENTRE_HZ] * len(shots),
        "difference_hz": difference,
        "lock_residual_hz": [Fraction(0)] * len(shots),
    }
    for name in ("aom1_hz", "aom2_hz", "drive_hz"):
        columns[f"read_{name}"] = columns[name]
    for name, values in columns.items():
        _number(steps, name, [float(v) for v in values], "Hz")
        steps.create_dataset(f"{name}_exact", data=[str(v) for v in values], dtype=_TEXT)
    steps["index"] = [shot.index for shot in shots]
    steps["order"] = [shot.order for shot in shots]
    steps["carrier_leak"] = [_leak(shot) for shot in shots]
    times = np.array([[shot.began_s + k * FRAME_S for k in range(4)] for shot in shots])
    first = np.rint(times / FRAME_S).astype(np.int64)[:, :1]
    ids = first + np.arange(4)
    steps["frame_id"] = ids
    volts = [shot.volts for shot in shots]
    for name, numbers, unit in (
        ("volts", volts, "V"),
        ("read_volts", volts, "V"),
        ("exposure_s", [shot.exposure_s for shot in shots], "s"),
        ("changed_s", [shot.began_s - 0.05 for shot in shots], "s"),
        ("timestamp_s", times, "s"),
        ("signal_to_noise", [shot.signal / max(shot.noise, 1e-9) for shot in shots], ""),
        ("noise_level", [shot.noise for shot in shots], ""),
        ("saturated_share", [0.0] * len(shots), ""),
        ("lock_error_hz", [shot.lock_hz for shot in shots], "Hz"),
        ("lock_error_se_hz", [shot.lock_se_hz for shot in shots], "Hz"),
        ("brightness_dn", [np.nan] * len(shots), "dn"),
        ("unexplained", [np.nan] * len(shots), ""),
    ):
        _number(steps, name, numbers, unit)
    verdicts = ["partial" if shot.repeated else "ok" for shot in shots]
    steps.create_dataset("verdict", data=verdicts, dtype=_TEXT)
    steps.create_dataset("sentence", data=["" for _ in shots], dtype=_TEXT)
    _checksums(steps, entry["data"])


def _checksums(steps: Any, data: Any) -> None:
    """Checksums of each step: of its pixels, then of all its numbers."""
    pixels = data[data.attrs["signal"]]
    count = len(pixels)
    steps["pixel_checksum"] = np.array([_digest(pixels[k].tobytes()) for k in range(count)])
    columns = {name: steps[name][()] for name in sorted(steps)}
    said = {name: c for name, c in columns.items() if name not in ("verdict", "sentence")}
    rows = [
        b"".join(name.encode() + column[k : k + 1].tobytes() for name, column in said.items())
        for k in range(count)
    ]
    steps["row_checksum"] = np.array([_digest(row) for row in rows])


def _header_checksum(entry: Any) -> np.uint64:
    """Checksum of labels, geometry and provenance, by the section Checksums."""
    groups = ("user", "sample", "acquisition", "provenance", "instrument", "region")
    content = {f"entry/{name}": entry[name][()] for name in (
        "title", "entry_identifier_uuid", "start_time", "data/y_m", "data/x_m"
    )}  # fmt: skip

    def take(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset) and name.startswith(groups):
            content[f"entry/{name}"] = node[()]

    entry.visititems(take)
    said = (name.encode() + _bytes(content[name]) for name in sorted(content))
    return _digest(b"".join(said))


def _bytes(value: Any) -> bytes:
    return bytes(value) if isinstance(value, bytes) else bytes(value.tobytes())


def _digest(content: bytes) -> np.uint64:
    return np.uint64(int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "little"))


def _leak(shot: Shot) -> float:
    """Amplitude of the carrier in the hologram per unit of the sideband's, by the four frames."""
    if not shot.hz:
        return 0.0
    offset_hz = -(shot.order * shot.hz + 0.25 / FRAME_S)
    turns = np.exp(2j * np.pi * offset_hz * FRAME_S * np.arange(4)) * np.array([1, 1j, -1, -1j])
    own = abs(np.sinc(0.25))
    return float(abs(np.sinc(offset_hz * FRAME_S) * turns.sum()) / 4 / own)


def _data(entry: Any, laboratory: Laboratory, shots: Sequence[Shot]) -> None:
    stage = laboratory.stage
    data = _group(entry, "data", "NXdata")
    _number(data, "y_m", stage.y_m, "m")
    _number(data, "x_m", stage.x_m, "m")
    where = _group(entry, "region", "NXcollection")
    for name, piece in (("row", stage.rows), ("column", stage.columns)):
        where[name] = piece.start
    where["height"], where["width"] = len(stage.y_m), len(stage.x_m)
    framed = shots[0].frames is not None
    name = "frames" if framed else "field"
    kept: list[Any] = [shot.frames if framed else shot.image for shot in shots]
    stack = np.stack(kept)
    data.create_dataset(name, data=stack, chunks=(1, *stack.shape[1:]))
    data.attrs["signal"] = name
    data.attrs["axes"] = ["drive_hz", ".", ".", "."] if framed else ["drive_hz", "y_m", "x_m"]


def _group(parent: Any, name: str, kind: str, **attributes: str) -> Any:
    group = parent.create_group(name)
    group.attrs.update(NX_class=kind, **attributes)
    return group


def _texts(group: Any, **texts: str) -> None:
    for name, text in texts.items():
        group.create_dataset(name, data=text, dtype=h5py.string_dtype("utf-8"))


def _number(group: Any, name: str, value: object, unit: str) -> None:
    dataset = group.create_dataset(name, data=value)
    if unit:
        dataset.attrs["units"] = unit
