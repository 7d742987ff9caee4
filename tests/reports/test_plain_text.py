"""Text from outside: everything that does not print is shown as its escape."""

import pytest

from reports.plain_text import one_line, visible


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("R07", "R07"),
        ("Ré 07 µ′ 竹\n簧", "Ré 07 µ′ 竹\n簧"),
        ("trop dure\u00a0!\u202f\u3000", "trop dure\u00a0!\u202f\u3000"),
        ("\x1b]0;x\x07", "\\x1b]0;x\\x07"),
        ("\x9b31m\x85\x7f", "\\x9b31m\\x85\\x7f"),
        ("a\rb\tc\x08\0", "a\\rb\\tc\\x08\\x00"),
        ("\u202e\u2066\u200f\u200b\ufeff", "\\u202e\\u2066\\u200f\\u200b\\ufeff"),
        ("\U000e0041\ue000\u2028\u2029", "\\U000e0041\\ue000\\u2028\\u2029"),
        ("\udcff", "\\udcff"),
    ],
)
def test_what_does_not_print_becomes_its_escape(text, shown):
    assert visible(text) == shown
    assert visible(text).encode()


def test_a_line_stays_one_line():
    assert one_line("a\nb\x1b") == "a\\nb\\x1b"
