"""Air that moves with the reed and adds mass, and sound that the reed radiates."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="air_load",
    title="air adds mass and radiation loss",
    stage=Stage.ACOUSTICS,
    position=0,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.7,
            "1 is free air on both sides in a baffle; a mouthpiece is neither",
            positive=True,
        ),
    ),
    change=additive("reed", air_share="fraction"),
    reference="Rayleigh, Theory of Sound, section 302",
)
