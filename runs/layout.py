"""What writer and reader of a run file agree on, see ``docs/run-file.md``."""

import contextlib
import re
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from typing import Final, Literal

from protocols.units import exact_decimal
from runs.verdict import Verdict

FORMAT: Final = "reedbench-run"
FORMAT_VERSION: Final = 4

Status = Literal["running", "complete", "interrupted", "failed"]

# Columns of `/entry/steps`. Every frequency also has a column `<name>_exact` of text.
PLANNED_HZ: Final = (
    "asked_hz",
    "drive_hz",
    "aom1_hz",
    "aom2_hz",
    "difference_hz",
    "lock_residual_hz",
)
READ_BACK_HZ: Final = ("read_aom1_hz", "read_aom2_hz", "read_drive_hz")
# Numbers of a measured step besides its frequencies, each with its unit.
MEASURED: Final = {
    "read_volts": "V",
    "changed_s": "s",
    "signal_to_noise": "",
    "noise_level": "",
    "saturated_share": "",
    "brightness_dn": "dn",
    "lock_error_hz": "Hz",
    "lock_error_se_hz": "Hz",
    "unexplained": "",
}
# Column that only runs have whose steps are not all exposed alike.
EXPOSURE: Final = "exposure_s"
# Columns of `/entry/interruptions`, and how many of them there may be.
INTERRUPTIONS: Final = ("position", "kind", "began", "ended", "reason")
INTERRUPTIONS_MAX: Final = 64
# Positions of `/entry/retakes` that hold no take. A step that is being set aside has UNDER_WAY less
# its position, so that another process can finish what this one was killed in.
FREE: Final = -1
UNDER_WAY: Final = -2
EXACT_BYTES: Final = 64
SENTENCE_BYTES: Final = 240
# How the sentence of a pending step ends that was measured before.
TO_BE_TAKEN_AGAIN: Final = "to be taken again"
# Of what went wrong, no more than this is told.
_LONGEST_REASON = 120


InterruptionKind = Literal["resumed", "paused", "recovered"]


@dataclass(frozen=True)
class Interruption:
    """A place where a run was not carried on at once.

    Attributes
    ----------
    position : int
        Of the step that came after it, from 0.
    kind : {'resumed', 'paused', 'recovered'}
        By another process, after a pause, or after an instrument had failed.
    began, ended : str
        ISO 8601.
    reason : str
    """

    position: int
    kind: InterruptionKind
    began: str
    ended: str
    reason: str


class Kind(StrEnum):
    """What a run is of."""

    SWEEP = "sweep"
    DARK = "dark"
    FLAT = "flat"
    LO_ONLY = "lo_only"
    OBJECT_ONLY = "object_only"
    ORDER0 = "order0"


@dataclass(frozen=True)
class Acquisition:
    """What a run is of, and which part of a campaign it is.

    Attributes
    ----------
    kind : Kind
    campaign : str
        The same in all runs of a campaign; empty if it stands alone.
    part : str
        Name within the campaign.
    clamping : int
        How often the reed had been clamped anew since the campaign began.
    """

    kind: Kind = Kind.SWEEP
    campaign: str = ""
    part: str = ""
    clamping: int = 0


@dataclass(frozen=True)
class RunLabels:
    """What a person says about a run; reed and series stand in the bench's preparation.

    Attributes
    ----------
    strength : float or None
        Nominal strength of the reed, such as 3.5.
    note, operator : str
    campaign, part : str
        Of what the run is a part; see `Acquisition`.
    clamping : int
    """

    strength: float | None = None
    note: str = ""
    operator: str = ""
    campaign: str = ""
    part: str = ""
    clamping: int = 0


def exact_text(value: Fraction) -> str:
    """Write a fraction exactly, as decimals where they end: what ``Fraction(text)`` reads back.

    Raises
    ------
    ValueError
        If it needs more characters than a run file holds.
    """
    try:
        text = exact_decimal(value)
    except ValueError:
        text = str(value)
    text = text if len(text) <= EXACT_BYTES else str(value)
    if len(text) > EXACT_BYTES:
        raise ValueError(
            f"{text} has more than {EXACT_BYTES} characters; no synthesizer has such a step"
        )
    return text


def verdict_of(said: bytes) -> Verdict | None:
    """Return the verdict that a file has of a step; None if the bytes are those of none."""
    with contextlib.suppress(ValueError):
        return Verdict(said.decode())
    return None


def short_reason(error: BaseException) -> str:
    """Return the operating system's words, also where HDF5 quotes them, or the first line of it."""
    said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    quoted = re.search(r"error message = '([^']+)'", said)
    if quoted:
        return quoted[1]
    return said.splitlines()[0][:_LONGEST_REASON] if said else type(error).__name__
