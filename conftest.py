"""Fixtures of all tests; doctests of the README write files, each in a folder of its own."""

import pytest

pytest_plugins = ["tests.fixtures.benches", "tests.fixtures.sweeps"]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(request, tmp_path, monkeypatch):
    if isinstance(request.node, pytest.DoctestItem):
        monkeypatch.chdir(tmp_path)
