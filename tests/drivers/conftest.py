"""Fixtures of the drivers' tests."""

import pytest

from tests.drivers.generators import Stands


@pytest.fixture
def stands():
    """Return a function that puts a simulated generator on a wire."""
    with Stands() as stands:
        yield stands
