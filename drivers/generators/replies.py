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
    """Range of the sines that a generator plays into high impedance, and digits of its answers.

    Attributes
    ----------
    least_vpp, most_vpp : Decimal
        Volts peak to peak.
    most_hz : int
        Highest frequency at which `most_vpp` holds.
    amplitude_digits, frequency_digits : int
        Significant digits of its answers.
    """

    least_vpp: Decimal
    most_vpp: Decimal
    most_hz: int
    amplitude_digits: int
    frequency_digits: int


@dataclass(frozen=True, slots=True)
class Played:
    """Output of a generator as it reports it.

    Attributes
    ----------
    frequency_hz : Fraction
    amplitude_vpp : Decimal
        Volts peak to peak of the open socket.
    is_on : bool
        Whether the output is on.
    """

    frequency_hz: Fraction
    amplitude_vpp: Decimal
    is_on: bool


def agrees(exact: Fraction | Decimal, shown: Fraction | Decimal, digits: int) -> bool:
    """Return whether a number is another one rounded to some significant digits.

    Parameters
    ----------
    exact : Fraction or Decimal
        Not 0.
    shown : Fraction or Decimal
    digits : int

    Returns
    -------
    bool
    """
    value = Fraction(exact)
    leading = (Decimal(value.numerator) / value.denominator).adjusted()
    return abs(value - Fraction(shown)) <= Fraction(10) ** (leading - digits + 1) / 2


def matching(pattern: str) -> Callable[[str], re.Match[str]]:
    """Return a parser of answers that match a regular expression as a whole.

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
