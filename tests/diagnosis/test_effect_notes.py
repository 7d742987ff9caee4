"""A diagnosis knows what to check for each effect, also for one without notes of its own."""

import pytest

from diagnosis.effect_notes import NOTES, notes_of
from diagnosis.observable_groups import Observable
from physics.effects.catalogue import BY_ID, CATALOGUE
from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage


def test_notes_are_on_effects_of_the_catalogue() -> None:
    assert set(NOTES) <= set(BY_ID)


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.id)
def test_each_effect_has_a_check_and_leaves_something_alone(effect: Effect) -> None:
    notes = notes_of(effect)
    assert notes.check
    assert notes.unaffected
    assert notes.unaffected < set(Observable)
    assert set(notes.similar) <= set(BY_ID) - {effect.id}


def test_an_effect_without_notes_has_those_of_the_part_that_it_changes() -> None:
    new = Effect(
        id="new",
        title="new",
        stage=Stage.OPTICS,
        parameters=(Parameter("distance", "m", 0.05, "toy"),),
        change=additive("optics.layout", defocus_m="distance"),
        reference="toy",
    )
    notes = notes_of(new)
    assert notes.unaffected == notes_of(BY_ID["defocus"]).unaffected
    assert notes.check
    assert not notes.similar
