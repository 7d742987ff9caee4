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
from drivers.roles import Bench

_EXIT_STATUS: Final[dict[Status, Literal["success", "abort", "fail"]]] = {
    "complete": "success",
    "interrupted": "abort",
    "failed": "fail",
}
_SOURCES: Final = {
    "index": "protocol",
    "asked_hz": "protocol",
    "drive_hz": "generator",
    "difference_hz": "synthesizers",
    "volts": "generator",
    "signal_to_noise": "camera",
    "noise_level": "camera",
    "saturated_share": "camera",
    "verdict": "acquire.quality",
    "sentence": "acquire.quality",
}
_UNITS: Final = {"asked_hz": "Hz", "drive_hz": "Hz", "difference_hz": "Hz", "volts": "V"}


def documents_path(run_path: Path) -> Path:
    """Return where the documents of a run file stand: ``R07.h5`` → ``R07.documents.jsonl``."""
    return run_path.with_suffix(".documents.jsonl")


class DocumentLog:
    """Start, descriptor, event and stop documents of one run; a context manager.

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

    def __init__(
        self, run_path: Path, plan: Plan, bench: Bench, labels: RunLabels, uid: str
    ) -> None:
        # It takes longer to import than the rest of this package.
        import event_model

        metadata = _metadata(run_path, plan, bench, labels)
        bundle = event_model.compose_run(uid=uid, metadata=metadata)
        stream = bundle.compose_descriptor(name="primary", data_keys=_data_keys())
        self._compose_stop, self._compose_event = bundle.compose_stop, stream.compose_event
        self.path = documents_path(run_path)
        self._file = _create(self.path)
        try:
            self._write("start", bundle.start_doc)
            self._write("descriptor", stream.descriptor_doc)
        except BaseException:
            self.discard()
            raise

    def event(self, step: Step, measured: MeasuredStep, time_s: float) -> None:
        """Write the event of one measured step.

        Parameters
        ----------
        step : Step
            As planned.
        measured : MeasuredStep
        time_s : float
            POSIX time of the measurement.
        """
        read = measured.read_back
        data: dict[str, Any] = {
            "index": step.index,
            "asked_hz": float(step.asked_hz),
            "drive_hz": float(read.drive_hz),
            "difference_hz": float(read.aom1_hz - read.aom2_hz),
            "volts": read.volts,
            "signal_to_noise": _finite(measured.signal_to_noise),
            "noise_level": _finite(measured.noise_level),
            "saturated_share": measured.saturated_share,
            "verdict": str(measured.judgement.verdict),
            "sentence": measured.judgement.sentence,
        }
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
            raise RunFileError(
                f"{self.path}: cannot be written ({short_reason(error)}); make room on the disk"
            ) from error


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
        dtype = "string" if text else "integer" if name == "index" else "number"
        keys[name] = {"source": source, "dtype": dtype, "shape": []}
        if name in _UNITS:
            keys[name]["units"] = _UNITS[name]
    return keys


def _finite(value: float) -> float:
    """JSON knows no NaN; what could not be measured for want of frames is 0."""
    return value if math.isfinite(value) else 0.0
