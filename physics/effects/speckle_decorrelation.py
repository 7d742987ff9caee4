"""Fringes that lose contrast where the vibration amplitude is large."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="speckle_decorrelation",
    title="fringes lose contrast with amplitude",
    stage=Stage.OPTICS,
    position=2,
    parameters=(
        Parameter(
            "contrast_loss",
            "1/rad2",
            0.001,
            "speckle that changes as the surface tilts; at most: more leaves no tenth fringe",
            positive=True,
            most=0.02,
        ),
    ),
    change=additive("optics.interference", decorrelation_per_rad2="contrast_loss"),
    reference="Yamaguchi, Optica Acta 28 (1981): decorrelation by tilt",
)
