"""A camera that reads low where it is bright."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "sensor", nonlinearity=values["fraction"])


EFFECT = Effect(
    id="sensor_nonlinearity",
    title="camera bends",
    stage=Stage.CAMERA,
    parameters=(
        Parameter("fraction", "", 0.1, "anti-blooming, a well that is nearly full", positive=True),
    ),
    change=_change,
    moves=frozenset({Tap.SENSOR}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=(),
    action="flat frames at several exposures",
    reference="photon transfer",
)
