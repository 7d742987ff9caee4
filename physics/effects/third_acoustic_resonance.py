"""One more acoustic resonance that the bench file does not list, where there is one already."""

from dataclasses import replace
from functools import partial

from physics.effects.second_acoustic_resonance import EFFECT as SECOND
from physics.effects.second_acoustic_resonance import with_unlisted

EFFECT = replace(
    SECOND,
    id="third_acoustic_resonance",
    title="another unlisted acoustic resonance",
    change=partial(with_unlisted, "third_resonance"),
    after=SECOND.id,
)
