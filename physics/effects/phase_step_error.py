"""Phase steps between frames that alternate around a quarter turn."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="phase_step_error",
    title="phase steps are unequal",
    stage=Stage.OPTICS,
    position=5,
    parameters=(
        Parameter(
            "error",
            "rad",
            0.15,
            "a tenth of a quarter turn; at most: a third of a quarter turn",
            most=0.6,
        ),
    ),
    change=additive("optics.interference", quarter_error_rad="error"),
    reference="phase-shifting holography",
)
