"""Clay that does not seal its half of the mouthpiece chamber."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="chamber_leakage",
    title="sound leaks into the covered half of the chamber",
    stage=Stage.ACOUSTICS,
    position=3,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.3,
            "clay that is pressed in by hand; at most: no clay",
            positive=True,
            most=1.0,
        ),
    ),
    change=additive("chamber", leak="fraction"),
    reference="paper, section II: asymmetric excitation",
)
