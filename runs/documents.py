"""Write a run as documents of the bluesky event model, to a JSON lines file next to the run file.

Every line is a pair ``[name, document]`` as suitcase-jsonl writes it, so LiveTable and Tiled can
read runs. Arrays stay in the run file; the last documents point to them.
"""

import contextlib
import io
import json
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, Self

from drivers.roles import Bench
from protocols.plan import Plan
from protocols.step import Step
from runs.disk import error_class
from runs.errors import DiskError, RunFileError
from runs.layout import (
    RunLabels,
    Status,
    short_reason,
)
from runs.measured_step import MeasuredStep
from runs.records import StepRecord

_EXIT_STATUS: Final[dict[Status, Literal["success", "abort", "fail"]]] = {
    "complete": "success",
    "interrupted": "abort",
    "failed": "fail",
}
_LAST: Final = ("stream_resource", "stream_datum", "stop")
_SOURCES: Final = {
    "index": "protocol",
    "order": "protocol",
    "attempt": "acquire.runner.runner",
    "asked_hz": "protocol",
    "drive_hz": "generator",
    "difference_hz": "synthesizers",
    "volts": "generator",
    "signal_to_noise": "camera",
    "noise_level": "camera",
    "saturated_share": "camera",
    "brightness_dn": "camera",
    "lock_error_hz": "camera",
    "lock_error_se_hz": "camera",
    "unexplained": "camera",
    "verdict": "acquire.runner.quality",
    "sentence": "acquire.runner.quality",
}
_INTEGERS: Final = ("index", "order", "attempt")
_UNITS: Final = {
    "asked_hz": "Hz",
    "drive_hz": "Hz",
    "difference_hz": "Hz",
    "volts": "V",
    "lock_error_hz": "Hz",
    "lock_error_se_hz": "Hz",
}


def documents_path(run_path: Path) -> Path:
    """Return the path of the documents of a run file: ``R07.h5`` → ``R07.documents.jsonl``."""
    return run_path.with_suffix(".documents.jsonl")


def rewritten_path(run_path: Path) -> Path:
    """Return the path at which `DocumentLog.resume` writes documents: ``R07.documents.part``."""
    return documents_path(run_path).with_suffix(".part")


def holds_no_event(run_path: Path) -> bool:
    """Return whether the documents of a run hold only its beginning, without any step.

    A process that is killed before it has created the run file leaves such documents.
    """
    try:
        lines = documents_path(run_path).read_text(encoding="utf-8").splitlines(keepends=True)
    except (OSError, UnicodeDecodeError):
        return False
    # The last line may have been cut short.
    cut = lines.pop() if lines and not lines[-1].endswith("\n") else ""
    try:
        documents = [json.loads(line) for line in lines]
        names = [name for name, _ in documents]
        of_run = not documents or documents[0][1]["run_file"] == run_path.name
    except (ValueError, TypeError, KeyError, IndexError):
        return False
    beginning = ["start", "descriptor", "descriptor"]
    if not of_run or names != beginning[: len(names)]:
        return False
    head = json.dumps(beginning[len(names) : len(names) + 1])[:-1]
    return cut[: len(head)] == head[: len(cut)] if names != beginning else not cut


@dataclass(frozen=True, slots=True)
class _Begun:
    """Documents of a run up to its last event: start, descriptors of two streams, events."""

    start: Any
    primary: Any
    steps: Any
    events: tuple[Any, ...] = ()

    @classmethod
    def read(cls, documents: Sequence[tuple[str, Any]]) -> Self:
        """Collect them from pairs of name and document; KeyError or TypeError if one is missing."""
        streams = {found["name"]: found for name, found in documents if name == "descriptor"}
        events = tuple(found for name, found in documents if name == "event")
        return cls(dict(documents)["start"], streams["primary"], streams["steps"], events)

    @property
    def attempts(self) -> dict[tuple[int, int], int]:
        """Return the number of attempts of each step, by index and order."""
        counts: dict[tuple[int, int], int] = {}
        for event in self.events:
            data = event["data"]
            step = data["index"], data["order"]
            counts[step] = max(counts.get(step, 0), data["attempt"])
        return counts


class DocumentLog:
    """Documents of one run, open for writing; a context manager.

    Use `create` or `resume` to open them. The stream ``primary`` has one event for every attempt.
    The stream ``steps`` is the array in the run file: one row for every planned step, which holds
    its last attempt, or zeros. The documents that say where this array is are written last, because
    a file that is being written cannot be read.
    """

    def __init__(self, run_path: Path, file: io.FileIO, begun: _Begun) -> None:
        # Imported here, because it takes longer to import than all the rest of this package.
        import event_model

        self.path = documents_path(run_path)
        self._run_path, self._file, self._begun = run_path, file, begun
        self._counts = {"primary": 1 + len(begun.events), "steps": 1}
        self._compose_event = event_model.ComposeEvent(begun.primary, self._counts)
        self._compose_stop = event_model.ComposeStop(begun.start, self._counts, poison_pill=[])

    @classmethod
    def create(cls, run_path: Path, plan: Plan, bench: Bench, labels: RunLabels, uid: str) -> Self:
        """Create the documents of a new run, with its start and its descriptors.

        Parameters
        ----------
        run_path : Path
            Path of the run file.
        plan : Plan
        bench : Bench
        labels : RunLabels
        uid : str
            Unique identifier of the run file and of the start document.

        Raises
        ------
        RunFileError
            If the documents exist already or cannot be created.
        DiskError
            If the disk refuses them.
        """
        import event_model

        metadata = _metadata(run_path, plan, bench, labels)
        bundle = event_model.compose_run(uid=uid, metadata=metadata)
        primary = bundle.compose_descriptor(name="primary", data_keys=_data_keys())
        steps = bundle.compose_descriptor(
            name="steps", data_keys=_array_keys(plan), configuration=_rows(plan)
        )
        begun = _Begun(bundle.start_doc, primary.descriptor_doc, steps.descriptor_doc)
        log = cls(run_path, _create(documents_path(run_path)), begun)
        try:
            log._write("start", begun.start)
            log._write("descriptor", begun.primary)
            log._write("descriptor", begun.steps)
        except BaseException:
            log.discard()
            raise
        return log

    def attempts_of(self, index: int, order: int) -> int:
        """Return how many attempts of a step the documents held when they were opened."""
        return self._begun.attempts.get((index, order), 0)

    @classmethod
    def resume(cls, run_path: Path) -> Self:
        """Open the documents of a run that is not complete, to continue them.

        An incomplete last line and the closing documents of an interrupted run are removed: a run
        has one beginning and one end.

        Raises
        ------
        RunFileError
            If there are no documents, or they are not those of a run.
        """
        path, rewritten = documents_path(run_path), rewritten_path(run_path)
        documents = _documents(path)
        try:
            begun = _Begun.read(documents)
        except (KeyError, TypeError, ValueError):
            raise RunFileError(
                f"{path}: does not begin with the documents of a run; measure the sweep again"
            ) from None
        try:
            # A link of this name must not be followed.
            rewritten.unlink(missing_ok=True)
            with rewritten.open("xb") as part:
                part.writelines(_line(*document) for document in documents)
                part.flush()
                os.fsync(part.fileno())
            rewritten.replace(path)
            return cls(run_path, path.open("ab", buffering=0), begun)
        except OSError as error:
            with contextlib.suppress(OSError):
                rewritten.unlink(missing_ok=True)
            raise _cannot_write(path, error) from error

    def event(self, data: dict[str, Any], time_s: float) -> None:
        """Write the event of one measured step.

        Parameters
        ----------
        data : dict
            Data of the event, from `event_data` or `recorded_data`.
        time_s : float
            POSIX time of the measurement, in s.

        Raises
        ------
        DiskError
            If the disk refuses the event.
        """
        # Documents that another version of this software created may have fewer columns.
        data = {name: data[name] for name in self._begun.primary["data_keys"]}
        timestamps = dict.fromkeys(data, time_s)
        self._write("event", self._compose_event(data=data, timestamps=timestamps, time=time_s))

    def finish(self, status: Status, reason: str = "") -> None:
        """Write where the arrays are, and the stop document. Do nothing if already closed.

        Raises
        ------
        DiskError
            If the disk refuses the documents.
        """
        if self._file.closed:
            return
        self._point_at_arrays()
        stop = self._compose_stop(exit_status=_EXIT_STATUS[status], reason=reason)
        self._write("stop", stop)
        try:
            self._file.close()
        except OSError as error:
            raise _cannot_write(self.path, error) from error

    def discard(self) -> None:
        """Close the documents and remove their file."""
        self._file.close()
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the documents without a stop document. May be called twice."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _point_at_arrays(self) -> None:
        import event_model

        steps, rows = self._begun.steps, self._begun.start["num_points"]
        [(name, key)] = steps["data_keys"].items()
        compose = event_model.ComposeStreamResource(self._begun.start)
        bundle = compose(
            mimetype="application/x-hdf5",
            # Not percent-encoded, because Tiled does not decode the path.
            uri=f"file://localhost/{self._run_path.absolute().as_posix().lstrip('/')}",
            data_key=name,
            parameters={
                "dataset": f"/entry/data/{name}",
                "chunk_shape": [1, *key["shape"]],
                "swmr": False,
            },
        )
        datum = bundle.compose_stream_datum(
            indices={"start": 0, "stop": rows},
            seq_nums={"start": 1, "stop": rows + 1},
            descriptor=steps,
        )
        self._write("stream_resource", bundle.stream_resource_doc)
        self._write("stream_datum", datum)
        self._counts["steps"] += rows

    def _write(self, name: str, document: Any) -> None:
        """Write a complete line or nothing."""
        line = _line(name, document)
        end = os.fstat(self._file.fileno()).st_size
        try:
            while line:
                line = line[self._file.write(line) :]
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(end)
            raise _cannot_write(self.path, error) from error


def _line(name: str, document: Any) -> bytes:
    return (json.dumps([name, document], allow_nan=False) + "\n").encode()


def _cannot_write(path: Path, error: OSError) -> DiskError:
    return DiskError(f"{path}: cannot be written ({short_reason(error)}); free space on the disk")


def _documents(path: Path) -> list[tuple[str, Any]]:
    """Return all undamaged documents of a run without those of its end."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise error_class(error)(
            f"{path}: cannot be read ({error}); measure the sweep again"
        ) from error
    documents = []
    for line in lines:
        try:
            name, document = json.loads(line)
        except (ValueError, TypeError):
            break
        if name not in _LAST:
            documents.append((name, document))
    return documents


def event_data(step: Step, attempt: int, measured: MeasuredStep) -> dict[str, Any]:
    """Return the data of the event of a step that was just measured.

    Parameters
    ----------
    step : Step
        The step as planned.
    attempt : int
        Number of the attempt, from 1.
    measured : MeasuredStep
    """
    read = measured.read_back
    return {
        "index": step.index,
        "order": step.order,
        "attempt": attempt,
        "asked_hz": float(step.asked_hz),
        "drive_hz": float(read.drive_hz),
        "difference_hz": float(read.aom1_hz - read.aom2_hz),
        "volts": read.volts,
        "signal_to_noise": _finite(measured.signal_to_noise),
        "noise_level": _finite(measured.noise_level),
        "saturated_share": measured.saturated_share,
        "brightness_dn": _finite(measured.brightness_dn),
        "lock_error_hz": _finite(measured.lock_error_hz),
        "lock_error_se_hz": _finite(measured.lock_error_se_hz),
        "unexplained": _finite(measured.unexplained),
        "verdict": str(measured.judgement.verdict),
        "sentence": measured.judgement.sentence,
    }


def recorded_data(record: StepRecord, attempt: int) -> dict[str, Any]:
    """Return the data of the event of a measured step in a run file, see `event_data`."""
    aom1_hz, aom2_hz = record.read_aom1_hz or 0, record.read_aom2_hz or 0
    return {
        "index": record.index,
        "order": record.order,
        "attempt": attempt,
        "asked_hz": float(record.asked_hz),
        "drive_hz": float(record.read_drive_hz or 0),
        "difference_hz": float(aom1_hz - aom2_hz),
        "volts": record.read_volts,
        "signal_to_noise": _finite(record.signal_to_noise),
        "noise_level": _finite(record.noise_level),
        "saturated_share": record.saturated_share,
        "brightness_dn": _finite(record.brightness_dn),
        "lock_error_hz": _finite(record.lock_error_hz),
        "lock_error_se_hz": _finite(record.lock_error_se_hz),
        "unexplained": _finite(record.unexplained),
        "verdict": str(record.verdict),
        "sentence": record.sentence,
    }


def _create(path: Path) -> io.FileIO:
    try:
        # Unbuffered: a buffer would write refused bytes again when the file is closed.
        return path.open("xb", buffering=0)
    except FileExistsError:
        raise RunFileError(
            f"{path}: exists already and is never overwritten; choose another name or move it"
        ) from None
    except OSError as error:
        raise error_class(error)(
            f"{path}: cannot be made ({short_reason(error)}); check folder and rights"
        ) from error


def _metadata(run_path: Path, plan: Plan, bench: Bench, labels: RunLabels) -> dict[str, Any]:
    preparation = bench.preparation
    return {
        "plan_name": plan.protocol.name,
        # LiveTable requires both. Runs of a bench have no numbers; the time grows from run to run.
        "plan_type": "protocol",
        "scan_id": int(time.time()),
        "run_file": run_path.name,
        "num_points": len(plan.steps),
        "hints": {"dimensions": [(["drive_hz"], "primary")]},
        "bench": bench.name,
        "bench_fingerprint": bench.fingerprint,
        "protocol_sha256": plan.protocol.sha256,
        "seed": bench.seed,
        "reed": preparation.reed,
        "series": preparation.series,
        "chamber": preparation.chamber,
        "strength": labels.strength,
        "note": labels.note,
        "operator": labels.operator,
    }


def _data_keys() -> dict[str, dict[str, Any]]:
    keys = {}
    for name, source in _SOURCES.items():
        text = name in ("verdict", "sentence")
        dtype = "string" if text else "integer" if name in _INTEGERS else "number"
        keys[name] = {"source": source, "dtype": dtype, "shape": []}
        if name in _UNITS:
            keys[name]["units"] = _UNITS[name]
    return keys


def _array_keys(plan: Plan) -> dict[str, dict[str, Any]]:
    """Return the data key of the images that the run file keeps of one step."""
    if plan.protocol.keep == "holograms":
        name, source, dtype = "field", "holography.reconstruction", "<c8"
        sizes = {"y_m": plan.region.height, "x_m": plan.region.width}
    else:
        name, source, dtype = "frames", "camera", "<u2"
        rows, columns = plan.frame_shape
        frames = max(step.frames for step in plan.steps)
        sizes = {"frame": frames, "row": rows, "column": columns}
    described = {
        "source": source,
        "dtype": "array",
        "dtype_numpy": dtype,
        "shape": list(sizes.values()),
        "dims": list(sizes),
        "units": "dn",
        "external": "STREAM:",
    }
    return {name: described}


def _rows(plan: Plan) -> dict[str, dict[str, Any]]:
    """Return index and sideband order of each row, as the configuration of a descriptor."""
    rows = {name: [getattr(step, name) for step in plan.steps] for name in ("index", "order")}
    key = {
        "source": "protocol",
        "dtype": "array",
        "dtype_numpy": "<i8",
        "shape": [len(plan.steps)],
    }
    return {
        "steps": {
            "data": rows,
            "timestamps": dict.fromkeys(rows, time.time()),
            "data_keys": dict.fromkeys(rows, key),
        }
    }


def _finite(value: float) -> float:
    """Return a number, or 0 if it is NaN (not measured, frames missing): JSON has no NaN."""
    return value if math.isfinite(value) else 0.0
