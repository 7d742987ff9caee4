"""Light of the next sideband in the hologram of every sideband."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="sideband_crosstalk",
    title="next sideband leaks into the hologram",
    stage=Stage.OPTICS,
    position=3,
    parameters=(
        Parameter(
            "fraction",
            "",
            0.08,
            "an exposure averages distant sidebands out, but not spurs of the "
            "synthesizers; at most: more is a wrong frequency",
            positive=True,
            most=0.5,
        ),
    ),
    change=additive("optics.interference", crosstalk="fraction"),
    reference="paper, section II.A",
)
