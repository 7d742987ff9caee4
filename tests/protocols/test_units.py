"""Quantities are exact, and nothing but a number with a fitting unit is one."""

from decimal import Decimal
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.units import (
    exact_decimal,
    format_quantity,
    invisible_character,
    parse_quantity,
    shown_value,
)

# Powers of ten that the symbols stand for (SI brochure, table 7), written out independently.
POWERS = {"n": -9, "u": -6, "µ": -6, "μ": -6, "m": -3, "c": -2, "": 0, "k": 3, "M": 6, "G": 9}
UNITS = ("Hz", "V", "m", "s", "rad")

decimals = st.decimals(
    min_value=-(10**9), max_value=10**9, places=6, allow_nan=False, allow_infinity=False
)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("0.5 V", "V", Fraction(1, 2)),
        ("12.4 Hz", "Hz", Fraction(62, 5)),
        ("25 cents", "cents", Fraction(25)),
        ("1 cent", "cents", Fraction(1)),
        ("80 MHz", "Hz", Fraction(80_000_000)),
        ("1 uHz", "Hz", Fraction(1, 10**6)),
        ("6.7 um", "m", Fraction(67, 10**7)),
        ("6.7 µm", "m", Fraction(67, 10**7)),
        ("650 nm", "m", Fraction(65, 10**8)),
        ("0.1 s", "s", Fraction(1, 10)),
        ("1.5 min", "s", Fraction(90)),
        ("10 mrad", "rad", Fraction(1, 100)),
        ("16V", "V", Fraction(16)),
        (" -2.5e-1  V ", "V", Fraction(-1, 4)),
        (".5 volt", "V", Fraction(1, 2)),
        # 1 GHz / 2^32, the step of a binary synthesizer, has 23 decimals.
        ("0.23283064365386962890625 Hz", "Hz", Fraction(10**9, 2**32)),
    ],
)
def test_reads_exactly(text, unit, value):
    assert parse_quantity(text, unit) == value


@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        (12.4, "12.4 has no unit"),
        (12, "12 has no unit"),
        (True, "True has no unit"),
        (None, "an empty value has no unit"),
        ([12], "a list has no unit"),
        ({"Hz": 12}, "a mapping has no unit"),
        (float("nan"), "nan is not a finite number"),
        (float("-inf"), "-inf is not a finite number"),
        ("12.4", "'12.4' is not a number with a unit"),
        ("nan Hz", "'nan Hz' is not a number with a unit"),
        ("inf Hz", "'inf Hz' is not a number with a unit"),
        ("12,4 Hz", "is not a number with a unit"),
        ("1_000 Hz", "is not a number with a unit"),
        ("٣ Hz", "is not a number with a unit"),
        ("12.4 Hz * 2", "is not a number with a unit"),
        ("12.4 rad/s", "is not a number with a unit"),
        ("__import__('os') Hz", "is not a number with a unit"),
        ("Hz", "is not a number with a unit"),
        ("", "is not a number with a unit"),
        ("12.4 mhz", "unknown unit 'mhz'"),
        ("744 rpm", "unknown unit 'rpm'"),
        ("12.4 Bq", "unknown unit 'Bq'"),
        ("12.4 V", "is not a frequency"),
        ("80 ms", "is not a frequency"),
        ("25 cents", "is not a frequency"),
        ("1e40 Hz", "needs more than 40 digits"),
        ("1e-99 Hz", "needs more than 40 digits"),
        ("1e999 Hz", "is not a number with a unit"),
        ("1e999999999 Hz", "is not a number with a unit"),
        ("1" * 100_000 + " Hz", "is longer than 40 characters"),
    ],
)
def test_refuses_with_a_remedy(value, complaint):
    with pytest.raises(ValueError, match=r"write a frequency such as '12\.4 Hz'") as refusal:
        parse_quantity(value, "Hz")
    assert complaint in str(refusal.value)
    assert len(str(refusal.value)) < 150
    assert "\n" not in str(refusal.value)


@given(decimals, st.sampled_from(sorted(POWERS)), st.sampled_from(UNITS))
@settings(deadline=None)
def test_prefixes_are_exact_powers_of_ten(number, prefix, unit):
    value = parse_quantity(f"{number:f} {prefix}{unit}", unit)
    assert value == Fraction(number) * Fraction(10) ** POWERS[prefix]


@given(decimals, st.sampled_from((*UNITS, "cents")))
@settings(deadline=None)
def test_what_is_written_reads_back(number, unit):
    value = Fraction(number)
    assert parse_quantity(format_quantity(value, unit), unit) == value


@given(st.text(max_size=60))
@settings(deadline=None)
def test_any_text_is_a_quantity_or_a_value_error(text):
    try:
        value = parse_quantity(text, "Hz")
    except ValueError:
        return
    assert parse_quantity(format_quantity(value, "Hz"), "Hz") == value


@given(st.integers(), st.integers(0, 40), st.integers(0, 40))
def test_exact_decimal_is_what_decimal_reads(numerator, twos, fives):
    value = Fraction(numerator, 2**twos * 5**fives)
    text = exact_decimal(value)
    assert Fraction(Decimal(text)) == value
    assert "e" not in text.lower()
    assert "." not in text or not text.endswith("0")


@pytest.mark.parametrize("value", [Fraction(1, 3), Fraction(-22, 7)])
def test_exact_decimal_refuses_endless_decimals(value):
    with pytest.raises(ValueError, match="not a finite decimal"):
        exact_decimal(value)


def test_a_long_value_is_shown_short():
    assert shown_value("x" * 1000) == "'" + "x" * 38 + "…"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("Vandoren V12, été, 日本\u00a012 😀", ""),
        ("", ""),
        ("a\x1b[2J", "U+001B"),
        ("a\nb", "U+000A"),
        ("\u202eV 5", "U+202E"),
        ("a\u200bb\x00", "U+200B"),
        ("\ud800", "U+D800"),
    ],
)
def test_invisible_characters_are_found(text, found):
    assert invisible_character(text) == found
