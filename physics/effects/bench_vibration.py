"""A bench that vibrates: the phase between the beams changes from frame to frame."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="bench_vibration",
    title="bench vibrates",
    stage=Stage.ENVIRONMENT,
    position=2,
    parameters=(
        Parameter(
            "jitter",
            "rad",
            0.15,
            "a tenth of a wavelength of path is 0.6 rad; at most: from 1 rad on, "
            "four frames show no fringes",
            positive=True,
            most=1.0,
        ),
    ),
    change=additive("optics.interference", jitter_rad="jitter"),
    reference="interferometry without an isolated table",
)
