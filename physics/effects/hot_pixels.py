"""Pixels that fill up in the dark."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "sensor", hot=values["fraction"])


EFFECT = Effect(
    id="hot_pixels",
    title="hot pixels",
    stage=Stage.CAMERA,
    parameters=(Parameter("fraction", "", 0.005, "sensors that are not cooled", positive=True),),
    change=_change,
    moves=frozenset({Tap.SENSOR}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("fixed_pattern_noise",),
    action="dark frames",
    reference="data sheets of CCD cameras",
)
