"""A vamp thicker at its sides and thinner in its middle than in the drawing."""

from physics.alterations import Layer
from physics.effects.changes import altered
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="thickness_crown",
    title="vamp is thicker at its sides",
    stage=Stage.MECHANICS,
    position=7,
    parameters=(
        Parameter(
            "thickness",
            "m",
            10e-6,
            "thickness is known to 10 µm: paper, section III.A; at most: a reed "
            "maker's whole correction",
            most=0.0001,
        ),
    ),
    change=altered(Layer(0, 2), "thickness"),
    reference="paper, section III.A",
)
