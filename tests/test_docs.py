"""What the documentation names exists: files, modules, commands, options, functions, counts."""

import importlib.util
import json
import pkgutil
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer
import yaml

from acquire.cli.main import app
from physics.effects.catalogue import CATALOGUE

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    path.relative_to(ROOT)
    for path in [
        *ROOT.glob("*.md"),
        *(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts),
    ]
)
SOURCES = sorted(
    path.relative_to(ROOT)
    for folder in ROOT.iterdir()
    if (folder / "__init__.py").exists()
    for path in folder.rglob("*.py")
)


@pytest.fixture(scope="module")
def generators():
    """The modules that generate parts of pages."""
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        import generated
        import reference_keys

        yield {"generated": generated, "reference_keys": reference_keys}
    finally:
        sys.path.remove(str(ROOT / "docs"))


def blocks(text, language):
    """Return the fenced code blocks of a language, without their common indentation."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^\1```$", text, re.MULTILINE | re.DOTALL)
    return [re.sub(rf"^{indent}", "", code, flags=re.MULTILINE) for indent, code in found]


def commands_of(text):
    """Return the ``acquire`` commands of a page: in terminal blocks, and between backticks."""
    lines = [line for block in blocks(text, "console") for line in block.splitlines()]
    lines += re.findall(r"^    (acquire [^\n#]*)", text, re.MULTILINE)
    inline = re.findall(r"`((?:taskset -c \S+ )?acquire [a-z][^`]*)`", text)
    typed = [line.removeprefix("$ ") for line in lines if line.startswith(("$ ", "acquire "))]
    found = [part.strip() for line in typed + inline for part in re.split(r";|>", line)]
    return [line[line.index("acquire ") :] for line in found if "acquire " in line]


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_files_that_a_page_names_exist(page):
    text = (ROOT / page).read_text("utf-8")
    named = re.findall(r"`((?:[a-z_]+/)+(?:[a-zA-Z_]+\.(?:py|yaml))?)(?:::\w+)?`", text)
    linked = re.findall(r"\]\(([^)#:]+?)(?:#[^)]*)?\)", text)
    # NAME stands for a file of the reader.
    named = [name for name in named if "NAME" not in name]
    missing = [name for name in named if not (ROOT / name).exists()]
    missing += [name for name in linked if not (ROOT / page).parent.joinpath(name).exists()]
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_modules_that_a_page_names_exist(page):
    text = (ROOT / page).read_text("utf-8")
    modules = set(re.findall(r"python -m ((?:benchmarks|studies|blind)[\w.]*)", text))
    packages = "acquire|diagnosis|drivers|fitting|holography|physics|protocols|reports|runs"
    modules |= set(re.findall(rf"^\.\. automodule:: ((?:{packages})[\w.]+)", text, re.MULTILINE))
    assert [name for name in sorted(modules) if importlib.util.find_spec(name) is None] == []


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_names_that_a_page_gives_in_a_module_exist(page):
    """Names between backticks such as ``fitting.modal.optimiser`` or ``runs.disk.DiskFile``."""
    text = (ROOT / page).read_text("utf-8")
    packages = "acquire|diagnosis|drivers|fitting|holography|physics|protocols|reports|runs"
    missing = []
    for name in re.findall(rf"`((?:{packages})\.[a-z_]\w*(?:\.\w+)*)`", text):
        if name.rpartition(".")[2] in ("yaml", "py", "md", "html"):
            continue
        try:
            pkgutil.resolve_name(name)
        except (ImportError, AttributeError):
            missing.append(name)
    assert missing == []


def test_pages_that_the_code_names_exist():
    missing = {
        f"{path}: {name}"
        for path in SOURCES
        for name in re.findall(r"\bdocs/[\w/-]+\.\w+", (ROOT / path).read_text("utf-8"))
        if not (ROOT / name).exists() and "_build" not in name
    }
    assert missing == set()


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_commands_and_options_that_a_page_names_exist(page):
    groups = {"": typer.main.get_command(app)}
    wrong = []
    for line in commands_of((ROOT / page).read_text("utf-8")):
        words = [re.sub(r"[\[\]…]", "", word) for word in shlex.split(line.replace("'", ""))]
        command = groups[""]
        rest = words[1:]
        while hasattr(command, "commands") and rest and not rest[0].startswith("-"):
            if rest[0] not in command.commands:
                wrong.append(line)
                break
            command, rest = command.commands[rest[0]], rest[1:]
        else:
            options = {each for p in command.params for each in (*p.opts, *p.secondary_opts)}
            given = {word for word in rest if re.fullmatch(r"--[a-z].*", word)}
            if not given <= options | {"--help"}:
                wrong.append(line)
    # Words that stand for any command.
    assert [line for line in wrong if "COMMAND" not in line] == []


def test_commands_are_found_in_pages():
    """A test of no commands would always pass."""
    counts = [len(commands_of((ROOT / page).read_text("utf-8"))) for page in PAGES]
    assert sum(counts) > 80


def test_the_table_of_packages_is_that_of_the_import_contract():
    text = (ROOT / "docs/explanation/architecture.md").read_text("utf-8")
    table = re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    assert table == layers[::-1]


@pytest.mark.slow
def test_counts_on_the_page_of_the_paper_are_those_of_the_comparison():
    text = (ROOT / "docs/explanation/paper.md").read_text("utf-8")
    words = (
        r"(\d+) are reproduced, (\d+) differ and (\d+) are refuted; (\d+) printed numbers cannot"
    )
    (said,) = re.findall(rf"Of (\d+) comparisons {words}", text)
    asked = [sys.executable, "-m", "acquire", "paper", "--json"]
    counts = json.loads(subprocess.run(asked, capture_output=True, check=True).stdout)["counts"]
    verdicts = ("reproduced", "differs", "refuted", "not reproducible")
    assert [int(number) for number in said[1:]] == [counts[verdict] for verdict in verdicts]
    assert int(said[0]) == sum(counts[verdict] for verdict in verdicts[:3])


def test_detectability_has_a_row_or_a_word_for_every_effect(generators):
    text = (ROOT / "docs/explanation/detectability.md").read_text("utf-8")
    table = re.findall(r"^\| (\w+) \| \S", text, re.MULTILINE)[1:]
    named = re.findall(r"`(\w+)`", generators["generated"].effects_without_size())
    assert len(table) >= 40
    assert sorted([*table, *named]) == sorted(effect.id for effect in CATALOGUE)


def test_every_key_of_the_shipped_files_is_in_the_reference(generators):
    tables = {table.name: table for table in generators["reference_keys"].tables()}
    for kind, folder in (("protocol", "."), ("bench", "benches"), ("reed", "reeds")):
        known = {key.path for key in tables[kind].keys}
        for path in (ROOT / "protocols" / folder).glob("*.yaml"):
            content = yaml.safe_load(path.read_text("utf-8"))
            if "parts" not in content:
                assert {key.partition(".")[0] for key in content} <= known, path


def test_every_marker_of_a_page_is_generated(generators):
    parts = generators["generated"].PARTS
    used = set()
    for page in PAGES:
        used |= set(re.findall(r"<!-- generated: ([a-z-]+) -->", (ROOT / page).read_text("utf-8")))
    # CONTRIBUTING and a decision record explain markers by one of these.
    assert used == set(parts)
    # One sentence, which a test of its own reads.
    for name in set(parts) - {"effects-without-size"}:
        assert parts[name]().count("\n") > 3


def test_every_option_has_a_meaning(generators):
    for words, verb in generators["generated"].verbs().items():
        assert verb.help, words
        for parameter in verb.params:
            assert parameter.help, f"{words} {parameter.name}"


def test_decision_records_have_a_number_a_status_and_a_date(generators):
    table = generators["generated"].decisions()
    numbers = [int(number) for number in re.findall(r"^\| \[(\d{4}) ", table, re.MULTILINE)]
    assert numbers == list(range(1, len(numbers) + 1))
    for path in (ROOT / "docs/decisions").glob("0*.md"):
        assert path.read_text("utf-8").startswith(f"# {path.name[:4]} ")


def test_a_term_is_defined_once():
    text = (ROOT / "docs/glossary.md").read_text("utf-8")
    terms = re.findall(r"^\| (?!term |--)([^|]+?) \|", text, re.MULTILINE)
    assert len(terms) == len(set(terms)) > 35


def test_continuous_integration_runs_targets_that_exist():
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text("utf-8"))
    makefile = (ROOT / "Makefile").read_text("utf-8")
    targets = set()
    for job in workflow["jobs"].values():
        assert job["runs-on"]
        for step in job["steps"]:
            assert len({"uses", "run"} & set(step)) == 1
            targets |= set(re.findall(r"^make ([a-z-]+)", step.get("run", "")))
    assert targets == {"test", "run", "docs", "test-all"}
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)
    matrix = workflow["jobs"]["test"]["strategy"]["matrix"]
    assert matrix["python"] == ["3.11", "3.12", "3.13", "3.14"]
    assert [system.partition("-")[0] for system in matrix["system"]] == [
        "ubuntu",
        "macos",
        "windows",
    ]
