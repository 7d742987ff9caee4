"""Check the values that the datasets of a run file hold: texts, geometry, columns, header."""

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
from runs.errors import RunFileError
from runs.integrity.checksums import (
    HEADER_CHECKSUM,
    header_checksum,
    in_header,
)
from runs.integrity.expected import Part, ValueKind
from runs.integrity.stored import Check, altered
from runs.layout import (
    PLANNED_HZ,
    Status,
)
from runs.verdict import Verdict

# Chosen: four times the size limit of a protocol, bench or reed file (64 KiB), the largest texts.
MAX_TEXT_BYTES: Final = 256 * 1024

# Largest order of a sideband that a protocol may ask for, see `protocols.protocol.Sideband`.
_MAX_ORDER: Final = 100

# Largest index that a protocol may ask for, see `protocols.protocol.Sweep`. Calibration steps are
# numbered from 0, so their index stays below MAX_STEPS.
_MAX_INDEX: Final = max(100_000, MAX_STEPS)

# Chosen: lengths in m and times in s of a bench are far inside these limits, and the squares of
# the limits are finite numbers.
_MIN_SIZE, _MAX_SIZE = 1e-12, 1e6

# Largest reference frequency that a protocol may ask for, see `protocols.protocol.Sweep`.
_MAX_HZ: Final = 1e9

# Largest relative difference between a frequency as float64 and as exact text. Chosen: rounding to
# float64 changes a number by at most 1.1e-16 of it.
_ROUNDING: Final = 1e-12

# Relative tolerance of the pixel pitch. Chosen: it is a difference of float64 coordinates that are
# up to 10⁴ times as large, so rounding is about 1e-12 of it.
_ROUNDED_AXIS: Final = 1e-9


def require_texts(check: Check, layout: Mapping[str, Part]) -> None:
    """Raise an error if a text is longer than `MAX_TEXT_BYTES`.

    Texts may hold control characters: `acquire.cli.console` and the HTML pages escape them.
    """
    for name, part in layout.items():
        if part.kind is not ValueKind.TEXT:
            continue
        texts = np.atleast_1d(np.asarray(check.values(name), dtype=object)).tolist()
        check.require(max(map(len, texts), default=0) <= MAX_TEXT_BYTES, name, "is too long")


def require_geometry(check: Check) -> None:
    """Raise an error if the region leaves the image, or a length or time is out of range."""
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
        _require_range(check, f"entry/instrument/{name}", _MIN_SIZE, _MAX_SIZE)
    for name in ("y_m", "x_m"):
        _require_range(check, f"entry/data/{name}", -_MAX_SIZE, _MAX_SIZE)
    _require_axes(check, (rows, columns))


def _require_axes(check: Check, shape: tuple[int, int]) -> None:
    """Raise an error if the pitch of the image axes differs from that of the optics."""
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
            f"does not have the pitch of {pitch_m:.4g} m that follows from the optics",
        )


def require_columns(check: Check) -> None:
    """Raise an error if indices, positions, orders, volts or frequencies are out of range."""
    steps = check.shape("entry/steps/verdict")[0]
    _require_range(check, "entry/steps/index", -_MAX_INDEX, _MAX_INDEX)
    _require_range(check, "entry/steps/order", 0, _MAX_ORDER)
    _require_range(check, "entry/instrument/synthesizers/sideband_order", 0, _MAX_ORDER)
    _require_range(check, "entry/instrument/camera/saturation_value", 1, 65_535)
    _require_range(check, "entry/steps/volts", 0, 1000)
    _require_range(check, "entry/instrument/acoustic_resonances", 0, _MAX_HZ)
    # -1 is a free place; -2 - position is a place that is being filled (see `layout.UNDER_WAY`).
    _require_range(check, "entry/earlier_attempts/position", -1 - steps, steps - 1)
    _require_range(check, "entry/interruptions/position", -1, MAX_STEPS)
    strength = check.values("entry/sample/strength")
    check.require(not math.isinf(strength), "entry/sample/strength", "is infinite")
    # Row checksums protect the frequencies of measured steps. Steps without a measurement have no
    # checksum, so their planned frequencies are compared with the exact texts.
    unmeasured = ~np.isin(check.values("entry/steps/verdict"), [v for v in Verdict if v.measured])
    for name in PLANNED_HZ:
        _require_exact(check, f"entry/steps/{name}", unmeasured)


def _require_range(check: Check, name: str, least: float, most: float) -> None:
    """Raise an error if a value is NaN, below `least` or above `most`."""
    if name not in check.datasets:
        return
    values = np.asarray(check.values(name))
    # Negated, so that NaN counts as outside.
    outside = values[~((least <= values) & (values <= most))]
    if outside.size:
        raise altered(
            check.path, name, f"holds {outside.flat[0]:g}, which is outside {least:g} … {most:g}"
        )


def _require_exact(check: Check, name: str, rows: Any) -> None:
    """Raise an error if the exact text of a frequency is missing or is not equal to its number.

    Parameters
    ----------
    check : Check
    name : str
        Path of the column of numbers.
    rows : (steps,) bool
        Rows to check.
    """
    texts = check.values(f"{name}_exact")[rows].tolist()
    check.require(all(texts), f"{name}_exact", "lacks a frequency")
    if name not in check.datasets:
        return
    for text, hz in zip(texts, check.values(name)[rows].tolist(), strict=True):
        # Most texts are decimals, and float() reads those ten times as fast as Fraction() does.
        exact_hz = float(Fraction(text) if "/" in text else text)
        same = math.isclose(exact_hz, hz, rel_tol=_ROUNDING)
        check.require(same, name, f"is {hz:g} as a number, but {text} as a text")


def require_words(check: Check) -> None:
    """Raise an error if a text has no known value: status, chamber, times, frame rate, versions."""

    def text_of(name: str) -> str:
        text: str = check.values(name)
        return text

    for name, known in {
        "entry/status": get_args(Status),
        "entry/sample/chamber": ("asymmetric", "symmetric"),
    }.items():
        check.require(text_of(name) in known, name, f"is {shown_value(text_of(name))}")
    datetime.fromisoformat(text_of("entry/start_time"))
    if text_of("entry/end_time"):
        datetime.fromisoformat(text_of("entry/end_time"))
    rate = "entry/instrument/camera/frame_rate_exact"
    check.require(0 < Fraction(text_of(rate)) <= _MAX_HZ, rate, f"is {shown_value(text_of(rate))}")
    versions = json.loads(text_of("entry/provenance/package_versions"))
    check.require(
        isinstance(versions, dict) and all(isinstance(v, str) for v in versions.values()),
        "entry/provenance/package_versions",
        "is not a table of versions",
    )


def require_header(check: Check) -> None:
    """Raise an error if labels, geometry or provenance do not match the header checksum."""
    names = [name for name in check.datasets if in_header(name)]
    for name in names:
        # The shapes of datasets outside the layout are not checked anywhere else.
        check.require(math.prod(check.shape(name)) <= _MAX_INDEX, name, "is too long")
    if header_checksum({name: check.values(name) for name in names}) != check.values(
        HEADER_CHECKSUM
    ):
        raise RunFileError(
            f"{check.path}: is damaged or altered (labels, geometry or provenance do not have the "
            "checksum that was written with them); use another copy of the file"
        )
