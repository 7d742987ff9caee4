"""A small mass, such as moisture or wax, on the last 2 mm of the tip."""

from physics.alterations import TipMass
from physics.effects.changes import altered
from physics.effects.effect import Effect, Parameter, Stage

EFFECT = Effect(
    id="tip_mass",
    title="mass on the tip",
    stage=Stage.MECHANICS,
    position=9,
    parameters=(
        Parameter(
            "mass",
            "kg",
            0.5e-6,
            "a drop of 1 mm diameter weighs 0.5 mg; at most: a drop of 2 mm",
            positive=True,
            most=5e-06,
        ),
    ),
    change=altered(TipMass(), "mass"),
    reference="Rayleigh, Theory of Sound, section 91",
)
