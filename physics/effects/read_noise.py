"""A camera that reads with more noise than its data sheet says."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "sensor", read_factor=values["log_factor"])


EFFECT = Effect(
    id="read_noise",
    title="read noise",
    stage=Stage.CAMERA,
    parameters=(Parameter("log_factor", "", 0.5, "pick-up, warm electronics", positive=True),),
    change=_change,
    moves=frozenset({Tap.SENSOR}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("fixed_pattern_noise",),
    action="dark frames",
    reference="photon transfer",
)
