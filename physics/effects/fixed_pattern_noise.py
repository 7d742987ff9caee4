"""Pixels whose sensitivity differs more than usual."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage, Tap

EFFECT = Effect(
    id="fixed_pattern_noise",
    title="pixel sensitivity varies",
    stage=Stage.CAMERA,
    position=1,
    parameters=(Parameter("rms", "", 0.03, "old sensors, dust", positive=True),),
    change=additive("sensor", pattern="rms"),
    moves=frozenset({Tap.SENSOR}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("read_noise",),
    action="frames of even light",
    reference="photon transfer",
)
