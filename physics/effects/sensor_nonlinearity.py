"""A sensor that reads low where the image is bright."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="sensor_nonlinearity",
    title="sensor response is nonlinear",
    stage=Stage.CAMERA,
    position=4,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.1,
            "anti-blooming; a well that is nearly full; at most: anti-blooming "
            "that begins at half of the well",
            positive=True,
            most=0.4,
        ),
    ),
    change=additive("sensor", nonlinearity="fraction"),
    reference="photon transfer",
)
