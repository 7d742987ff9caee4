"""Packs the frames of a complete run: the same run file, smaller, without the loss of a bit.

A run file is written uncompressed, because only bytes that have their place beforehand are safe
from a process that is killed (decision 0010). Once a run is complete it is copied into a compressed
file, read back, and only then is the copy given the run's name.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from acquire.errors import RunFileError
from acquire.run_layout import short_reason

# Groups of the run file that hold frames beside other things.
_WITH_FRAMES: Final = ("data", "retakes")
_DISK_ERRORS: Final = (OSError, RuntimeError)


def pack(path: str | Path, progress: Callable[[float], None] | None = None) -> float:
    """Compress the frames of a run file that nobody is writing.

    Parameters
    ----------
    path : str or Path
        Replaced at once, by a file that was read back and found equal; until then it stays as it
        was, whatever happens.
    progress : callable, optional
        Told of the share that is done, from 0 to 1.

    Returns
    -------
    float
        Size of the file over what it was. 1 if there is nothing to pack: no frames are kept, or
        they are packed already.

    Raises
    ------
    RunFileError
        If the disk has no room for the copy, or cannot be read or written.
    """
    path = Path(path)
    packed = path.with_name(f".{path.name}.packed")
    report = progress or _say_nothing
    try:
        with h5py.File(path, "r") as source:
            if "frames" not in source["entry/data"] or source["entry/data/frames"].compression:
                return 1.0
            before = path.stat().st_size
            _require_room(path, before)
            with h5py.File(packed, "w") as target:
                _copy(source, target, lambda share: report(0.7 * share))
            with h5py.File(packed, "r") as copy:
                _require_same(source, copy, path, lambda share: report(0.7 + 0.3 * share))
        _replace(path, packed)
        return path.stat().st_size / before
    except _DISK_ERRORS as error:
        raise RunFileError(
            f"{path}: its frames cannot be packed ({short_reason(error)}); the file is whole as it "
            "is"
        ) from error
    finally:
        packed.unlink(missing_ok=True)


def _require_room(path: Path, size_bytes: int) -> None:
    free_bytes = shutil.disk_usage(path.parent).free
    if free_bytes < size_bytes:
        raise RunFileError(
            f"{path}: packing its frames may take {size_bytes / 1e6:.0f} MB for a while, but its "
            f"disk has {free_bytes / 1e6:.0f} MB left; the file is whole as it is"
        )


def _copy(source: Any, target: Any, report: Callable[[float], None]) -> None:
    """Copy everything, frames compressed."""
    target.attrs.update(source.attrs)
    entry = target.create_group("entry")
    entry.attrs.update(source["entry"].attrs)
    for name, part in source["entry"].items():
        if name not in _WITH_FRAMES:
            source.copy(part, entry)
            continue
        group = entry.create_group(name)
        group.attrs.update(part.attrs)
        for key in part:
            link = part.get(key, getlink=True)
            if isinstance(link, h5py.SoftLink):
                group[key] = h5py.SoftLink(link.path)
            elif key != "frames":
                source.copy(part[key], group)
            else:
                _copy_frames(part[key], group, report if name == "data" else _say_nothing)


def _copy_frames(frames: Any, group: Any, report: Callable[[float], None]) -> None:
    packed = group.create_dataset(
        "frames", frames.shape, frames.dtype, chunks=frames.chunks, shuffle=True, compression="lzf"
    )
    packed.attrs.update(frames.attrs)
    for place in range(len(frames)):
        step = frames[place]
        # A place without frames needs no chunk: what is not there is zero.
        if step.any():
            packed[place] = step
        report((place + 1) / len(frames))


def _require_same(source: Any, copy: Any, path: Path, report: Callable[[float], None]) -> None:
    """Refuse a copy in which frames differ; HDF5 copied the rest itself."""
    for name in _WITH_FRAMES:
        if "frames" not in source["entry"][name]:
            continue
        frames, packed = source["entry"][name]["frames"], copy["entry"][name]["frames"]
        for place in range(len(frames)):
            if not np.array_equal(frames[place], packed[place]):
                raise RunFileError(
                    f"{path}: frames come back changed from a packed copy; the file is whole as it "
                    "is, look after its disk"
                )
            if name == "data":
                report((place + 1) / len(frames))


def _say_nothing(_share: float) -> None:
    """Report nothing."""


def _replace(path: Path, packed: Path) -> None:
    """Give the copy the run's name, once it is on the disk."""
    with packed.open("rb") as file:
        os.fsync(file.fileno())
    shutil.copymode(path, packed)
    packed.replace(path)
