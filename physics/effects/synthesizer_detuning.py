"""AOM synthesizers whose frequency difference is not the commanded one."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="synthesizer_detuning",
    title="synthesizers are detuned",
    stage=Stage.TIMING,
    position=1,
    parameters=(
        Parameter(
            "offset",
            "Hz",
            0.03,
            "one step of a 32-bit synthesizer at 80 MHz is 0.02 to 0.1 Hz; at "
            "most: a tenth of the frame rate: more loses the lock",
            most=1.0,
        ),
    ),
    change=additive("clocks", detuning_hz="offset"),
    reference="paper, equation 3",
)
