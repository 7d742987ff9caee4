"""More air that moves along with the reed than with a free plate, as its mouthpiece guides it."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="air_load",
    title="more air moves along than with a free plate",
    stage=Stage.ACOUSTICS,
    position=0,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.5,
            "a plate in a wide wall moves twice the air of a free plate; a "
            "mouthpiece is between; at most: a narrow gap between reed and wall "
            "moves three times as much",
            positive=True,
            most=2.0,
        ),
    ),
    change=additive("reed", air_share="fraction"),
    reference="Rayleigh, Theory of Sound, section 302",
)
