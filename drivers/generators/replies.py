"""Replies of generators: ranges, readings and whether they agree with what was asked."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Final

MICROHERTZ: Final = Fraction(1, 1_000_000)


@dataclass(frozen=True, slots=True)
class SineRange:
    """What sines a generator can play into high impedance, and how exactly it says so.

    Attributes
    ----------
    least_vpp, most_vpp : Decimal
        Volts peak to peak.
    most_hz : int
        Up to which `most_vpp` holds.
    amplitude_digits, frequency_digits : int
        Significant digits of what it says.
    """

    least_vpp: Decimal
    most_vpp: Decimal
    most_hz: int
    amplitude_digits: int
    frequency_digits: int


@dataclass(frozen=True, slots=True)
class Played:
    """What a generator says that it plays.

    Attributes
    ----------
    frequency_hz : Fraction
    amplitude_vpp : Decimal
        Of the open socket.
    is_on : bool
        Whether the output is on.
    """

    frequency_hz: Fraction
    amplitude_vpp: Decimal
    is_on: bool


def agrees(told: Fraction | Decimal, said: Fraction | Decimal, digits: int) -> bool:
    """Whether a number is what another looks like with so many significant digits.

    Parameters
    ----------
    told : Fraction or Decimal
        Not 0.
    said : Fraction or Decimal
    digits : int

    Returns
    -------
    bool
    """
    exact = Fraction(told)
    leading = (Decimal(exact.numerator) / exact.denominator).adjusted()
    return abs(exact - Fraction(said)) <= Fraction(10) ** (leading - digits + 1) / 2


def matching(pattern: str) -> Callable[[str], re.Match[str]]:
    """Return what understands only answers that match a regular expression as a whole.

    Parameters
    ----------
    pattern : str

    Returns
    -------
    callable
        Raises `ValueError` for other answers.
    """

    def understand(answer: str) -> re.Match[str]:
        found = re.fullmatch(pattern, answer)
        if found is None:
            raise ValueError(answer)
        return found

    return understand


def in_hertz(frequency_hz: Fraction) -> str:
    """Write a frequency of a whole number of microhertz, all digits of it.

    Parameters
    ----------
    frequency_hz : Fraction

    Returns
    -------
    str
        Such as ``2033.075000``.
    """
    whole, micro = divmod(round(frequency_hz / MICROHERTZ), 1_000_000)
    return f"{whole}.{micro:06d}"
