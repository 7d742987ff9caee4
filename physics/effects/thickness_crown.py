"""A vamp whose sides are thicker, and its middle thinner, than the drawing's."""

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
    return with_alteration(twin, Layer(0, 2), values["thickness"])


EFFECT = Effect(
    id="thickness_crown",
    title="vamp thicker at its sides",
    stage=Stage.MECHANICS,
    parameters=(Parameter("thickness", "m", 10e-6, "paper, section III.A: thickness to 10 µm"),),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("transverse_modulus",),
    action="measure the thickness of the vamp",
    reference="paper, section III.A",
)
