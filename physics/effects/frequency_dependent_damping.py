"""Losses that grow with frequency, where the nominal model has one loss factor."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="frequency_dependent_damping",
    title="loss factor grows with frequency",
    stage=Stage.MECHANICS,
    position=1,
    parameters=(
        Parameter(
            "exponent",
            "",
            0.3,
            "loss tangents of wood from 1 to 20 kHz; at most: a dashpot: loss in "
            "proportion to frequency",
            most=1.0,
        ),
    ),
    change=additive("reed", loss_growth="exponent"),
    reference="Ono and Norimoto, loss of spruce against frequency",
)
