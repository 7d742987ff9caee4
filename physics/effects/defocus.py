"""Images focused at a distance where the reed is not."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="defocus",
    title="image is out of focus",
    stage=Stage.OPTICS,
    position=6,
    parameters=(
        Parameter(
            "distance",
            "m",
            0.05,
            "distances are measured with a ruler, and reeds are put back by hand; "
            "at most: further off, the reed cannot be recognised",
            most=0.2,
        ),
    ),
    change=additive("optics.layout", defocus_m="distance"),
    reference="holography by Fresnel transform",
)
