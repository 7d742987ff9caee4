"""Pixels that fill up without light."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="hot_pixels",
    title="hot pixels",
    stage=Stage.CAMERA,
    position=2,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.005,
            "sensors that are not cooled; at most: more is no working sensor",
            positive=True,
            most=0.05,
        ),
    ),
    change=additive("sensor", hot="fraction"),
    reference="data sheets of CCD cameras",
)
