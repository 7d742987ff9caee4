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
    return more(twin, "optics", fade_per_h=values["loss_rate"])


EFFECT = Effect(
    id="laser_power_drift",
    title="laser drifts",
    stage=Stage.OPTICS,
    parameters=(Parameter("loss_rate", "1/h", 0.4, "diode lasers that warm up"),),
    change=_change,
    moves=frozenset({Tap.SENSOR, Tap.FIELD}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("laser_mode_hop",),
    action="a photodiode next to the bench",
    reference="data sheets of diode lasers",
)
