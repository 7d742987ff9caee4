"""What must hold of a run file before it is read: layout, types, sizes and a few numbers.

HDF5 lets a file say that its data lie in another file, that a column has 10¹² rows, or that a text
is a number. Reading such a file would open what nobody named, ask for terabytes, or return nonsense
as good. So every object is looked at first, without following a link and without reading an array;
then the numbers that say where and how large everything is; then what people get to see.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from protocols.protocol import MAX_STEPS
from protocols.units import shown_value
from runs.content_checks import (
    MAX_TEXT_BYTES,
    require_columns,
    require_geometry,
    require_header,
    require_texts,
    require_words,
)
from runs.errors import RunFileError
from runs.expected import GROUPS, OPTIONAL_GROUPS, PICTURES, TOGETHER, Kind, Part
from runs.layout import (
    FORMAT,
    FORMAT_VERSION,
)
from runs.stored import Check, altered, datasets, places_of_data, require_heaps
from runs.verdict import Verdict

# No filter shrinks more than deflate does (1032 : 1, zlib's documentation).
_MOST_SHRUNK: Final = 1032


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


def _layout(file: Any, check: Check) -> dict[str, Part]:
    """Datasets that the file has to have, and those that it may have and has.

    Raises
    ------
    KeyError
        Naming one that is missing.
    """
    layout: dict[str, Part] = {}
    for group, parts in GROUPS.items():
        if group in OPTIONAL_GROUPS and group not in file:
            continue
        for last, part in parts.items():
            name = f"{group}/{last}"
            if name in check.datasets:
                layout[name] = part
            elif not part.optional:
                raise KeyError(f"{name} is missing")
    for one, other in TOGETHER:
        if (one in layout) != (other in layout):
            raise KeyError(f"{other if one in layout else one} is missing")
    signal = _attribute(file["entry/data"], "signal", h5py.h5t.STRING)
    if signal not in PICTURES:
        raise altered(check.path, "entry/data", "does not say what its signal is")
    kind, axes = PICTURES[str(signal)]
    layout[f"entry/data/{signal}"] = Part(kind, ("steps", *axes))
    places = "entry/retakes/position"
    if places in layout and check.shape(places) != (0,):
        layout[f"entry/retakes/{signal}"] = Part(kind, ("retakes", *axes))
    for name in layout:
        if name not in check.datasets:
            raise KeyError(f"{name} is missing")
    return layout


def _require_type(check: Check, name: str, part: Part) -> None:
    """Refuse another type than that of the layout, to the last bit of its description."""
    found = check.datasets[name].id.get_type()
    if part.kind is Kind.TEXT:
        fits = found.get_class() == h5py.h5t.STRING and found.get_size() <= MAX_TEXT_BYTES
    else:
        fits = any(found.equal(known) for known in _types(part.kind))
    check.require(fits, name, f"holds no {part.kind.name.lower()}")


def _types(kind: Kind) -> Sequence[Any]:
    h5t = h5py.h5t
    whole = [
        getattr(h5t, f"STD_{sign}{bits}{order}")
        for sign in "IU"
        for bits in (8, 16, 32, 64)
        for order in ("LE", "BE")
    ]
    match kind:
        case Kind.INTEGER:
            return whole
        case Kind.FIELD:
            return [h5t.py_create(np.dtype(np.complex64), logical=True)]
        case Kind.FRAMES:
            return [h5t.STD_U16LE, h5t.STD_U16BE]
        case _:
            return [*whole, h5t.IEEE_F32LE, h5t.IEEE_F64LE, h5t.IEEE_F32BE, h5t.IEEE_F64BE]


def _require_shapes(check: Check, layout: Mapping[str, Part]) -> None:
    """Refuse shapes that do not fit together, or that the file has no bytes for."""
    scalars = [name for name, part in layout.items() if not part.shape]
    rows = {
        "entry/steps/verdict": 1,
        "entry/instrument/acoustic_resonances": 1,
        "entry/retakes/position": 1,
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
            f"has the shape {check.shape(name)} in place of {expected}",
        )
        _require_bytes(check, name)


def _lengths(check: Check, layout: Mapping[str, Part]) -> dict[str, int]:
    """Lengths of the axes of the layout, by name."""
    lengths = {
        "steps": check.shape("entry/steps/verdict")[0],
        "lines": check.shape("entry/instrument/acoustic_resonances")[0],
    }
    check.require(1 <= lengths["steps"] <= MAX_STEPS, "entry/steps", f"has {lengths['steps']} rows")
    for axis in ("retakes", "interruptions"):
        if f"entry/{axis}/position" in layout:
            lengths[axis] = check.shape(f"entry/{axis}/position")[0]
    sizes = {"rows": "instrument/camera", "columns": "instrument/camera"}
    sizes |= {"height": "region", "width": "region"}
    return lengths | {
        axis: int(check.values(f"entry/{group}/{axis}")) for axis, group in sizes.items()
    }


def _require_bytes(check: Check, name: str) -> None:
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


def _require_chunks(check: Check, layout: Mapping[str, Part]) -> None:
    """Refuse pictures that are not stored step by step, or that are good and have no bytes."""
    good = (check.values("entry/steps/verdict") == Verdict.OK).tolist()
    for name, part in layout.items():
        dataset = check.datasets[name]
        made, shape = dataset.made, dataset.shape
        if made.get_layout() != h5py.h5d.CHUNKED:
            continue
        pictures = part.kind in (Kind.FIELD, Kind.FRAMES)
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


# --- What stands in it -------------------------------------------------------------------------
