"""The shape of the code: small folders, short files, short functions, few parameters."""

from pathlib import Path

import pytest

from studies.structure import structure

ROOT = Path(__file__).parent.parent
# An effect is one file, and there are as many as there are effects.
MANY_FILES = {"physics/effects"}


@pytest.fixture(scope="module")
def found():
    return structure(ROOT)


def test_folders_are_small(found):
    fuller = {folder: n for folder, n in found.files_per_folder.items() if n > 15}
    assert fuller.keys() <= MANY_FILES


def test_files_fit_in_a_head(found):
    assert max(found.longest_files.values()) <= 500


def test_functions_fit_on_a_screen(found):
    assert {each.place: each.lines for each in found.longest if each.lines > 60} == {}
    assert {e.place: e.parameters for e in found.most_parameters if e.parameters > 8} == {}


def test_a_long_function_is_found(tmp_path):
    (tmp_path / "physics").mkdir()
    body = "\n".join(f"    x{k} = {k}" for k in range(70))
    (tmp_path / "physics" / "long.py").write_text(f"def far(a, *, b):\n{body}\n")
    longest = structure(tmp_path).longest[0]
    assert (longest.place, longest.lines, longest.parameters) == ("physics/long.py:far", 71, 2)
