"""A vamp whose thickness grows towards the heel faster than in the drawing."""

from physics.alterations import Layer
from physics.effects.changes import altered
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="thickness_wedge",
    title="vamp is thicker towards the heel",
    stage=Stage.MECHANICS,
    position=6,
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
    change=altered(Layer(1, 0), "thickness"),
    reference="paper, section III.A",
)
