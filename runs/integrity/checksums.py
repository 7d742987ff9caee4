"""Checksums of a run file: two for each step (pixels, other numbers) and one for the header.

They are BLAKE2b (RFC 7693) digests of 8 bytes: a damaged step goes unnoticed once in 1.8e19 times.
The checksum of a hologram of 0.6 MB takes 1.0 ms, that of four frames of 10.5 MB takes 18 ms, while
the camera exposes the next step (`python -m benchmarks.watching` prints both times).
"""

import hashlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

PIXEL_CHECKSUM: Final = "pixel_checksum"
ROW_CHECKSUM: Final = "row_checksum"
CHECKSUMS: Final = (PIXEL_CHECKSUM, ROW_CHECKSUM)
HEADER_CHECKSUM: Final = "entry/header_checksum"
# The header is written before the first step and never changed. Data that users add to other groups
# do not change its checksum.
_HEADER_GROUPS: Final = (
    "entry/user/", "entry/sample/", "entry/acquisition/", "entry/provenance/", "entry/instrument/",
    "entry/region/",
)  # fmt: skip
_HEADER_NAMES: Final = frozenset(
    {
        "entry/title",
        "entry/entry_identifier_uuid",
        "entry/start_time",
        "entry/data/y_m",
        "entry/data/x_m",
    }
)
# A step may be judged again; that changes its verdict and sentence, but none of its numbers.
_NOT_COVERED: Final = frozenset({"verdict", "sentence", ROW_CHECKSUM})
_DIGEST_BYTES: Final = 8


def pixel_checksum(pixels: npt.NDArray[Any]) -> int:
    """Return the checksum of the pixels of one step.

    Parameters
    ----------
    pixels : (height, width) complex64 or (frames, rows, columns) uint16
        Pixels in dn, in the data type of the file.
    """
    return _digest(np.ascontiguousarray(pixels))


def row_checksums(columns: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.uint64]:
    """Return the checksum of each row of a table.

    Parameters
    ----------
    columns : mapping of str to (rows, …) array
        All columns, in the data types of the file, with texts of fixed length. The checksum covers
        every column except ``verdict``, ``sentence`` and ``row_checksum``.

    Returns
    -------
    (rows,) uint64
    """
    names = sorted(columns.keys() - _NOT_COVERED)
    count = min(len(columns[name]) for name in names)
    parts = []
    for name in names if count else ():
        head = np.frombuffer(name.encode(), np.uint8)
        entries = np.ascontiguousarray(columns[name]).reshape(count, -1).view(np.uint8)
        parts += [np.broadcast_to(head, (count, len(head))), entries]
    rows = np.concatenate(parts, axis=1) if count else ()
    return np.array([_digest(row) for row in rows], dtype=np.uint64)


def whole_rows(columns: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.bool_]:
    """Return which rows of a table match their stored checksum.

    Parameters
    ----------
    columns : mapping of str to (rows, …) array
        See `row_checksums`; here ``row_checksum`` is required.

    Returns
    -------
    (rows,) bool
    """
    same: npt.NDArray[np.bool_] = row_checksums(columns) == columns[ROW_CHECKSUM]
    return same


def in_header(name: str) -> bool:
    """Return whether the header checksum covers a dataset, given by its path.

    The header is the labels, the geometry and the provenance of a run.
    """
    return name in _HEADER_NAMES or name.startswith(_HEADER_GROUPS)


def header_checksum(values: Mapping[str, str | bytes | npt.NDArray[Any]]) -> int:
    """Return the checksum of the labels, geometry and provenance of a run file.

    Parameters
    ----------
    values : mapping of str to text or array
        Values of datasets by path, such as ``entry/sample/name``. Datasets that are not `in_header`
        are ignored. Numbers have the data types of the file.
    """
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for name in sorted(filter(in_header, values)):
        value = values[name]
        text = value.encode() if isinstance(value, str) else value
        digest.update(name.encode())
        digest.update(text if isinstance(text, bytes) else np.ascontiguousarray(text).tobytes())
    return int.from_bytes(digest.digest(), "little")


def _digest(content: npt.NDArray[Any]) -> int:
    return int.from_bytes(
        hashlib.blake2b(content.data, digest_size=_DIGEST_BYTES).digest(), "little"
    )
