"""AOM synthesizers whose frequency difference drifts."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage, Tap

EFFECT = Effect(
    id="synthesizer_drift",
    title="synthesizers drift apart",
    stage=Stage.TIMING,
    position=3,
    parameters=(Parameter("rate", "Hz/h", 0.15, "oscillators that warm up"),),
    change=additive("clocks", detuning_hz_h="rate"),
    moves=frozenset({Tap.HOLOGRAM}),
    keeps=frozenset({Tap.SENSOR, Tap.MODES}),
    neighbours=("synthesizer_detuning",),
    action="wait until they are warm",
    reference="data sheets of quartz oscillators",
)
