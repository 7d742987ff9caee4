"""A laser whose power drifts, so that both beams get weaker together."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="laser_power_drift",
    title="laser power drifts",
    stage=Stage.OPTICS,
    position=0,
    parameters=(
        Parameter(
            "loss_rate",
            "1/h",
            0.4,
            "diode lasers that warm up; at most: a failing diode",
            most=2.0,
        ),
    ),
    change=additive("optics.interference", fade_per_h="loss_rate"),
    reference="data sheets of diode lasers",
)
