"""Pixels whose sensitivity differs more than usual."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="fixed_pattern_noise",
    title="pixel sensitivity varies",
    stage=Stage.CAMERA,
    position=1,
    parameters=(
        Parameter(
            "rms",
            "",
            0.03,
            "old sensors, dust; at most: dirt that the eye sees on every frame",
            positive=True,
            most=0.2,
        ),
    ),
    change=additive("sensor", pattern="rms"),
    reference="photon transfer",
)
