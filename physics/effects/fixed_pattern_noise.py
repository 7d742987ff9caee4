"""Pixels that are not alike."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "sensor", pattern=values["rms"])


EFFECT = Effect(
    id="fixed_pattern_noise",
    title="pattern of the sensor",
    stage=Stage.CAMERA,
    parameters=(Parameter("rms", "", 0.03, "old sensors, dust", positive=True),),
    change=_change,
    moves=frozenset({Tap.SENSOR}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("read_noise",),
    action="frames of even light",
    reference="photon transfer",
)
