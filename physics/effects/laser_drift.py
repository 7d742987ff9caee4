"""A laser whose power drifts: both beams get weaker together."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "beams", fade_per_h=values["fade"])


EFFECT = Effect(
    id="laser_drift",
    title="laser drifts",
    stage=Stage.OPTICS,
    parameters=(Parameter("fade", "1/h", 0.4, "diode lasers that warm up"),),
    change=_change,
    moves=frozenset({Tap.SENSOR, Tap.FIELD}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("coherence_step",),
    action="a photodiode next to the bench",
    reference="data sheets of diode lasers",
)
