"""AOM synthesizers whose frequency difference drifts."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="synthesizer_drift",
    title="synthesizers drift apart",
    stage=Stage.TIMING,
    position=3,
    parameters=(
        Parameter(
            "rate",
            "Hz/h",
            0.15,
            "oscillators that warm up; at most: crystals of two devices, 0.04 ppm per hour",
            most=3.0,
        ),
    ),
    change=additive("clocks", detuning_hz_h="rate"),
    reference="data sheets of quartz oscillators",
)
