"""Write run files: one sweep in one self-describing HDF5 file (``docs/reference/run-file.md``).

Everything is allocated before the first step and read back, so writing a step only overwrites
bytes. The verdict of a step is written and flushed after its data: a program that is killed at any
moment leaves a file that opens with plain h5py, and in which every step with a verdict is complete.
Before a step is measured again, it is copied to a spare place. Checksums detect later damage.
"""

import contextlib
import os
import shutil
import weakref
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import h5py
import numpy as np
import numpy.typing as npt

from drivers.roles import Bench, Frame
from holography.reconstruction import Reconstruction
from protocols.plan import Plan
from runs.contents import NewRun, fill, planned_columns, prove
from runs.disk import DiskFile, error_class, give_name
from runs.errors import DiskError, RunFileError
from runs.integrity.checksums import (
    PIXEL_CHECKSUM,
    ROW_CHECKSUM,
    pixel_checksum,
    row_checksums,
    whole_rows,
)
from runs.integrity.unborn import cannot_make, require_readable, unborn_path
from runs.layout import (
    FREE,
    INTERRUPTIONS,
    MEASURED,
    READ_BACK_HZ,
    SENTENCE_BYTES,
    TO_BE_MEASURED_AGAIN,
    UNDER_WAY,
    Interruption,
    RunLabels,
    Status,
    exact_text,
    short_reason,
    verdict_of,
)
from runs.measured_step import MeasuredStep
from runs.provenance import git_revision, package_versions
from runs.verdict import Judgement, Verdict

# h5py raises RuntimeError if the disk refuses bytes that HDF5 had in a cache.
_DISK_ERRORS: Final = (OSError, RuntimeError)
# Errors that h5py raises when bytes differ from those that were written.
_UNREADABLE: Final = (*_DISK_ERRORS, KeyError, ValueError, TypeError)
# Disk space to keep free after a step. Chosen: HDF5 writes a few pages of 4 KiB to close a file.
_RESERVE_BYTES: Final = 1_000_000
# Largest relative difference of a planned number between two computers. Chosen: far above the
# rounding of float64 (1e-16), far below any step of a setting.
_ROUNDING: Final = 1e-9


class RunWriter:
    """A run file that is being written. Used by one thread at a time.

    Attributes
    ----------
    path : Path
    damaged : tuple of int
        Positions of steps that `resume` found damaged; they must be measured again.
    """

    def __init__(
        self, path: Path, disk: DiskFile, keep: str, date: Callable[[], datetime] | None = None
    ) -> None:
        self.path, self._date = path, date or partial(datetime.now, UTC)
        self.damaged: tuple[int, ...] = ()
        self._disk = disk
        self._keep, self._name = keep, "field" if keep == "holograms" else "frames"
        self._file = h5py.File(disk, "r+")
        try:
            entry = self._file["entry"]
            # Opened once: opening a dataset takes longer than writing a number to it.
            self._steps, self._earlier_attempts = (
                dict(entry["steps"]),
                dict(entry["earlier_attempts"]),
            )
            self._signal = entry["data"][self._name]
            planned = self._steps.keys() - self._earlier_attempts.keys()
            self._planned = {name: self._steps[name][()] for name in planned}
            disk.check()
        except BaseException:
            self._file.close()
            raise
        # Closes the file at exit if the caller forgot it. HDF5 itself would do so too late, after
        # Python has ended.
        self._closing = weakref.finalize(self, _close, self._file, disk)

    @classmethod
    def create(
        cls,
        path: str | Path,
        plan: Plan,
        bench: Bench,
        labels: RunLabels,
        reconstruction: Reconstruction,
        uid: str,
    ) -> Self:
        """Create the file with everything that is known before the first step, and read it back.

        Parameters
        ----------
        path : str or Path
        plan : Plan
        bench : Bench
            Open bench; its camera need not be configured yet.
        labels : RunLabels
        reconstruction : Reconstruction
            Geometry that a reader needs to interpret pixels.
        uid : str
            Unique identifier of the run.

        Raises
        ------
        RunFileError
            If the file exists already or cannot be created; no file is left behind.
        DiskError
            If the disk refuses the file, or does not give back what was written.
        """
        path = Path(path)
        if os.path.lexists(path):
            raise RunFileError(
                f"{path}: exists already and is never overwritten; choose another name or move it"
            )
        origin = {"git_revision": git_revision() or "", "package_versions": package_versions()}
        began = stamp(bench.clock.date())
        read_once = bench.identities, bench.camera.saturation_dn
        new = NewRun(plan, bench, *read_once, labels, reconstruction, uid, began, origin)
        # The file gets its name only when it is finished, so a killed process leaves no bad run.
        unborn = unborn_path(path)
        with contextlib.ExitStack() as undo:
            try:
                disk = DiskFile.create(unborn)
                undo.callback(unborn.unlink, missing_ok=True)
                undo.callback(disk.close)
                with h5py.File(disk, "w") as file:
                    fill(file, new, allocate=True)
                disk.sync()
                prove(path, unborn, new)
                require_readable(path, unborn)
                writer = cls(path, disk, plan.protocol.keep, bench.clock.date)
                undo.callback(writer.close)
                give_name(unborn, path)
            except _DISK_ERRORS as error:
                raise cannot_make(path, error) from error
            undo.pop_all()
        return writer

    @classmethod
    def resume(cls, path: str | Path, plan: Plan) -> Self:
        """Open the file of a run that is not complete, to continue it.

        Steps that the disk has damaged become pending, see `damaged`. Earlier attempts with damaged
        numbers are removed.

        Parameters
        ----------
        path : str or Path
        plan : Plan
            The plan with which the run was started.

        Raises
        ------
        RunFileError
            If another program has the file open, it cannot be written, or its steps are not those
            of the plan.
        """
        path = Path(path)
        with contextlib.ExitStack() as undo:
            try:
                disk = DiskFile.open_existing(path)
                undo.callback(disk.close)
                writer = cls(path, disk, plan.protocol.keep)
            except _UNREADABLE as error:
                raise error_class(error)(
                    f"{path}: cannot be continued ({short_reason(error)}); close other programs "
                    "that have it open"
                ) from error
            undo.callback(writer.close)
            writer._require_planned(plan)
            with writer._disk_errors("its steps cannot be checked"):
                writer._finish_earlier_attempts()
                writer._give_up_damaged()
            undo.pop_all()
        return writer

    @property
    def spare(self) -> int:
        """Return how many more attempts can be set aside."""
        return int(np.count_nonzero(self._earlier_attempts["position"][()] == FREE))

    def reopen(self, interruption: Interruption) -> None:
        """Record that the run continues, and after which interruption.

        Raises
        ------
        DiskError
            If the disk refuses it.
        """
        with self._disk_errors("cannot be written"):
            self._set_status("running")
        self.add_interruption(interruption)

    def add_interruption(self, interruption: Interruption) -> None:
        """Record an interruption; it is ignored if `layout.INTERRUPTIONS_MAX` are recorded.

        Raises
        ------
        DiskError
            If the disk refuses it.
        """
        interruptions = self._file["entry/interruptions"]
        free = np.flatnonzero(interruptions["position"][()] < 0)
        if not free.size:
            return
        with self._disk_errors("cannot be written"):
            for name in INTERRUPTIONS[1:]:
                interruptions[name][free[0]] = _cut(str(getattr(interruption, name)))
            self._flush()
            interruptions["position"][free[0]] = interruption.position
            self._flush()

    def set_aside(self, position: int) -> None:
        """Copy a step to a spare place, and make the step pending.

        Raises
        ------
        RunFileError
            If there is no spare place.
        DiskError
            If the disk refuses the copy.
        """
        free = np.flatnonzero(self._earlier_attempts["position"][()] == FREE)
        if not free.size:
            raise RunFileError(
                f"{self.path}: has no space to measure step {position + 1} again; measure "
                "a new sweep"
            )
        place = int(free[0])
        with self._disk_errors(f"step {position + 1} cannot be set aside"):
            for name, column in self._earlier_attempts.items():
                if name != "position":
                    source = self._signal if name == self._name else self._steps[name]
                    column[place] = source[position]
            self._flush()
            self._earlier_attempts["position"][place] = UNDER_WAY - position
            self._flush()
            self._finish_setting_aside(place)

    def write(self, position: int, step: MeasuredStep) -> None:
        """Write one step; on return the operating system has all its bytes.

        Parameters
        ----------
        position : int
            Position of the step in the plan, from 0.
        step : MeasuredStep

        Raises
        ------
        DiskError
            If the disk refuses the step; earlier steps are safe.
        """
        self._require_space()
        pixels = step.field if self._keep == "holograms" else self._stacked(step.frames)
        # Converted before the checksum, which covers the bytes of the file.
        pixels = np.asarray(pixels, dtype=self._signal.dtype)
        row = self._row(position, step, pixels)
        with self._disk_errors(f"step {position + 1} cannot be written"):
            self._signal[position] = pixels
            for name, entry in row.items():
                self._steps[name][position : position + 1] = entry
            self._flush()
            self._write_judgement(position, step.judgement)

    def mark(self, position: int, verdict: Verdict, reason: str) -> None:
        """Record that a step was not finished (interrupted) or is left out (skipped).

        Raises
        ------
        DiskError
            If the disk refuses it.
        """
        with self._disk_errors("cannot be written"):
            self._write_judgement(position, Judgement(verdict, reason))

    def finish(self, status: Status) -> None:
        """Wait until all steps are on the disk, write the final status, and close the file.

        Do nothing if the file is closed already.

        Raises
        ------
        DiskError
            If the disk refuses anything. The file is closed nevertheless.
        """
        if not self._file:
            return
        try:
            with self._disk_errors("cannot be closed"):
                self._flush()
                self._disk.sync()
                self._set_status(status)
        except DiskError:
            # A full disk still accepts a status, which overwrites allocated bytes.
            with contextlib.suppress(*_DISK_ERRORS):
                self._set_status("failed")
            raise
        finally:
            self.close()

    def discard(self) -> None:
        """Close the file and remove it."""
        self.close()
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file without a final status. May be called twice."""
        self._closing()

    @contextlib.contextmanager
    def _disk_errors(self, state: str) -> Iterator[None]:
        """Convert errors of the disk to a `DiskError` that says what could not be done, and why."""
        try:
            yield
        except _DISK_ERRORS as error:
            raise DiskError(
                f"{self.path}: {state} ({short_reason(error)}); free space on the disk, or replace "
                "it; the steps before are safe"
            ) from error

    def _flush(self) -> None:
        """Pass all bytes to the operating system, and raise an error that it returned."""
        self._file.flush()
        self._disk.check()

    def _finish_setting_aside(self, place: int) -> None:
        """Make a step pending whose attempt is copied completely to `/entry/earlier_attempts`."""
        position = UNDER_WAY - int(self._earlier_attempts["position"][place])
        self._make_pending(position, TO_BE_MEASURED_AGAIN)
        self._earlier_attempts["position"][place] = position
        self._flush()

    def _make_pending(self, position: int, reason: str) -> None:
        """Declare the data of a step invalid, so that it is measured again."""
        # The verdict first: readers must never see it together with a sentence of another one.
        self._steps["verdict"][position] = str(Verdict.PENDING)
        self._flush()
        self._write_judgement(position, Judgement(Verdict.PENDING, reason))

    def _require_planned(self, plan: Plan) -> None:
        """Raise an error if the steps of the file are not those of the plan."""
        for name, (expected, _unit) in planned_columns(plan).items():
            found = self._planned.get(name)
            if found is None or not _is_as_planned(found, expected):
                raise RunFileError(
                    f"{self.path}: its column {name} does not follow from its protocol; the file "
                    "is damaged, or was begun by another version of this software; measure again"
                )

    def _finish_earlier_attempts(self) -> None:
        """Finish the copies that a killed process began; remove damaged earlier attempts."""
        positions = self._earlier_attempts["position"][()]
        of_step = np.where(positions <= UNDER_WAY, UNDER_WAY - positions, positions)
        known = (of_step >= 0) & (of_step < len(self._signal))
        planned = {name: column[of_step * known] for name, column in self._planned.items()}
        intact = known & whole_rows(planned | self._measured(self._earlier_attempts))
        for place in np.flatnonzero(positions != FREE):
            if not intact[place]:
                self._earlier_attempts["position"][place] = FREE
                self._flush()
            elif positions[place] <= UNDER_WAY:
                self._finish_setting_aside(int(place))

    def _give_up_damaged(self) -> None:
        """Make steps pending whose bytes do not match their checksums."""
        verdicts = [verdict_of(content) for content in self._steps["verdict"][()]]
        measured = self._measured(self._steps)
        intact = whole_rows(self._planned | measured)
        damaged = []
        for position, verdict in enumerate(verdicts):
            if verdict is not None and not verdict.measured:
                continue
            checksum = int(measured[PIXEL_CHECKSUM][position])
            if verdict is None or not (intact[position] and self._has_pixels(position, checksum)):
                self._make_pending(position, f"was damaged on the disk; {TO_BE_MEASURED_AGAIN}")
                damaged.append(position)
        self.damaged = tuple(damaged)

    def _has_pixels(self, position: int, checksum: int) -> bool:
        """Return whether the stored pixels of a step have this checksum."""
        pixels = self._signal[position]
        # An unreadable disk must end the resume here, and not count as a damaged step.
        self._disk.check()
        return pixel_checksum(pixels) == checksum

    def _measured(self, group: dict[str, Any]) -> dict[str, npt.NDArray[Any]]:
        """Return the columns that hold what was measured, of steps or of earlier attempts."""
        names = self._earlier_attempts.keys() - {"position", self._name}
        columns = {name: group[name][()] for name in names}
        self._disk.check()
        return columns

    def _planned_row(self, position: int) -> dict[str, npt.NDArray[Any]]:
        return {name: column[position : position + 1] for name, column in self._planned.items()}

    def _require_space(self) -> None:
        """Raise an error if the disk lacks space for a step, while the file can still be closed."""
        step_bytes = int(self._signal.dtype.itemsize * np.prod(self._signal.shape[1:]))
        free_bytes = shutil.disk_usage(self.path.parent).free
        if free_bytes < step_bytes + _RESERVE_BYTES:
            raise DiskError(
                f"{self.path}: its disk has {free_bytes / 1e6:.1f} MB left, too little for another "
                "step; free space on the disk; the steps before are safe"
            )

    def _stacked(self, frames: Sequence[Frame]) -> npt.NDArray[np.uint16]:
        """Return the frames of one step as the file stores them, with zeros for missing frames."""
        stack = np.zeros(self._signal.shape[1:], dtype=np.uint16)
        for place, frame in zip(stack, frames, strict=False):
            place[...] = frame.image
        return stack

    def _set_status(self, status: Status) -> None:
        self._file["entry/end_time"][()] = "" if status == "running" else stamp(self._date())
        self._flush()
        self._file["entry/status"][()] = status
        self._flush()

    def _row(
        self, position: int, step: MeasuredStep, pixels: npt.NDArray[Any]
    ) -> dict[str, npt.NDArray[Any]]:
        """Return everything that was measured except pixels: one array, (1, …), for each column."""
        values: dict[str, object] = {}
        for column in READ_BACK_HZ:
            hz: Fraction = getattr(step.read_back, column.removeprefix("read_"))
            values[column] = float(hz)
            values[f"{column}_exact"] = exact_text(hz).encode()
        values["read_volts"] = step.read_back.volts
        for column in MEASURED:
            if column != "read_volts":
                values[column] = getattr(step, column)
        # Filled up if frames are missing, so that no values of an earlier attempt stay.
        kept = step.frames[: self._steps["frame_id"].shape[1]]
        missing = self._steps["frame_id"].shape[1] - len(kept)
        values["timestamp_s"] = [frame.timestamp_s for frame in kept] + [np.nan] * missing
        values["frame_id"] = [frame.id for frame in kept] + [-1] * missing
        values[PIXEL_CHECKSUM] = pixel_checksum(pixels)
        row = {
            name: np.array([value], dtype=self._steps[name].dtype) for name, value in values.items()
        }
        row[ROW_CHECKSUM] = row_checksums(row | self._planned_row(position))
        return row

    def _write_judgement(self, position: int, judgement: Judgement) -> None:
        self._steps["sentence"][position] = _cut(judgement.sentence)
        self._flush()
        self._steps["verdict"][position] = str(judgement.verdict)
        self._flush()


def _close(file: Any, disk: DiskFile) -> None:
    """Close a file; HDF5 first, because it may still write to the disk."""
    file.close()
    disk.close()


def _is_as_planned(found: npt.NDArray[Any], expected: npt.NDArray[Any]) -> bool:
    """Return whether a column equals that of the plan, within `_ROUNDING`."""
    if expected.dtype.kind != "f":
        return np.array_equal(found, expected)
    same_shape = found.shape == expected.shape
    return same_shape and np.allclose(found, expected, rtol=_ROUNDING, atol=0.0, equal_nan=True)


def _cut(text: str) -> str:
    """Return as much of a text as a column holds, cut between two characters."""
    return text.encode()[:SENTENCE_BYTES].decode(errors="ignore")


def stamp(date: datetime) -> str:
    """Return a time as ISO 8601, to the second."""
    return date.isoformat(timespec="seconds")
