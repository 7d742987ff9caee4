"""An amplifier whose gain falls towards the end of the band."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="amplifier_rolloff",
    title="amplifier rolls off at high frequency",
    stage=Stage.DRIVE,
    position=1,
    parameters=(
        Parameter(
            "inverse_corner",
            "",
            0.7,
            "10 kHz divided by the corner frequency; audio amplifiers reach 20 to "
            "100 kHz; at most: amplifiers for speech end at 5 kHz",
            positive=True,
            most=2.0,
        ),
    ),
    change=additive("drive", roll_off="inverse_corner"),
    reference="Butterworth, On the theory of filter amplifiers, 1930",
)
