"""Cane whose moduli grow with frequency more than the nominal model assumes."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="viscoelastic_stiffening",
    title="moduli grow with frequency",
    stage=Stage.MECHANICS,
    position=0,
    parameters=(
        Parameter(
            "E_L",
            "",
            0.05,
            "paper, hypothesis H4: E_L grows as f^0.18 from 2 to 16 kHz in series "
            "A, f^0.08 in B; at most: twice what the paper found in any reed",
            positive=True,
            most=0.3,
        ),
        Parameter(
            "G_LT",
            "",
            0.08,
            "paper, hypothesis H4: G_LT grows as f^0.25 from 2 to 16 kHz in "
            "series A, f^0.24 in B; at most: more than the paper found in any "
            "reed",
            positive=True,
            most=0.3,
        ),
    ),
    change=additive("reed.shift", growth_E_L="E_L", growth_G_LT="G_LT"),
    reference="paper, section IV.B",
)
