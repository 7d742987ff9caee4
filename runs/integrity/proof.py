"""Compare an HDF5 file on the disk with the content that was to be written."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
# Offset of the file length in a superblock, by version of the superblock. The length has eight
# bytes, little-endian (HDF5 File Format Specification 3.0, section II.A).
_LENGTH_AT: Final = {0: 40, 1: 44, 2: 28, 3: 28}
_LENGTH_BYTES: Final = 8
# Bytes to read: more than the last offset plus the length.
_SUPERBLOCK_BYTES: Final = 64


def missing_bytes(path: Path) -> int:
    """Return how many bytes are missing at the end of a file, compared with its superblock.

    Raises
    ------
    OSError
        If the file cannot be read, or does not begin with an HDF5 superblock.
    """
    with path.open("rb") as file:
        head = file.read(_SUPERBLOCK_BYTES)
    is_hdf5 = len(head) == _SUPERBLOCK_BYTES and head.startswith(_SIGNATURE)
    offset = _LENGTH_AT.get(head[len(_SIGNATURE)]) if is_hdf5 else None
    if offset is None:
        raise OSError("its first bytes are not those of an HDF5 file")
    length = int.from_bytes(head[offset : offset + _LENGTH_BYTES], "little")
    return max(length - path.stat().st_size, 0)


def differing(found: Any, expected: Any, passed_over: frozenset[str] = frozenset()) -> str:
    """Return the name of the first object in which two files differ; empty if they are equal.

    Names, attributes, links, types, shapes and values are compared.

    Parameters
    ----------
    found, expected : h5py.File
        Open for reading.
    passed_over : frozenset of str
        Paths of datasets whose values and storage are not compared; their types, shapes and
        attributes are.
    """
    return next(_differences(found, expected, passed_over), "")


def _differences(found: Any, expected: Any, passed_over: frozenset[str]) -> Iterator[str]:
    if _attributes(found) != _attributes(expected):
        yield found.name
    if found.keys() != expected.keys():
        yield next(iter(found.keys() ^ expected.keys()))
        return
    for name in expected:
        # Soft and external links have a path, hard links have none.
        paths = [getattr(file.get(name, getlink=True), "path", None) for file in (found, expected)]
        if paths != [None, None]:
            if paths[0] != paths[1]:
                yield f"{expected.name}/{name}"
            continue
        one, other = found[name], expected[name]
        if isinstance(one, h5py.Group) and isinstance(other, h5py.Group):
            yield from _differences(one, other, passed_over)
        elif not _same_dataset(one, other, values=other.name not in passed_over):
            yield other.name


def _attributes(node: Any) -> dict[str, tuple[str, str]]:
    return {name: (type(value).__name__, repr(value)) for name, value in node.attrs.items()}


def _same_dataset(one: Any, other: Any, *, values: bool) -> bool:
    if not isinstance(one, h5py.Dataset) or not isinstance(other, h5py.Dataset):
        return False
    if (one.shape, one.dtype, _attributes(one)) != (other.shape, other.dtype, _attributes(other)):
        return False
    return not values or _bytes(one) == _bytes(other)


def _bytes(dataset: Any) -> bytes:
    """Return the content of a dataset as bytes, in which NaN equals NaN."""
    content = np.asarray(dataset[()])
    # h5py returns texts of variable length as Python objects.
    return repr(content.tolist()).encode() if content.dtype.hasobject else content.tobytes()
