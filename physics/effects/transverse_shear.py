"""Shear moduli through the thickness that are not those of the reference material."""

from collections.abc import Mapping

from physics.effects.form import (
    Effect,
    Parameter,
    Stage,
    Tap,
)
from physics.twin import Twin, with_cane


def _change(twin: Twin, values: Mapping[str, float]) -> Twin:
    return with_cane(twin, G_LR=values["G_LR"], G_TR=values["G_TR"])


EFFECT = Effect(
    id="transverse_shear",
    title="shear moduli through the thickness",
    stage=Stage.MECHANICS,
    parameters=(
        Parameter("G_LR", "", 0.3, "spread of shear moduli of hardwoods and cane"),
        Parameter("G_TR", "", 0.3, "spread of shear moduli of hardwoods and cane"),
    ),
    change=_change,
    moves=frozenset({Tap.MODES}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.HOLOGRAM, Tap.FIELD}),
    neighbours=("clamp_compliance",),
    action="measure a short thick strip",
    reference="paper, Table 3",
)
