"""A camera with more read noise than its data sheet states."""

from physics.effects.changes import changed
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="read_noise",
    title="read noise exceeds the data sheet",
    stage=Stage.CAMERA,
    position=3,
    parameters=(
        Parameter(
            "log_factor",
            "",
            0.5,
            "pick-up, warm electronics; at most: seven times the data sheet; more "
            "hides the fringes",
            positive=True,
            most=2.0,
        ),
    ),
    change=changed("sensor", scale={"read_noise_e": "log_factor"}),
    reference="photon transfer",
)
