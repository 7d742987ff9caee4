"""How the datasets of a run file are stored: checked before any of them is read."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, Final

import h5py

from protocols.units import shown_value
from runs.errors import RunFileError

# The one link of the layout, and what it leads to.
_LINKS: Final = {"entry/data/drive_hz": "/entry/steps/drive_hz"}

# Filters that every h5py has: deflate, shuffle, fletcher32, lzf.
_FILTERS: Final = frozenset({1, 2, 3, 32000})

# Signature of a heap of texts of any length, and size of what stands before it and each object.
_HEAP, _HEAP_HEAD = b"GCOL", 16

# Chosen: a run file has 130 objects.
_MAX_OBJECTS: Final = 10_000


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
class Check:
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
            raise altered(self.path, name, what)

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


def altered(path: Path, name: str, what: str) -> RunFileError:
    """Return the error that says what is wrong with a dataset."""
    return RunFileError(
        f"{path}: is damaged or altered ({_shown(name)} {what}); use another copy of the file"
    )


def _shown(name: str) -> str:
    """Name of an object, which may hold anything, on one line."""
    return name if name.isprintable() and len(name) < 80 else shown_value(name)


def datasets(path: Path, file: Any) -> Iterator[tuple[str, _Stored]]:
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
                raise altered(path, name, "is another object under a second name")
            seen.add(_address(child))
            if len(seen) > _MAX_OBJECTS:
                raise altered(path, name, f"is one of more than {_MAX_OBJECTS} objects")
            kind = h5py.h5i.get_type(child)
            if kind == h5py.h5i.GROUP:
                groups.append((f"{name}/", child))
            elif kind == h5py.h5i.DATASET:
                stored = _Stored(child, child.get_create_plist(), child.shape or ())
                _require_storage(path, name, stored.made)
                yield name, stored
            else:
                raise altered(path, name, "is neither a group nor a dataset")


def _address(opened: Any) -> int:
    address: int = h5py.h5o.get_info(opened).addr
    return address


def _is_known_link(path: Path, group: Any, link: bytes, name: str) -> bool:
    """Whether a link is that of the layout; all others are refused unless they are hard."""
    kind = group.links.get_info(link).type
    if kind == h5py.h5l.TYPE_HARD:
        return False
    if kind != h5py.h5l.TYPE_SOFT:
        raise altered(path, name, "lies in another file")
    if group.links.get_val(link) != _LINKS.get(name, "").encode():
        raise altered(path, name, "is a link to something else")
    return True


def _require_storage(path: Path, name: str, made: Any) -> None:
    """Refuse what lies in another file, or cannot be read without others' software."""
    if made.get_external_count() or made.get_layout() == h5py.h5d.VIRTUAL:
        raise altered(path, name, "keeps its data in another file")
    filters = {made.get_filter(k)[0] for k in range(made.get_nfilters())}
    if not filters <= _FILTERS:
        raise altered(path, name, f"is stored through the unknown filter {max(filters)}")


def places_of_data(check: Check) -> list[tuple[int, int]]:
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


def require_heaps(check: Check, data: Sequence[tuple[int, int]]) -> None:
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
