"""A vamp that is thicker on one side than on the other."""

from physics.alterations import Layer
from physics.effects.changes import altered
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="thickness_tilt",
    title="vamp is thicker on its left side",
    stage=Stage.MECHANICS,
    position=8,
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
    change=altered(Layer(0, 1), "thickness"),
    reference="paper, section III.A",
)
