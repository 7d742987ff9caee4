"""Proves that an HDF5 file is on the disk as it was meant to be."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
# Byte at which a superblock says how long the file is, by its version (HDF5 File Format
# Specification 3.0, section II.A); eight bytes, little-endian.
_LENGTH_AT: Final = {0: 40, 1: 44, 2: 28, 3: 28}
_LENGTH_BYTES: Final = 8
_SUPERBLOCK_BYTES: Final = 64


def missing_bytes(path: Path) -> int:
    """Return by how many bytes a file is shorter than its superblock says; 0 if it is whole.

    Raises
    ------
    OSError
        If it cannot be read, or does not begin as an HDF5 file does.
    """
    with path.open("rb") as file:
        head = file.read(_SUPERBLOCK_BYTES)
    whole = len(head) == _SUPERBLOCK_BYTES and head.startswith(_SIGNATURE)
    at = _LENGTH_AT.get(head[len(_SIGNATURE)]) if whole else None
    if at is None:
        raise OSError("its first bytes are not those of HDF5")
    length = int.from_bytes(head[at : at + _LENGTH_BYTES], "little")
    return max(length - path.stat().st_size, 0)


def differing(found: Any, expected: Any, passed_over: frozenset[str] = frozenset()) -> str:
    """Return the name of the first thing in which a file is not as expected; empty if none is.

    Compared are names, attributes, links, types, shapes and values of everything.

    Parameters
    ----------
    found, expected : h5py.File
        Open for reading.
    passed_over : frozenset of str
        Paths of datasets whose values, filters and places are not compared, but their types,
        shapes and attributes are.
    """
    return next(_differences(found, expected, passed_over), "")


def _differences(found: Any, expected: Any, passed_over: frozenset[str]) -> Iterator[str]:
    if _attributes(found) != _attributes(expected):
        yield found.name
    if found.keys() != expected.keys():
        yield next(iter(found.keys() ^ expected.keys()))
        return
    for name in expected:
        # Hard links have no path.
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
    """Content of a dataset, so that NaN equals NaN."""
    content = np.asarray(dataset[()])
    # Texts of any length come as objects.
    return repr(content.tolist()).encode() if content.dtype.hasobject else content.tobytes()
