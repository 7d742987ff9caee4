"""Sizes of effects in words."""

from types import SimpleNamespace

from diagnosis.inference.problem import LocatedEffect
from physics.effects.catalogue import BY_ID
from reports.effects import size_words

LINE, AIR = BY_ID["second_acoustic_resonance"], BY_ID["air_load"]
AT = {"hz": 5206.1, "quality": 18.0, "phase": 0.0}


def candidate(*effects):
    """A candidate all sizes of which are 0.5 ± 0.1 times their scale."""
    located = tuple(LocatedEffect(each, AT if each is LINE else {}) for each in effects)
    sizes = {each.id: [(p, 0.5, 0.1) for p in each.sizes] for each in effects}
    return SimpleNamespace(effects=located, size_estimates=sizes)


def test_where_an_effect_acts_is_said_with_its_sizes():
    said = size_words(candidate(LINE)).split("; ")
    assert [each.split()[0] for each in said] == [p.name for p in (*LINE.sizes, *LINE.gridded)]
    assert "strength 0.5 ± 0.1" in said
    assert "hz 5206 Hz" in said
    assert "quality 18" in said
    assert "phase 0 rad" in said


def test_second_sizes_can_be_left_out():
    short = size_words(candidate(LINE), strengths_only=True)
    assert short == "strength 0.5 ± 0.1; hz 5206 Hz; quality 18; phase 0 rad"


def test_of_two_effects_each_has_its_title():
    both = size_words(candidate(AIR, LINE), strengths_only=True)
    assert both.startswith(f"{AIR.title}: ")
    assert f"; {LINE.title}: strength" in both
    assert size_words(None) == ""
