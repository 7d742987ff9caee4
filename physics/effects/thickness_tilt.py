"""A vamp that is thicker on one side than on the other."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.mechanics import Layer
from physics.twin import Twin, with_alteration


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_alteration(twin, Layer(0, 1), values["thickness"])


EFFECT = Effect(
    id="thickness_tilt",
    title="vamp thicker on its left side",
    stage=Stage.MECHANICS,
    parameters=(Parameter("thickness", "m", 10e-6, "paper, section III.A: thickness to 10 µm"),),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("clamp_asymmetry",),
    action="measure the thickness of the vamp",
    reference="paper, section III.A",
)
