"""Phase steps between frames that alternate around a quarter turn."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage, Tap

EFFECT = Effect(
    id="phase_step_error",
    title="phase steps are unequal",
    stage=Stage.OPTICS,
    position=5,
    parameters=(Parameter("error", "rad", 0.15, "a tenth of a quarter turn"),),
    change=additive("optics", quarter_error_rad="error"),
    moves=frozenset({Tap.HOLOGRAM}),
    keeps=frozenset({Tap.LOG, Tap.SENSOR, Tap.MODES}),
    neighbours=("synthesizer_detuning",),
    action="order 0: steps within an acquisition and between them",
    reference="phase-shifting holography",
)
