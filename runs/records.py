"""Records of steps and interruptions, from the columns of a run file."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from runs.checksums import (
    ROW_CHECKSUM,
)
from runs.layout import (
    EXPOSURE,
    INTERRUPTIONS,
    MEASURED,
    PLANNED_HZ,
    READ_BACK_HZ,
    TO_BE_TAKEN_AGAIN,
    Acquisition,
    Interruption,
    Kind,
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
        Place in the file, from 0; what `Run.field` wants.
    index : int
        k of the protocol's sweep.
    asked_hz, drive_hz, aom1_hz, aom2_hz, difference_hz, lock_residual_hz : Fraction
        As planned.
    volts : float
        Peak volts at the load, as planned.
    carrier_leak : float
        See `protocols.step.Step`.
    read_aom1_hz, read_aom2_hz, read_drive_hz : Fraction or None
        What the instruments said; None if the step was not measured.
    read_volts : float
        NaN if the step was not measured, like all numbers below.
    exposure_s : float or None
        Of this step alone; None if it was that of the run.
    changed_s : float
        When the last setting was changed, on the camera's clock.
    timestamps_s : tuple of float
        Starts of the exposures, on the camera's clock.
    frame_ids : tuple of int
        -1 where there is no frame.
    signal_to_noise, noise_level, saturated_share, brightness_dn : float
    lock_error_hz, lock_error_se_hz, unexplained : float
        See `MeasuredStep`.
    verdict : Verdict
    sentence : str
        Why that verdict.
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


def read_acquisition(group: Any) -> Acquisition:
    """Return what a run is a part of."""
    return Acquisition(
        Kind(read_text(group, "kind")),
        read_text(group, "campaign"),
        read_text(group, "part"),
        int(group["clamping"][()]),
    )


def read_text(group: Any, name: str) -> str:
    """Return a text of a group."""
    value: str = group[name].asstr()[()]
    return value


def read_columns(group: Any) -> dict[str, Column]:
    """All columns of a table of steps but for their pixels."""
    skipped = {"position", "field", "frames"}
    return {name: group[name][()] for name in sorted(group.keys() - skipped)}


def settled_columns(group: Any) -> tuple[dict[str, Column], list[Verdict | None]]:
    """All columns of a table of steps but for their pixels, and the verdict of each step.

    Another process may be writing. A verdict is written last, and taken back first: where it and
    the checksum are the same before and after all else was read, so was all else. Other steps are
    pending: they were just being measured, or set aside. None is a verdict that is damaged.
    """
    before, sums_before = (group[name][()] for name in ("verdict", ROW_CHECKSUM))
    columns = read_columns(group)
    after, sums_after = (group[name][()] for name in ("verdict", ROW_CHECKSUM))
    same = (before == after) & (sums_before == sums_after)
    pairs = zip(before.tolist(), same, strict=True)
    return columns, [verdict_of(said) if kept else Verdict.PENDING for said, kept in pairs]


def _texts(column: Column) -> list[str]:
    return [text.decode() for text in column.tolist()]


def step_records(columns: dict[str, Column], verdicts: Sequence[Verdict]) -> Iterator[StepRecord]:
    """Give one record per step."""
    exact = {name: _texts(columns[f"{name}_exact"]) for name in PLANNED_HZ}
    numbers = ("index", "order", "volts", "carrier_leak")
    exposures = columns.get(EXPOSURE)
    for position, taken in enumerate(taken_fields(columns, verdicts)):
        # Of any type, for mypy: the mappings supply fields of several types.
        asked: dict[str, Any] = {name: _fraction(texts[position]) for name, texts in exact.items()}
        asked |= {name: columns[name][position].item() for name in numbers}
        exposure_s = np.nan if exposures is None else float(exposures[position])
        asked["exposure_s"] = None if np.isnan(exposure_s) else exposure_s
        yield StepRecord(position=position, **asked, **taken)


def taken_fields(
    columns: dict[str, Column], verdicts: Sequence[Verdict]
) -> Iterator[dict[str, Any]]:
    """Fields of `StepRecord` that say what was measured.

    A step without a verdict may be just being written: nothing of it is given.
    """
    sentences = _texts(columns["sentence"])
    exact = {name: columns[f"{name}_exact"] for name in READ_BACK_HZ}
    numbers = {name: columns[name] for name in MEASURED}
    frames = columns["frame_id"].shape[1]
    for row, verdict in enumerate(verdicts):
        there, sentence = verdict.measured, sentences[row]
        if verdict is Verdict.PENDING and not sentence.endswith(TO_BE_TAKEN_AGAIN):
            sentence = ""
        times, ids = columns["timestamp_s"][row].tolist(), columns["frame_id"][row].tolist()
        yield {
            "timestamps_s": tuple(times) if there else (np.nan,) * frames,
            "frame_ids": tuple(ids) if there else (-1,) * frames,
            "verdict": verdict,
            "sentence": sentence,
            **{name: _fraction(c[row].decode()) if there else None for name, c in exact.items()},
            **{name: c[row].item() if there else np.nan for name, c in numbers.items()},
        }


def read_interruptions(group: Any) -> Iterator[Interruption]:
    """Yield the interruptions of a run."""
    # First, because it is written last.
    positions = group["position"][()]
    texts = [group[name].asstr()[()] for name in INTERRUPTIONS[1:]]
    for position, kind, *others in zip(positions, *texts, strict=True):
        if position >= 0:
            yield Interruption(int(position), kind, *others)


def _fraction(text: str) -> Fraction | None:
    return Fraction(text) if text else None
