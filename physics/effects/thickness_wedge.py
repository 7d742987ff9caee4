"""A vamp that grows thicker along the reed faster than the drawing's."""

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
    return with_alteration(twin, Layer(1, 0), values["thickness"])


EFFECT = Effect(
    id="thickness_wedge",
    title="vamp thicker towards the heel",
    stage=Stage.MECHANICS,
    parameters=(Parameter("thickness", "m", 10e-6, "paper, section III.A: thickness to 10 µm"),),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("viscoelastic_stiffening",),
    action="measure the thickness of the vamp",
    reference="paper, section III.A",
)
