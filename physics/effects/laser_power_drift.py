"""A laser whose power drifts, so that both beams get weaker together."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage, Tap

EFFECT = Effect(
    id="laser_power_drift",
    title="laser power drifts",
    stage=Stage.OPTICS,
    position=0,
    parameters=(Parameter("loss_rate", "1/h", 0.4, "diode lasers that warm up"),),
    change=additive("optics", fade_per_h="loss_rate"),
    moves=frozenset({Tap.SENSOR, Tap.FIELD}),
    keeps=frozenset({Tap.LOG, Tap.MODES}),
    neighbours=("laser_mode_hop",),
    action="a photodiode next to the bench",
    reference="data sheets of diode lasers",
)
