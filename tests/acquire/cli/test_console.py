"""Consoles: text stays text, and a terminal that is gone ends nothing."""

import io
import json
import os
import pty
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console, Group
from rich.panel import Panel
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from acquire.cli.console import (
    messages,
    results,
    show_json,
    show_message,
)
from reports.plain_text import plain

ROOT = Path(__file__).parents[3]
HOSTILE = "[bold red]R07[/] :100: \x1b]0;x\x07\x1b[31m\x9b2J\u202e\udcff"
SHOWN = "[bold red]R07[/] :100: \\x1b]0;x\\x07\\x1b[31m\\x9b2J\\u202e\\udcff"


# --- Text --------------------------------------------------------------------------------------


def test_a_line_is_shown_as_text(capsys):
    results().print(HOSTILE, soft_wrap=True)
    # Rich itself drops the bell.
    assert capsys.readouterr().out == SHOWN.replace("\\x07", "") + "\n"


def test_a_message_is_shown_as_text(capsys):
    show_message(f"first\n{HOSTILE}")
    assert capsys.readouterr().err == "first\n" + SHOWN.replace("\\x07", "") + "\n"


@pytest.mark.parametrize("cell", [HOSTILE, Text(HOSTILE), plain(HOSTILE)], ids=type)
def test_text_within_tables_is_shown_as_text(capsys, cell):
    table = Table("head", title=cell if isinstance(cell, str) else "title")
    table.add_row(cell)
    results().print(Group(Panel(table), cell), width=200)
    written = capsys.readouterr().out
    assert written.count("[bold red]R07[/] :100: \\x1b]0;x") >= 2
    assert written.replace("\n", "").isprintable()


def test_a_table_of_plain_cells_stays_straight(capsys):
    table = Table("head", "after")
    table.add_row(plain(HOSTILE), plain(7))
    results().print(table, width=200)
    written = capsys.readouterr().out
    assert SHOWN in written
    assert len({len(line.rstrip()) for line in written.splitlines() if line.strip()}) == 1


def test_richs_own_control_codes_stay(monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    for name in ("NO_COLOR", "TTY_COMPATIBLE", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    console = messages()
    with Progress(console=console, auto_refresh=False) as progress:
        progress.add_task("work", total=2)
        console.print(Text("red \x1b[31m", style="red"))
    written = terminal.getvalue()
    assert "\x1b[31mred \\x1b[31m\x1b[0m" in written
    # The cursor is hidden while the bar is shown, and lines are erased for it.
    assert "\x1b[?25l" in written
    assert "\x1b[2K" in written
    assert "\x1b[?25h" in written


def test_json_is_ascii(capsys):
    show_json({"note": HOSTILE + "ü"})
    written = capsys.readouterr().out
    assert json.loads(written) == {"note": HOSTILE + "ü"}
    assert written.isascii()
    assert written.replace("\n", "").isprintable()


def test_characters_that_an_encoding_lacks_are_escaped(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    results().print("± 3 µm")
    assert raw.getvalue() == b"\\xb1 3 \\xb5m\n"


def test_a_process_without_streams_prints_nothing(monkeypatch):
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    show_message("lost")
    results().print("lost")
    show_json("lost")


def test_every_console_is_made_here():
    """Another console would let escape sequences through, and fail where a terminal is gone."""
    packages = ("acquire", "blind", "diagnosis", "drivers", "fitting", "holography", "physics")
    sources = [path for name in packages for path in (ROOT / name).rglob("*.py")]
    other = re.compile(r"\b(Console|get_console|typer\.s?echo|click\.s?echo)\(")
    found = [path.name for path in sources if other.search(path.read_text("utf-8"))]
    assert found == ["console.py"]


# --- Streams that are gone ---------------------------------------------------------------------

# Waits until it hears that its streams are gone; then works with a live bar, prints, and notes
# that it came to its end.
WORK = """
import sys, threading, time
from pathlib import Path
from acquire.cli.console import messages, results, show_json, show_message
from rich.progress import Progress

trouble = []
threading.excepthook = lambda args: trouble.append(repr(args.exc_value))
with Progress(console=messages(), refresh_per_second=50) as progress:
    bar = progress.add_task("working", total=10)
    progress.refresh()
    Path("ready").touch()
    while not Path("gone").exists():
        time.sleep(0.01)
    for _ in range(10):
        show_message("a message\\n" * 100)
        print("something of a library", file=sys.stderr)
        progress.advance(bar)
        time.sleep(0.03)
show_message("done")
results().print("a result\\n" * 10000)
show_json({"status": "complete"})
Path("end").write_text(repr(trouble))
"""


def _started(folder, **streams):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm"}
    process = subprocess.Popen(
        [sys.executable, "-c", WORK], cwd=folder, env=environment, stdin=subprocess.DEVNULL,
        **streams,
    )  # fmt: skip
    deadline_s = time.monotonic() + 30
    while not (folder / "ready").exists() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return process


def _came_to_its_end(process, folder):
    (folder / "gone").touch()
    assert process.wait(timeout=30) == 0
    assert (folder / "end").read_text() == "[]"


def test_a_closed_terminal_ends_nothing(tmp_path):
    ours, theirs = pty.openpty()
    process = _started(tmp_path, stdout=theirs, stderr=theirs)
    os.close(theirs)
    assert b"working" in os.read(ours, 4096)
    os.close(ours)
    _came_to_its_end(process, tmp_path)


def test_a_pipe_that_nothing_reads_ends_nothing(tmp_path):
    process = _started(tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    process.stderr.close()
    _came_to_its_end(process, tmp_path)


def test_a_full_disk_loses_messages_and_ends_nothing(tmp_path):
    with open("/dev/full", "w") as full:
        process = _started(tmp_path, stdout=subprocess.DEVNULL, stderr=full)
    _came_to_its_end(process, tmp_path)


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_a_result_that_is_lost_on_a_full_disk_is_a_failure(options):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "acquire", "effects", *options], cwd=ROOT, stdout=full,
            stderr=subprocess.PIPE, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "No space left" in line
    assert "standard output" in line


def test_a_plain_console_would_fail_here():
    """Guards the tests above: what they mend is there."""
    console = Console(file=open("/dev/full", "w"))  # noqa: SIM115  # closed below
    with pytest.raises(OSError, match="No space left"):
        console.print("lost")
    with pytest.raises(OSError, match="No space left"):
        console.file.close()
