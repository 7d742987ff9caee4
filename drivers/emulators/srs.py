"""A simulated Stanford Research SG384, after the drivers that others wrote for it.

Its identity, the ends of its lines, the forms of its answers and its error numbers are those that
qudi's driver found on a real SG384 or took from the manual; limits are those of QCoDeS' driver.
What neither says is chosen here and marked; nothing was compared with a real generator.
"""

from collections import deque
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from typing import Final

Change = Callable[[Fraction, float, bool], None]

_LEAST_HZ: Final = Decimal(950_000)
_MOST_HZ: Final = Decimal(4_050_000_000)
_LEAST_DBM: Final = Decimal(-110)
_MOST_DBM: Final = Decimal("16.5")
_UNITS: Final = {"": 1, "HZ": 1, "KHZ": 1_000, "MHZ": 1_000_000, "GHZ": 1_000_000_000}
_ILLEGAL_VALUE: Final = 10
_UNDEFINED_COMMAND: Final = 111
_ILLEGAL_QUERY: Final = 112
_MISSING_PARAMETERS: Final = 116
_INVALID_NUMBER: Final = 118
_ILLEGAL_UNITS: Final = 127


class _RefusedError(Exception):
    """A command that leaves a number in the queue of errors."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class SRSEmulator:
    """The generator, as one who calls it over LAN finds it after power-up.

    Parameters
    ----------
    on_change : callable
        Called with frequency in Hz, power in dBm and whether the type-N output is on, at every
        change.
    timebase : int
        0 crystal, 1 OCXO, 2 rubidium, 3 external.
    serial_number : str

    Attributes
    ----------
    frequency_hz : Fraction
    power_dbm : Decimal
    is_on, is_modulated : bool
    """

    def __init__(
        self, on_change: Change, timebase: int = 3, serial_number: str = "s/n001796"
    ) -> None:
        self._on_change = on_change
        self._timebase = timebase
        self._identity = f"Stanford Research Systems,SG384,{serial_number},ver1.21.26"
        self._line = b""
        self._errors: deque[int] = deque()
        self.frequency_hz = Fraction(10_000_000)
        # Chosen, as the worst that can be found.
        self.power_dbm = Decimal(0)
        self.is_on = self.is_modulated = True

    def receive(self, data: bytes) -> bytes:
        """Take in bytes and return the answers to the questions among them."""
        answers = bytearray()
        *lines, self._line = (self._line + data).split(b"\n")
        for line in lines:
            for part in line.decode("ascii", errors="replace").split(";"):
                answers += self._answer(part.strip().upper())
        return bytes(answers)

    def _answer(self, text: str) -> bytes:
        if not text:
            return b""
        before = (self.frequency_hz, self.power_dbm, self.is_on)
        try:
            head, _, argument = text.partition(" ")
            if head.endswith("?"):
                return f"{self._tell(head[:-1])}\r\n".encode()
            self._set(head, argument.strip())
        except _RefusedError as refusal:
            self._errors.append(refusal.number)
        if before != (self.frequency_hz, self.power_dbm, self.is_on):
            self._on_change(self.frequency_hz, float(self.power_dbm), self.is_on)
        return b""

    def _tell(self, head: str) -> str:
        if head == "*IDN":
            return self._identity
        if head == "FREQ":
            # Chosen: as many decimals as the step has.
            microhertz = int(self.frequency_hz * 1_000_000)
            return f"{microhertz // 1_000_000}.{microhertz % 1_000_000:06d}"
        if head == "AMPR":
            return f"{self.power_dbm:.2f}"
        if head in ("ENBR", "MODL"):
            return str(int(self.is_on if head == "ENBR" else self.is_modulated))
        if head == "TIMB":
            return str(self._timebase)
        if head == "LERR":
            return str(self._errors.popleft() if self._errors else 0)
        raise _RefusedError(_ILLEGAL_QUERY)

    def _set(self, head: str, argument: str) -> None:
        if head not in ("FREQ", "AMPR", "ENBR", "MODL"):
            raise _RefusedError(_UNDEFINED_COMMAND)
        if not argument:
            raise _RefusedError(_MISSING_PARAMETERS)
        if head == "FREQ":
            number, unit = _number_and_unit(argument)
            hz = _within(number * unit, _LEAST_HZ, _MOST_HZ)
            # Chosen: digits below the step are rounded.
            self.frequency_hz = Fraction(round(hz * 1_000_000), 1_000_000)
        elif head == "AMPR":
            number, _ = _number_and_unit(argument.removesuffix("DBM").strip())
            self.power_dbm = _within(round(number, 2), _LEAST_DBM, _MOST_DBM)
        elif argument not in ("0", "1"):
            raise _RefusedError(_ILLEGAL_VALUE)
        elif head == "ENBR":
            self.is_on = argument == "1"
        else:
            self.is_modulated = argument == "1"


def _number_and_unit(argument: str) -> tuple[Decimal, int]:
    digits = argument.rstrip("GHKMZ ")
    unit = argument[len(digits) :].strip()
    if unit not in _UNITS:
        raise _RefusedError(_ILLEGAL_UNITS)
    try:
        number = Decimal(digits)
    except InvalidOperation:
        raise _RefusedError(_INVALID_NUMBER) from None
    if not number.is_finite():
        raise _RefusedError(_INVALID_NUMBER)
    return number, _UNITS[unit]


def _within(number: Decimal, least: Decimal, most: Decimal) -> Decimal:
    if not least <= number <= most:
        raise _RefusedError(_ILLEGAL_VALUE)
    return number
