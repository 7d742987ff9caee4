"""Names and conventions that writer and reader share (``docs/reference/run-file.md``)."""

import contextlib
import re
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from typing import Final, Literal

from protocols.units import exact_decimal
from runs.verdict import Verdict

FORMAT: Final = "reedbench-run"
FORMAT_VERSION: Final = 5

Status = Literal["running", "complete", "interrupted", "failed"]

# Planned frequencies of a step. Each also has a column `<name>_exact` with the exact value as text.
PLANNED_HZ: Final = (
    "asked_hz",
    "drive_hz",
    "aom1_hz",
    "aom2_hz",
    "difference_hz",
    "lock_residual_hz",
)
# Frequencies that the instruments report during a step, with `_exact` columns too.
READ_BACK_HZ: Final = ("read_aom1_hz", "read_aom2_hz", "read_drive_hz")
# All other numbers of a measured step, each with its unit.
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
# Column of the exposure of each step; only in runs whose steps have different exposures.
EXPOSURE: Final = "exposure_s"
# Columns of `/entry/interruptions`.
INTERRUPTIONS: Final = ("position", "kind", "began", "ended", "reason")
# Rows of `/entry/interruptions`. Chosen; interruptions beyond the last row are not recorded.
INTERRUPTIONS_MAX: Final = 64
# Values of `/entry/earlier_attempts/position`. FREE is a place without an attempt. While a step is
# copied to a place, the place has the value UNDER_WAY - position of the step, so that another
# process can finish the copy if this one is killed.
FREE: Final = -1
UNDER_WAY: Final = -2
# Longest text of an exact number. Chosen: the frequency of a 48-bit tuning word below 1 GHz has up
# to 58 characters as an exact decimal.
EXACT_BYTES: Final = 64
# Longest sentence of a step, and longest text of an interruption. Chosen; longer texts are cut.
SENTENCE_BYTES: Final = 240
# End of the sentence of a pending step that was measured before.
TO_BE_MEASURED_AGAIN: Final = "to be measured again"
# Longest reason in an error message, in characters. Chosen; longer reasons are cut.
_MAX_REASON_LENGTH: Final = 120


InterruptionKind = Literal["resumed", "paused", "recovered"]


@dataclass(frozen=True)
class Interruption:
    """A place in a run where measuring stopped and continued later.

    Attributes
    ----------
    position : int
        Position of the first step after it, from 0.
    kind : {'resumed', 'paused', 'recovered'}
        Continued by another process, after a pause, or after the failure of an instrument.
    began, ended : str
        Times, ISO 8601.
    reason : str
        Why the run was interrupted.
    """

    position: int
    kind: InterruptionKind
    began: str
    ended: str
    reason: str


class RunKind(StrEnum):
    """What a run measures: a sweep, or one of the calibrations."""

    SWEEP = "sweep"
    DARK = "dark"
    FLAT = "flat"
    LO_ONLY = "lo_only"
    OBJECT_ONLY = "object_only"
    ORDER0 = "order0"


@dataclass(frozen=True)
class RunPurpose:
    """What a run measures, and which part of a campaign it is.

    Attributes
    ----------
    kind : RunKind
    campaign : str
        Name of the campaign, the same in all its runs; empty if the run belongs to no campaign.
    part : str
        Name of the run within the campaign.
    clamping : int
        How often the reed was removed and clamped again since the campaign began.
    """

    kind: RunKind = RunKind.SWEEP
    campaign: str = ""
    part: str = ""
    clamping: int = 0


@dataclass(frozen=True)
class RunLabels:
    """Labels that the operator gives a run; reed and series are in the preparation of the bench.

    Attributes
    ----------
    strength : float or None
        Nominal strength of the reed, such as 3.5; None if unknown.
    note, operator : str
        Free text, and the name of the operator.
    campaign, part : str
        Name of the campaign and of the run in it, see `RunPurpose`.
    clamping : int
        See `RunPurpose`.
    """

    strength: float | None = None
    note: str = ""
    operator: str = ""
    campaign: str = ""
    part: str = ""
    clamping: int = 0


def exact_text(value: Fraction) -> str:
    """Return a fraction as exact text that ``Fraction(text)`` reads back.

    The text is a decimal number if that is exact, and ``p/q`` if not.

    Raises
    ------
    ValueError
        If the text has more characters than a run file stores.
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


def verdict_of(content: bytes) -> Verdict | None:
    """Return the verdict that a run file holds as bytes; None if they are not a verdict."""
    with contextlib.suppress(ValueError):
        return Verdict(content.decode())
    return None


def short_reason(error: BaseException) -> str:
    """Return the reason of an error in a few words, for a message of one line.

    This is the text of the operating system, also if HDF5 quotes it, or else the first line of the
    error, or its class name.
    """
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    quoted = re.search(r"error message = '([^']+)'", text)
    if quoted:
        return quoted[1]
    return text.splitlines()[0][:_MAX_REASON_LENGTH] if text else type(error).__name__
