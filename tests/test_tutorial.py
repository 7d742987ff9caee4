"""The tutorial works as it is written: its files, its changes, and its commands in their order."""

import json
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.test_docs import blocks

ROOT = Path(__file__).parents[1]
# What the tutorial says comes out of each command, as keys of its JSON.
_WITH_JSON = ("plan", "run", "modes", "show", "list", "diagnose")


@dataclass
class Shell:
    """A terminal in the folder of a newcomer."""

    folder: Path

    def answer(self, line):
        """Run one command of the tutorial; return its JSON, or None if it prints none."""
        words = shlex.split(line)
        if words[0] == "acquire":
            asked = ["--json"] if words[1] in _WITH_JSON else []
            words = [sys.executable, "-m", "acquire", *words[1:], *asked]
        done = subprocess.run(
            words, cwd=self.folder, capture_output=True, text=True, check=False, timeout=1500
        )
        assert done.returncode == 0, f"{line}\n{done.stderr}"
        return json.loads(done.stdout) if "--json" in words else None


def change(path, diff):
    """Apply a block of the tutorial that shows lines to replace."""
    text = path.read_text("utf-8")
    lines = diff.splitlines()[2:]
    old = "".join(f"{line[1:]}\n" for line in lines if line.startswith("-"))
    new = "".join(f"{line[1:]}\n" for line in lines if line.startswith("+"))
    # Lines stand one by one in a file: each removed line goes, its successor takes its place.
    removed, added = old.splitlines(), new.splitlines()
    assert all(text.splitlines().count(line) == 1 for line in removed), path
    for line, replacement in zip(removed, added, strict=False):
        text = text.replace(f"{line}\n", f"{replacement}\n")
    last = added[len(removed) - 1]
    more = "".join(f"{line}\n" for line in added[len(removed) :])
    path.write_text(text.replace(f"{last}\n", f"{last}\n{more}"), "utf-8")


@pytest.mark.slow
def test_the_tutorial_works_as_it_is_written(tmp_path):
    page = (ROOT / "docs/tutorial.md").read_text("utf-8")
    # Its folder is in the checkout, from which it copies shipped files.
    shell = Shell(tmp_path / "my-lab")
    shell.folder.mkdir()
    (tmp_path / "protocols").symlink_to(ROOT / "protocols")
    answers = {}
    for block in re.finditer(r"^```(\w+)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL):
        language, text = block[1], block[2]
        if language == "yaml":
            (shell.folder / text.split()[1]).write_text(text, "utf-8")
        elif language == "diff":
            change(shell.folder / text.split()[1], text)
        else:
            for line in text.splitlines():
                command = line.removeprefix("$ ")
                # Set-up of the newcomer's environment; `make run` has a job of its own.
                if command.startswith(("acquire ", "cp ")) and "../measurements" not in command:
                    answers[command] = shell.answer(command)
    assert len(blocks(page, "yaml")) == 2
    plan = answers["acquire plan my-protocol.yaml"]
    assert (len(plan["steps"]), plan["violations"]) == (139, [])
    assert answers["acquire show first.h5"]["verdicts"] == {"ok": 139}

    thin, thick = (
        {mode["name"]: mode["hz"] for mode in answers[f"acquire modes {reed} --mesh fast"]["modes"]}
        for reed in ("clarinet", "my-reed.yaml")
    )
    assert all(thick[name] > thin[name] for name in ("F2", "T2", "T3", "F3"))
    assert thick["F1"] < thin["F1"]

    first, second = (
        answers[f"acquire run my-protocol.yaml --reed R12 --out {name}.h5"]["fit"]["modes"]
        for name in ("first", "second")
    )
    assert {"F1", "T1", "F2", "T2", "X1", "T3", "F3"} <= set(first)
    assert all(second[name]["hz"] > first[name]["hz"] for name in ("T2", "T3", "F3"))
    assert second["F1"]["hz"] < first["F1"]["hz"]

    diagnosis = answers["acquire diagnose campaign --out diagnosis.html"]
    assert diagnosis["verdict"] == "effect"
    assert diagnosis["effects_named"] == ["synthesizer_detuning"]
    assert diagnosis["gap"]["first_failing_observable"] == "hologram"
    assert diagnosis["probability"]["synthesizer_detuning"] > 0.5
    offset = diagnosis["effects"]["synthesizer_detuning"]["sizes"]["offset"]
    assert abs(offset["value"] - 0.1) < 4 * offset["error"] < 0.05
    assert (shell.folder / "diagnosis.html").stat().st_size > 10_000
