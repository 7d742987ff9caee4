"""The datasets of a run file: what kind of data each holds, and its shape."""

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from runs.integrity.checksums import CHECKSUMS
from runs.layout import (
    EXPOSURE,
    INTERRUPTIONS,
    MEASURED,
    PLANNED_HZ,
    READ_BACK_HZ,
)

# Frames of a step: four-phase demodulation needs four (decision 0001).
_FRAMES: Final = 4


class ValueKind(Enum):
    """Kind of data that a dataset holds."""

    TEXT = auto()
    INTEGER = auto()
    NUMBER = auto()
    FIELD = auto()
    FRAMES = auto()


@dataclass(frozen=True)
class Part:
    """One dataset of the layout.

    Attributes
    ----------
    kind : ValueKind
    shape : tuple of str or int
        Lengths of its axes, or names of axes whose lengths `runs.integrity.checks` reads from the
        file.
    optional : bool
        Whether a file without it is valid.
    """

    kind: ValueKind
    shape: tuple[str | int, ...] = ()
    optional: bool = False


def _measured(rows: str) -> dict[str, Part]:
    """Return the columns that hold what was measured; `rows` is the name of their first axis."""
    columns = {f"{name}_exact": Part(ValueKind.TEXT, (rows,)) for name in READ_BACK_HZ}
    columns |= {name: Part(ValueKind.NUMBER, (rows,), optional=True) for name in READ_BACK_HZ}
    columns |= {name: Part(ValueKind.NUMBER, (rows,)) for name in MEASURED}
    columns |= {name: Part(ValueKind.INTEGER, (rows,)) for name in CHECKSUMS}
    columns |= {name: Part(ValueKind.TEXT, (rows,)) for name in ("verdict", "sentence")}
    return columns | {
        "timestamp_s": Part(ValueKind.NUMBER, (rows, _FRAMES)),
        "frame_id": Part(ValueKind.INTEGER, (rows, _FRAMES)),
        EXPOSURE: Part(ValueKind.NUMBER, (rows,), optional=True),
    }


def _steps() -> dict[str, Part]:
    """Return the columns of ``/entry/steps``: what was planned and what was measured."""
    columns = {f"{name}_exact": Part(ValueKind.TEXT, ("steps",)) for name in PLANNED_HZ}
    columns |= {name: Part(ValueKind.NUMBER, ("steps",), optional=True) for name in PLANNED_HZ}
    columns |= {name: Part(ValueKind.NUMBER, ("steps",)) for name in ("volts", "carrier_leak")}
    columns["index"] = Part(ValueKind.INTEGER, ("steps",))
    columns["order"] = Part(ValueKind.INTEGER, ("steps",), optional=True)
    return columns | _measured("steps")


def _scalars(kind: ValueKind, *names: str, optional: bool = False) -> dict[str, Part]:
    return {name: Part(kind, (), optional) for name in names}


# Datasets of each group, by name. A file has all required datasets of a group or lacks the group.
GROUPS: Final[dict[str, dict[str, Part]]] = {
    "entry": _scalars(
        ValueKind.TEXT, "title", "entry_identifier_uuid", "start_time", "end_time", "status"
    )
    | _scalars(ValueKind.INTEGER, "header_checksum"),
    "entry/user": _scalars(ValueKind.TEXT, "name"),
    "entry/sample": _scalars(ValueKind.TEXT, "name", "series", "chamber", "note")
    | _scalars(ValueKind.NUMBER, "strength"),
    "entry/acquisition": _scalars(ValueKind.TEXT, "kind", "campaign", "part")
    | _scalars(ValueKind.INTEGER, "clamping"),
    "entry/provenance": _scalars(
        ValueKind.TEXT,
        *("protocol", "protocol_sha256", "bench", "bench_fingerprint", "git_revision"),
        "package_versions",
    )
    | _scalars(ValueKind.TEXT, "reed", "reed_sha256", "simulated_disorder", optional=True)
    | _scalars(ValueKind.INTEGER, "seed"),
    "entry/instrument": _scalars(ValueKind.TEXT, "name")
    | {"acoustic_resonances": Part(ValueKind.NUMBER, ("lines",))},
    "entry/instrument/camera": _scalars(ValueKind.TEXT, "identity", "frame_rate_exact")
    | _scalars(ValueKind.NUMBER, "count_time", "pixel_size")
    | _scalars(ValueKind.INTEGER, "saturation_value", "rows", "columns"),
    "entry/instrument/synthesizers": _scalars(ValueKind.TEXT, "identity")
    | _scalars(ValueKind.INTEGER, "sideband_order"),
    "entry/instrument/generator": _scalars(ValueKind.TEXT, "identity"),
    "entry/instrument/laser": _scalars(ValueKind.NUMBER, "wavelength", "distance"),
    "entry/region": _scalars(ValueKind.INTEGER, "row", "column", "height", "width"),
    "entry/steps": _steps(),
    "entry/earlier_attempts": {"position": Part(ValueKind.INTEGER, ("earlier_attempts",))}
    | _measured("earlier_attempts"),
    "entry/interruptions": {"position": Part(ValueKind.INTEGER, ("interruptions",))}
    | {name: Part(ValueKind.TEXT, ("interruptions",)) for name in INTERRUPTIONS[1:]},
    "entry/data": {
        "y_m": Part(ValueKind.NUMBER, ("height",)),
        "x_m": Part(ValueKind.NUMBER, ("width",)),
    },
}

OPTIONAL_GROUPS: Final = frozenset(
    {"entry/acquisition", "entry/earlier_attempts", "entry/interruptions"}
)

# Pairs of datasets: a file has both of them or neither.
TOGETHER: Final = (
    ("entry/earlier_attempts/position", "entry/interruptions/position"),
    ("entry/provenance/reed", "entry/provenance/reed_sha256"),
    ("entry/steps/lock_error_hz", "entry/steps/lock_error_se_hz"),
)

# Images that a run keeps, by the name of their dataset: kind and axes of the images of one step.
PICTURES: Final = {
    "field": (ValueKind.FIELD, ("height", "width")),
    "frames": (ValueKind.FRAMES, (_FRAMES, "rows", "columns")),
}
