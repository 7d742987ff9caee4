"""Effects of the reed: what the bench renders, fitted, is what is predicted."""

import pytest

from physics.effects.effect import Stage
from tests.studies.fitted_closures import effects_at, worst_of_open_groups

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", effects_at(Stage.MECHANICS))
def test_effects_of_the_reed_close(name, tmp_path_factory) -> None:
    folder = tmp_path_factory.getbasetemp() / "closure"
    assert worst_of_open_groups(name, folder) == {}
