"""What verbs write: nothing of others is replaced, and a bad disk is one line and status 1."""

import errno
import json
import os
import re
import shutil
from pathlib import Path

import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind.cases import drawn_label, seal
from fitting.forward import (
    PaperModel,
    hz_of,
    viscoelastic_cents,
)
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    viscoelastic_cane,
)
from reproduction.rows import Group, from_text
from reproduction.whole import PaperComparison

MINE = b"mine, and dear to me"
HOSTILE = "R7[bold]\x1b]0;x\x1b[31m\x9b2J\u202e <script>alert(1)</script>$\\frac$"
SHOWN = "R7[bold]\\x1b]0;x\\x1b[31m\\x9b2J\\u202e <script>alert(1)</script>$\\frac$"


@pytest.fixture
def runs(measured, folder):
    """Copies of the two measured runs, where commands are given."""
    return [Path(shutil.copy(run, folder)).relative_to(folder) for run in (measured.a, measured.b)]


@pytest.fixture
def table(folder):
    """Resonances of one reed, by the paper's model."""
    model, lines = PaperModel(iterations=30), ["reed,series,mode,hz"]
    for series in Series:
        cane = viscoelastic_cane(Components(0.5, -0.4, 0.3, 0.2), series)
        hz = hz_of(viscoelastic_cents(model, cane, series))
        lines += [f"R1,{series},{name},{f}" for name, f in zip(model.modes, hz, strict=True)]
    Path("reeds.csv").write_text("\n".join(lines))
    return Path("reeds.csv")


@pytest.fixture
def paper(monkeypatch):
    """A comparison with the paper that takes no minute; how often it was computed."""
    calls = []
    rows = (from_text("Table 1", "x", 5, 5.1, 0.2, "Hz"),)

    def compare(announce):
        calls.append(announce)
        return PaperComparison(
            (Group("numbers", "Numbers: some", "How.", rows),), ("One finding.",)
        )

    monkeypatch.setattr("reproduction.whole.compare_paper", compare)
    return calls


@pytest.fixture
def sealed(folder):
    """Options of `blind score` for a sealed case and its answer."""
    published, kept = seal([drawn_label(0, 0, 11)])
    for name in ("cases", "answers"):
        Path(name).mkdir()
    Path("cases/sealed.json").write_text(json.dumps(published))
    Path("key.json").write_text(json.dumps(kept))
    said = {"verdict": "none", "probability": {"none": 0.9, "unknown": 0.1}, "likely": [["none"]],
            "effects": {}, "effects_named": [], "explained_fraction": {"by": {}}}  # fmt: skip
    (name,) = published["cases"]
    Path(f"answers/{name}.json").write_text(json.dumps(said))
    return ["cases", "--answers", "answers", "--key", "key.json"]


def _refused(said, *words):
    assert said.status == 2
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert line.startswith("acquire: ")
    for word in words:
        assert word in line


# --- Files of others ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("verb", "option"),
    [
        (["report", "R07-A.h5"], "--out"),
        (["diagnose", "R07-A.h5"], "--out"),
        (["diagnose", "R07-A.h5"], "--next"),
        (["population", "reeds.csv", "--model", "paper"], "--out"),
        (["modes", "--mesh", "fast"], "--pictures"),
        (["paper"], "--out"),
        (["blind", "score", "cases", "--answers", "answers", "--key", "key.json"], "--picture"),
    ],
    ids=lambda value: "".join(value[:2]),
)
@pytest.mark.usefixtures("table", "sealed")
def test_no_verb_replaces_a_run_or_a_file_of_others(cli, runs, folder, paper, verb, option):
    victims = {"B.png": runs[1].read_bytes(), "mine.png": MINE}
    for name, content in victims.items():
        Path(name).write_bytes(content)
    before = sorted(folder.rglob("*"))
    for name in victims:
        _refused(cli(*verb, option, name), name, f"choose another place with {option}")
    assert {name: Path(name).read_bytes() for name in victims} == victims
    assert sorted(folder.rglob("*")) == before
    assert paper == []


def test_an_input_is_never_an_output(cli, runs, folder):
    Path("link.html").symlink_to(runs[0])
    Path("hard.html").hardlink_to(runs[0])
    before = runs[0].read_bytes()
    for name in (runs[0], "link.html", "hard.html"):
        _refused(cli("report", *runs, "--out", name), "input of this command", "--out")
        _refused(cli("diagnose", runs[0], "--out", name), "input of this command", "--out")
    _refused(cli("diagnose", runs[0], "--out", "x", "--next", "x"), "same name")
    _refused(cli("diagnose", runs[0], "--out", "x-sweep.yaml", "--next", "x.yaml"), "same name")
    _refused(cli("population", ".", "--out", "resonances.csv"), "same name")
    assert runs[0].read_bytes() == before


@pytest.mark.parametrize("name", ["R07-A.html", "R07-A.contact-sheet.png", "R07-A.modes.png"])
def test_a_report_leaves_files_of_its_names_alone(cli, runs, name):
    Path(name).write_bytes(MINE)
    _refused(cli("report", runs[0]), name, "move it away")
    assert Path(name).read_bytes() == MINE


@pytest.mark.parametrize("name", ["resonances.csv", "resonances-components.csv"])
def test_a_population_leaves_tables_of_its_names_alone(cli, runs, name):
    """Also a table of resonances that a person has typed, with all the columns that are read."""
    typed = b"reed,series,mode,hz,error_cents\nR1,A,F1,1850.000,3\n"
    Path(name).write_bytes(typed)
    _refused(cli("population", "."), name, "move it away")
    assert Path(name).read_bytes() == typed


def test_a_table_of_components_leaves_files_of_its_name_alone(cli, table):
    Path("reeds-components.csv").write_bytes(MINE)
    _refused(cli("population", table, "--model", "paper"), "reeds-components.csv", "--out")
    assert Path("reeds-components.csv").read_bytes() == MINE


def test_a_page_of_the_paper_leaves_a_file_of_its_name_alone(cli, folder, paper):
    Path("paper.html").write_bytes(MINE)
    _refused(cli("paper"), "paper.html", "move it away")
    assert paper == []


@pytest.mark.parametrize("name", ["x.html", "x.response.png"])
def test_nothing_is_measured_if_its_report_cannot_be_kept(
    cli, folder, protocol_file, bench_file, name
):
    sweep = [protocol_file(), "--bench", bench_file()]
    Path(name).write_bytes(MINE)
    before = sorted(folder.rglob("*"))
    _refused(cli("run", *sweep, "--out", "x.h5"), name, "move it away", "--out")
    assert sorted(folder.rglob("*")) == before
    assert Path(name).read_bytes() == MINE
    # A run file of the name that its page would have.
    _refused(cli("run", *sweep, "--out", "y.html"), "y.html", "input of this command")
    assert sorted(folder.rglob("*")) == before


def test_blind_cases_and_their_key_replace_nothing(cli, folder):
    make = ["blind", "make", "--tier", "0", "--count", "1", "--seed", "1"]
    Path("there").mkdir()
    Path("key.json").write_bytes(MINE)
    Path("link.json").symlink_to("nothing.json")
    before = sorted(folder.rglob("*"))
    _refused(cli(*make, "there"), "there", "name another place")
    for key in ("key.json", "link.json"):
        _refused(cli(*make, "cases", "--key", key), key, "name another place")
    _refused(cli(*make, "cases", "--key", "no/key.json"), "no/key.json", "no folder")
    assert sorted(folder.rglob("*")) == before
    assert Path("key.json").read_bytes() == MINE


# --- Disks that refuse -------------------------------------------------------------------------


@pytest.fixture
def full_disk(monkeypatch):
    """Return a function that fills the disk."""

    def fsync(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    return lambda: monkeypatch.setattr(os, "fsync", fsync)


@pytest.mark.parametrize(
    ("verb", "written"),
    [
        (["report", "RUN", "--out", "x.html"], "x.html"),
        (["population", "reeds.csv", "--model", "paper"], "reeds-components.csv"),
        (["modes", "--mesh", "fast", "--pictures", "x.png"], "x.png"),
        (["paper"], "paper.html"),
        (["blind", "score", "cases", "--answers", "answers", "--key", "key.json", "--picture",
          "x.png"], "x.png"),
    ],
    ids=["report", "population", "modes", "paper", "score"],
)  # fmt: skip
@pytest.mark.usefixtures("table", "sealed", "paper")
def test_a_full_disk_is_one_line_and_leaves_what_was_there(
    cli, measured, folder, full_disk, verb, written
):
    verb = [measured.a if word == "RUN" else word for word in verb]
    done = cli(*verb)
    assert done.status == 0, done.err
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert folder / written in before
    full_disk()
    said = cli(*verb)
    assert said.status == 1
    lines = [line for line in said.err.splitlines() if line.startswith("acquire: ")]
    assert len(lines) == 1
    assert said.err.splitlines()[-1] == lines[0]
    assert "No space left" in lines[0]
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.slow
def test_a_run_is_reported_even_if_its_report_does_not_fit(
    cli, folder, protocol_file, bench_file, monkeypatch
):
    def refuse(output):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("reports.own_output._keep_mode", lambda path, descriptor: refuse(path))
    said = cli("run", protocol_file(), "--bench", bench_file(), "--out", "x.h5", "--json")
    assert said.status == 1
    assert said.json["status"] == "complete"
    # Nine steps hardly identify a mode: what is written is the report, or else a contact sheet.
    assert re.match(
        r"acquire: x\.(html|contact-sheet\.png): cannot be written \(No space left",
        said.err.splitlines()[-1],
    )


def test_a_set_of_cases_that_does_not_fit_leaves_nothing(cli, folder, full_disk):
    full_disk()
    said = cli("blind", "make", "cases", "--tier", "0", "--count", "1", "--seed", "1")
    assert said.status == 1
    (line,) = said.err.splitlines()
    assert "No space left" in line
    assert os.listdir(folder) == []


def test_a_disk_that_fails_while_it_is_read_is_one_line(cli, folder, monkeypatch):
    def refuse(*arguments):
        raise OSError(errno.EIO, os.strerror(errno.EIO), "runs\n/R07.h5")

    monkeypatch.setattr("reports.run_tables.runs_table", refuse)
    said = cli("list", ".")
    assert said.status == 1
    (line,) = said.err.splitlines()
    assert "runs\\n/R07.h5" in line
    assert "Input/output error" in line


# --- Names and notes ---------------------------------------------------------------------------


@pytest.mark.slow
def test_what_people_wrote_is_text_everywhere(cli, folder, protocol_file, bench_file, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    protocol, run = protocol_file(), f"{HOSTILE[:20]}.h5"
    # Characters that do not print are refused in a protocol; markup is text there as well.
    named = json.dumps("Sweep " + re.sub(r"[^ -~]", "", HOSTILE))
    protocol.write_text(f"name: {named}\n" + protocol.read_text().replace("name:", "# ", 1))
    said = cli("run", protocol, "--bench", bench_file(), "--reed", HOSTILE, "--note", HOSTILE,
               "--operator", HOSTILE, "--out", run)  # fmt: skip
    # Nine steps on a tiny sensor are not enough for a fit; the page has the pictures.
    assert said.status in (0, 1)
    verbs = [["show", run], ["list", "."], ["plan", protocol], ["fit", f"gone{HOSTILE}"]]
    verbs += [[verb, HOSTILE] for verb in ("report", "plan", "population", "pause", "diagnose")]
    shown = [said, *(cli(*verb) for verb in verbs)]
    for said in shown:
        for text in (said.out, said.err):
            assert text.replace("\n", "").isprintable()
            assert "\N{COLLISION SYMBOL}" not in text
    assert SHOWN in shown[1].out
    assert SHOWN in shown[2].out
    assert cli("show", run, "--json").json["note"] == HOSTILE
    (page,) = folder.glob("*.html")
    html = page.read_text("utf-8")
    assert html.replace("\n", "").isprintable()
    assert "<script" not in html
    assert "\\x1b]0;x" in html
