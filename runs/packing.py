"""Pack a complete run: compress its frames without loss, which makes the run file smaller.

A run file is written uncompressed, because only space that was allocated beforehand is safe if the
process is killed (decision 0010). Once a run is complete, it is copied to a compressed file. The
copy is read back and compared, and only then replaces the run file.
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

from runs.disk import DiskFile, error_class
from runs.errors import DiskError, RunFileError
from runs.integrity.checksums import PIXEL_CHECKSUM, pixel_checksum
from runs.integrity.proof import differing, missing_bytes
from runs.layout import FREE, short_reason
from runs.reader import Run
from runs.verdict import Verdict

# Groups of the run file that hold frames, and for each the group with their verdicts and checksums.
_WITH_FRAMES: Final = {"data": "steps", "earlier_attempts": "earlier_attempts"}
_FRAMES: Final = frozenset(f"/entry/{name}/frames" for name in _WITH_FRAMES)
# Errors that h5py raises when it cannot read or write.
_UNREADABLE: Final = (OSError, RuntimeError, KeyError, ValueError, TypeError)
# Fraction of the time that copying takes; reading back takes the rest. Chosen for the progress bar.
_COPYING: Final = 0.7


@dataclass(frozen=True)
class Packing:
    """Result of packing a run.

    Attributes
    ----------
    before_bytes, after_bytes : int
        Size of the run file before and after.
    reason : str
        Why the run was not packed; empty if it was packed.
    """

    before_bytes: int
    after_bytes: int
    reason: str = ""

    @property
    def ratio(self) -> float:
        """Return the size after packing, divided by the size before."""
        return self.after_bytes / self.before_bytes


def pack(path: str | Path, progress: Callable[[float], None] | None = None) -> Packing:
    """Compress the frames of a complete run, whose lock the caller holds.

    Parameters
    ----------
    path : str or Path
        Path of the run file. It stays unchanged, whatever happens, until the packed copy was read
        back and found equal; the copy then replaces it in one operation.
    progress : callable, optional
        Called with the fraction of the work that is done, from 0 to 1.

    Returns
    -------
    Packing

    Raises
    ------
    RunFileError
        If the run is not complete, or is damaged.
    DiskError
        If the disk has no space for the copy, or cannot be read or written.
    KeyboardInterrupt
        If the operator pressed Ctrl-C.
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
            return Packing(size_bytes, size_bytes, "keeps holograms, which cannot be compressed")
        labels = [f"step {step.index}" for step in run.steps]
    packed = packed_path(path)
    try:
        with _interrupts_delayed() as obey, h5py.File(path, "r", locking=False) as source:
            if source["entry/data/frames"].compression:
                return Packing(size_bytes, size_bytes, "is packed already")
            _require_space(path, size_bytes)
            report = _reporter(progress, obey)
            _write_copy(source, packed, path, labels, lambda done: report(_COPYING * done))
            _prove(source, packed, path, lambda done: report(_COPYING + (1 - _COPYING) * done))
            shutil.copymode(path, packed)
            packed.replace(path)
        return Packing(size_bytes, path.stat().st_size)
    except _UNREADABLE as error:
        raise error_class(error)(
            f"{path}: its frames cannot be packed ({short_reason(error)}); the file is unchanged, "
            "try again later or keep it unpacked"
        ) from error
    finally:
        packed.unlink(missing_ok=True)


def packed_path(path: Path) -> Path:
    """Return the path of the packed copy of a run file: ``R07.h5`` → ``.R07.h5.packed``."""
    return path.with_name(f".{path.name}.packed")


def _require_space(path: Path, size_bytes: int) -> None:
    """Raise an error if the disk has no space for a second file of the same size."""
    free_bytes = shutil.disk_usage(path.parent).free
    if free_bytes < size_bytes:
        raise DiskError(
            f"{path}: packing needs {size_bytes / 1e6:.0f} MB of free disk space for a copy, but "
            f"its disk has {free_bytes / 1e6:.0f} MB left; the file is unchanged, free space and "
            "pack it again (acquire pack)"
        )


def _write_copy(
    source: Any, packed: Path, path: Path, labels: list[str], report: Callable[[float], None]
) -> None:
    """Write a copy with compressed frames and wait until it is on the disk.

    `labels` are the names of the steps in messages.
    """
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
                _copy_all_but_frames(source, part, group)
                if "frames" in part:
                    rows = _Rows.of(source["entry"], name, labels)
                    report_here = report if name == "data" else _ignore
                    _copy_frames(part["frames"], group, rows, path, disk, report_here)
        disk.sync()
    finally:
        disk.close()


def _copy_all_but_frames(source: Any, part: Any, group: Any) -> None:
    for key in part:
        link = part.get(key, getlink=True)
        if isinstance(link, h5py.SoftLink):
            group[key] = h5py.SoftLink(link.path)
        elif key != "frames":
            source.copy(part[key], group)


@dataclass(frozen=True)
class _Rows:
    """Checksums and names of the frames of one group; each place holds the frames of one attempt.

    Attributes
    ----------
    checksums : (places,) uint64
    holds : (places,) bool
        Whether a place holds an attempt.
    labels : list of str
        Name of the attempt in messages.
    """

    checksums: npt.NDArray[np.uint64]
    holds: npt.NDArray[np.bool_]
    labels: list[str]

    @classmethod
    def of(cls, entry: Any, name: str, labels: list[str]) -> "_Rows":
        """Read them from the file for the group of a name."""
        rows = entry[_WITH_FRAMES[name]]
        verdicts = rows["verdict"].asstr()[()]
        holds = np.array([Verdict(verdict).measured for verdict in verdicts], dtype=bool)
        if "position" in rows:
            positions = rows["position"][()]
            holds &= positions > FREE
            labels = [f"an earlier attempt of {labels[max(k, 0)]}" for k in positions]
        return cls(rows[PIXEL_CHECKSUM][()], holds, labels)

    def are_undamaged(self, place: int, frames: npt.NDArray[Any]) -> bool:
        """Return whether the frames match their checksum, or no attempt is expected here."""
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
        if not rows.are_undamaged(place, step):
            raise RunFileError(
                f"{path}: {rows.labels[place]} is damaged (its frames do not have the checksum "
                "that was written with them), so the run is not packed; use another copy of the "
                "file"
            )
        # A place without frames needs no chunk: HDF5 reads a missing chunk as zeros.
        if step.any():
            packed[place] = step
        disk.check()
        report((place + 1) / len(frames))


def _prove(source: Any, packed: Path, path: Path, report: Callable[[float], None]) -> None:
    """Read the packed copy back, and raise an error unless it equals the run."""
    wrong = "the end of the file" if missing_bytes(packed) else ""
    with suppress(*_UNREADABLE), h5py.File(packed, "r", locking=False) as copy:
        wrong = wrong or differing(copy, source, _FRAMES) or _first_changed(source, copy, report)
        if not wrong:
            return
    raise DiskError(
        f"{path}: its packed copy differs from it ({wrong or 'the copy cannot be read'}), so the "
        "disk is not reliable; the file is unchanged, copy it to another disk"
    )


def _first_changed(source: Any, copy: Any, report: Callable[[float], None]) -> str:
    """Return the name of the first frames that differ; empty if all are equal."""
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


def _ignore(_fraction: float) -> None:
    """Do nothing with a report of progress."""


def _reporter(
    progress: Callable[[float], None] | None, obey: Callable[[], None]
) -> Callable[[float], None]:
    """Return a function to call after each step: it obeys an interrupt, then reports progress."""

    def report(fraction: float) -> None:
        obey()
        (progress or _ignore)(fraction)

    return report


@contextmanager
def _interrupts_delayed() -> Iterator[Callable[[], None]]:
    """Delay Ctrl-C until the yielded function is called, or until the end.

    Inside a call of HDF5, the interrupt would be lost together with a part of the copy.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield lambda: None
        return
    pending: list[FrameType | None] = []

    def obey() -> None:
        if pending:
            before(signal.SIGINT, pending.pop())

    signal.signal(signal.SIGINT, lambda _number, frame: pending.append(frame))
    try:
        yield obey
    finally:
        signal.signal(signal.SIGINT, before)
    obey()
