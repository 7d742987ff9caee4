"""One more acoustic resonance that the bench file does not list, where there is one already."""

from collections.abc import Mapping
from dataclasses import replace

from physics.effects.second_acoustic_resonance import EFFECT as SECOND
from physics.effects.second_acoustic_resonance import unlisted_resonance
from physics.parameters.tree import BenchParameters


def _change(parameters: BenchParameters, values: Mapping[str, float]) -> BenchParameters:
    if not values["strength"]:
        return parameters
    resonance = unlisted_resonance(values)
    return replace(parameters, drive=replace(parameters.drive, third_resonance=resonance))


EFFECT = replace(
    SECOND,
    id="third_acoustic_resonance",
    title="another unlisted acoustic resonance",
    change=_change,
    after=SECOND.id,
)
