"""Packs the frames of a complete run: the same run file, smaller, without the loss of a bit.

A run file is written uncompressed, because only bytes that have their place beforehand are safe
from a process that is killed (decision 0010). Once a run is complete it is copied into a compressed
file, read back, and only then is the copy given the run's name.
"""

import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Final

import h5py
import numpy as np
import numpy.typing as npt

from runs.checksums import PIXEL_CHECKSUM, pixel_checksum
from runs.disk import DiskFile, error_class
from runs.errors import DiskError, RunFileError
from runs.layout import FREE, short_reason
from runs.proof import differing, missing_bytes
from runs.reader import Run
from runs.verdict import Verdict

# Groups of the run file that hold frames, with the group whose rows say what each is.
_WITH_FRAMES: Final = {"data": "steps", "retakes": "retakes"}
_FRAMES: Final = frozenset(f"/entry/{name}/frames" for name in _WITH_FRAMES)
# What h5py raises where it cannot read or write.
_UNREADABLE: Final = (OSError, RuntimeError, KeyError, ValueError, TypeError)
# Share of the work that copying is; reading back is the rest.
_COPYING: Final = 0.7


@dataclass(frozen=True)
class Packing:
    """What packing a run came to.

    Attributes
    ----------
    before_bytes, after_bytes : int
        Sizes of the run file.
    reason : str
        Why there was nothing to pack; empty if it was packed now.
    """

    before_bytes: int
    after_bytes: int
    reason: str = ""

    @property
    def ratio(self) -> float:
        """Size after over size before."""
        return self.after_bytes / self.before_bytes


def pack(path: str | Path, progress: Callable[[float], None] | None = None) -> Packing:
    """Compress the frames of a complete run, whose lock the caller holds.

    Parameters
    ----------
    path : str or Path
        Replaced at once, by a file that was read back and found equal; until then it stays as it
        was, whatever happens.
    progress : callable, optional
        Told of the share that is done, from 0 to 1.

    Raises
    ------
    RunFileError
        If the run is not complete, or damaged.
    DiskError
        If the disk has no room for the copy, or refuses to be read or written.
    KeyboardInterrupt
        If somebody pressed Ctrl-C.
    """
    path = Path(path)
    with Run.open(path) as run:
        size_bytes = path.stat().st_size
        if run.status != "complete":
            raise RunFileError(
                f"{path}: is {run.status} and cannot be packed; continue it first (acquire run "
                "… --resume)"
            )
        if run.keep != "frames":
            return Packing(size_bytes, size_bytes, "keeps holograms, which do not get smaller")
        labels = [f"step {step.index}" for step in run.steps]
    packed = packed_path(path)
    try:
        with _interrupts_held_back() as obey, h5py.File(path, "r", locking=False) as source:
            if source["entry/data/frames"].compression:
                return Packing(size_bytes, size_bytes, "is packed already")
            _require_room(path, size_bytes)
            report = _reporter(progress, obey)
            _write_copy(source, packed, path, labels, lambda share: report(_COPYING * share))
            _prove(source, packed, path, lambda share: report(_COPYING + (1 - _COPYING) * share))
            shutil.copymode(path, packed)
            packed.replace(path)
        return Packing(size_bytes, path.stat().st_size)
    except _UNREADABLE as error:
        raise error_class(error)(
            f"{path}: its frames cannot be packed ({short_reason(error)}); the file is whole as it "
            "is"
        ) from error
    finally:
        packed.unlink(missing_ok=True)


def packed_path(path: Path) -> Path:
    """Return where the packed copy of a run file is made: ``R07.h5`` → ``.R07.h5.packed``."""
    return path.with_name(f".{path.name}.packed")


def _require_room(path: Path, size_bytes: int) -> None:
    free_bytes = shutil.disk_usage(path.parent).free
    if free_bytes < size_bytes:
        raise DiskError(
            f"{path}: packing its frames may take {size_bytes / 1e6:.0f} MB for a while, but its "
            f"disk has {free_bytes / 1e6:.0f} MB left; the file is whole as it is"
        )


def _write_copy(
    source: Any, packed: Path, path: Path, labels: list[str], report: Callable[[float], None]
) -> None:
    """Write a copy with compressed frames, and wait until it is on the disk."""
    disk = DiskFile.create(packed)
    try:
        with h5py.File(disk, "w") as target:
            target.attrs.update(source.attrs)
            entry = target.create_group("entry")
            entry.attrs.update(source["entry"].attrs)
            for name, part in source["entry"].items():
                if name not in _WITH_FRAMES:
                    source.copy(part, entry)
                    continue
                group = entry.create_group(name)
                group.attrs.update(part.attrs)
                _copy_small(source, part, group)
                if "frames" in part:
                    rows = _Rows.of(source["entry"], name, labels)
                    tell = report if name == "data" else _say_nothing
                    _copy_frames(part["frames"], group, rows, path, disk, tell)
        disk.sync()
    finally:
        disk.close()


def _copy_small(source: Any, part: Any, group: Any) -> None:
    """Copy all of a group but its frames."""
    for key in part:
        link = part.get(key, getlink=True)
        if isinstance(link, h5py.SoftLink):
            group[key] = h5py.SoftLink(link.path)
        elif key != "frames":
            source.copy(part[key], group)


@dataclass(frozen=True)
class _Rows:
    """What a file says of its frames, place by place.

    Attributes
    ----------
    checksums : (places,) uint64
    holds : (places,) bool
        Whether a place holds a take.
    labels : list of str
        What to call it.
    """

    checksums: npt.NDArray[np.uint64]
    holds: npt.NDArray[np.bool_]
    labels: list[str]

    @classmethod
    def of(cls, entry: Any, name: str, labels: list[str]) -> "_Rows":
        """Read them for the frames of a group."""
        rows = entry[_WITH_FRAMES[name]]
        verdicts = rows["verdict"].asstr()[()]
        holds = np.array([Verdict(said).measured for said in verdicts], dtype=bool)
        if "position" in rows:
            positions = rows["position"][()]
            holds &= positions > FREE
            labels = [f"an earlier take of {labels[max(k, 0)]}" for k in positions]
        return cls(rows[PIXEL_CHECKSUM][()], holds, labels)

    def whole(self, place: int, frames: npt.NDArray[Any]) -> bool:
        """Whether frames are those that were written."""
        return not self.holds[place] or pixel_checksum(frames) == int(self.checksums[place])


def _copy_frames(
    frames: Any,
    group: Any,
    rows: _Rows,
    path: Path,
    disk: DiskFile,
    report: Callable[[float], None],
) -> None:
    packed = group.create_dataset(
        "frames", frames.shape, frames.dtype, chunks=frames.chunks, shuffle=True, compression="lzf"
    )
    packed.attrs.update(frames.attrs)
    for place in range(len(frames)):
        step = frames[place]
        if not rows.whole(place, step):
            raise RunFileError(
                f"{path}: {rows.labels[place]} is damaged (its frames do not have the checksum "
                "that was written with them), so the run is not packed; use another copy of the "
                "file"
            )
        # A place without frames needs no chunk: what is not there is zero.
        if step.any():
            packed[place] = step
        disk.check()
        report((place + 1) / len(frames))


def _prove(source: Any, packed: Path, path: Path, report: Callable[[float], None]) -> None:
    """Read the copy back, and refuse one that is not the same run."""
    wrong = "the end of the file" if missing_bytes(packed) else ""
    with suppress(*_UNREADABLE), h5py.File(packed, "r", locking=False) as copy:
        wrong = wrong or differing(copy, source, _FRAMES) or _first_changed(source, copy, report)
        if not wrong:
            return
    raise DiskError(
        f"{path}: comes back changed from a packed copy ({wrong or 'it cannot be read'}); the file "
        "is whole as it is, look after its disk"
    )


def _first_changed(source: Any, copy: Any, report: Callable[[float], None]) -> str:
    """Name of the first frames that differ; empty if none do."""
    for name in _WITH_FRAMES:
        if "frames" not in source["entry"][name]:
            continue
        frames, packed = source["entry"][name]["frames"], copy["entry"][name]["frames"]
        for place in range(len(frames)):
            if not np.array_equal(frames[place], packed[place]):
                return f"frames {place + 1} of {packed.name}"
            if name == "data":
                report((place + 1) / len(frames))
    return ""


def _say_nothing(_share: float) -> None:
    """Report nothing."""


def _reporter(
    progress: Callable[[float], None] | None, obey: Callable[[], None]
) -> Callable[[float], None]:
    """Return what is called after each step: obeys an interrupt, then reports."""

    def report(share: float) -> None:
        obey()
        (progress or _say_nothing)(share)

    return report


@contextmanager
def _interrupts_held_back() -> Iterator[Callable[[], None]]:
    """Keep Ctrl-C until the function that is yielded is called, or to the end.

    In the middle of HDF5 it would be lost, and a piece of the copy with it.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield lambda: None
        return
    came: list[FrameType | None] = []

    def obey() -> None:
        if came:
            before(signal.SIGINT, came.pop())

    signal.signal(signal.SIGINT, lambda _number, frame: came.append(frame))
    try:
        yield obey
    finally:
        signal.signal(signal.SIGINT, before)
    obey()
