"""A local oscillator that is not centred on the sensor."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="lo_misalignment",
    title="local oscillator is off centre",
    stage=Stage.OPTICS,
    position=7,
    parameters=(
        Parameter(
            "down",
            "m",
            0.0008,
            "chosen: a tenth of a turn of a mirror mount (80 threads per inch, a lever of 40 mm) "
            "half a metre away; at most: the radius of a beam that fills the sensor, which leaves "
            "an eighth of the light in its middle",
            most=0.015,
        ),
        Parameter(
            "right",
            "m",
            0.0008,
            "chosen: a tenth of a turn of a mirror mount (80 threads per inch, a lever of 40 mm) "
            "half a metre away; at most: the radius of a beam that fills the sensor, which leaves "
            "an eighth of the light in its middle",
            most=0.015,
        ),
    ),
    change=additive("optics.illumination", local_oscillator_shift_m=("down", "right")),
    reference="Gaussian beams",
)
