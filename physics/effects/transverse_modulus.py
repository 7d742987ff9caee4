"""A Young modulus across the grain that differs from the reference material's."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="transverse_modulus",
    title="Young modulus across the grain differs",
    stage=Stage.MECHANICS,
    position=3,
    parameters=(
        Parameter(
            "E_T",
            "",
            0.3,
            "spread of transverse moduli of cane in the literature that the paper "
            "cites; at most: all species in the Wood Handbook, from 0.04 to 0.1 "
            "of E_L",
            most=1.0,
        ),
    ),
    change=additive("reed.shift", E_T="E_T"),
    reference="paper, Table 3: modes T are sensitive to E_T",
)
