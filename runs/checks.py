"""What must hold of a run file before it is read: layout, types, sizes and a few numbers.

HDF5 lets a file say that its data lie in another file, that a column has 10¹² rows, or that a text
is a number. Reading such a file would open what nobody named, ask for terabytes, or return nonsense
as good. So every object is looked at first, without following a link and without reading an array;
then the numbers that say where and how large everything is; then what people get to see.
"""

import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum, auto
from fractions import Fraction
from itertools import pairwise
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, Final, get_args

import h5py
import numpy as np

from holography.fresnel import FresnelTransform
from protocols.protocol import MAX_STEPS
from protocols.units import shown_value
from runs.checksums import (
    CHECKSUMS,
    HEADER_CHECKSUM,
    header_checksum,
    in_header,
)
from runs.errors import RunFileError
from runs.layout import (
    EXPOSURE,
    FORMAT,
    FORMAT_VERSION,
    MEASURED,
    PLANNED_HZ,
    READ_BACK_HZ,
    SEAMS,
    Status,
)
from runs.verdict import Verdict

# Frames of a step: the four phases of a hologram.
_FRAMES: Final = 4
# The one link of the layout, and what it leads to.
_LINKS: Final = {"entry/data/drive_hz": "/entry/steps/drive_hz"}
# Filters that every h5py has: deflate, shuffle, fletcher32, lzf.
_FILTERS: Final = frozenset({1, 2, 3, 32000})
# No filter shrinks more than deflate does (1032 : 1, zlib's documentation).
_MOST_SHRUNK: Final = 1032
# Signature of a heap of texts of any length, and size of what stands before it and each object.
_HEAP, _HEAP_HEAD = b"GCOL", 16
# Chosen: a run file has 130 objects.
_MAX_OBJECTS: Final = 10_000
# Chosen: four times the largest text, which is that of a description (64 KiB).
_MAX_TEXT_BYTES: Final = 256 * 1024
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


class _Kind(Enum):
    """What a dataset holds."""

    TEXT = auto()
    INTEGER = auto()
    NUMBER = auto()
    FIELD = auto()
    FRAMES = auto()


@dataclass(frozen=True)
class _Part:
    """One dataset of the layout.

    Attributes
    ----------
    kind : _Kind
    shape : tuple
        Lengths of its axes, or their names, see `_lengths`.
    optional : bool
        Whether a file may lack it.
    """

    kind: _Kind
    shape: tuple[str | int, ...] = ()
    optional: bool = False


def _taken(rows: str) -> dict[str, _Part]:
    """Columns that tell what was measured, of steps or of earlier takes."""
    columns = {f"{name}_exact": _Part(_Kind.TEXT, (rows,)) for name in READ_BACK_HZ}
    columns |= {name: _Part(_Kind.NUMBER, (rows,), optional=True) for name in READ_BACK_HZ}
    columns |= {name: _Part(_Kind.NUMBER, (rows,)) for name in MEASURED}
    columns |= {name: _Part(_Kind.INTEGER, (rows,)) for name in CHECKSUMS}
    columns |= {name: _Part(_Kind.TEXT, (rows,)) for name in ("verdict", "sentence")}
    return columns | {
        "timestamp_s": _Part(_Kind.NUMBER, (rows, _FRAMES)),
        "frame_id": _Part(_Kind.INTEGER, (rows, _FRAMES)),
        EXPOSURE: _Part(_Kind.NUMBER, (rows,), optional=True),
    }


def _steps() -> dict[str, _Part]:
    columns = {f"{name}_exact": _Part(_Kind.TEXT, ("steps",)) for name in PLANNED_HZ}
    columns |= {name: _Part(_Kind.NUMBER, ("steps",), optional=True) for name in PLANNED_HZ}
    columns |= {name: _Part(_Kind.NUMBER, ("steps",)) for name in ("volts", "carrier_leak")}
    columns["index"] = _Part(_Kind.INTEGER, ("steps",))
    columns["order"] = _Part(_Kind.INTEGER, ("steps",), optional=True)
    return columns | _taken("steps")


def _scalars(kind: _Kind, *names: str, optional: bool = False) -> dict[str, _Part]:
    return {name: _Part(kind, (), optional) for name in names}


# Groups of the layout that a file has or lacks as a whole, with their datasets.
_GROUPS: Final[dict[str, dict[str, _Part]]] = {
    "entry": _scalars(
        _Kind.TEXT, "title", "entry_identifier_uuid", "start_time", "end_time", "status"
    )
    | _scalars(_Kind.INTEGER, "header_checksum"),
    "entry/user": _scalars(_Kind.TEXT, "name"),
    "entry/sample": _scalars(_Kind.TEXT, "name", "series", "chamber", "note")
    | _scalars(_Kind.NUMBER, "strength"),
    "entry/acquisition": _scalars(_Kind.TEXT, "kind", "campaign", "part")
    | _scalars(_Kind.INTEGER, "clamping"),
    "entry/provenance": _scalars(
        _Kind.TEXT,
        *("protocol", "protocol_sha256", "bench", "bench_fingerprint", "git_revision"),
        "package_versions",
    )
    | _scalars(_Kind.TEXT, "reed", "reed_sha256", optional=True)
    | _scalars(_Kind.INTEGER, "seed"),
    "entry/instrument": _scalars(_Kind.TEXT, "name")
    | {"acoustic_lines": _Part(_Kind.NUMBER, ("lines",))},
    "entry/instrument/camera": _scalars(_Kind.TEXT, "identity", "frame_rate_exact")
    | _scalars(_Kind.NUMBER, "count_time", "pixel_size")
    | _scalars(_Kind.INTEGER, "saturation_value", "rows", "columns"),
    "entry/instrument/synthesizers": _scalars(_Kind.TEXT, "identity")
    | _scalars(_Kind.INTEGER, "sideband_order"),
    "entry/instrument/generator": _scalars(_Kind.TEXT, "identity"),
    "entry/instrument/laser": _scalars(_Kind.NUMBER, "wavelength", "distance"),
    "entry/region": _scalars(_Kind.INTEGER, "row", "column", "height", "width"),
    "entry/steps": _steps(),
    "entry/retakes": {"position": _Part(_Kind.INTEGER, ("retakes",))} | _taken("retakes"),
    "entry/seams": {"position": _Part(_Kind.INTEGER, ("seams",))}
    | {name: _Part(_Kind.TEXT, ("seams",)) for name in SEAMS[1:]},
    "entry/data": {
        "y_m": _Part(_Kind.NUMBER, ("height",)),
        "x_m": _Part(_Kind.NUMBER, ("width",)),
    },
}
_OPTIONAL_GROUPS: Final = frozenset({"entry/acquisition", "entry/retakes", "entry/seams"})
# What writers write both of, or neither.
_TOGETHER: Final = (
    ("entry/retakes/position", "entry/seams/position"),
    ("entry/provenance/reed", "entry/provenance/reed_sha256"),
    ("entry/steps/lock_error_hz", "entry/steps/lock_error_se_hz"),
)
_PICTURES: Final = {
    "field": (_Kind.FIELD, ("height", "width")),
    "frames": (_Kind.FRAMES, (_FRAMES, "rows", "columns")),
}


def require_run(path: Path, file: Any) -> None:
    """Refuse a file that is no run file, or whose parts are not what the layout says.

    Parameters
    ----------
    path : Path
        For its size, and for messages.
    file : h5py.File
        Open for reading.

    Raises
    ------
    RunFileError
        Naming the part and what is wrong with it.
    KeyError, OSError, RuntimeError, ValueError, TypeError
        As h5py, where HDF5 itself finds damage.
    """
    _require_version(path, file)
    check = _Check(path, path.stat().st_size, dict(_datasets(path, file)))
    places = _places_of_data(check)
    _require_heaps(check, places)
    if _attribute(file, "format", h5py.h5t.STRING) != FORMAT:
        raise _no_run_file(path)
    layout = _layout(file, check)
    for name, part in layout.items():
        _require_type(check, name, part)
    _require_shapes(check, layout)
    _require_chunks(check, layout)
    _require_texts(check, layout)
    _require_geometry(check)
    _require_columns(check)
    _require_words(check)
    _require_header(check)


@dataclass(frozen=True)
class _Stored:
    """A dataset, and how it is stored.

    Attributes
    ----------
    id : DatasetID
    made : PropDCID
        What it was made with: layout, filters, other files.
    shape : tuple of int
        Empty for a single value, and also where there is none, see `_require_shapes`.
    """

    id: Any
    made: Any
    shape: tuple[int, ...]


@dataclass(frozen=True)
class _Check:
    """What is checked.

    Attributes
    ----------
    path : Path
    size_bytes : int
        Of the file.
    datasets : mapping of str to _Stored
    read : dict of str to array or str
        What was read of them.
    """

    path: Path
    size_bytes: int
    datasets: Mapping[str, _Stored]
    read: dict[str, Any] = field(default_factory=dict)

    def require(self, holds: bool, name: str, what: str) -> None:
        """Refuse the file unless something holds of the dataset of a name."""
        if not holds:
            raise _altered(self.path, name, what)

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of a dataset, as it is stored."""
        return self.datasets[name].shape

    def values(self, name: str) -> Any:
        """All of a dataset of numbers, or of a column of texts; read once."""
        if name not in self.read:
            dataset = h5py.Dataset(self.datasets[name].id)
            text = h5py.check_string_dtype(dataset.dtype)
            self.read[name] = dataset.asstr()[()] if text else dataset[()]
        return self.read[name]


def _altered(path: Path, name: str, what: str) -> RunFileError:
    return RunFileError(
        f"{path}: is damaged or altered ({_shown(name)} {what}); use another copy of the file"
    )


def _shown(name: str) -> str:
    """Name of an object, which may hold anything, on one line."""
    return name if name.isprintable() and len(name) < 80 else shown_value(name)


# --- Whether it is ours ------------------------------------------------------------------------


def _require_version(path: Path, file: Any) -> None:
    """Refuse a file of another version, which may be laid out otherwise."""
    if not h5py.h5a.exists(file.id, b"format"):
        raise _no_run_file(path)
    found = _attribute(file, "format_version", h5py.h5t.INTEGER)
    if found == FORMAT_VERSION:
        return
    newer = found is not None and found > FORMAT_VERSION
    remedy = "update it" if newer else "measure again, or read the file with plain h5py"
    raise RunFileError(
        f"{path}: has format version {shown_value(_plain(found))}, this software reads version "
        f"{FORMAT_VERSION}; {remedy}"
    )


def _plain(value: Any) -> Any:
    """Value of an attribute as Python has it."""
    return value.item() if isinstance(value, np.generic) else value


def _no_run_file(path: Path) -> RunFileError:
    return RunFileError(f"{path}: is HDF5 but no run file; name one that acquire wrote")


def _attribute(holder: Any, name: str, kind: int) -> Any:
    """Single value of an attribute; None if there is none, or one of another kind."""
    if not h5py.h5a.exists(holder.id, name.encode()):
        return None
    attribute = h5py.h5a.open(holder.id, name.encode())
    if attribute.shape != () or attribute.get_type().get_class() != kind:
        return None
    return holder.attrs[name]


# --- Objects, types and shapes -----------------------------------------------------------------


def _datasets(path: Path, file: Any) -> Iterator[tuple[str, _Stored]]:
    """All datasets with their names; only hard links lead to them, one to each."""
    groups = [("", h5py.h5g.open(file.id, b"/"))]
    # An object's address is its identity.
    seen = {_address(groups[0][1])}
    while groups:
        above, group = groups.pop()
        for link in group:
            name = f"{above}{link.decode('utf-8', errors='replace')}"
            if _is_known_link(path, group, link, name):
                continue
            child = h5py.h5o.open(group, link)
            if _address(child) in seen:
                raise _altered(path, name, "is another object under a second name")
            seen.add(_address(child))
            if len(seen) > _MAX_OBJECTS:
                raise _altered(path, name, f"is one of more than {_MAX_OBJECTS} objects")
            kind = h5py.h5i.get_type(child)
            if kind == h5py.h5i.GROUP:
                groups.append((f"{name}/", child))
            elif kind == h5py.h5i.DATASET:
                stored = _Stored(child, child.get_create_plist(), child.shape or ())
                _require_storage(path, name, stored.made)
                yield name, stored
            else:
                raise _altered(path, name, "is neither a group nor a dataset")


def _address(opened: Any) -> int:
    address: int = h5py.h5o.get_info(opened).addr
    return address


def _is_known_link(path: Path, group: Any, link: bytes, name: str) -> bool:
    """Whether a link is that of the layout; all others are refused unless they are hard."""
    kind = group.links.get_info(link).type
    if kind == h5py.h5l.TYPE_HARD:
        return False
    if kind != h5py.h5l.TYPE_SOFT:
        raise _altered(path, name, "lies in another file")
    if group.links.get_val(link) != _LINKS.get(name, "").encode():
        raise _altered(path, name, "is a link to something else")
    return True


def _require_storage(path: Path, name: str, made: Any) -> None:
    """Refuse what lies in another file, or cannot be read without others' software."""
    if made.get_external_count() or made.get_layout() == h5py.h5d.VIRTUAL:
        raise _altered(path, name, "keeps its data in another file")
    filters = {made.get_filter(k)[0] for k in range(made.get_nfilters())}
    if not filters <= _FILTERS:
        raise _altered(path, name, f"is stored through the unknown filter {max(filters)}")


def _layout(file: Any, check: _Check) -> dict[str, _Part]:
    """Datasets that the file has to have, and those that it may have and has.

    Raises
    ------
    KeyError
        Naming one that is missing.
    """
    layout: dict[str, _Part] = {}
    for group, parts in _GROUPS.items():
        if group in _OPTIONAL_GROUPS and group not in file:
            continue
        for last, part in parts.items():
            name = f"{group}/{last}"
            if name in check.datasets:
                layout[name] = part
            elif not part.optional:
                raise KeyError(f"{name} is missing")
    for one, other in _TOGETHER:
        if (one in layout) != (other in layout):
            raise KeyError(f"{other if one in layout else one} is missing")
    signal = _attribute(file["entry/data"], "signal", h5py.h5t.STRING)
    if signal not in _PICTURES:
        raise _altered(check.path, "entry/data", "does not say what its signal is")
    kind, axes = _PICTURES[str(signal)]
    layout[f"entry/data/{signal}"] = _Part(kind, ("steps", *axes))
    places = "entry/retakes/position"
    if places in layout and check.shape(places) != (0,):
        layout[f"entry/retakes/{signal}"] = _Part(kind, ("retakes", *axes))
    for name in layout:
        if name not in check.datasets:
            raise KeyError(f"{name} is missing")
    return layout


def _require_type(check: _Check, name: str, part: _Part) -> None:
    """Refuse another type than that of the layout, to the last bit of its description."""
    found = check.datasets[name].id.get_type()
    if part.kind is _Kind.TEXT:
        fits = found.get_class() == h5py.h5t.STRING and found.get_size() <= _MAX_TEXT_BYTES
    else:
        fits = any(found.equal(known) for known in _types(part.kind))
    check.require(fits, name, f"holds no {part.kind.name.lower()}")


def _types(kind: _Kind) -> Sequence[Any]:
    h5t = h5py.h5t
    whole = [
        getattr(h5t, f"STD_{sign}{bits}{order}")
        for sign in "IU"
        for bits in (8, 16, 32, 64)
        for order in ("LE", "BE")
    ]
    match kind:
        case _Kind.INTEGER:
            return whole
        case _Kind.FIELD:
            return [h5t.py_create(np.dtype(np.complex64), logical=True)]
        case _Kind.FRAMES:
            return [h5t.STD_U16LE, h5t.STD_U16BE]
        case _:
            return [*whole, h5t.IEEE_F32LE, h5t.IEEE_F64LE, h5t.IEEE_F32BE, h5t.IEEE_F64BE]


def _require_shapes(check: _Check, layout: Mapping[str, _Part]) -> None:
    """Refuse shapes that do not fit together, or that the file has no bytes for."""
    scalars = [name for name, part in layout.items() if not part.shape]
    rows = {
        "entry/steps/verdict": 1,
        "entry/instrument/acoustic_lines": 1,
        "entry/retakes/position": 1,
        "entry/seams/position": 1,
    }
    for name, axes in {**dict.fromkeys(scalars, 0), **rows}.items():
        if name in layout:
            space = check.datasets[name].id.get_space().get_simple_extent_type()
            check.require(space != h5py.h5s.NULL, name, "has no value")
            shape = check.shape(name)
            check.require(len(shape) == axes, name, f"has the shape {shape}")
    lengths = _lengths(check, layout)
    for name, part in layout.items():
        expected = tuple(lengths[axis] if isinstance(axis, str) else axis for axis in part.shape)
        check.require(
            check.shape(name) == expected,
            name,
            f"has the shape {check.shape(name)} in place of {expected}",
        )
        _require_bytes(check, name)


def _lengths(check: _Check, layout: Mapping[str, _Part]) -> dict[str, int]:
    """Lengths of the axes of the layout, by name."""
    lengths = {
        "steps": check.shape("entry/steps/verdict")[0],
        "lines": check.shape("entry/instrument/acoustic_lines")[0],
    }
    check.require(1 <= lengths["steps"] <= MAX_STEPS, "entry/steps", f"has {lengths['steps']} rows")
    for axis in ("retakes", "seams"):
        if f"entry/{axis}/position" in layout:
            lengths[axis] = check.shape(f"entry/{axis}/position")[0]
    sizes = {"rows": "instrument/camera", "columns": "instrument/camera"}
    sizes |= {"height": "region", "width": "region"}
    return lengths | {
        axis: int(check.values(f"entry/{group}/{axis}")) for axis, group in sizes.items()
    }


def _require_bytes(check: _Check, name: str) -> None:
    """Refuse a dataset that is larger than what the file has for it."""
    dataset = check.datasets[name]
    made, shape = dataset.made, dataset.shape
    size_bytes = math.prod(shape) * dataset.id.get_type().get_size()
    if made.get_nfilters():
        # Pictures without light have no bytes once they are packed; only one is ever read at once.
        one_bytes = size_bytes // max(shape[0], 1) if shape else size_bytes
        check.require(
            one_bytes <= _MOST_SHRUNK * check.size_bytes,
            name,
            f"is larger than a file of {check.size_bytes} bytes can hold",
        )
    else:
        stored = dataset.id.get_storage_size()
        check.require(
            size_bytes <= stored <= check.size_bytes,
            name,
            f"needs {size_bytes} bytes and has {stored}",
        )


def _require_chunks(check: _Check, layout: Mapping[str, _Part]) -> None:
    """Refuse pictures that are not stored step by step, or that are good and have no bytes."""
    good = (check.values("entry/steps/verdict") == Verdict.OK).tolist()
    for name, part in layout.items():
        dataset = check.datasets[name]
        made, shape = dataset.made, dataset.shape
        if made.get_layout() != h5py.h5d.CHUNKED:
            continue
        pictures = part.kind in (_Kind.FIELD, _Kind.FRAMES)
        chunk = made.get_chunk()
        expected = (1, *shape[1:])
        check.require(pictures and chunk == expected, name, f"is stored in pieces of {chunk}")
        listed: list[tuple[int, ...]] = []
        dataset.id.chunk_iter(lambda piece, into=listed: into.append(piece.chunk_offset))
        places = [(row, *(0 for _ in shape[1:])) for row in range(shape[0])]
        needed = places
        if made.get_nfilters():
            # Those that are packed and hold no light have no bytes, but then they are not good.
            is_needed = good if name.startswith("entry/data/") else [False] * len(places)
            needed = [place for place, needs in zip(places, is_needed, strict=True) if needs]
        check.require(
            len(set(listed)) == len(listed) and set(needed) <= set(listed) <= set(places),
            name,
            "has lost the place of a step",
        )


def _places_of_data(check: _Check) -> list[tuple[int, int]]:
    """First and last byte of all data, in order; refuse those outside the file, or upon each other.

    Raises
    ------
    RunFileError
    """
    places = sorted(
        (start, start + size, name)
        for name, dataset in check.datasets.items()
        for start, size in _places(dataset)
        if size
    )
    for start, end, name in places:
        check.require(start > 0 and end <= check.size_bytes, name, "lies outside the file")
    for (_, end, _), (start, _, name) in pairwise(places):
        check.require(end <= start, name, "shares bytes with something else")
    return [(start, end) for start, end, _ in places]


def _places(dataset: _Stored) -> list[tuple[int, int]]:
    """First byte in the file, and number of bytes, of every piece of a dataset."""
    layout = dataset.made.get_layout()
    if layout == h5py.h5d.CONTIGUOUS:
        start = dataset.id.get_offset()
        return [] if start is None else [(start, dataset.id.get_storage_size())]
    found: list[tuple[int, int]] = []
    if layout == h5py.h5d.CHUNKED:
        dataset.id.chunk_iter(lambda chunk: found.append((chunk.byte_offset, chunk.size)))
    return found


def _require_heaps(check: _Check, data: Sequence[tuple[int, int]]) -> None:
    """Refuse a heap of texts in which HDF5 would search for ever.

    HDF5 2.0 goes through a heap object by object, and stays where it is at one whose number and
    size are 0 (Format Specification, III.E "Global Heap").
    """
    ends = [0, *(end for _, end in data)]
    starts = [*(start for start, _ in data), check.size_bytes]
    with check.path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        for start, end in zip(ends, starts, strict=True):
            place = content.find(_HEAP, start, end)
            while place >= 0:
                endless = _is_endless(content, place, end)
                check.require(not endless, "a heap of texts", f"at byte {place} has no end")
                place = content.find(_HEAP, place + 1, end)


def _is_endless(content: mmap, start: int, end: int) -> bool:
    """Whether a heap between two places holds an object of number and size 0."""
    size = int.from_bytes(content[start + 8 : start + _HEAP_HEAD], "little")
    place, last = start + _HEAP_HEAD, min(start + size, end) - _HEAP_HEAD
    while place <= last:
        number, size = struct.unpack_from("<H6xQ", content, place)
        if number == 0:
            # What is left, which is the last.
            return bool(size == 0)
        # Objects begin at multiples of 8 bytes.
        place += _HEAP_HEAD + -(-size // 8) * 8
    return False


# --- What stands in it -------------------------------------------------------------------------


def _require_texts(check: _Check, layout: Mapping[str, _Part]) -> None:
    """Refuse texts that are longer than anyone writes.

    They may hold control characters: `acquire.cli.console` and the pages show those as text.
    """
    for name, part in layout.items():
        if part.kind is not _Kind.TEXT:
            continue
        texts = np.atleast_1d(np.asarray(check.values(name), dtype=object)).tolist()
        check.require(max(map(len, texts), default=0) <= _MAX_TEXT_BYTES, name, "is too long")


def _require_geometry(check: _Check) -> None:
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


def _require_axes(check: _Check, shape: tuple[int, int]) -> None:
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


def _require_columns(check: _Check) -> None:
    """Refuse numbers that no run has: they would be read as places, orders or volts."""
    steps = check.shape("entry/steps/verdict")[0]
    _require_range(check, "entry/steps/index", -_MAX_INDEX, _MAX_INDEX)
    _require_range(check, "entry/steps/order", 0, _MAX_ORDER)
    _require_range(check, "entry/instrument/synthesizers/sideband_order", 0, _MAX_ORDER)
    _require_range(check, "entry/instrument/camera/saturation_value", 1, 65_535)
    _require_range(check, "entry/steps/volts", 0, 1000)
    _require_range(check, "entry/instrument/acoustic_lines", 0, _MOST_HZ)
    # A place is free, or of a step; one that is being filled has −2 less its step.
    _require_range(check, "entry/retakes/position", -1 - steps, steps - 1)
    _require_range(check, "entry/seams/position", -1, MAX_STEPS)
    strength = check.values("entry/sample/strength")
    check.require(not math.isinf(strength), "entry/sample/strength", "is infinite")
    # Steps with a verdict have checksums; of the others a killed process may have left half, but
    # for what was planned.
    unmeasured = ~np.isin(check.values("entry/steps/verdict"), [v for v in Verdict if v.measured])
    for name in PLANNED_HZ:
        _require_exact(check, f"entry/steps/{name}", unmeasured)


def _require_range(check: _Check, name: str, least: float, most: float) -> None:
    if name not in check.datasets:
        return
    values = np.asarray(check.values(name))
    # Of NaN, neither comparison holds.
    odd = values[~((least <= values) & (values <= most))]
    if odd.size:
        raise _altered(check.path, name, f"has a {odd.flat[0]:g}")


def _require_exact(check: _Check, name: str, whole: Any) -> None:
    """Refuse frequencies whose text is none, or another one than their number, at whole steps."""
    texts = check.values(f"{name}_exact")[whole].tolist()
    check.require(all(texts), f"{name}_exact", "lacks a frequency")
    if name not in check.datasets:
        return
    for text, hz in zip(texts, check.values(name)[whole].tolist(), strict=True):
        # Most are decimals, and those are read ten times as fast so.
        exact_hz = float(Fraction(text) if "/" in text else text)
        check.require(math.isclose(exact_hz, hz, rel_tol=_ROUNDING), name, f"is {hz:g} and {text}")


def _require_words(check: _Check) -> None:
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


def _require_header(check: _Check) -> None:
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
