"""Mutations of the bytes of a run file."""

import random
from collections.abc import Callable
from pathlib import Path

from benchmarks.fuzzing.run_files import Original

Change = Callable[[Path, Original, random.Random], str]


# Of the superblock, version 0.
_SUPERBLOCK = 96


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


BYTES: tuple[Change, ...] = (byte_anywhere, byte_of_structure, byte_of_structure, byte_of_header,
                              byte_of_header, byte_of_superblock, block_of_zeros, truncated,
                              garbage_after)  # fmt: skip
