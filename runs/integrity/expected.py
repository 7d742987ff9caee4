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


class Kind(Enum):
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
    kind : Kind
    shape : tuple of str or int
        Lengths of its axes, or names of axes whose lengths `runs.integrity.checks` reads from the
        file.
    optional : bool
        Whether a file without it is valid.
    """

    kind: Kind
    shape: tuple[str | int, ...] = ()
    optional: bool = False


def _measured(rows: str) -> dict[str, Part]:
    """Return the columns that hold what was measured; `rows` is the name of their first axis."""
    columns = {f"{name}_exact": Part(Kind.TEXT, (rows,)) for name in READ_BACK_HZ}
    columns |= {name: Part(Kind.NUMBER, (rows,), optional=True) for name in READ_BACK_HZ}
    columns |= {name: Part(Kind.NUMBER, (rows,)) for name in MEASURED}
    columns |= {name: Part(Kind.INTEGER, (rows,)) for name in CHECKSUMS}
    columns |= {name: Part(Kind.TEXT, (rows,)) for name in ("verdict", "sentence")}
    return columns | {
        "timestamp_s": Part(Kind.NUMBER, (rows, _FRAMES)),
        "frame_id": Part(Kind.INTEGER, (rows, _FRAMES)),
        EXPOSURE: Part(Kind.NUMBER, (rows,), optional=True),
    }


def _steps() -> dict[str, Part]:
    """Return the columns of ``/entry/steps``: what was planned and what was measured."""
    columns = {f"{name}_exact": Part(Kind.TEXT, ("steps",)) for name in PLANNED_HZ}
    columns |= {name: Part(Kind.NUMBER, ("steps",), optional=True) for name in PLANNED_HZ}
    columns |= {name: Part(Kind.NUMBER, ("steps",)) for name in ("volts", "carrier_leak")}
    columns["index"] = Part(Kind.INTEGER, ("steps",))
    columns["order"] = Part(Kind.INTEGER, ("steps",), optional=True)
    return columns | _measured("steps")


def _scalars(kind: Kind, *names: str, optional: bool = False) -> dict[str, Part]:
    return {name: Part(kind, (), optional) for name in names}


# Datasets of each group, by name. A file has all required datasets of a group or lacks the group.
GROUPS: Final[dict[str, dict[str, Part]]] = {
    "entry": _scalars(
        Kind.TEXT, "title", "entry_identifier_uuid", "start_time", "end_time", "status"
    )
    | _scalars(Kind.INTEGER, "header_checksum"),
    "entry/user": _scalars(Kind.TEXT, "name"),
    "entry/sample": _scalars(Kind.TEXT, "name", "series", "chamber", "note")
    | _scalars(Kind.NUMBER, "strength"),
    "entry/acquisition": _scalars(Kind.TEXT, "kind", "campaign", "part")
    | _scalars(Kind.INTEGER, "clamping"),
    "entry/provenance": _scalars(
        Kind.TEXT,
        *("protocol", "protocol_sha256", "bench", "bench_fingerprint", "git_revision"),
        "package_versions",
    )
    | _scalars(Kind.TEXT, "reed", "reed_sha256", optional=True)
    | _scalars(Kind.INTEGER, "seed"),
    "entry/instrument": _scalars(Kind.TEXT, "name")
    | {"acoustic_resonances": Part(Kind.NUMBER, ("lines",))},
    "entry/instrument/camera": _scalars(Kind.TEXT, "identity", "frame_rate_exact")
    | _scalars(Kind.NUMBER, "count_time", "pixel_size")
    | _scalars(Kind.INTEGER, "saturation_value", "rows", "columns"),
    "entry/instrument/synthesizers": _scalars(Kind.TEXT, "identity")
    | _scalars(Kind.INTEGER, "sideband_order"),
    "entry/instrument/generator": _scalars(Kind.TEXT, "identity"),
    "entry/instrument/laser": _scalars(Kind.NUMBER, "wavelength", "distance"),
    "entry/region": _scalars(Kind.INTEGER, "row", "column", "height", "width"),
    "entry/steps": _steps(),
    "entry/earlier_attempts": {"position": Part(Kind.INTEGER, ("earlier_attempts",))}
    | _measured("earlier_attempts"),
    "entry/interruptions": {"position": Part(Kind.INTEGER, ("interruptions",))}
    | {name: Part(Kind.TEXT, ("interruptions",)) for name in INTERRUPTIONS[1:]},
    "entry/data": {
        "y_m": Part(Kind.NUMBER, ("height",)),
        "x_m": Part(Kind.NUMBER, ("width",)),
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
    "field": (Kind.FIELD, ("height", "width")),
    "frames": (Kind.FRAMES, (_FRAMES, "rows", "columns")),
}
