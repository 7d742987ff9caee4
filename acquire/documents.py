"""A run as documents of the bluesky event model, one JSON line each beside the run file.

Every line is a pair ``[name, document]`` as suitcase-jsonl writes it, so LiveTable, databroker
and Tiled read our runs. Arrays stay in the run file, which the start document names.
"""

import json
import math
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, Self, TextIO

from acquire.errors import RunFileError
from acquire.plan import Plan, Step
from acquire.run_layout import RunLabels, Status, short_reason
from acquire.run_writer import MeasuredStep
from acquire.runfile import StepRecord
from drivers.roles import Bench

_EXIT_STATUS: Final[dict[Status, Literal["success", "abort", "fail"]]] = {
    "complete": "success",
    "interrupted": "abort",
    "failed": "fail",
}
_SOURCES: Final = {
    "index": "protocol",
    "take": "acquire.runner",
    "asked_hz": "protocol",
    "drive_hz": "generator",
    "difference_hz": "synthesizers",
    "volts": "generator",
    "signal_to_noise": "camera",
    "noise_level": "camera",
    "saturated_share": "camera",
    "lock_error_hz": "camera",
    "lock_error_se_hz": "camera",
    "verdict": "acquire.quality",
    "sentence": "acquire.quality",
}
_UNITS: Final = {
    "asked_hz": "Hz",
    "drive_hz": "Hz",
    "difference_hz": "Hz",
    "volts": "V",
    "lock_error_hz": "Hz",
    "lock_error_se_hz": "Hz",
}


def documents_path(run_path: Path) -> Path:
    """Return where the documents of a run file stand: ``R07.h5`` → ``R07.documents.jsonl``."""
    return run_path.with_suffix(".documents.jsonl")


class DocumentLog:
    """Start, descriptor, event and stop documents of one run; a context manager.

    Made by `create` and `resume`.
    """

    def __init__(
        self,
        path: Path,
        file: TextIO,
        compose_event: Any,
        compose_stop: Any,
        told: frozenset[tuple[int, int]] = frozenset(),
    ) -> None:
        self.path = path
        self._file, self._told = file, told
        self._compose_event, self._compose_stop = compose_event, compose_stop

    @classmethod
    def create(cls, run_path: Path, plan: Plan, bench: Bench, labels: RunLabels, uid: str) -> Self:
        """Begin the documents of a new run.

        Parameters
        ----------
        run_path : Path
            Of the run file.
        plan : Plan
        bench : Bench
        labels : RunLabels
        uid : str
            Of the run file, and of the start document.

        Raises
        ------
        RunFileError
            If the documents exist already or cannot be made.
        """
        # It takes longer to import than the rest of this package.
        import event_model

        metadata = _metadata(run_path, plan, bench, labels)
        bundle = event_model.compose_run(uid=uid, metadata=metadata)
        stream = bundle.compose_descriptor(name="primary", data_keys=_data_keys())
        path = documents_path(run_path)
        log = cls(path, _create(path), stream.compose_event, bundle.compose_stop)
        try:
            log._write("start", bundle.start_doc)
            log._write("descriptor", stream.descriptor_doc)
        except BaseException:
            log.discard()
            raise
        return log

    @property
    def told(self) -> frozenset[tuple[int, int]]:
        """Index and take of every event that was there when the documents were gone on with."""
        return self._told

    @classmethod
    def resume(cls, run_path: Path) -> Self:
        """Go on with the documents of a run that is not complete.

        A line that was cut short, and the stop document of a run that was ended, are left out: a
        run has one beginning and one end.

        Raises
        ------
        RunFileError
            If there are none, or they are no documents of a run.
        """
        import event_model

        path = documents_path(run_path)
        documents = _documents(path)
        named = dict(reversed(documents))
        counts = {"primary": 1 + sum(name == "event" for name, _ in documents)}
        try:
            start, descriptor = named["start"], named["descriptor"]
            compose_event = event_model.ComposeEvent(descriptor=descriptor, event_counters=counts)
        except (KeyError, TypeError, ValueError):
            raise RunFileError(
                f"{path}: does not begin with the documents of a run; measure the sweep again"
            ) from None
        compose_stop = event_model.ComposeStop(start=start, event_counters=counts, poison_pill=[])
        whole = path.with_suffix(".part")
        try:
            with whole.open("w", encoding="utf-8") as part:
                part.writelines(json.dumps(document) + "\n" for document in documents)
            whole.replace(path)
            told = frozenset(
                (document["data"]["index"], document["data"]["take"])
                for name, document in documents
                if name == "event"
            )
            return cls(path, path.open("a", encoding="utf-8"), compose_event, compose_stop, told)
        except OSError as error:
            raise _cannot_write(path, error) from error

    def event(self, data: dict[str, Any], time_s: float) -> None:
        """Write the event of one measured step.

        Parameters
        ----------
        data : dict
            See `event_data` and `recorded_data`.
        time_s : float
            POSIX time of the measurement.

        Raises
        ------
        RunFileError
            If the disk refuses.
        """
        timestamps = dict.fromkeys(data, time_s)
        self._write("event", self._compose_event(data=data, timestamps=timestamps, time=time_s))

    def finish(self, status: Status, reason: str = "") -> None:
        """Write the stop document and close. Does nothing the second time."""
        if self._file.closed:
            return
        stop = self._compose_stop(exit_status=_EXIT_STATUS[status], reason=reason)
        self._write("stop", stop)
        self._file.close()

    def discard(self) -> None:
        """Close and remove documents that say nothing worth keeping."""
        self._file.close()
        self.path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def _write(self, name: str, document: Any) -> None:
        try:
            self._file.write(json.dumps([name, document], allow_nan=False) + "\n")
            self._file.flush()
        except OSError as error:
            raise _cannot_write(self.path, error) from error


def _cannot_write(path: Path, error: OSError) -> RunFileError:
    return RunFileError(f"{path}: cannot be written ({short_reason(error)}); make room on the disk")


def _documents(path: Path) -> list[tuple[str, Any]]:
    """Documents of a run that is not complete, as far as they are whole, without the last one."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RunFileError(f"{path}: cannot be read ({error}); measure the sweep again") from error
    documents = []
    for line in lines:
        try:
            name, document = json.loads(line)
        except ValueError:
            break
        if name != "stop":
            documents.append((name, document))
    return documents


def event_data(step: Step, take: int, measured: MeasuredStep) -> dict[str, Any]:
    """Data of the event of a step that was just measured.

    Parameters
    ----------
    step : Step
        As planned.
    take : int
        From 1: how often the step was taken.
    measured : MeasuredStep
    """
    read = measured.read_back
    return {
        "index": step.index,
        "take": take,
        "asked_hz": float(step.asked_hz),
        "drive_hz": float(read.drive_hz),
        "difference_hz": float(read.aom1_hz - read.aom2_hz),
        "volts": read.volts,
        "signal_to_noise": _finite(measured.signal_to_noise),
        "noise_level": _finite(measured.noise_level),
        "saturated_share": measured.saturated_share,
        "lock_error_hz": _finite(measured.lock_error_hz),
        "lock_error_se_hz": _finite(measured.lock_error_se_hz),
        "verdict": str(measured.judgement.verdict),
        "sentence": measured.judgement.sentence,
    }


def recorded_data(record: StepRecord, take: int) -> dict[str, Any]:
    """Data of the event of a measured step that a run file holds, see `event_data`."""
    aom1_hz, aom2_hz = record.read_aom1_hz or 0, record.read_aom2_hz or 0
    return {
        "index": record.index,
        "take": take,
        "asked_hz": float(record.asked_hz),
        "drive_hz": float(record.read_drive_hz or 0),
        "difference_hz": float(aom1_hz - aom2_hz),
        "volts": record.read_volts,
        "signal_to_noise": _finite(record.signal_to_noise),
        "noise_level": _finite(record.noise_level),
        "saturated_share": record.saturated_share,
        "lock_error_hz": _finite(record.lock_error_hz),
        "lock_error_se_hz": _finite(record.lock_error_se_hz),
        "verdict": str(record.verdict),
        "sentence": record.sentence,
    }


def _create(path: Path) -> TextIO:
    try:
        return path.open("x", encoding="utf-8")
    except FileExistsError:
        raise RunFileError(
            f"{path}: exists already and is never overwritten; choose another name or move it"
        ) from None
    except OSError as error:
        raise RunFileError(
            f"{path}: cannot be made ({short_reason(error)}); check folder and rights"
        ) from error


def _metadata(run_path: Path, plan: Plan, bench: Bench, labels: RunLabels) -> dict[str, Any]:
    preparation = bench.preparation
    return {
        "plan_name": plan.protocol.name,
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
        dtype = "string" if text else "integer" if name in ("index", "take") else "number"
        keys[name] = {"source": source, "dtype": dtype, "shape": []}
        if name in _UNITS:
            keys[name]["units"] = _UNITS[name]
    return keys


def _finite(value: float) -> float:
    """JSON knows no NaN; what could not be measured for want of frames is 0."""
    return value if math.isfinite(value) else 0.0
