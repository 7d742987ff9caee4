"""All effects are in one form, and none of any is the nominal twin, bit for bit."""

from pathlib import Path

import pytest

import physics.effects
from physics.effects.catalogue import BY_ID, CATALOGUE
from physics.effects.form import Effect
from physics.twin import Twin

FOLDER = Path(physics.effects.__file__).parent
NOT_EFFECTS = {"__init__", "form", "catalogue"}
each = pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.id)


def values(effect: Effect, size: float) -> dict[str, float]:
    return {p.name: p.places[0] if p.places else size * p.spread for p in effect.parameters}


def test_every_file_is_in_the_catalogue() -> None:
    files = {path.stem for path in FOLDER.glob("*.py")} - NOT_EFFECTS
    assert files == set(BY_ID)
    assert len(CATALOGUE) >= 30


@each
def test_none_of_an_effect_is_the_nominal_twin(effect: Effect) -> None:
    assert effect.change(Twin(), values(effect, 0.0)) == Twin()


@each
def test_an_effect_changes_the_twin(effect: Effect) -> None:
    changed = effect.change(Twin(), values(effect, 1.0))
    assert changed != Twin()
    assert hash(changed) is not None


@each
def test_effects_say_what_they_must(effect: Effect) -> None:
    assert effect.moves
    assert effect.keeps
    assert not effect.moves & effect.keeps
    assert effect.action
    assert effect.reference
    assert set(effect.neighbours) <= set(BY_ID) - {effect.id}
    for parameter in effect.parameters:
        assert parameter.source
        assert parameter.places or parameter.spread > 0
    assert effect.sizes, "an effect has a size"
