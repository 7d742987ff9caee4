"""Make records of steps and interruptions from the columns of a run file."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from runs.integrity.checksums import ROW_CHECKSUM
from runs.layout import (
    EXPOSURE,
    INTERRUPTIONS,
    MEASURED,
    PLANNED_HZ,
    READ_BACK_HZ,
    TO_BE_MEASURED_AGAIN,
    Interruption,
    RunKind,
    RunPurpose,
    verdict_of,
)
from runs.verdict import Verdict

Column = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class StepRecord:
    """One step of a run file.

    Attributes
    ----------
    position : int
        Row in the file, from 0; the argument of `Run.field`.
    index : int
        Index k of the step in the protocol's sweep.
    order : int
        Order of the sideband that the step measures.
    asked_hz, drive_hz, aom1_hz, aom2_hz, difference_hz, lock_residual_hz : Fraction
        Planned frequencies, see `protocols.step.Step`.
    volts : float
        Planned peak volts at the load.
    carrier_leak : float
        See `protocols.step.Step`.
    read_aom1_hz, read_aom2_hz, read_drive_hz : Fraction or None
        Frequencies that the instruments reported; None if the step was not measured.
    read_volts : float
        Peak volts that the generator reported. NaN if the step was not measured, like all numbers
        below.
    exposure_s : float or None
        Exposure of this step; None if it is that of the run.
    changed_s : float
        Time of the last change of a setting on the camera's clock, in s.
    timestamps_s : tuple of float
        Start of each exposure on the camera's clock, in s.
    frame_ids : tuple of int
        -1 where there is no frame.
    signal_to_noise, noise_level, saturated_share, brightness_dn : float
    lock_error_hz, lock_error_se_hz, unexplained : float
        See `MeasuredStep`.
    verdict : Verdict
    sentence : str
        Reason of the verdict.
    """

    position: int
    index: int
    order: int
    asked_hz: Fraction
    drive_hz: Fraction
    aom1_hz: Fraction
    aom2_hz: Fraction
    difference_hz: Fraction
    lock_residual_hz: Fraction
    volts: float
    carrier_leak: float
    read_aom1_hz: Fraction | None
    read_aom2_hz: Fraction | None
    read_drive_hz: Fraction | None
    read_volts: float
    exposure_s: float | None
    changed_s: float
    timestamps_s: tuple[float, ...]
    frame_ids: tuple[int, ...]
    signal_to_noise: float
    noise_level: float
    saturated_share: float
    brightness_dn: float
    lock_error_hz: float
    lock_error_se_hz: float
    unexplained: float
    verdict: Verdict
    sentence: str


def read_acquisition(group: Any) -> RunPurpose:
    """Return what a run measures and its part in a campaign."""
    return RunPurpose(
        RunKind(read_text(group, "kind")),
        read_text(group, "campaign"),
        read_text(group, "part"),
        int(group["clamping"][()]),
    )


def read_text(group: Any, name: str) -> str:
    """Return a text of a group."""
    value: str = group[name].asstr()[()]
    return value


def read_columns(group: Any) -> dict[str, Column]:
    """Return all columns of a table of steps except their pixels."""
    skipped = {"position", "field", "frames"}
    return {name: group[name][()] for name in sorted(group.keys() - skipped)}


def settled_columns(group: Any) -> tuple[dict[str, Column], list[Verdict | None]]:
    """Read a table of steps, which another process may be changing.

    The writer of a step writes its verdict last and withdraws it first. So if verdict and checksum
    of a row are the same before and after its other columns are read, these belong together. Other
    steps are being measured or set aside at this moment, and are returned as pending.

    Returns
    -------
    columns : dict of str to (steps, …) array
        All columns except the pixels.
    verdicts : list of Verdict or None
        Verdict of each step; None if it is damaged.
    """
    before, sums_before = (group[name][()] for name in ("verdict", ROW_CHECKSUM))
    columns = read_columns(group)
    after, sums_after = (group[name][()] for name in ("verdict", ROW_CHECKSUM))
    same = (before == after) & (sums_before == sums_after)
    pairs = zip(before.tolist(), same, strict=True)
    return columns, [verdict_of(text) if settled else Verdict.PENDING for text, settled in pairs]


def _texts(column: Column) -> list[str]:
    return [text.decode() for text in column.tolist()]


def step_records(columns: dict[str, Column], verdicts: Sequence[Verdict]) -> Iterator[StepRecord]:
    """Yield one record per step."""
    exact = {name: _texts(columns[f"{name}_exact"]) for name in PLANNED_HZ}
    numbers = ("index", "order", "volts", "carrier_leak")
    exposures = columns.get(EXPOSURE)
    for position, taken in enumerate(measured_fields(columns, verdicts)):
        # Any, because the fields of a record have several types.
        planned: dict[str, Any] = {key: _fraction(texts[position]) for key, texts in exact.items()}
        planned |= {name: columns[name][position].item() for name in numbers}
        exposure_s = np.nan if exposures is None else float(exposures[position])
        planned["exposure_s"] = None if np.isnan(exposure_s) else exposure_s
        yield StepRecord(position=position, **planned, **taken)


def measured_fields(
    columns: dict[str, Column], verdicts: Sequence[Verdict]
) -> Iterator[dict[str, Any]]:
    """Yield, for each step, the fields of `StepRecord` that hold what was measured.

    A step without a measurement gets empty values, because it may be half written.
    """
    sentences = _texts(columns["sentence"])
    exact = {name: columns[f"{name}_exact"] for name in READ_BACK_HZ}
    numbers = {name: columns[name] for name in MEASURED}
    frames = columns["frame_id"].shape[1]
    for row, verdict in enumerate(verdicts):
        measured, sentence = verdict.measured, sentences[row]
        if verdict is Verdict.PENDING and not sentence.endswith(TO_BE_MEASURED_AGAIN):
            sentence = ""
        times, ids = columns["timestamp_s"][row].tolist(), columns["frame_id"][row].tolist()
        yield {
            "timestamps_s": tuple(times) if measured else (np.nan,) * frames,
            "frame_ids": tuple(ids) if measured else (-1,) * frames,
            "verdict": verdict,
            "sentence": sentence,
            **{name: _fraction(c[row].decode()) if measured else None for name, c in exact.items()},
            **{name: c[row].item() if measured else np.nan for name, c in numbers.items()},
        }


def read_interruptions(group: Any) -> Iterator[Interruption]:
    """Yield the interruptions of a run."""
    # Read first, because it is written last: a row with a position is complete.
    positions = group["position"][()]
    texts = [group[name].asstr()[()] for name in INTERRUPTIONS[1:]]
    for position, kind, *others in zip(positions, *texts, strict=True):
        if position >= 0:
            yield Interruption(int(position), kind, *others)


def _fraction(text: str) -> Fraction | None:
    return Fraction(text) if text else None
