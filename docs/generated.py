"""Parts of pages that are generated from the code, so that they cannot go out of date.

A page holds a marker such as ``<!-- generated: verbs -->``; the site shows in its place what the
function of that name in `PARTS` returns, as Markdown.
"""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import typer
from reference_keys import Key, Table, tables

from acquire.cli.main import app
from physics.effects.catalogue import CATALOGUE
from physics.parameters.disorder import CATALOGUE as DISORDER
from reports.effects import effects_table

ROOT = Path(__file__).parents[1]
_TABLE_CLASSES = (
    ("key", "keys"),
    ("option", "options"),
    ("effect", "effects"),
    ("disorder", "effects"),
)
_MARKER = re.compile(r"<!-- generated: ([a-z-]+) -->")


def fill_in(page: str) -> str:
    """Return the Markdown of a page with all of its markers replaced."""
    return _MARKER.sub(lambda marker: _with_classes(PARTS[marker[1]]()), page)


def _with_classes(markdown: str) -> str:
    """Give tables of keys, options and effects the class by which `site.css` lays them out."""
    for first, name in _TABLE_CLASSES:
        markdown = re.sub(rf"^\| {first} \|", f"{{.{name}}}\n\\g<0>", markdown, flags=re.MULTILINE)
    return markdown


def verbs() -> dict[str, Any]:
    """Return every command by its words, such as ``bench check``."""
    found = {}
    for name, command in typer.main.get_command(app).commands.items():
        if hasattr(command, "commands"):
            found |= {f"{name} {below}": verb for below, verb in command.commands.items()}
        else:
            found[name] = command
    return found


def command_line() -> str:
    """Return a section for every command, with its arguments and options."""
    return "\n\n".join(_verb(words, command) for words, command in verbs().items())


def _verb(words: str, command: Any) -> str:
    rows = []
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            name, least = parameter.metavar or parameter.name.upper(), "required"
            least = "required" if parameter.required else _shown(parameter.default)
        else:
            name = ", ".join([*parameter.opts, *parameter.secondary_opts])
            least = _shown(parameter.default)
            if parameter.metavar:
                name += f" {parameter.metavar}"
        help_text = " ".join((parameter.help or "").split()).replace("|", "\\|")
        name = name.replace("|", "\\|")
        rows.append(f"| `{name}` | {least} | {help_text} |")
    title = f"## `acquire {words}`"
    table = "\n".join(["| option | if left out | meaning |", "|---|---|---|", *rows])
    return f"{title}\n\n{' '.join(command.help.split())}\n\n{table}"


def _shown(default: Any) -> str:
    nothing = default in (None, "") or isinstance(default, bool) or callable(default)
    return "" if nothing else f"`{default}`"


def effects() -> str:
    """Return the table of `acquire effects`."""
    table = effects_table(CATALOGUE)
    rows = [[column.title for column in table.columns], ["---"] * len(table.columns)]
    rows += [[f"`{row[0]}`", *map(str, row[1:])] for row in table.rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', ' ') for cell in row)} |" for row in rows)


def effects_without_size() -> str:
    """Return a sentence about the effects that the table of detectability does not have."""
    page = (ROOT / "docs/explanation/detectability.md").read_text("utf-8")
    measured = set(re.findall(r"^\| (\w+) \|", page, re.MULTILINE))
    missing = ", ".join(f"`{effect.id}`" for effect in CATALOGUE if effect.id not in measured)
    return f"Not in this table, because the study did not try it: {missing or 'none'}."


def disorder() -> str:
    """Return a table of all kinds of disorder."""
    rows = [
        "| disorder | unit | ordinary | limits | meaning | source |",
        "|---|---|---|---|---|---|",
    ]
    for kind in DISORDER:
        ordinary, (low, high) = kind.ordinary, kind.limits
        cells = (
            f"`{kind.name}`",
            f"`{ordinary.unit}`" if ordinary.unit else "",
            f"{ordinary.low:g} to {ordinary.high:g}",
            f"{low:g} to {high:g}",
            kind.meaning,
            ordinary.source,
        )
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def decisions() -> str:
    """Return a table of all decision records with status and date."""
    rows = ["| record | status | date |", "|---|---|---|"]
    for path in sorted((ROOT / "docs/decisions").glob("0*.md")):
        text = path.read_text("utf-8")
        title = re.search(r"^# (.*)", text)
        status = re.search(r"^\*\*Status\.\*\* (.*), (\d{4}-\d\d-\d\d)\.$", text, re.MULTILINE)
        if title is None or status is None:
            raise ValueError(f"{path.name}: needs a title and a line **Status.** WORD, DATE.")
        date = status[2].replace("-", "\N{NON-BREAKING HYPHEN}")
        rows.append(f"| [{title[1]}]({path.name}) | {status[1]} | {date} |")
    return "\n".join(rows)


def file_keys(name: str) -> str:
    """Return a table of all keys of one kind of file."""
    (table,) = (each for each in tables() if each.name == name)
    return _key_table(table)


def driver_keys() -> str:
    """Return a section with a table for every driver that has options."""
    files = ("protocol", "bench", "reed", "campaign")
    return "\n\n".join(
        f"### {table.title}\n\n{table.description}\n\n{_key_table(table)}"
        for table in tables()
        if table.name not in files
    )


def _key_table(table: Table) -> str:
    rows = [_key_row(key) for key in table.keys]
    return "\n".join(["| key | value | if left out | meaning |", "|---|---|---|---|", *rows])


def _key_row(key: Key) -> str:
    value = ", ".join(word for word in (key.kind, key.allowed) if word)
    if key.unit:
        value = f"{value} (`{key.unit}`)"
    default = key.default.strip('"')
    meaning = f"With `{key.when}`. {key.description}" if key.when else key.description
    least = {"required": "**required**", "none": "", "optional": ""}.get(key.default)
    cells = (f"`{key.path}`", value, f"`{default}`" if least is None else least, meaning)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


PARTS: dict[str, Callable[[], str]] = {
    "verbs": command_line,
    "effects": effects,
    "effects-without-size": effects_without_size,
    "disorder": disorder,
    "decisions": decisions,
    "driver-keys": driver_keys,
    **{
        f"{name}-keys": partial(file_keys, name)
        for name in ("protocol", "campaign", "bench", "reed")
    },
}
