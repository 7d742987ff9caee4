"""A vamp that is thicker or thinner than the drawing by the same amount everywhere."""

from physics.alterations import Layer
from physics.effects.changes import altered
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="thickness_offset",
    title="vamp is thicker everywhere",
    stage=Stage.MECHANICS,
    position=5,
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
    change=altered(Layer(0, 0), "thickness"),
    reference="paper, section III.A",
)
