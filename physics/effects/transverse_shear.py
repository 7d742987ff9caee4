"""Shear moduli through the thickness that differ from the reference material's."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="transverse_shear",
    title="shear moduli through the thickness differ",
    stage=Stage.MECHANICS,
    position=4,
    parameters=(
        Parameter(
            "G_LR",
            "",
            0.3,
            "spread of shear moduli of hardwoods and cane; at most: all species "
            "in the Wood Handbook",
            most=1.0,
        ),
        Parameter(
            "G_TR",
            "",
            0.3,
            "spread of shear moduli of hardwoods and cane; at most: all species "
            "in the Wood Handbook",
            most=1.0,
        ),
    ),
    change=additive("reed.shift", G_LR="G_LR", G_TR="G_TR"),
    reference="paper, Table 3",
)
