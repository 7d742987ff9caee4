"""Clay that does not cover its half of the mouthpiece."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "drive", open_right=values["fraction"])


EFFECT = Effect(
    id="chamber_leakage",
    title="covered half of the chamber is driven too",
    stage=Stage.ACOUSTICS,
    parameters=(Parameter("fraction", "", 0.3, "clay that is pressed in by hand", positive=True),),
    change=_change,
    moves=frozenset({Tap.RESPONSE}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.FIELD, Tap.MODES}),
    neighbours=("thickness_tilt",),
    action="take the clay out",
    reference="paper, section II: asymmetric excitation",
)
