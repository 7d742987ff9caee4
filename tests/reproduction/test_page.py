"""The page, its summary, and the sentences: complete, self-contained, escaped."""

import io
import re
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure
from rich.console import Console

from reports.errors import OutputRefusedError
from reports.own_output import require_writable
from reports.tables import terminal_table
from reproduction.findings import findings
from reproduction.groups.cane import compare_cane
from reproduction.groups.chain import compare_hypotheses
from reproduction.groups.factors import compare_factors
from reproduction.groups.frequencies import compare_frequencies
from reproduction.groups.mesh_evidence import compare_meshes
from reproduction.groups.metamodel import compare_metamodel, reference_hz
from reproduction.groups.sensitivities import compare_sensitivities
from reproduction.groups.sweep import compare_sweep
from reproduction.page import (
    counts_table,
    document,
    page_output,
    shown_number,
    write_page,
)
from reproduction.rows import (
    Drawing,
    Group,
    from_text,
    interval_from_text,
    not_printed,
    not_reproducible,
)
from reproduction.whole import PaperComparison

# A reed is built, and populations are drawn.
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def comparison():
    def draw():
        figure = Figure(figsize=(1, 1))
        figure.add_subplot().plot([0, 1])
        return figure

    rows = (
        from_text("Table <b>", "as printed", 5, 5.1, 0.2, "mm"),
        from_text("Table 1", "a little off", 5, 5.3, 0.2),
        from_text("Table 1", "off", 5, 5.7, 0.2),
        from_text("Table 1", "far off", 5, 25, 0.2, remark="by -3 & more"),
        from_text("Table 1", "counted wrong", 5, 6, 0),
        from_text("Table 1", "refuted", 5, 25, 0.2, refuted=True),
        interval_from_text("Table 1", "an octave", 440, 880, 1),
        not_printed("Table 1", "ours alone", 12345.6, "Hz"),
        not_reproducible("Table 1", "theirs alone", 0.25, "%", "no data"),
    )
    groups = (
        Group("first", "First group: more words", "How.", rows, (Drawing("A & B", draw),)),
        Group("second", "Second", "So.", rows[:1]),
    )
    return PaperComparison(groups, ("One < two.", "Three."))


class _Page(HTMLParser):
    """Cells of every row of every table, and the classes of the rows."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.sources, self.open_tags = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag not in ("meta", "img", "br"):
            self.open_tags.append(tag)
        if tag == "tr":
            self.rows.append((attributes.get("class", ""), []))
        if tag in ("td", "th"):
            self.rows[-1][1].append("")
        self.sources += [attributes[k] for k in ("src", "href") if k in attributes]

    def handle_endtag(self, tag):
        assert self.open_tags.pop() == tag

    def handle_data(self, data):
        if {"td", "th"} & set(self.open_tags):
            self.rows[-1][1][-1] += data


@pytest.fixture(scope="module")
def page(comparison):
    return _Page(document(comparison))


def test_every_row_is_there_once_with_its_shade(page, comparison):
    rows = [(shade, cells) for shade, cells in page.rows if len(cells) == 9]
    rows = [(shade, cells) for shade, cells in rows if cells[0] != "table"]
    shades = {cells[1]: shade for shade, cells in rows}
    assert len(rows) == len(comparison.rows)
    assert shades == {
        "as printed": "",
        "a little off": "near",
        "off": "far",
        "far off": "farthest",
        "counted wrong": "farthest",
        "refuted": "refuted",
        "an octave": "farthest",
        "ours alone": "",
        "theirs alone": "",
    }


def test_cells_say_what_the_rows_say(page):
    cells = {cells[1]: cells for _, cells in page.rows if len(cells) == 9}
    assert cells["as printed"] == [
        "Table <b>", "as printed", "5", "5.1", "mm", "+0.1", "0.2", "text", "",
    ]  # fmt: skip
    assert cells["an octave"][5] == "+1200 cents"
    assert cells["ours alone"][2:7] == ["", "12346", "Hz", "", ""]
    assert cells["theirs alone"][2:] == ["0.25", "", "%", "", "", "none", "no data"]
    assert cells["far off"][8] == "by −3 & more"


def test_the_page_is_closed_and_needs_nothing_else(page, comparison):
    assert page.open_tags == []
    assert {source.partition(":")[0] for source in page.sources} == {"#first", "#second", "data"}
    text = document(comparison)
    assert "<script" not in text
    assert "One &lt; two." in text


def test_the_summary_counts(comparison):
    text = re.sub(r"<[^>]+>", " ", document(comparison))
    assert re.search(r"9 comparisons .* 8 of them .* 2 are reproduced", text)
    assert re.search(r"5 differ, and 1 are refuted\. 1 cannot be computed", text)


def test_what_agrees_unfolds(comparison):
    text = document(comparison)
    assert "The other 2 rows: 1 reproduced, 1 not reproducible" in text
    assert "<summary>1 rows: 1 reproduced</summary>" in text


def test_the_table_of_the_command_line_adds_up(comparison):
    console = Console(width=120, file=io.StringIO())
    console.print(terminal_table(counts_table(comparison)))
    lines = console.file.getvalue().strip().splitlines()
    assert [word for word in lines[-1].split() if word.isdigit()] == ["2", "5", "1", "1", "1"]
    assert any("First group " in line for line in lines)
    assert not any("more words" in line for line in lines)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, ""),
        (0.0, "0"),
        (-12.3456, "−12.35"),
        (0.00090472, "0.0009047"),
        (2208.31, "2208.3"),
        (10300.4, "10300"),
        (1e7, "10000000"),
    ],
)
def test_numbers_are_short(value, text):
    assert shown_number(value) == text


def test_a_page_is_written_and_replaced(comparison, tmp_path):
    page = tmp_path / "page.html"
    write_page(PaperComparison(comparison.groups[:1], ()), page)
    require_writable([page_output(page)])
    write_page(comparison, page)
    assert page.read_text(encoding="utf-8") == document(comparison)


def test_places_that_cannot_be_written_are_refused(comparison, tmp_path):
    for page, words in (
        (tmp_path / "nowhere" / "page.html", "there is no folder"),
        (tmp_path, "it is a folder"),
    ):
        with pytest.raises(OutputRefusedError, match=words) as refused:
            require_writable([page_output(page)])
        assert "choose another place with --out" in str(refused.value)
        with pytest.raises(OutputRefusedError, match="choose another place with --out"):
            write_page(comparison, page)


def test_a_page_in_a_locked_folder_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(OutputRefusedError, match="permission denied"):
        require_writable([page_output(tmp_path / "page.html")])


def test_sentences_carry_the_numbers_of_their_rows(
    numbers, models, network, evidence, printed_sensitivities, table_9
):
    groups = (
        compare_sweep(numbers, models.adjusted),
        compare_sensitivities(numbers, printed_sensitivities, evidence),
        compare_metamodel(numbers, models, network, evidence),
        compare_meshes(numbers, evidence, reference_hz(table_9)),
        compare_frequencies(numbers, models),
        compare_factors(numbers, models),
        compare_cane(numbers, models),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("reproduction.groups.chain._POPULATIONS", 2)
        chain = compare_hypotheses(numbers, models, lambda words: None)
    said = findings(row for group in (*groups, chain) for row in group.rows)
    assert len(said) == 8
    assert "converged ones lie −17, +0 and +0 cents from Table 9" in said[0]
    assert not re.search(r"\bnan\b", " ".join(said))
    assert "of H1, 76.2 cents, Table 1 alone leaves 79.0 cents" in said[5]
