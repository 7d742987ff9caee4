"""Images focused at a distance at which the reed is not."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, more


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return more(twin, "optics", defocus_m=values["distance"])


EFFECT = Effect(
    id="defocus",
    title="out of focus",
    stage=Stage.OPTICS,
    parameters=(
        Parameter("distance", "m", 0.05, "distances measured with a ruler, and reeds put back"),
    ),
    change=_change,
    moves=frozenset({Tap.FIELD}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.MODES}),
    neighbours=(),
    action="focus again on the edges of the reed",
    reference="holography by Fresnel transform",
)
