"""One description of a table gives terminal, HTML, CSV and records."""

import io
import math

import pytest
from rich.console import Console

from reports.fit_tables import _per_volt
from reports.own_output import page_kind
from reports.pages import Picture, render, table_html
from reports.tables import Column, Table, records_table, terminal_table, write_csv

COLUMNS = (
    Column("mode", "mode", meaning="its name"),
    Column("hz", "frequency", "Hz", ".1f"),
    Column("loss", "loss", format=lambda pair: f"{pair[0]:.2f} ± {pair[1]:.2f}"),
)
HOSTILE = "<script>\x1b[31m</script>&\"'"
ESCAPED = "&lt;script&gt;\\x1b[31m&lt;/script&gt;&amp;&#34;&#39;"
TABLE = Table(COLUMNS, (("F1", 1996.25, (0.03, 0.01)), ("T1", math.nan, None)), "A title", "A note")


def printed(table, width=80):
    console = Console(width=width, file=io.StringIO())
    console.print(terminal_table(table))
    return console.file.getvalue()


def test_a_cell_shows_its_value_or_nothing():
    assert TABLE.texts == [["F1", "1996.2", "0.03 ± 0.01"], ["T1", "", ""]]


def test_records_hold_values_by_key():
    assert TABLE.records()[0] == {"mode": "F1", "hz": 1996.25, "loss": (0.03, 0.01)}


def test_records_become_a_table_again():
    table = records_table("A title", [{"mode": "F1", "hz": 1996.25}, {"mode": "T1", "hz": "none"}])
    assert table.texts == [["F1", "1996.25"], ["T1", "none"]]
    assert records_table("Nothing", []).texts == []


def test_columns_are_selected_in_the_order_asked_for():
    assert TABLE.select("hz", "mode").texts == [["1996.2", "F1"], ["", "T1"]]


def test_the_terminal_shows_units_and_never_cuts_numbers():
    text = printed(TABLE)
    for word in ("A title", "A note", "frequency", "(Hz)", "0.03 ± 0.01"):
        assert word in text
    long = Table(COLUMNS[:2], (("a name that is much too long", 1996.25),))
    assert "1996.2" in printed(long, width=24)


def test_the_last_row_may_sum_up():
    total = Table(COLUMNS[:2], (("F1", 1.0), ("all", 1.0)), total=True)
    lines = printed(total).rstrip().splitlines()
    assert lines[-1].split() == ["all", "1.0"]
    assert not lines[-2].strip()
    assert '<tr class="total">' in table_html(total)


def test_csv_has_empty_cells_for_what_is_not_known():
    file = io.StringIO()
    write_csv(file, COLUMNS[:2], [("a,b", 1.0), ("c", None), ("d", math.nan)])
    assert file.getvalue() == '"a,b",1.0\nc,\nd,\n'


def test_html_says_what_the_columns_mean_and_escapes_every_value():
    column = Column(HOSTILE, HOSTILE, HOSTILE, meaning=HOSTILE)
    html = table_html(Table((column,), ((HOSTILE,),), HOSTILE, HOSTILE, row_kinds=("near",)))
    assert "<script" not in html
    # Label, caption, heading with unit and title, cell, note, term and meaning.
    assert html.count(ESCAPED) == 9
    assert '<tr class="near">' in html
    assert '<th scope="col" class="number">frequency (Hz)</th>' in table_html(TABLE)


@pytest.mark.parametrize("template", ["run.html"])
def test_a_page_begins_with_the_mark_of_its_kind(template):
    kind = page_kind("report")
    page = render(template, kind, HOSTILE, no_fit=HOSTILE, cane=None, sweeps=())
    assert page.startswith(kind.mark)
    assert "<script" not in page
    # Title, heading and warning.
    assert page.count(ESCAPED) == 3


def test_a_picture_is_part_of_the_page():
    assert Picture(b"\x00", "alt").source == "data:image/png;base64,AA=="


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ((626.34, 2.04), "626.3 ± 2.0"),
        ((11.83, 0.0374), "11.830 ± 0.037"),
        ((2.2, 0.132), "2.20 ± 0.13"),
        ((43.81, 25.0), "43.8 ± 25.0"),
        ((43.81, None), "43.8"),
    ],
)
def test_an_error_per_volt_is_never_printed_as_none(value, text):
    assert _per_volt(value) == text
