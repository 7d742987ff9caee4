"""Mutations of the groups, datasets and attributes of a run file, through h5py."""

import math
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from benchmarks.fuzzing.run_bytes import BYTES, Change
from benchmarks.fuzzing.run_files import Mutant, Original, decoy_of


def _edited(change: Callable[[Any, Original, random.Random], str]) -> Change:
    def edited(path: Path, original: Original, rng: random.Random) -> str:
        shutil.copy(original.path, path)
        with h5py.File(path, "r+") as file:
            return change(file, original, rng)

    edited.__name__ = change.__name__.lstrip("_")
    edited.__doc__ = change.__doc__
    return edited


def _any_path(original: Original, rng: random.Random) -> str:
    return rng.choice(original.paths)


def _any_dataset(file: Any, original: Original, rng: random.Random) -> str:
    return rng.choice([name for name in original.paths if isinstance(file[name], h5py.Dataset)])


def _replace(file: Any, name: str, **made: Any) -> None:
    """Make a dataset in the place of another, with its attributes."""
    attributes = dict(file[name].attrs)
    del file[name]
    file.create_dataset(name, **made)
    file[name].attrs.update(attributes)


# What files of older versions and of other programs lack: that it is gone cannot be seen.
_OPTIONAL = ("entry/acquisition", "entry/steps/order")


def _deleted(file: Any, original: Original, rng: random.Random) -> str:
    """Delete a group or dataset."""
    name = _any_path(original, rng)
    del file[name]
    return "any" if name in _OPTIONAL else "same"


def _renamed(file: Any, original: Original, rng: random.Random) -> str:
    """Rename a group or dataset."""
    name = _any_path(original, rng)
    file.move(name, name + rng.choice(("x", "\x1b[2J", " ", "é")))
    return "any" if name in _OPTIONAL else "same"


def _exchanged(file: Any, original: Original, rng: random.Random) -> str:
    """Exchange the names of two datasets."""
    one, other = _any_dataset(file, original, rng), _any_dataset(file, original, rng)
    if one != other:
        file.move(one, "kept")
        file.move(other, one)
        file.move("kept", other)
    # The same type and shape may mean something else.
    kinds = {
        (
            file[name].shape,
            "O" if h5py.check_string_dtype(file[name].dtype) else file[name].dtype.kind,
        )
        for name in (one, other)
    }
    return "any" if len(kinds) == 1 else "same"


_ATTRIBUTES = (
    1, 3.5, np.nan, "x", "\x1b[2J", b"x", [1, 2], ["a", "b"], np.zeros(2000), "field", "frames", 2,
    "3", np.zeros((0,)), h5py.Empty("f"), "y" * 60_000, -1, 2**40,
)  # fmt: skip


def _attribute(file: Any, original: Original, rng: random.Random) -> str:
    """Delete an attribute, or give it another value and type."""
    holders = [file, *(file[name] for name in original.paths)]
    holder = rng.choice([each for each in holders if len(each.attrs)])
    name = rng.choice(list(holder.attrs))
    if rng.random() < 0.3:
        del holder.attrs[name]
        return "same"
    holder.attrs[name] = rng.choice(_ATTRIBUTES)
    return "same"


_TYPES: dict[str, Any] = {
    "text": h5py.string_dtype("utf-8"), "fixed text": "S8", "half": "f2", "single": "f4",
    "compound": np.dtype([("a", "f8"), ("b", "i4")]), "big-endian": ">f8", "complex": "c16",
    "bool": "?", "byte": "i1", "unsigned": "u8", "integer": "i8", "opaque": "V8",
    "enum": h5py.enum_dtype({"a": 0, "b": 1}), "reference": h5py.ref_dtype, "array": "(3,)f8",
    "region": h5py.regionref_dtype, "lists": h5py.vlen_dtype("f8"), "long double": "f16",
}  # fmt: skip
_NUMBERS = ("single", "big-endian", "byte", "unsigned", "integer")
_TEXTS = ("text", "fixed text")


def _retyped(file: Any, original: Original, rng: random.Random) -> str:
    """Give a dataset another type."""
    name, kind = _any_dataset(file, original, rng), rng.choice(list(_TYPES))
    shape, was = file[name].shape, file[name].dtype
    if math.prod(shape) > 1_000_000:
        return "same"
    _replace(file, name, shape=shape, dtype=_TYPES[kind])
    # Zeros are numbers too, and an empty text is one.
    readable = (was.kind in "if" and kind in _NUMBERS) or (
        h5py.check_string_dtype(was) is not None and kind in _TEXTS
    )
    if readable or not math.prod(shape):
        return "any"
    return "refused" if _is_read(name) else "same"


# What no reader asks for.
_UNREAD = (
    "program_name", "/frame_rate", "bit_depth_readout", "volts_max", "data/drive_hz", "order0",
)  # fmt: skip


def _is_read(name: str) -> bool:
    """Whether a change of an object's type or shape can matter."""
    inexact = name.endswith("_hz") and name.startswith(("entry/steps", "entry/earlier_attempts"))
    measured = name.endswith(("lock_error_hz", "lock_error_se_hz"))
    return not name.endswith(_UNREAD) and (measured or not inexact)


def _reshaped(file: Any, original: Original, rng: random.Random) -> str:
    """Give a dataset other rows, more axes, or none."""
    name = _any_dataset(file, original, rng)
    old = file[name]
    shape, dtype = old.shape, old.dtype
    if math.prod(shape) > 1_000_000:
        shape = (1, *shape[1:])
    new = rng.choice(
        [
            (*shape, 1), (1, *shape), (), (0,), (1,), (len(shape), 2), (*shape[:-1], 2), (2**10,),
            tuple(n + 1 for n in shape), tuple(max(n - 1, 0) for n in shape), shape[::-1],
        ]
    )  # fmt: skip
    same = new == old.shape
    _replace(file, name, shape=new, dtype=dtype)
    return "any" if same else "refused" if _is_read(name) else "same"


def _null_space(file: Any, original: Original, rng: random.Random) -> str:
    """Leave nothing of a dataset but its type."""
    name = _any_dataset(file, original, rng)
    _replace(file, name, data=h5py.Empty(file[name].dtype))
    return "refused" if _is_read(name) else "same"


def _other_object(file: Any, original: Original, rng: random.Random) -> str:
    """Put a group in the place of a dataset, or a dataset or a named type in that of a group."""
    name = _any_path(original, rng)
    was_group = isinstance(file[name], h5py.Group)
    del file[name]
    if rng.random() < 0.3:
        file[name] = np.dtype("f8")
    elif was_group:
        file[name] = 1.0
    else:
        file.create_group(name)
    return "same"


def _external_link(file: Any, original: Original, rng: random.Random) -> str:
    """Link to another file."""
    name = _any_path(original, rng)
    del file[name]
    file[name] = h5py.ExternalLink(str(decoy_of(original)), name)
    return "refused" if _is_read(name) else "same"


def _soft_link(file: Any, original: Original, rng: random.Random) -> str:
    """Link to another object, to itself, or to nothing."""
    name, other = _any_path(original, rng), _any_path(original, rng)
    del file[name]
    target = rng.choice((f"/{other}", f"/{name}", "/nothing", ".", "/", "..", "/entry"))
    file[name] = h5py.SoftLink(target)
    return "same"


def _hard_link(file: Any, original: Original, rng: random.Random) -> str:
    """Give an object a second name, also within itself."""
    name, other = _any_path(original, rng), _any_path(original, rng)
    target = file[other]
    if rng.random() < 0.5:
        group = file[name] if isinstance(file[name], h5py.Group) else file[name].parent
        group["again"] = target
        return "same"
    del file[name]
    file[name] = target
    return "same" if name != other else "any"


def _external_storage(file: Any, original: Original, rng: random.Random) -> str:
    """Keep a dataset's bytes in another file."""
    name = _any_dataset(file, original, rng)
    data = file[name][()]
    if h5py.check_string_dtype(file[name].dtype) and not isinstance(data, np.ndarray):
        data = np.bytes_(data)
    raw = decoy_of(original).with_suffix(".raw")
    array = np.asarray(data)
    if array.dtype.hasobject or array.nbytes > raw.stat().st_size:
        return _external_link(file, original, rng)
    attributes = dict(file[name].attrs)
    del file[name]
    dataset = file.create_dataset(
        name, array.shape or (1,), array.dtype, external=[(str(raw), 0, h5py.h5f.UNLIMITED)]
    )
    dataset.attrs.update(attributes)
    return "refused" if _is_read(name) else "same"


def _virtual(file: Any, original: Original, rng: random.Random) -> str:
    """Take a dataset from another file."""
    name = _any_dataset(file, original, rng)
    old = file[name]
    if not old.shape or h5py.check_string_dtype(old.dtype):
        return _external_link(file, original, rng)
    layout = h5py.VirtualLayout(old.shape, old.dtype)
    layout[...] = h5py.VirtualSource(str(decoy_of(original)), name, shape=old.shape)
    attributes = dict(old.attrs)
    del file[name]
    file.create_virtual_dataset(name, layout)
    file[name].attrs.update(attributes)
    return "refused" if _is_read(name) else "same"


def _filtered(file: Any, original: Original, rng: random.Random) -> str:
    """Store a dataset through a filter that is not there."""
    name = _any_dataset(file, original, rng)
    old = file[name]
    if not old.shape or not old.size:
        return "same"
    made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    made.set_chunk((1, *old.shape[1:]))
    made.set_filter(rng.choice((300, 305, 32015, 32768, 65_000)), h5py.h5z.FLAG_OPTIONAL, ())
    space, kind, attributes = old.id.get_space().copy(), old.id.get_type(), dict(old.attrs)
    del file[name]
    group, _, last = name.rpartition("/")
    h5py.h5d.create(file[group].id, last.encode(), kind, space, made)
    file[name].attrs.update(attributes)
    return "refused" if _is_read(name) else "same"


def _absurd_shape(file: Any, original: Original, rng: random.Random) -> str:
    """Give a dataset a shape of terabytes, with or without bytes behind it."""
    name = _any_dataset(file, original, rng)
    dtype = file[name].dtype
    rest = file[name].shape[1:]
    shape = rng.choice([(2**40,), (2**20, 2**20), (2**33, *rest), (1, 2**38)])
    chunks = rng.choice([None, True, tuple(min(n, 2**8) for n in shape)])
    _replace(file, name, shape=shape, dtype=dtype, chunks=chunks)
    return "refused" if _is_read(name) else "same"


def _absurd_everywhere(file: Any, original: Original, rng: random.Random) -> str:
    """Say that every picture is absurdly large, wherever it is said."""
    side = rng.choice((2**15, 2**17, 2**20))
    name = "frames" if "frames" in file["entry/data"] else "field"
    steps = len(file["entry/steps/verdict"])
    shape = (steps, 4, side, side) if name == "frames" else (steps, side, side)
    for key in ("entry/instrument/camera/rows", "entry/instrument/camera/columns"):
        file[key][()] = side
    if name == "field":
        for key, value in (("row", 0), ("column", 0), ("height", side), ("width", side)):
            file[f"entry/region/{key}"][()] = value
        for key in ("y_m", "x_m"):
            _replace(file, f"entry/data/{key}", data=np.linspace(-0.01, 0.01, side))
    # So far away that the transform is valid.
    file["entry/instrument/laser/distance"][()] = 1e6
    chunks = (1, *shape[1:-2], *(min(side, rng.choice((2**9, 2**13))),) * 2)
    _replace(
        file,
        f"entry/data/{name}",
        shape=shape,
        dtype=file[f"entry/data/{name}"].dtype,
        chunks=chunks,
    )
    return "refused"


ABSURD: dict[str, tuple[Any, ...]] = {
    "entry/region/row": (-1, 2**40, -(2**63)),
    "entry/region/column": (-5, 2**31),
    "entry/region/height": (0, -3, 2**40, 100_000),
    "entry/region/width": (0, -3, 2**40, 100_000),
    "entry/instrument/camera/pixel_size": (np.nan, 0.0, -6.7e-6, np.inf, 1e300, 1e-300),
    "entry/instrument/camera/rows": (0, -128, 2**40, 127),
    "entry/instrument/camera/columns": (0, -160, 2**40, 161),
    "entry/instrument/camera/count_time": (np.nan, -1.0, np.inf),
    "entry/instrument/camera/saturation_value": (-5,),
    "entry/instrument/laser/wavelength": (np.nan, 0.0, -1.0, np.inf),
    "entry/instrument/laser/distance": (np.nan, 0.0, -1.0, np.inf, 1e-6),
    "entry/instrument/synthesizers/sideband_order": (-(2**40), 2**40),
    "entry/sample/strength": (np.inf,),
}
_ABSURD_ITEMS: dict[str, tuple[Any, ...]] = {
    "entry/steps/index": (2**62,),
    "entry/steps/order": (2**40, -(2**40)),
    "entry/steps/volts": (np.nan, -1.0, np.inf),
    "entry/earlier_attempts/position": (5, 99, 2**62),
    "entry/interruptions/position": (-5, 2**62),
    "entry/instrument/acoustic_resonances": (np.nan, -1.0, np.inf),
    "entry/data/y_m": (np.nan, np.inf),
    "entry/data/x_m": (np.nan, np.inf),
}
ABSURD_TEXTS: dict[str, tuple[str, ...]] = {
    "entry/status": ("done", "", "\x1b[2J"),
    "entry/start_time": ("yesterday", "\x1b[31m", "9" * 30),
    "entry/acquisition/kind": ("sweeps", "", "\x1b[2J"),
    "entry/instrument/camera/frame_rate_exact": ("0", "-12.4", "nan", "1/0", "x", "", "inf"),
    "entry/provenance/package_versions": ("[]", "{", "1", '"x"', '{"a": 1}', "[" * 5000),
    "entry/sample/chamber": ("round",),
}
_ABSURD_TEXT_ITEMS = {
    "entry/steps/verdict": ("great", "", "\x1b[2J"),
    "entry/steps/drive_hz_exact": ("x", "nan", "1/0", "9" * 60, "-1"),
    "entry/steps/asked_hz_exact": ("", "inf", "\x1b[2J"),
    "entry/steps/read_aom1_hz_exact": ("x", "1/0", "٣"),
}


def _absurd_number(file: Any, _original: Original, rng: random.Random) -> str:
    """Say a number that cannot be."""
    name, values = rng.choice([*ABSURD.items(), *_ABSURD_ITEMS.items()])
    value, dataset = rng.choice(values), file[name]
    if dataset.shape == ():
        dataset[()] = value
    else:
        dataset[rng.randrange(len(dataset))] = value
    return "refused"


def _absurd_text(file: Any, _original: Original, rng: random.Random) -> str:
    """Say a word that cannot be."""
    name, texts = rng.choice([*ABSURD_TEXTS.items(), *_ABSURD_TEXT_ITEMS.items()])
    text, dataset = rng.choice(texts), file[name]
    if dataset.shape == ():
        _replace(file, name, data=text)
    else:
        dataset[rng.randrange(len(dataset))] = text
    return "refused"


_ODD_TEXTS = (
    b"\x1b[2J\x1b[31mred", b"\x07", b"\xff\xfe", b"\xe2\x80\xaex", b"", b"a\nb", b"\x7f", b"\xc3",
    b"\xc2\x9b2J", b"x" * 10_000_000, b"\xed\xa0\x80",
)  # fmt: skip


def _text(file: Any, original: Original, rng: random.Random) -> str:
    """Put control characters, bytes that are no UTF-8, or very much, in a text."""
    texts = [
        n
        for n in original.paths
        if isinstance(file[n], h5py.Dataset) and h5py.check_string_dtype(file[n].dtype)
    ]
    name = rng.choice(texts)
    text = rng.choice(_ODD_TEXTS)
    if file[name].shape == ():
        _replace(file, name, data=np.bytes_(text) if text else "")
    elif len(file[name]):
        file[name][rng.randrange(len(file[name]))] = text
    return "any"


_EDITS = (
    _deleted, _renamed, _exchanged, _attribute, _attribute, _retyped, _retyped, _reshaped,
    _null_space, _other_object, _external_link, _soft_link, _hard_link, _external_storage, _virtual,
    _filtered, _absurd_shape, _absurd_everywhere, _absurd_number, _absurd_number, _absurd_text,
    _text,
)  # fmt: skip
_OBJECTS = tuple(map(_edited, _EDITS))


def mutant_of(path: Path, original: Original, rng: random.Random) -> Mutant:
    """Write a mutant."""
    change = rng.choice(rng.choice((BYTES, _OBJECTS, _OBJECTS)))
    try:
        expected = change(path, original, rng)
    except (OSError, ValueError, TypeError, RuntimeError, KeyError) as error:
        # HDF5 itself refuses some: then the file is as it was, or lacks what was deleted.
        return Mutant(path, original, f"{change.__name__} ({type(error).__name__})", "same")
    return Mutant(path, original, change.__name__, expected)
