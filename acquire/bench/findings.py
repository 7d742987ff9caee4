"""Findings of `acquire bench check` and `acquire bench off`, and how both read a bench file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from drivers.registry import OUTPUTS
from drivers.roles import Instrument, RoleName
from drivers.safe_off import instruments_off
from holography.errors import BenchError
from protocols.bench import BenchFile
from protocols.errors import ProtocolError
from protocols.protocol import Protocol

Result = Literal["pass", "fail", "note", "skipped"]

# Remedy for the operator if an output may be on and the program cannot reach the instrument.
_BY_HAND: Final[Mapping[str, str]] = {
    "generator": "switch its output off at its front panel, or pull the loudspeaker's cable",
    "synthesizers": "switch off the RF amplifiers of the modulators, or the synthesizers",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check of one instrument; one line of the table.

    Attributes
    ----------
    check : str
        Name of the check, such as ``opened`` or ``limits``.
    about : str
        Role of the instrument, or ``bench``.
    result : {'pass', 'fail', 'note', 'skipped'}
        ``note`` is information, not a failure; ``skipped`` means that the check was impossible,
        because another one failed.
    found : str
        What the check found.
    remedy : str
        What to do; empty if there is nothing to do.
    """

    check: str
    about: str
    result: Result
    found: str
    remedy: str = ""

    def to_json(self) -> dict[str, str]:
        """Return the finding as JSON values with stable keys."""
        return {
            "check": self.check,
            "about": self.about,
            "result": self.result,
            "found": self.found,
            "remedy": self.remedy,
        }


def read_bench(name: str) -> BenchFile:
    """Read a bench file, or a shipped bench by its name.

    Raises
    ------
    ProtocolError
        If it cannot be used. The message says so if it is a protocol.
    """
    try:
        return BenchFile.from_file(name)
    except ProtocolError as error:
        try:
            Protocol.from_file(name)
        except ProtocolError:
            raise error from None
        raise ProtocolError(
            f"{name}: is a protocol, which says what to measure; name a bench file, which says "
            "with which instruments, such as simulated"
        ) from None


def failed(check: str, about: str, error: BaseException | str) -> Finding:
    """Return the finding that a check failed.

    Parameters
    ----------
    check, about : str
        See `Finding`.
    error : exception or str
        Error; a message of this software has its remedy after a semicolon.
    """
    text = " ".join(str(error).split())
    if isinstance(error, BaseException) and not isinstance(error, BenchError):
        text = f"{type(error).__name__}: {text}; this is an error of the driver, please report it"
    found, _, remedy = text.partition("; ")
    return Finding(check, about, "fail", found, remedy or "check its power supply and its cables")


def confirmed_off(check: str, role: RoleName, instrument: Instrument) -> Finding:
    """Switch an instrument off, and return the finding whether it confirmed that.

    Parameters
    ----------
    check : str
        See `Finding`.
    role : {'synthesizers', 'generator', 'camera'}
    instrument : Instrument
        Open instrument.
    """
    return all_confirmed_off(check, {role: instrument})[role]


def all_confirmed_off(
    check: str, instruments: Mapping[RoleName, Instrument]
) -> dict[RoleName, Finding]:
    """Switch instruments off, all at once; see `confirmed_off`."""
    return {
        role: _confirmed(check, role, unconfirmed)
        for role, unconfirmed in instruments_off(instruments).items()
    }


def _confirmed(check: str, role: RoleName, unconfirmed: Sequence[str]) -> Finding:
    if unconfirmed:
        return _with_hands(failed(check, role, "; ".join(unconfirmed)))
    what = OUTPUTS.get(role)
    return Finding(check, role, "pass", f"{what}: off, confirmed" if what else "stopped")


def unreached(check: str, role: RoleName, error: BaseException | str) -> Finding:
    """Return the finding that an instrument could not be reached, so that its output may be on."""
    finding = failed(check, role, error)
    if role not in OUTPUTS:
        return Finding(check, role, "note", f"not reached: {finding.found}", finding.remedy)
    found = f"{OUTPUTS[role]} may still be on; not reached: {finding.found}"
    return _with_hands(Finding(check, role, "fail", found, finding.remedy))


def _with_hands(finding: Finding) -> Finding:
    by_hand = _BY_HAND.get(finding.about)
    remedy = f"{by_hand}. Then: {finding.remedy}" if by_hand else finding.remedy
    return Finding(finding.check, finding.about, finding.result, finding.found, remedy)
