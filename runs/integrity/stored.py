"""Check how the datasets of a run file are stored, before any of them is read."""

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

# The only soft link of the layout, and its target.
_LINKS: Final = {"entry/data/drive_hz": "/entry/steps/drive_hz"}

# Identifiers of the filters that every h5py includes: deflate, shuffle, fletcher32, lzf.
_FILTERS: Final = frozenset({1, 2, 3, 32000})

# Signature of a global heap (texts of variable length), and size in bytes of the header of the heap
# and of each object in it (HDF5 File Format Specification 3.0, section III.E).
_HEAP, _HEAP_HEADER_BYTES = b"GCOL", 16

# Chosen: a run file has 130 objects; users may add theirs.
_MAX_OBJECTS: Final = 10_000


@dataclass(frozen=True)
class _Stored:
    """A dataset, and how it is stored.

    Attributes
    ----------
    id : DatasetID
    made : PropDCID
        Creation properties: layout, filters, external files.
    shape : tuple of int
        Empty for a scalar, and for a dataset without a value, which `runs.integrity.checks`
        refuses.
    """

    id: Any
    made: Any
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Check:
    """A run file that is being checked.

    Attributes
    ----------
    path : Path
    size_bytes : int
        Size of the file.
    datasets : mapping of str to _Stored
        All datasets, by path.
    read : dict of str to array or str
        Values that were read already, by path; filled by `values`.
    """

    path: Path
    size_bytes: int
    datasets: Mapping[str, _Stored]
    read: dict[str, Any] = field(default_factory=dict)

    def require(self, holds: bool, name: str, what: str) -> None:
        """Raise an error about a dataset unless a condition holds; `what` says what is wrong."""
        if not holds:
            raise altered(self.path, name, what)

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a dataset in the file."""
        return self.datasets[name].shape

    def values(self, name: str) -> Any:
        """Return the values of a dataset of numbers or texts; the file is read only once."""
        if name not in self.read:
            dataset = h5py.Dataset(self.datasets[name].id)
            text = h5py.check_string_dtype(dataset.dtype)
            self.read[name] = dataset.asstr()[()] if text else dataset[()]
        return self.read[name]


def altered(path: Path, name: str, what: str) -> RunFileError:
    """Return an error that names a dataset and says what is wrong with it."""
    return RunFileError(
        f"{path}: is damaged or altered ({_shown(name)} {what}); use another copy of the file"
    )


def _shown(name: str) -> str:
    """Return the name of an object on one line; a damaged name may hold any characters."""
    return name if name.isprintable() and len(name) < 80 else shown_value(name)


def datasets(path: Path, file: Any) -> Iterator[tuple[str, _Stored]]:
    """Yield the path and storage of each dataset; raise an error if any has a second hard link."""
    groups = [("", h5py.h5g.open(file.id, b"/"))]
    # The address of an object in the file identifies it.
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
    """Return whether a link is the soft link of the layout; raise an error for other soft links."""
    kind = group.links.get_info(link).type
    if kind == h5py.h5l.TYPE_HARD:
        return False
    if kind != h5py.h5l.TYPE_SOFT:
        raise altered(path, name, "is in another file")
    if group.links.get_val(link) != _LINKS.get(name, "").encode():
        raise altered(path, name, "is a link that does not belong to the layout")
    return True


def _require_storage(path: Path, name: str, made: Any) -> None:
    """Raise an error if data are in another file, or need filters that h5py does not include."""
    if made.get_external_count() or made.get_layout() == h5py.h5d.VIRTUAL:
        raise altered(path, name, "keeps its data in another file")
    filters = {made.get_filter(k)[0] for k in range(made.get_nfilters())}
    if not filters <= _FILTERS:
        raise altered(path, name, f"is stored with the unknown filter {max(filters)}")


def places_of_data(check: Check) -> list[tuple[int, int]]:
    """Return the byte ranges of all data in the file, sorted.

    Returns
    -------
    list of (int, int)
        Offset of the first byte, and of the byte after the last one.

    Raises
    ------
    RunFileError
        If a range leaves the file or overlaps another one.
    """
    places = sorted(
        (start, start + size, name)
        for name, dataset in check.datasets.items()
        for start, size in _places(dataset)
        if size
    )
    for start, end, name in places:
        check.require(start > 0 and end <= check.size_bytes, name, "is partly outside the file")
    for (_, end, _), (start, _, name) in pairwise(places):
        check.require(end <= start, name, "shares bytes with another dataset")
    return [(start, end) for start, end, _ in places]


def _places(dataset: _Stored) -> list[tuple[int, int]]:
    """Return offset and number of bytes of every chunk of a dataset."""
    layout = dataset.made.get_layout()
    if layout == h5py.h5d.CONTIGUOUS:
        start = dataset.id.get_offset()
        return [] if start is None else [(start, dataset.id.get_storage_size())]
    found: list[tuple[int, int]] = []
    if layout == h5py.h5d.CHUNKED:
        dataset.id.chunk_iter(lambda chunk: found.append((chunk.byte_offset, chunk.size)))
    return found


def require_heaps(check: Check, data: Sequence[tuple[int, int]]) -> None:
    """Raise an error if a global heap would make HDF5 loop forever.

    HDF5 2.0 reads a heap object by object, and never gets past an object whose number and size are
    both 0 (HDF5 File Format Specification 3.0, section III.E).
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
    """Return whether the heap at `start` holds an object whose number and size are both 0."""
    size = int.from_bytes(content[start + 8 : start + _HEAP_HEADER_BYTES], "little")
    place, last = start + _HEAP_HEADER_BYTES, min(start + size, end) - _HEAP_HEADER_BYTES
    while place <= last:
        number, size = struct.unpack_from("<H6xQ", content, place)
        if number == 0:
            # Object 0 is the free space of the heap, and the last object.
            return bool(size == 0)
        # Objects begin at multiples of 8 bytes.
        place += _HEAP_HEADER_BYTES + -(-size // 8) * 8
    return False
