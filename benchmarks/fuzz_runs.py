"""Mutations of run files, and what reads them: in a process of its own, with limits.

Two small runs are measured on the simulated bench, one that keeps holograms and one that keeps
frames, which are packed. Copies of them are damaged byte by byte, or changed object by object with
h5py. A child process reads each of them as `acquire show`, `list`, `fit` and `resume` do; what it
read must be what the original holds, unless values were changed on purpose.
"""

import contextlib
import ctypes
import hashlib
import io
import json
import math
import os
import random
import re
import resource
import select
import shutil
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import acquire
from acquire.cli.console import results
from acquire.cli.display import (
    bad_steps_of,
    catalogue_entry,
    details_table,
    run_details,
)
from acquire.runner.resuming import unfinished
from benchmarks.fuzz_judging import Outcome, Tally, Unnoticed, judged
from benchmarks.fuzz_readers import Implausible
from protocols.bench import BenchFile
from protocols.plan import Plan
from protocols.protocol import Protocol
from runs.errors import RunFileError
from runs.reader import Run

# Chosen: the originals take 0.1 s; a child that says nothing is given up after some hundred times
# that, on a machine that others use too.
LIMIT_S = 30.0
# Chosen: the originals need 30 MiB besides the program.
LIMIT_MIB = 300
# Chosen: what no request of a small file comes near, so that one of terabytes fails.
_ADDRESS_SPACE = 16 << 30
# How many files one child reads, unless it dies.
_BATCH = 40
_SMALL = {
    "sweep.first": 14, "sweep.last": 22, "camera.width": 160, "camera.height": 128,
    "policy.bad_step": {"retries": 1, "then": "skip"},
}  # fmt: skip
# Of the superblock, version 0.
_SUPERBLOCK = 96


# What no checksum covers, because it changes after it was written (docs/run-file.md, Checksums).
_NOT_COVERED = re.compile(
    r"entry/(status|end_time|interruptions/.*|(steps|retakes)/(verdict|sentence))"
)
_PICTURES = ("field", "frames")


@dataclass(frozen=True)
class Original:
    """A run file that is in order.

    Attributes
    ----------
    path : Path
    plan : Plan
    content : mapping
        What is read in it, see `content_of`.
    paths : tuple of str
        Of all groups and datasets.
    values, unchecked : list of (int, int)
        Ranges of bytes that hold values of datasets, and those of them that have no checksum.
    """

    path: Path
    plan: Plan
    content: dict[str, str]
    paths: tuple[str, ...]
    values: list[tuple[int, int]]
    unchecked: list[tuple[int, int]]


@dataclass(frozen=True)
class Mutant:
    """A changed run file.

    Attributes
    ----------
    path : Path
    original : Original
    what : str
        How it was changed.
    expected : {'same', 'unnoticed', 'refused', 'any'}
        'same': what is read must be the original's content, or the file refused; 'unnoticed': other
        content may be read, because no checksum covers it; 'refused': the file must be refused;
        'any': other values may be read, because others were written as a program would.
    """

    path: Path
    original: Original
    what: str
    expected: str


# --- Originals ---------------------------------------------------------------------------------


def originals(folder: Path) -> list[Original]:
    """Measure two small runs on the simulated bench."""
    bench = BenchFile.from_file().replace(
        {"twin": {"mesh": "coarse", "faults": {"drop_frame_at": [3]}}}
    )
    made = []
    for keep in ("holograms", "frames"):
        path = folder / f"{keep}.h5"
        plan = acquire.plan(
            Protocol.from_file("quick").replace({**_SMALL, "keep": keep}), bench
        ).plan
        # As if read from files, whose text is not written again for every run.
        plan = acquire.plan(
            Protocol.from_text(plan.protocol.text), BenchFile.from_text(plan.bench.text)
        ).plan
        acquire.run(plan, path, reed="R07", seed=1, labels=None)
        with h5py.File(path) as file:
            paths = tuple(_object_paths(file))
            values = sorted(_value_ranges(path, file, paths))
            bare = filter(_NOT_COVERED.fullmatch, paths)
            unchecked = sorted(_dataset_ranges(file[name] for name in bare))
        made.append(Original(path, plan, content_of(path, plan), paths, values, unchecked))
    return made


def _object_paths(file: Any) -> Iterator[str]:
    names: list[str] = []
    file.visit(names.append)
    yield from names


def _value_ranges(path: Path, file: Any, paths: Sequence[str]) -> Iterator[tuple[int, int]]:
    """Ranges of bytes that hold values: raw data, chunks, and heaps of texts of variable length."""
    yield from _dataset_ranges(file[name] for name in paths)
    data, start = path.read_bytes(), 0
    while (start := data.find(b"GCOL", start)) >= 0:
        yield start, start + int.from_bytes(data[start + 8 : start + 16], "little")
        start += 16


def _dataset_ranges(nodes: Iterable[Any]) -> Iterator[tuple[int, int]]:
    """Ranges of bytes of the values of datasets; groups have none."""
    for dataset in nodes:
        if not isinstance(dataset, h5py.Dataset):
            continue
        offset, size = dataset.id.get_offset(), dataset.id.get_storage_size()
        if offset is not None:
            yield offset, offset + size
        elif dataset.chunks:
            for number in range(dataset.id.get_num_chunks()):
                chunk = dataset.id.get_chunk_info(number)
                yield chunk.byte_offset, chunk.byte_offset + chunk.size


# --- What is read ------------------------------------------------------------------------------


def content_of(path: Path, plan: Plan) -> dict[str, str]:
    """Hashes of all that a run file says, by what it is.

    What is refused by itself, such as one step, has no entry.

    Raises
    ------
    RunFileError
        If the file is refused.
    """
    read: dict[str, str] = {}
    with Run.open(path) as run:
        details = run_details(run)
        shown = {"details": details, "entry": catalogue_entry(run), "bad_steps": bad_steps_of(run)}
        for name, value in shown.items():
            text = json.dumps(value, default=repr).replace(str(path), "")
            json.loads(text)
            read[name] = text
        _require_seen(details)
        for name in ("uid", "title", "labels", "acquisition", "reconstruction", "frame_rate_hz",
                     "exposure_s", "saturation_dn", "sideband_order", "acoustic_resonances_hz",
                     "keep", "protocol_text", "bench_text", "reed_text",
                     "package_versions"):  # fmt: skip
            read[name] = repr(getattr(run, name))
        read["axes"] = repr((run.y_m.tolist(), run.x_m.tolist()))
        read["reed"] = run.reed_file().sha256
        for step in run.steps:
            read[f"step {step.position}"] = repr(step)
            if step.verdict.measured:
                _add_array(read, f"field {step.position}", partial(run.field, step.position))
            if step.verdict.measured and run.keep == "frames":
                _add_array(read, f"frames {step.position}", partial(run.frames, step.position))
        for number, take in enumerate(run.retakes):
            read[f"take {number}"] = repr(take)
            _add_array(read, f"field of take {number}", partial(run.retaken_field, number))
    try:
        read["unfinished"] = repr(unfinished(path, plan))
    except RunFileError as error:
        _require_line(str(error))
    return read


def _add_array(read: dict[str, str], name: str, call: Callable[[], Any]) -> None:
    try:
        array = call()
    except RunFileError as error:
        _require_line(str(error))
        return
    read[name] = f"{array.shape} {hashlib.sha256(array.tobytes()).hexdigest()}"


def _require_line(said: str) -> None:
    if not said.isprintable() or len(said) > 400:
        raise Implausible("a message that is not one line", said)


def _require_seen(details: Mapping[str, Any]) -> None:
    """Require that `acquire show` prints no control characters but line ends."""
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        results().print(details_table(details))
    if not shown.getvalue().replace("\n", "").isprintable():
        raise Implausible("a control character reaches the terminal", repr(shown.getvalue())[:300])


def _shown(mutant: Mutant) -> str:
    return f"{mutant.path.name} of {mutant.original.path.name}"


def _compare(mutant: Mutant) -> None:
    """Read a mutant, and require that it is what it should be."""
    read, first = content_of(mutant.path, mutant.original.plan), mutant.original.content
    if mutant.expected == "refused":
        raise Implausible(f"{mutant.what}: read as if in order")
    if mutant.expected == "any":
        return
    # Steps that are refused by themselves are missing.
    other = [name for name in read if read[name] != first.get(name)]
    if other and mutant.expected == "unnoticed":
        raise Unnoticed
    missing = [name for name in first if name not in read]
    refused = [name for name in missing if not name.startswith(_PICTURES)]
    if other or refused:
        kinds = sorted({name.rstrip("0123456789 ") for name in (*other, *refused)})
        details = [f"{n}: {first.get(n, '')[:200]} → {read.get(n, '')[:200]}" for n in other[:2]]
        raise Implausible(
            f"{mutant.what}: other {', '.join(kinds)[:80]} read as if in order", str(details)
        )
    if missing:
        # Of a file that is read but for some of its steps.
        raise RunFileError(f"{mutant.path}: {len(missing)} arrays refused")


# --- Bytes -------------------------------------------------------------------------------------

Change = Callable[[Path, Original, random.Random], str]


def _inside(position: int, ranges: list[tuple[int, int]]) -> bool:
    return any(start <= position < end for start, end in ranges)


def _written(path: Path, data: bytes, original: Original, places: list[int]) -> str:
    path.write_bytes(data)
    unchecked = any(_inside(place, original.unchecked) for place in places)
    return "unnoticed" if unchecked else "same"


def byte_anywhere(path: Path, original: Original, rng: random.Random) -> str:
    """Change bytes anywhere."""
    data = bytearray(original.path.read_bytes())
    places = [rng.randrange(len(data)) for _ in range(rng.choice((1, 1, 5, 50, 500)))]
    for place in places:
        data[place] = rng.randrange(256)
    return _written(path, bytes(data), original, places)


def byte_of_structure(path: Path, original: Original, rng: random.Random) -> str:
    """Change one byte, or a few, that hold no value."""
    data = bytearray(original.path.read_bytes())
    places: list[int] = []
    wanted = rng.choice((1, 1, 1, 3, 10))
    while len(places) < wanted:
        place = rng.randrange(len(data))
        if not _inside(place, original.values):
            places.append(place)
            data[place] = rng.choice((data[place] ^ (1 << rng.randrange(8)), rng.randrange(256)))
    return _written(path, bytes(data), original, places)


def byte_of_superblock(path: Path, original: Original, rng: random.Random) -> str:
    """Change a byte of the superblock."""
    data = bytearray(original.path.read_bytes())
    place = rng.randrange(_SUPERBLOCK)
    data[place] ^= 1 << rng.randrange(8)
    return _written(path, bytes(data), original, [place])


def byte_of_header(path: Path, original: Original, rng: random.Random) -> str:
    """Change a byte of a named structure: heaps, B-trees, symbol tables, and object headers."""
    data = bytearray(original.path.read_bytes())
    mark = rng.choice((b"TREE", b"SNOD", b"HEAP", b"\x01\x00\x06\x00", b"\x01\x00\x07\x00"))
    found, start = [], 0
    while (start := data.find(mark, start)) >= 0:
        found.append(start)
        start += 1
    if not found:
        return byte_of_structure(path, original, rng)
    place = min(rng.choice(found) + rng.randrange(4, 300), len(data) - 1)
    data[place] = rng.choice((0, 255, data[place] ^ (1 << rng.randrange(8)), rng.randrange(256)))
    return _written(path, bytes(data), original, [place])


def block_of_zeros(path: Path, original: Original, rng: random.Random) -> str:
    """Lose a block of the disk."""
    data = bytearray(original.path.read_bytes())
    start, size = rng.randrange(len(data)), rng.choice((64, 512, 4096))
    data[start : start + size] = bytes(len(data[start : start + size]))
    return _written(path, bytes(data), original, list(range(start, min(start + size, len(data)))))


def truncated(path: Path, original: Original, rng: random.Random) -> str:
    """Lose the end."""
    data = original.path.read_bytes()
    path.write_bytes(
        data[: rng.choice((rng.randrange(len(data)), rng.randrange(2048), len(data) - 1))]
    )
    return "same"


def garbage_after(path: Path, original: Original, rng: random.Random) -> str:
    """Append bytes."""
    path.write_bytes(original.path.read_bytes() + rng.randbytes(rng.choice((1, 512, 100_000))))
    return "same"


# --- Objects -----------------------------------------------------------------------------------


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
    alike = (was.kind in "if" and kind in _NUMBERS) or (
        h5py.check_string_dtype(was) is not None and kind in _TEXTS
    )
    if alike or not math.prod(shape):
        return "any"
    return "refused" if _is_read(name) else "same"


# What no reader asks for.
_UNREAD = (
    "program_name", "/frame_rate", "bit_depth_readout", "volts_max", "data/drive_hz", "order0",
)  # fmt: skip


def _is_read(name: str) -> bool:
    """Whether a change of an object's type or shape can matter."""
    inexact = name.endswith("_hz") and name.startswith(("entry/steps", "entry/retakes"))
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
    "entry/retakes/position": (5, 99, 2**62),
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


def decoy_of(original: Original) -> Path:
    """A file that nothing may open."""
    return original.path.with_name(f"decoy-{original.path.name}")


_BYTES: tuple[Change, ...] = (byte_anywhere, byte_of_structure, byte_of_structure, byte_of_header,
                              byte_of_header, byte_of_superblock, block_of_zeros, truncated,
                              garbage_after)  # fmt: skip
_EDITS = (
    _deleted, _renamed, _exchanged, _attribute, _attribute, _retyped, _retyped, _reshaped,
    _null_space, _other_object, _external_link, _soft_link, _hard_link, _external_storage, _virtual,
    _filtered, _absurd_shape, _absurd_everywhere, _absurd_number, _absurd_number, _absurd_text,
    _text,
)  # fmt: skip
_OBJECTS = tuple(map(_edited, _EDITS))


def mutant_of(path: Path, original: Original, rng: random.Random) -> Mutant:
    """Write a mutant."""
    change = rng.choice(rng.choice((_BYTES, _OBJECTS, _OBJECTS)))
    try:
        expected = change(path, original, rng)
    except (OSError, ValueError, TypeError, RuntimeError, KeyError) as error:
        # HDF5 itself refuses some: then the file is as it was, or lacks what was deleted.
        return Mutant(path, original, f"{change.__name__} ({type(error).__name__})", "same")
    return Mutant(path, original, change.__name__, expected)


# --- Reading in a child process ----------------------------------------------------------------

_IN_OPEN, _IN_NONBLOCK = 0x20, 0o4000


class _Watch:
    """Tells whether files were opened, through Linux' inotify."""

    def __init__(self, files: list[Path]) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self._descriptor = libc.inotify_init1(_IN_NONBLOCK)
        for file in files:
            libc.inotify_add_watch(self._descriptor, os.fsencode(file), _IN_OPEN)

    def opened(self) -> bool:
        """Whether any was opened since the last question."""
        try:
            return bool(os.read(self._descriptor, 4096))
        except BlockingIOError:
            return False


def _child(mutants: list[Mutant], first: int, said: int) -> None:
    """Read mutants from the `first` on; say what became of each, in a line of JSON."""
    decoys = {decoy_of(mutant.original) for mutant in mutants}
    watch = _Watch([*decoys, *(decoy.with_suffix(".raw") for decoy in decoys)])
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    for number in range(first, len(mutants)):
        mutant = mutants[number]
        os.write(said, f"{number}\n".encode())
        outcome = judged(partial(_compare, mutant), mutant.path.name, LIMIT_MIB)
        if watch.opened():
            outcome = Outcome("wrong", f"{mutant.what}: another file was opened", outcome.said)
        line = json.dumps([outcome.kind, outcome.what, outcome.said])
        os.write(said, f"{line}\n".encode())


def read_by_children(mutants: list[Mutant]) -> list[tuple[Outcome, float]]:
    """Outcome of each mutant, and the seconds that it took; a child that dies tells which one."""
    outcomes: list[tuple[Outcome, float]] = []
    while len(outcomes) < len(mutants):
        outcomes += _read_by_child(mutants, len(outcomes))
    return outcomes


def _read_by_child(mutants: list[Mutant], first: int) -> list[tuple[Outcome, float]]:
    heard, said = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(heard)
        try:
            _child(mutants, first, said)
        finally:
            os._exit(0)
    os.close(said)
    outcomes: list[tuple[Outcome, float]] = []
    rest, began = b"", time.perf_counter()
    while True:
        ready, _, _ = select.select([heard], [], [], LIMIT_S)
        data = os.read(heard, 65_536) if ready else b""
        if not data:
            break
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            if line.startswith(b"["):
                outcomes.append((Outcome(*json.loads(line)), time.perf_counter() - began))
            began = time.perf_counter()
    os.close(heard)
    if not ready:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if first + len(outcomes) < len(mutants):
        mutant = mutants[first + len(outcomes)]
        ending = "hangs" if not ready else f"the process ends with {_ending(status)}"
        outcomes.append((Outcome("wrong", f"{mutant.what}: {ending}"), time.perf_counter() - began))
    return outcomes


def _ending(status: int) -> str:
    if os.WIFSIGNALED(status):
        return signal.Signals(os.WTERMSIG(status)).name
    return f"exit status {os.WEXITSTATUS(status)}"


def fuzz_runs(count: int, seed: int, folder: Path, kept: Path | None = None) -> Tally:
    """Read `count` mutated run files.

    Parameters
    ----------
    count, seed : int
    folder : Path
        Where files are written.
    kept : Path, optional
        Where those with a wrong outcome are kept.
    """
    tally, rng, start = Tally("run"), random.Random(f"run {seed}"), time.perf_counter()
    made = originals(folder)
    for original in made:
        decoy = decoy_of(original)
        shutil.copy(original.path, decoy)
        decoy.with_suffix(".raw").write_bytes(decoy.read_bytes())
    while tally.cases < count:
        size = min(_BATCH, count - tally.cases)
        mutants = [
            mutant_of(folder / f"mutant-{tally.cases + number:05}.h5", rng.choice(made), rng)
            for number in range(size)
        ]
        for mutant, (outcome, took_s) in zip(mutants, read_by_children(mutants), strict=True):
            if took_s > tally.slowest_s:
                tally.slowest_s, tally.slowest = took_s, f"{mutant.path.name} {mutant.what}"
            tally.add(outcome, partial(_shown, mutant))
            if outcome.kind == "wrong" and kept:
                shutil.copy(mutant.path, kept)
            mutant.path.unlink()
    tally.seconds = time.perf_counter() - start
    return tally
