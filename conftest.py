"""Fixtures of all tests; doctests of the README write files, each in a folder of its own."""

import pytest

_WHOLE_SWEEPS = {"README.md", "script-in-python.md"}

pytest_plugins = ["tests.fixtures.benches", "tests.fixtures.sweeps"]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(request, tmp_path, monkeypatch):
    if isinstance(request.node, pytest.DoctestItem):
        monkeypatch.chdir(tmp_path)


def pytest_collection_modifyitems(items):
    """Mark the examples that measure a whole sweep as slow."""
    for item in items:
        if isinstance(item, pytest.DoctestItem) and item.path.name in _WHOLE_SWEEPS:
            item.add_marker(pytest.mark.slow)
