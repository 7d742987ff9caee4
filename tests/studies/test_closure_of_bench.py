"""Effects of the bench around the reed: what it renders, fitted, is what is predicted."""

import pytest

from physics.effects.effect import Stage
from tests.studies.fitted_closures import effects_at, worst_of_open_groups

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", effects_at(*(set(Stage) - {Stage.MECHANICS})))
def test_effects_of_the_bench_close(name, tmp_path_factory) -> None:
    folder = tmp_path_factory.getbasetemp() / "closure"
    assert worst_of_open_groups(name, folder) == {}
