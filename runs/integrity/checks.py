"""Check layout, types, sizes and some numbers of a run file before its data are read.

An HDF5 file can say that its data are in another file, that a column has 10¹² rows, or that a text
is a number. Reading such a file would open a file that the user did not name, ask for terabytes of
memory, or return nonsense without an error. So every object is checked first, without following a
link and without reading an array; then the numbers that give positions and sizes; then the texts
that are shown to the user.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from protocols.protocol import MAX_STEPS
from protocols.units import shown_value
from runs.errors import RunFileError
from runs.integrity.content_checks import (
    MAX_TEXT_BYTES,
    require_columns,
    require_geometry,
    require_header,
    require_texts,
    require_words,
)
from runs.integrity.expected import GROUPS, OPTIONAL_GROUPS, PICTURES, TOGETHER, Part, ValueKind
from runs.integrity.stored import Check, altered, datasets, places_of_data, require_heaps
from runs.layout import (
    FORMAT,
    FORMAT_VERSION,
)
from runs.verdict import Verdict

# Largest compression ratio of all filters: that of deflate (zlib documentation: 1032 : 1).
_MAX_COMPRESSION: Final = 1032


def require_run(path: Path, file: Any) -> None:
    """Raise an error unless a file is a run file with the layout of this version.

    Parameters
    ----------
    path : Path
        Path of the file; used for its size and in messages.
    file : h5py.File
        The same file, open for reading.

    Raises
    ------
    RunFileError
        If an object does not have the layout. The message names the object and what is wrong.
    KeyError, OSError, RuntimeError, ValueError, TypeError
        Raised by h5py if HDF5 itself finds damage.
    """
    _require_version(path, file)
    check = Check(path, path.stat().st_size, dict(datasets(path, file)))
    places = places_of_data(check)
    require_heaps(check, places)
    if _attribute(file, "format", h5py.h5t.STRING) != FORMAT:
        raise _no_run_file(path)
    layout = _layout(file, check)
    for name, part in layout.items():
        _require_type(check, name, part)
    _require_shapes(check, layout)
    _require_chunks(check, layout)
    require_texts(check, layout)
    require_geometry(check)
    require_columns(check)
    require_words(check)
    require_header(check)


# --- Format and version ------------------------------------------------------------------------


def _require_version(path: Path, file: Any) -> None:
    """Raise an error if the file has another format version: its layout may differ."""
    if not h5py.h5a.exists(file.id, b"format"):
        raise _no_run_file(path)
    found = _attribute(file, "format_version", h5py.h5t.INTEGER)
    if found == FORMAT_VERSION:
        return
    newer = found is not None and found > FORMAT_VERSION
    remedy = "update this software" if newer else "measure again, or read the file with plain h5py"
    raise RunFileError(
        f"{path}: has format version {shown_value(_as_python(found))}, this software reads version "
        f"{FORMAT_VERSION}; {remedy}"
    )


def _as_python(value: Any) -> Any:
    """Convert a numpy scalar to a Python number; return other values unchanged."""
    return value.item() if isinstance(value, np.generic) else value


def _no_run_file(path: Path) -> RunFileError:
    return RunFileError(
        f"{path}: is an HDF5 file but not a run file; name a file that acquire wrote"
    )


def _attribute(node: Any, name: str, type_class: int) -> Any:
    """Return the value of a scalar attribute; None if it is missing or of another type class."""
    if not h5py.h5a.exists(node.id, name.encode()):
        return None
    attribute = h5py.h5a.open(node.id, name.encode())
    if attribute.shape != () or attribute.get_type().get_class() != type_class:
        return None
    return node.attrs[name]


# --- Objects, types and shapes -----------------------------------------------------------------


def _layout(file: Any, check: Check) -> dict[str, Part]:
    """Return the required datasets, and the optional ones that the file has.

    Raises
    ------
    KeyError
        If a required dataset is missing.
    """
    layout: dict[str, Part] = {}
    for group, parts in GROUPS.items():
        if group in OPTIONAL_GROUPS and group not in file:
            continue
        for dataset_name, part in parts.items():
            name = f"{group}/{dataset_name}"
            if name in check.datasets:
                layout[name] = part
            elif not part.optional:
                raise KeyError(f"{name} is missing")
    for first, second in TOGETHER:
        if (first in layout) != (second in layout):
            raise KeyError(f"{second if first in layout else first} is missing")
    signal = _attribute(file["entry/data"], "signal", h5py.h5t.STRING)
    if signal not in PICTURES:
        raise altered(check.path, "entry/data", "has no valid attribute 'signal'")
    kind, axes = PICTURES[str(signal)]
    layout[f"entry/data/{signal}"] = Part(kind, ("steps", *axes))
    earlier_positions = "entry/earlier_attempts/position"
    if earlier_positions in layout and check.shape(earlier_positions) != (0,):
        layout[f"entry/earlier_attempts/{signal}"] = Part(kind, ("earlier_attempts", *axes))
    for name in layout:
        if name not in check.datasets:
            raise KeyError(f"{name} is missing")
    return layout


def _require_type(check: Check, name: str, part: Part) -> None:
    """Raise an error if a dataset has not exactly a type that the layout allows."""
    found = check.datasets[name].id.get_type()
    if part.kind is ValueKind.TEXT:
        fits = found.get_class() == h5py.h5t.STRING and found.get_size() <= MAX_TEXT_BYTES
    else:
        fits = any(found.equal(allowed) for allowed in _types(part.kind))
    check.require(fits, name, f"is not of the type {part.kind.name.lower()}")


def _types(kind: ValueKind) -> Sequence[Any]:
    """Return the HDF5 types that a dataset of one kind may have."""
    h5t = h5py.h5t
    integers = [
        getattr(h5t, f"STD_{sign}{bits}{order}")
        for sign in "IU"
        for bits in (8, 16, 32, 64)
        for order in ("LE", "BE")
    ]
    match kind:
        case ValueKind.INTEGER:
            return integers
        case ValueKind.FIELD:
            return [h5t.py_create(np.dtype(np.complex64), logical=True)]
        case ValueKind.FRAMES:
            return [h5t.STD_U16LE, h5t.STD_U16BE]
        case _:
            return [*integers, h5t.IEEE_F32LE, h5t.IEEE_F64LE, h5t.IEEE_F32BE, h5t.IEEE_F64BE]


def _require_shapes(check: Check, layout: Mapping[str, Part]) -> None:
    """Raise an error if shapes do not fit together, or need more bytes than the file has."""
    scalars = [name for name, part in layout.items() if not part.shape]
    rows = {
        "entry/steps/verdict": 1,
        "entry/instrument/acoustic_resonances": 1,
        "entry/earlier_attempts/position": 1,
        "entry/interruptions/position": 1,
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
            f"has the shape {check.shape(name)} instead of {expected}",
        )
        _require_bytes(check, name)


def _lengths(check: Check, layout: Mapping[str, Part]) -> dict[str, int]:
    """Return the lengths of the axes of the layout, by name."""
    lengths = {
        "steps": check.shape("entry/steps/verdict")[0],
        "lines": check.shape("entry/instrument/acoustic_resonances")[0],
    }
    check.require(1 <= lengths["steps"] <= MAX_STEPS, "entry/steps", f"has {lengths['steps']} rows")
    for axis in ("earlier_attempts", "interruptions"):
        if f"entry/{axis}/position" in layout:
            lengths[axis] = check.shape(f"entry/{axis}/position")[0]
    sizes = {"rows": "instrument/camera", "columns": "instrument/camera"}
    sizes |= {"height": "region", "width": "region"}
    return lengths | {
        axis: int(check.values(f"entry/{group}/{axis}")) for axis, group in sizes.items()
    }


def _require_bytes(check: Check, name: str) -> None:
    """Raise an error if a dataset is larger than the bytes that the file stores for it."""
    dataset = check.datasets[name]
    made, shape = dataset.made, dataset.shape
    size_bytes = math.prod(shape) * dataset.id.get_type().get_size()
    if made.get_nfilters():
        # Packed images that are all zero occupy no bytes, so the sum says nothing. Images are read
        # one at a time: the size of one is what matters.
        one_bytes = size_bytes // max(shape[0], 1) if shape else size_bytes
        check.require(
            one_bytes <= _MAX_COMPRESSION * check.size_bytes,
            name,
            f"is larger than a file of {check.size_bytes} bytes can hold",
        )
    else:
        stored = dataset.id.get_storage_size()
        check.require(
            size_bytes <= stored <= check.size_bytes,
            name,
            f"needs {size_bytes} bytes, but {stored} are stored",
        )


def _require_chunks(check: Check, layout: Mapping[str, Part]) -> None:
    """Raise an error unless images are stored one chunk per step, and good steps have a chunk."""
    good = (check.values("entry/steps/verdict") == Verdict.OK).tolist()
    for name, part in layout.items():
        dataset = check.datasets[name]
        made, shape = dataset.made, dataset.shape
        if made.get_layout() != h5py.h5d.CHUNKED:
            continue
        pictures = part.kind in (ValueKind.FIELD, ValueKind.FRAMES)
        chunk = made.get_chunk()
        expected = (1, *shape[1:])
        check.require(pictures and chunk == expected, name, f"is stored in chunks of shape {chunk}")
        listed: list[tuple[int, ...]] = []
        dataset.id.chunk_iter(lambda piece, into=listed: into.append(piece.chunk_offset))
        offsets = [(row, *(0 for _ in shape[1:])) for row in range(shape[0])]
        needed = offsets
        if made.get_nfilters():
            # Packed images that are all zero have no chunk, but such steps are never good.
            is_needed = good if name.startswith("entry/data/") else [False] * len(offsets)
            needed = [offset for offset, needs in zip(offsets, is_needed, strict=True) if needs]
        check.require(
            len(set(listed)) == len(listed) and set(needed) <= set(listed) <= set(offsets),
            name,
            "lacks the chunk of a step, or has a wrong one",
        )
