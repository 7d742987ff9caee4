"""A clamp whose strips rest on elastic beds."""

from physics.alterations import YieldingClamp
from physics.effects.changes import altered
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="clamp_compliance",
    title="clamp is compliant",
    stage=Stage.MECHANICS,
    position=10,
    parameters=(
        Parameter(
            "compliance",
            "m/Pa",
            2e-13,
            "0.5 mm of hard plastic, 2.5 GPa, under each strip; at most: 0.2 mm of rubber, 50 MPa",
            positive=True,
            most=4e-12,
        ),
    ),
    change=altered(YieldingClamp(), "compliance"),
    reference="paper, section III: strips hold the reed fast",
)
