"""What the datasets of a run file may hold."""

import json
import math
from collections.abc import Mapping
from datetime import datetime
from fractions import Fraction
from typing import Any, Final, get_args

import numpy as np

from holography.fresnel import FresnelTransform
from protocols.protocol import MAX_STEPS
from protocols.units import shown_value
from runs.checksums import (
    HEADER_CHECKSUM,
    header_checksum,
    in_header,
)
from runs.errors import RunFileError
from runs.expected import Kind, Part
from runs.layout import (
    PLANNED_HZ,
    Status,
)
from runs.stored import Check, altered
from runs.verdict import Verdict

# Chosen: four times the largest text, which is that of a description (64 KiB).
MAX_TEXT_BYTES: Final = 256 * 1024

# As protocols have it, see `protocols.protocol.Sideband`.
_MAX_ORDER: Final = 100

# As protocols have it, see `protocols.protocol.Sweep`; still steps are counted.
_MAX_INDEX: Final = max(100_000, MAX_STEPS)

# Chosen: lengths in m and times in s of a bench lie far within, so that their squares are finite.
_LEAST_SIZE, _MOST_SIZE = 1e-12, 1e6

# As protocols have it for the reference of a sweep.
_MOST_HZ: Final = 1e9

# Frequencies stand in a file as float64 and as text; how far the former rounds the latter.
_ROUNDING: Final = 1e-12

# Steps of an axis are differences of numbers 10⁴ times as large, in float64.
_ROUNDED_AXIS: Final = 1e-9


def require_texts(check: Check, layout: Mapping[str, Part]) -> None:
    """Refuse texts that are longer than anyone writes.

    They may hold control characters: `acquire.cli.console` and the pages show those as text.
    """
    for name, part in layout.items():
        if part.kind is not Kind.TEXT:
            continue
        texts = np.atleast_1d(np.asarray(check.values(name), dtype=object)).tolist()
        check.require(max(map(len, texts), default=0) <= MAX_TEXT_BYTES, name, "is too long")


def require_geometry(check: Check) -> None:
    """Refuse a region that leaves the image, and sizes that are none."""
    row, column, height, width = (
        int(check.values(f"entry/region/{name}")) for name in ("row", "column", "height", "width")
    )
    rows, columns = (
        int(check.values(f"entry/instrument/camera/{name}")) for name in ("rows", "columns")
    )
    check.require(
        0 <= row <= rows - height and 0 <= column <= columns - width and min(height, width) > 0,
        "entry/region",
        f"leaves the image of {rows}×{columns} pixels",
    )
    for name in ("camera/pixel_size", "camera/count_time", "laser/wavelength", "laser/distance"):
        _require_range(check, f"entry/instrument/{name}", _LEAST_SIZE, _MOST_SIZE)
    for name in ("y_m", "x_m"):
        _require_range(check, f"entry/data/{name}", -_MOST_SIZE, _MOST_SIZE)
    _require_axes(check, (rows, columns))


def _require_axes(check: Check, shape: tuple[int, int]) -> None:
    """Refuse axes of pictures that do not follow from the optics."""
    instrument = "entry/instrument"
    transform = FresnelTransform(
        shape=shape,
        pixel_m=float(check.values(f"{instrument}/camera/pixel_size")),
        wavelength_m=float(check.values(f"{instrument}/laser/wavelength")),
        distance_m=float(check.values(f"{instrument}/laser/distance")),
    )
    for name, pitch_m in zip(("y_m", "x_m"), transform.object_pitch_m, strict=True):
        steps_m = np.diff(check.values(f"entry/data/{name}"))
        check.require(
            bool(np.allclose(steps_m, pitch_m, rtol=_ROUNDED_AXIS, atol=0)),
            f"entry/data/{name}",
            f"has no steps of {pitch_m:.4g} m, which the optics give",
        )


def require_columns(check: Check) -> None:
    """Refuse numbers that no run has: they would be read as places, orders or volts."""
    steps = check.shape("entry/steps/verdict")[0]
    _require_range(check, "entry/steps/index", -_MAX_INDEX, _MAX_INDEX)
    _require_range(check, "entry/steps/order", 0, _MAX_ORDER)
    _require_range(check, "entry/instrument/synthesizers/sideband_order", 0, _MAX_ORDER)
    _require_range(check, "entry/instrument/camera/saturation_value", 1, 65_535)
    _require_range(check, "entry/steps/volts", 0, 1000)
    _require_range(check, "entry/instrument/acoustic_resonances", 0, _MOST_HZ)
    # A place is free, or of a step; one that is being filled has −2 less its step.
    _require_range(check, "entry/retakes/position", -1 - steps, steps - 1)
    _require_range(check, "entry/interruptions/position", -1, MAX_STEPS)
    strength = check.values("entry/sample/strength")
    check.require(not math.isinf(strength), "entry/sample/strength", "is infinite")
    # Steps with a verdict have checksums; of the others a killed process may have left half, but
    # for what was planned.
    unmeasured = ~np.isin(check.values("entry/steps/verdict"), [v for v in Verdict if v.measured])
    for name in PLANNED_HZ:
        _require_exact(check, f"entry/steps/{name}", unmeasured)


def _require_range(check: Check, name: str, least: float, most: float) -> None:
    if name not in check.datasets:
        return
    values = np.asarray(check.values(name))
    # Of NaN, neither comparison holds.
    odd = values[~((least <= values) & (values <= most))]
    if odd.size:
        raise altered(check.path, name, f"has a {odd.flat[0]:g}")


def _require_exact(check: Check, name: str, whole: Any) -> None:
    """Refuse frequencies whose text is none, or another one than their number, at whole steps."""
    texts = check.values(f"{name}_exact")[whole].tolist()
    check.require(all(texts), f"{name}_exact", "lacks a frequency")
    if name not in check.datasets:
        return
    for text, hz in zip(texts, check.values(name)[whole].tolist(), strict=True):
        # Most are decimals, and those are read ten times as fast so.
        exact_hz = float(Fraction(text) if "/" in text else text)
        check.require(math.isclose(exact_hz, hz, rel_tol=_ROUNDING), name, f"is {hz:g} and {text}")


def require_words(check: Check) -> None:
    """Refuse words that a reader would act on, and does not know."""

    def word(name: str) -> str:
        text: str = check.values(name)
        return text

    for name, known in {
        "entry/status": get_args(Status),
        "entry/sample/chamber": ("asymmetric", "symmetric"),
    }.items():
        check.require(word(name) in known, name, f"is {shown_value(word(name))}")
    datetime.fromisoformat(word("entry/start_time"))
    if word("entry/end_time"):
        datetime.fromisoformat(word("entry/end_time"))
    rate = "entry/instrument/camera/frame_rate_exact"
    check.require(0 < Fraction(word(rate)) <= _MOST_HZ, rate, f"is {shown_value(word(rate))}")
    versions = json.loads(word("entry/provenance/package_versions"))
    check.require(
        isinstance(versions, dict) and all(isinstance(v, str) for v in versions.values()),
        "entry/provenance/package_versions",
        "is no list of versions",
    )


def require_header(check: Check) -> None:
    """Refuse other labels, geometry or provenance than were written before the first step."""
    names = [name for name in check.datasets if in_header(name)]
    for name in names:
        # Of what is not in the layout the shape was not checked.
        check.require(math.prod(check.shape(name)) <= _MAX_INDEX, name, "is too long")
    if header_checksum({name: check.values(name) for name in names}) != check.values(
        HEADER_CHECKSUM
    ):
        raise RunFileError(
            f"{check.path}: is damaged or altered (labels, geometry or provenance do not have the "
            "checksum that was written with them); use another copy of the file"
        )
