"""Quantities with units, exact: ``"12.4 Hz"`` in a file → ``Fraction(62, 5)`` in the program.

A protocol is exact from its text to the tuning word of a synthesizer, so nothing here passes
through a float. In the file the unit belongs to the value; in the program, to the name (``_hz``).
"""

import math
import re
import unicodedata
from collections.abc import Mapping
from fractions import Fraction
from functools import cache, partial
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, PlainSerializer

# Every unit that a description may use. The registry knows nothing else, so that "12.4 Bq" or
# "744 rpm" is refused rather than taken for a frequency.
_UNITS: Final = (
    "nano- = 1e-9 = n-",
    "micro- = 1e-6 = µ- = μ- = u-",
    "milli- = 1e-3 = m-",
    "centi- = 1e-2 = c-",
    "kilo- = 1e3 = k-",
    "mega- = 1e6 = M-",
    "giga- = 1e9 = G-",
    "meter = [length] = m = metre",
    "gram = [mass] = g",
    "second = [time] = s",
    "minute = 60 * second = min",
    "hertz = 1 / second = Hz",
    "volt = [voltage] = V",
    "ohm = [resistance]",
    "cent = [interval]",
    "radian = [angle] = rad",
    "pascal = kilogram / meter / second ** 2 = Pa",
    "kelvin = [temperature] = K",
    "degree_Celsius = kelvin; offset: 273.15 = degC",
)

# What each unit measures and how a quantity of it is written; both appear in error messages.
_KINDS: Final = {
    "Hz": ("a frequency", "12.4 Hz"),
    "V": ("a voltage", "0.5 V"),
    "ohm": ("a resistance", "8 ohm"),
    "m": ("a length", "6.7 um"),
    "s": ("a time", "0.1 s"),
    "cents": ("an interval", "25 cents"),
    "rad": ("an angle", "0.01 rad"),
    "Pa": ("a modulus", "14 GPa"),
    "kg/m^3": ("a density", "520 kg/m^3"),
    "degC": ("a temperature", "25 degC"),
}

_INVISIBLE: Final = frozenset({"Cc", "Cf", "Zl", "Zp", "Cs"})

# No quantity of a bench needs more characters, and a longer one could be made to cost minutes.
_MAX_CHARACTERS: Final = 40

_NUMBER: Final = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,2})?"
# Pint evaluates expressions; only one number and one unit, a word or word/word^3, ever reach it.
_QUANTITY: Final = re.compile(rf"({_NUMBER})\s*([A-Za-zµμ]+(?:/[A-Za-z]+\^3)?)")


@cache
def _registry() -> Any:
    """Pint's registry of the bench's units, made at the first use because pint imports slowly."""
    import pint

    registry = pint.UnitRegistry(None, non_int_type=Fraction)
    for definition in _UNITS:
        registry.define(definition)
    return registry


def shown_value(value: object) -> str:
    """Write a value of a file as an error message shows it: short, and on one line."""
    match value:
        case None:
            return "an empty value"
        case Mapping():
            return "a mapping"
        case list():
            return "a list"
    text = repr(value)
    return text if len(text) <= _MAX_CHARACTERS else f"{text[: _MAX_CHARACTERS - 1]}…"


def invisible_character(text: str) -> str:
    """Return the first invisible character of a text, such as ``U+001B``; empty if none.

    Those of Unicode's categories control (which includes the ends of lines and what a terminal
    acts on), format (which includes what turns the direction of writing), line and paragraph
    separator, and surrogate.
    """
    invisible = next((c for c in text if unicodedata.category(c) in _INVISIBLE), "")
    return f"U+{ord(invisible):04X}" if invisible else ""


def exact_decimal(value: Fraction) -> str:
    """Write a fraction as the decimal number that it is, without exponent or trailing zeros.

    Parameters
    ----------
    value : Fraction
        A number whose denominator has no prime factors but 2 and 5.

    Returns
    -------
    str

    Raises
    ------
    ValueError
        If the decimals of `value` never end.

    Examples
    --------
    >>> exact_decimal(Fraction(62, 5)), exact_decimal(Fraction(-1, 16))
    ('12.4', '-0.0625')
    """
    rest, powers = value.denominator, {2: 0, 5: 0}
    for prime in powers:
        while rest % prime == 0:
            rest //= prime
            powers[prime] += 1
    if rest != 1:
        raise ValueError(f"{value} is not a finite decimal number; keep it as a fraction")
    places = max(powers.values())
    digits = str(abs(value.numerator) * 10**places // value.denominator).zfill(places + 1)
    whole, decimals = digits[: len(digits) - places], digits[len(digits) - places :]
    sign = "-" if value < 0 else ""
    return f"{sign}{whole}.{decimals}" if places else f"{sign}{whole}"


def format_quantity(value: Fraction, unit: str) -> str:
    """Write a quantity so that `parse_quantity` reads the same value again.

    Examples
    --------
    >>> format_quantity(Fraction(62, 5), "Hz")
    '12.4 Hz'
    """
    return f"{exact_decimal(value)} {unit}"


def parse_quantity(value: object, unit: str) -> Fraction:
    """Read a quantity such as ``"80 MHz"`` exactly.

    Parameters
    ----------
    value : object
        What stood in the file. Only a string of one number and one unit is a quantity.
    unit : {'Hz', 'V', 'ohm', 'm', 's', 'cents', 'rad', 'Pa', 'kg/m^3', 'degC'}
        Unit of the result, which is the dimension that is wanted.

    Returns
    -------
    Fraction
        The value in `unit`, exact.

    Raises
    ------
    ValueError
        If the unit is missing, unknown or of another dimension, or the number is not finite or
        absurdly long. The message says how to write it.

    Examples
    --------
    >>> parse_quantity("6.7 um", "m")
    Fraction(67, 10000000)
    """
    kind, example = _KINDS[unit]
    remedy = f"write {kind} such as '{example}'"
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value} is not a finite number with a unit; {remedy}")
    if not isinstance(value, str):
        raise ValueError(f"{shown_value(value)} has no unit; {remedy}")
    if len(value) > _MAX_CHARACTERS:
        raise ValueError(
            f"{shown_value(value)} is longer than {_MAX_CHARACTERS} characters; {remedy}"
        )
    match = _QUANTITY.fullmatch(value.strip())
    if match is None:
        raise ValueError(f"{shown_value(value)} is not a number with a unit; {remedy}")
    number, written_unit = match.groups()
    result = _convert(Fraction(number), written_unit, unit, value, remedy)
    if len(exact_decimal(result)) > _MAX_CHARACTERS:
        raise ValueError(
            f"{shown_value(value)} needs more than {_MAX_CHARACTERS} digits in {unit}; {remedy}"
        )
    return result


def _convert(number: Fraction, written: str, wanted: str, value: str, remedy: str) -> Fraction:
    from pint.errors import DimensionalityError, OffsetUnitCalculusError, UndefinedUnitError

    try:
        return Fraction(_registry().Quantity(number, written).to(wanted).magnitude)
    except (UndefinedUnitError, OffsetUnitCalculusError):
        raise ValueError(f"{value!r} has the unknown unit {written!r}; {remedy}") from None
    except DimensionalityError:
        raise ValueError(f"{value!r} is not {_KINDS[wanted][0]}; {remedy}") from None


def _reader(unit: str) -> BeforeValidator:
    return BeforeValidator(partial(parse_quantity, unit=unit))


def _writer(unit: str) -> PlainSerializer:
    return PlainSerializer(partial(format_quantity, unit=unit), return_type=str)


Frequency = Annotated[Fraction, _reader("Hz"), _writer("Hz")]
Voltage = Annotated[Fraction, _reader("V"), _writer("V")]
Resistance = Annotated[Fraction, _reader("ohm"), _writer("ohm")]
Length = Annotated[Fraction, _reader("m"), _writer("m")]
Time = Annotated[Fraction, _reader("s"), _writer("s")]
Interval = Annotated[Fraction, _reader("cents"), _writer("cents")]
Angle = Annotated[Fraction, _reader("rad"), _writer("rad")]
Modulus = Annotated[Fraction, _reader("Pa"), _writer("Pa")]
Density = Annotated[Fraction, _reader("kg/m^3"), _writer("kg/m^3")]
Temperature = Annotated[Fraction, _reader("degC"), _writer("degC")]
