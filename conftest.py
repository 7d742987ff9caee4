"""Fixtures of all tests; doctests of the README write files, each in a folder of its own."""

import pytest

_WHOLE_SWEEPS = {"README.md", "script-in-python.md"}

pytest_plugins = ["tests.fixtures.benches", "tests.fixtures.sweeps"]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(request, tmp_path, monkeypatch):
    if isinstance(request.node, pytest.DoctestItem):
        monkeypatch.chdir(tmp_path)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the examples that measure a whole sweep as slow, and keep the tests of a file together.

    Tests of a file share fixtures: one worker runs them all, unless they name groups of their own.
    """
    for item in items:
        if isinstance(item, pytest.DoctestItem) and item.path.name in _WHOLE_SWEEPS:
            item.add_marker(pytest.mark.slow)
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(str(item.path)))
