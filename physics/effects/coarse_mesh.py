"""A finite-element mesh that is too coarse, and therefore too stiff."""

from physics.effects.changes import additive
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="coarse_mesh",
    title="mesh is too coarse",
    stage=Stage.NUMERICS,
    position=0,
    parameters=(
        Parameter(
            "fraction",
            "",
            1.0,
            "1 is quadratic tetrahedra of 2 mm, 1 mm at the tip; at most: twice "
            "the error of that mesh",
            most=2.0,
        ),
    ),
    change=additive("reed", coarse_share="fraction"),
    reference="paper, section IV: parabolic tetrahedra, 5927 points",
)
